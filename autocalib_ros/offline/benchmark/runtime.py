"""Processor time and memory of a replay: `autocalib benchmark cost SOURCE`.

The figures describe one run on one machine: compare ratios, not absolute times of different runs.
"""

from __future__ import annotations

import resource
import time
from pathlib import Path

import cv2
import numpy as np

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.replay_recording import replay

FLOW_POINTS = 300
FLOW_REPEATS = 30


def measure_cost(path: Path, duration_s: float | None) -> str:
    """Replay a recording on one thread and report processor times and peak memory.

    Reports the time per frame, its ratio to plain optical flow, the time of one solution, the peak resident memory
    before and after it, and the speed of a whole replay on all cores.
    """
    whole = _replay_speed(path, duration_s)
    cv2.setNumThreads(1)
    source = open_source(path, duration_s=duration_s)
    calibrator = AutoCalibrator(Options(camera_height=8.0))
    spent: list[float] = []
    images: list[np.ndarray] = []
    for frame in source.frames():
        began = time.thread_time()
        calibrator.add_image(frame.stamp_ns, frame.image)
        spent.append(time.thread_time() - began)
        if len(images) < 2:
            images.append(frame.image)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    began = time.thread_time()
    evidence = calibrator.snapshot()
    result = solve(evidence, Options(camera_height=8.0)) if evidence is not None else None
    solution = time.thread_time() - began
    mean, bare = 1e3 * float(np.mean(spent)), 1e3 * bare_optical_flow_s(images)
    height, width = images[0].shape[:2]
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return '\n'.join(
        [
            f'{width}x{height}, {len(spent)} frames of {source.name}, one thread',
            f'processor time per frame: mean {mean:.1f} ms, 95 % of frames '
            f'below {1e3 * np.quantile(spent, 0.95):.1f} ms',
            f'plain optical flow of {FLOW_POINTS} points: {bare:.1f} ms; a frame takes {mean / bare:.1f} times as long',
            f'one solution: {solution:.1f} s of processor time ({"calibrated" if result else "refused"})',
            f'peak resident memory: {memory:.0f} MB before the solution, {after:.0f} MB after',
            whole,
        ]
    )


def _replay_speed(path: Path, duration_s: float | None) -> str:
    """Replay as `autocalib replay` does, on all cores and with all solutions; report its speed and its cost."""
    began, before = time.perf_counter(), time.process_time()
    replayed = replay(open_source(path, duration_s=duration_s), Options(camera_height=8.0))
    took_s, processor_s = time.perf_counter() - began, time.process_time() - before
    recorded_s = max(replayed.evidence.stillness.recorded_s, replayed.evidence.seconds)
    return (
        f'whole replay with decoding and {len(replayed.moments)} solutions: {recorded_s:.0f} s of recording in '
        f'{took_s:.0f} s, {recorded_s / took_s:.1f} times real time; {processor_s:.0f} s of processor time, '
        f'{recorded_s / processor_s:.1f} times real time on one core'
    )


def bare_optical_flow_s(images: list[np.ndarray]) -> float:
    """Return the processor time of one pyramidal Lucas-Kanade step of `FLOW_POINTS` points between two images."""
    before, after = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image for image in images)
    points = cv2.goodFeaturesToTrack(before, FLOW_POINTS, 0.01, 10)
    began = time.thread_time()
    for _ in range(FLOW_REPEATS):
        # OpenCV's type stubs lack the documented None for `nextPts`
        cv2.calcOpticalFlowPyrLK(before, after, points, None, winSize=(15, 15), maxLevel=3)  # type: ignore[call-overload]
    return (time.thread_time() - began) / FLOW_REPEATS

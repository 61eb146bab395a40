"""Processor time and memory of a live camera: `autocalib benchmark cost SOURCE`.

The figures describe one run on one machine: compare ratios, not absolute times of different runs. The floor is bare
optical flow on frames of the same recording, measured in between, so that both suffer from what else the machine does.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.ground_truth import read_truth
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.replay_recording import replay
from autocalib_ros.perception.opencv_threads import pin_opencv_threads
from autocalib_ros.results.calibration import Calibration, Refusal

FLOW_POINTS = 300
"""Points of the bare optical flow."""
FLOOR_PERIOD = 10
"""Frames between two measurements of the bare optical flow."""
PROGRESS_INTERVAL_S = 1.0
"""Interval at which a node asks for the progress of the evidence, for its diagnostics."""
TRUTH_FILE = 'truth.json'
"""File beside a recording that holds its truth: the errors of the last solution then stand beside the cost."""
Timed = TypeVar('Timed')


@dataclass(frozen=True, kw_only=True)
class LiveCost:
    """Processor times in seconds of one recording as a live camera, on one thread."""

    name: str
    size: tuple[int, int]
    recorded_s: float
    images_s: np.ndarray
    """Of each image: perception, and a snapshot where one was due, shape (frames,)."""
    floor_s: np.ndarray
    """Of bare optical flow between two frames, at some of them, shape (n,)."""
    progress_s: float
    """Of all progress reports."""
    solutions_s: tuple[float, ...]
    """Of each solution on the way, with the search for line segments in the background."""
    last_solution_s: float
    result: Calibration | Refusal | None
    """Of all evidence; None without any."""
    tracks: int
    peak_mb: tuple[float, float]
    """Peak resident memory before and after the solution of all evidence, with that on the way."""
    truth: tuple[float, np.ndarray] | None = None
    """True focal length in pixels and ground normal in the camera (3,), if they are known."""

    @property
    def ratio(self) -> float:
        """Processor time of an image over that of the bare optical flow, both in the mean."""
        return float(self.images_s.mean() / self.floor_s.mean())

    @property
    def spread(self) -> float:
        """95th percentile of the processor time of an image over the mean."""
        return float(np.quantile(self.images_s, 0.95) / self.images_s.mean())

    @property
    def solution_ratio(self) -> float:
        """Processor time of the solution of all evidence over that of the bare optical flow between two frames."""
        return float(self.last_solution_s / self.floor_s.mean())

    @property
    def cores(self) -> tuple[float, float]:
        """Cores that images with progress reports, and solutions on the way, take at the rate of the recording."""
        seconds = max(self.recorded_s, 1e-9)
        return (float(self.images_s.sum()) + self.progress_s) / seconds, sum(self.solutions_s) / seconds

    @property
    def focal_error(self) -> tuple[float, float] | None:
        """Error of the focal length in percent and in stated standard deviations; None without truth or result."""
        if self.truth is None or not isinstance(self.result, Calibration):
            return None
        found, true = self.result.camera.focal_px, self.truth[0]
        sigma = self.result.stddev.focal_px or np.inf
        return 100 * (found / true - 1), (found - true) / sigma

    @property
    def normal_error_deg(self) -> float | None:
        """Angle between the found and the true ground normal, degrees; None without truth or plane."""
        if self.truth is None or not isinstance(self.result, Calibration) or self.result.ground is None:
            return None
        return float(np.degrees(np.arccos(np.clip(self.result.ground.normal_in_camera @ self.truth[1], -1, 1))))


def measure_live_cost(path: Path, duration_s: float | None) -> LiveCost:
    """Take the images of a recording as a node does, on one thread, with snapshots, progress and solutions."""
    pin_opencv_threads()
    source = open_source(path, duration_s=duration_s)
    truth = _truth_beside(path)
    options = Options(camera_height=8.0 if truth is None else truth[2])
    calibrator, progress_s, progress_due_ns = AutoCalibrator(options), 0.0, -1
    images_s, floor_s, solutions_s = [], [], []
    first_ns = newest_ns = 0
    before: np.ndarray | None = None
    for index, frame in enumerate(source.frames()):
        first_ns, newest_ns = first_ns if index else frame.stamp_ns, frame.stamp_ns
        _, spent_s = _timed(lambda: calibrator.add_image(frame.stamp_ns, frame.image))  # noqa: B023
        due, snapshot_s = _timed(calibrator.snapshot_if_due)
        images_s.append(spent_s + snapshot_s)
        if frame.stamp_ns >= progress_due_ns:
            progress_due_ns = frame.stamp_ns + round(PROGRESS_INTERVAL_S * 1e9)
            progress_s += _timed(calibrator.progress)[1]
        if due is not None:
            on_the_way, spent_s = _timed(lambda: solve(calibrator.with_segments(due), options))  # noqa: B023
            solutions_s.append(spent_s)
            if on_the_way:
                calibrator.accepted(due.track_count)
        if index % FLOOR_PERIOD in (0, 1):
            before, grey = _grey(frame.image), before
            if index % FLOOR_PERIOD and grey is not None:
                floor_s.append(bare_optical_flow_s(grey, before))
    memory = _peak_mb()
    (evidence, result), last_s = _timed(lambda: _solved(calibrator, options))
    return LiveCost(
        name=source.name,
        size=(0, 0) if before is None else (before.shape[1], before.shape[0]),
        recorded_s=(newest_ns - first_ns) * 1e-9,
        images_s=np.array(images_s),
        floor_s=np.array(floor_s),
        progress_s=progress_s,
        solutions_s=tuple(solutions_s),
        last_solution_s=last_s,
        result=result,
        tracks=0 if evidence is None else evidence.track_count,
        peak_mb=(memory, _peak_mb()),
        truth=None if truth is None else truth[:2],
    )


def format_cost(cost: LiveCost) -> str:
    """Return the figures as text."""
    mean, bare = 1e3 * float(cost.images_s.mean()), 1e3 * float(cost.floor_s.mean())
    images, solutions = cost.cores
    lines = [
        f'{cost.size[0]}x{cost.size[1]}, {len(cost.images_s)} frames of {cost.name}, one thread',
        f'processor time per frame: mean {mean:.1f} ms, 95 % of frames below '
        f'{1e3 * np.quantile(cost.images_s, 0.95):.1f} ms ({cost.spread:.1f} times the mean), longest '
        f'{1e3 * cost.images_s.max():.0f} ms',
        f'bare optical flow of {FLOW_POINTS} points on frames in between: {bare:.1f} ms; a frame takes '
        f'{cost.ratio:.1f} times as long',
        f'{len(cost.solutions_s)} solutions on the way: {sum(cost.solutions_s):.1f} s of processor time, the longest '
        f'{max(cost.solutions_s, default=0.0):.1f} s; progress reports: {cost.progress_s:.2f} s',
        f'as a live camera: {images:.2f} cores for images and progress, {solutions:.2f} for solutions',
        f'solution of all {cost.tracks} tracks: {cost.last_solution_s:.1f} s '
        f'({"calibrated" if cost.result else "refused"}), as long as {cost.solution_ratio:.0f} bare optical flows',
        f'peak resident memory: {cost.peak_mb[0]:.0f} MB before this solution, {cost.peak_mb[1]:.0f} MB after',
    ]
    if cost.focal_error is not None:
        percent, sigmas = cost.focal_error
        normal = cost.normal_error_deg
        lines.append(
            f'against {TRUTH_FILE}: focal length {percent:+.2f} % ({sigmas:+.1f} standard deviations)'
            + ('' if normal is None else f', ground normal {normal:.2f} degrees')
        )
    return '\n'.join(lines)


def measure_replay_speed(path: Path, duration_s: float | None) -> str:
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


def bare_optical_flow_s(before: np.ndarray, after: np.ndarray) -> float:
    """Return the processor time of one pyramidal Lucas-Kanade step of `FLOW_POINTS` points between grey images."""
    points = cv2.goodFeaturesToTrack(before, FLOW_POINTS, 0.01, 10)
    if points is None:
        points = np.random.default_rng(0).uniform(0, before.shape[::-1], (FLOW_POINTS, 1, 2)).astype(np.float32)

    def flow() -> object:
        # OpenCV's type stubs lack the documented None for `nextPts`
        return cv2.calcOpticalFlowPyrLK(before, after, points, None, winSize=(15, 15), maxLevel=3)  # type: ignore[call-overload]

    flow()  # the first one allocates
    return _timed(flow)[1]


def _timed(work: Callable[[], Timed]) -> tuple[Timed, float]:
    """Return the result of a function and its processor time in seconds."""
    began = time.thread_time()
    return work(), time.thread_time() - began


def _grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image.copy()


def _solved(calibrator: AutoCalibrator, options: Options) -> tuple[Evidence | None, Calibration | Refusal | None]:
    """Return all evidence and its solution."""
    evidence = calibrator.snapshot()
    return evidence, None if evidence is None else solve(evidence, options)


def _truth_beside(path: Path) -> tuple[float, np.ndarray, float] | None:
    """Return true focal length, ground normal in the camera (3,) and camera height of a recording; None if unknown."""
    file = path.parent / TRUTH_FILE
    if not file.exists():
        return None
    truth = read_truth(file)
    up = np.array(truth['camera']['R_world_from_camera'], float)[2]
    return float(truth['lens']['f']), up, float(truth['camera']['height'])


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

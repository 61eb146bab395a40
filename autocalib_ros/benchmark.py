"""What the program costs: `python -m autocalib_ros.benchmark cost SOURCE`.

Figures of one run on one machine: compare ratios, not milliseconds of different days.
"""

from __future__ import annotations

from autocalib_ros.threads import use_one_thread_for_linear_algebra

use_one_thread_for_linear_algebra()

import argparse  # noqa: E402
import resource  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from pathlib import Path  # noqa: E402

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from autocalib_ros.calibrator import AutoCalibrator, solve  # noqa: E402
from autocalib_ros.config import Options  # noqa: E402
from autocalib_ros.errors import AutocalibError  # noqa: E402
from autocalib_ros.offline.sources import open_source  # noqa: E402

BARE_POINTS = 300
BARE_REPEATS = 30


def main() -> int:
    """Run the benchmark named on the command line."""
    parser = argparse.ArgumentParser(prog='python -m autocalib_ros.benchmark', description=__doc__)
    commands = parser.add_subparsers(required=True, metavar='BENCHMARK')
    cost_parser = commands.add_parser('cost', help='processor time a frame and of a solution, and memory')
    cost_parser.add_argument('source', type=Path, help='recording to measure on')
    cost_parser.add_argument('--duration', type=float, help='seconds of it to use')
    cost_parser.set_defaults(run=lambda arguments: cost(arguments.source, arguments.duration))
    arguments = parser.parse_args()
    try:
        arguments.run(arguments)
    except AutocalibError as error:
        print(f'benchmark: error: {error}', file=sys.stderr)
        return 2
    return 0


def cost(path: Path, duration_s: float | None) -> None:
    """Print processor time per frame beside that of bare optical flow, of one solution, and the largest memory."""
    cv2.setNumThreads(1)
    source = open_source(path, duration_s=duration_s)
    calibrator = AutoCalibrator(Options(camera_height=8.0))
    spent, images = [], []
    for frame in source.frames():
        began = time.process_time()
        calibrator.add_image(frame.stamp_ns, frame.image)
        spent.append(time.process_time() - began)
        if len(images) < 2:
            images.append(frame.image)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    began = time.process_time()
    evidence = calibrator.snapshot()
    result = solve(evidence, Options(camera_height=8.0)) if evidence is not None else None
    solution = time.process_time() - began
    mean, bare = 1e3 * float(np.mean(spent)), 1e3 * bare_optical_flow_s(images)
    height, width = images[0].shape[:2]
    print(f'{width}x{height}, {len(spent)} frames of {source.name}, one thread')
    print(f'processor time per frame: mean {mean:.1f} ms, 95 % of frames below {1e3 * np.quantile(spent, 0.95):.1f} ms')
    print(f'bare optical flow of {BARE_POINTS} points: {bare:.1f} ms; a frame costs {mean / bare:.1f} times that')
    print(f'one solution: {solution:.1f} s of processor time ({"calibrated" if result else "refused"})')
    print(f'largest memory of the process: {memory:.0f} MB before the solution, '
          f'{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB after')


def bare_optical_flow_s(images: list[np.ndarray]) -> float:
    """Processor time of one pyramidal Lucas-Kanade step of `BARE_POINTS` points between two images."""
    before, after = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image for image in images)
    points = cv2.goodFeaturesToTrack(before, BARE_POINTS, 0.01, 10)
    began = time.process_time()
    for _ in range(BARE_REPEATS):
        cv2.calcOpticalFlowPyrLK(before, after, points, None, winSize=(15, 15), maxLevel=3)
    return (time.process_time() - began) / BARE_REPEATS


if __name__ == '__main__':
    sys.exit(main())

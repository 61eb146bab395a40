"""`autocalib demo`."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from autocalib_ros.commands import DONE, REFUSED
from autocalib_ros.commands.output import print_stderr, replay_and_report
from autocalib_ros.commands.replay_command import DEFAULT_OUT

if TYPE_CHECKING:
    import numpy as np

    from autocalib_ros.results.calibration import Calibration

HELP = 'simulate traffic, calibrate from it and compare with the ground truth'
DESCRIPTION = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the output folder, the seed and the source of the metric scale."""
    parser.add_argument(
        '--out', type=Path, default=DEFAULT_OUT, metavar='DIR', help='folder for the results (default: %(default)s)'
    )
    parser.add_argument('--seed', type=int, default=0, metavar='N', help='seed of the simulated traffic')
    parser.add_argument(
        '--scale-from',
        choices=('height', 'distance', 'speed'),
        default='height',
        help='quantity of the ground truth that fixes the metric scale (default: %(default)s)',
    )
    parser.add_argument('--keep-bag', action='store_true', help='keep the simulated recording in DIR/recording')


def run(arguments: argparse.Namespace) -> int:
    """Simulate, calibrate meanwhile, and compare with the ground truth; return the exit status."""
    print_stderr('Simulating a minute of traffic at a junction, and calibrating from it meanwhile.')
    from autocalib_ros.offline import outputs
    from autocalib_ros.offline.demonstration import (
        PICTURE,
        compare_with_truth,
        options_from_truth,
        simulated,
        write_picture,
    )
    from autocalib_ros.perception.opencv_threads import pin_opencv_threads

    pin_opencv_threads()
    bag = arguments.out / 'recording'
    outputs.prepare_output_dir(arguments.out, bag)
    recording = simulated(bag, arguments.seed)

    def show(found: Calibration, image: np.ndarray) -> None:
        if write_picture(arguments.out / PICTURE, found, image):
            print_stderr(f'First picture, with the grid on the road: {arguments.out / PICTURE}')

    try:
        replayed = replay_and_report(
            [recording],
            options_from_truth(recording.truth, arguments.scale_from),
            arguments.out,
            truth=recording.truth,
            on_accepted=show,
        )
    finally:
        if not arguments.keep_bag:
            shutil.rmtree(bag, ignore_errors=True)
    comparison = compare_with_truth(replayed.result, recording.truth)
    if comparison is None:
        return REFUSED
    print(comparison.table())
    if not comparison.within_tolerance:
        print_stderr('Demo failed: errors exceed the expected tolerance.')
    return DONE if comparison.within_tolerance else REFUSED

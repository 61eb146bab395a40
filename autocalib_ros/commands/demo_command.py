"""`autocalib demo`."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from autocalib_ros.commands import DONE, REFUSED
from autocalib_ros.commands.output import print_stderr, replay_and_report
from autocalib_ros.commands.replay_command import DEFAULT_OUT

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
    """Simulate, replay and compare with the ground truth; return the exit status."""
    from autocalib_ros.offline import outputs
    from autocalib_ros.offline.demonstration import compare_with_truth, options_from_truth, simulate_bag
    from autocalib_ros.offline.recordings.open import open_source

    bag = arguments.out / 'recording'
    outputs.prepare_output_dir(arguments.out, bag)
    try:
        truth = simulate_bag(bag, arguments.seed)
        replayed = replay_and_report(
            [open_source(bag)], options_from_truth(truth, arguments.scale_from), arguments.out, truth=truth
        )
    finally:
        if not arguments.keep_bag:
            shutil.rmtree(bag, ignore_errors=True)
    comparison = compare_with_truth(replayed.result, truth)
    if comparison is None:
        return REFUSED
    print(comparison.table())
    if not comparison.within_tolerance:
        print_stderr('Demo failed: errors exceed the expected tolerance.')
    return DONE if comparison.within_tolerance else REFUSED

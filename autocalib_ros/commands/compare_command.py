"""`autocalib compare`."""

from __future__ import annotations

import argparse
from pathlib import Path

from autocalib_ros.commands import DONE, REFUSED

HELP = 'compare two calibrations of one camera'
DESCRIPTION = (
    'Compare two calibrations of one camera, for example to check whether an old one is still valid. Exit status: '
    '0 if they agree within 3 combined standard deviations, 3 if they differ or their uncertainty is unknown, 2 on '
    'wrong input.'
)
CALIBRATION_FILES = (
    'calibration.json, NAME.autocalib.json of the node, or a camera_info.yaml, for example of a checkerboard '
    'calibration'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the two calibration files, the ground truth and the output format."""
    parser.add_argument('first', metavar='A', type=Path, help=CALIBRATION_FILES)
    parser.add_argument('second', metavar='B', type=Path, help='the same')
    parser.add_argument('--truth', metavar='T', type=Path, help='truth.json of a simulation; compares both with it too')
    parser.add_argument('--json', action='store_true', help='print a JSON document instead of the table')


def run(arguments: argparse.Namespace) -> int:
    """Compare two calibrations and print the result; return the exit status."""
    import json
    import sys

    from autocalib_ros.commands.comparison_table import comparison_document, comparison_lines, truth_lines
    from autocalib_ros.comparison import compare_calibrations
    from autocalib_ros.offline.terminal.style import coloured
    from autocalib_ros.results.saved_camera import read_saved_camera

    both = [read_saved_camera(path) for path in (arguments.first, arguments.second)]
    result = compare_calibrations(*both)
    errors = []
    if arguments.truth is not None:
        from autocalib_ros.offline.ground_truth import errors_against_truth, read_truth

        truth = read_truth(arguments.truth)
        errors = [errors_against_truth(known, truth) for known in both]
    if arguments.json:
        document = comparison_document(result)
        print(json.dumps({**document, **({'against_truth': errors} if errors else {})}, indent=1, allow_nan=False))
    else:
        colour = {True: 'green', False: 'red', None: 'yellow'}[result.agrees]
        print(coloured(result.verdict(), colour, sys.stdout))
        print(f'A: {arguments.first}\nB: {arguments.second}')
        print('\n'.join(comparison_lines(result)))
        if errors:
            print('\n'.join(['', *truth_lines(errors)]))
    return DONE if result.agrees else REFUSED

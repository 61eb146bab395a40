"""`autocalib index`."""

from __future__ import annotations

import argparse
from pathlib import Path

from autocalib_ros.commands import DONE

HELP = 'write one page over the reports of many cameras'
DESCRIPTION = (
    'Write index.html into a folder: one card for each calibration.json in it or below it, with its state, numbers and '
    'a link to its report. Refused and unreadable ones come first.'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the folder."""
    parser.add_argument('folder', metavar='DIR', type=Path, help='folder with the results of many cameras')


def run(arguments: argparse.Namespace) -> int:
    """Write the page; return the exit status."""
    from autocalib_ros.report.index_page import count_of_cameras, write_index

    path, cameras = write_index(arguments.folder)
    print(f'Written to {path}: {count_of_cameras(cameras)}')
    return DONE

"""`autocalib docs`."""

from __future__ import annotations

import argparse
from pathlib import Path

from autocalib_ros.commands import DONE, REFUSED

HELP = 'write the reference pages of the documentation from the code'
DESCRIPTION = (
    'Write the generated pages (parameters, command line, topics, refusal codes, constants) below FOLDER. '
    'Exit status: 0 written or up to date, 3 with --check if a page is out of date.'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the folder and the check."""
    parser.add_argument(
        'folder',
        metavar='FOLDER',
        type=Path,
        nargs='?',
        default=Path('docs'),
        help='folder of the documentation (default: %(default)s)',
    )
    parser.add_argument('--check', action='store_true', help='write nothing; list the pages that are out of date')


def run(arguments: argparse.Namespace) -> int:
    """Write or check the pages; return the exit status."""
    from autocalib_ros.commands.reference_pages import outdated, write_pages

    names = outdated(arguments.folder) if arguments.check else write_pages(arguments.folder)
    for name in names:
        print(f'{arguments.folder / name}: {"out of date" if arguments.check else "written"}')
    return REFUSED if arguments.check and names else DONE

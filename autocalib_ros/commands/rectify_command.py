"""`autocalib rectify`."""

from __future__ import annotations

import argparse

from autocalib_ros.commands import view_options as views

HELP = 'take the distortion out of an image or video'
DESCRIPTION = 'Take the distortion out of an image or video, with a saved calibration of the camera.'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the files and how much is shown."""
    views.add_files(parser)
    parser.add_argument(
        '--balance',
        type=float,
        metavar='B',
        help='0 shows valid pixels only, 1 all that the lens shows (default: as P of the calibration says)',
    )


def run(arguments: argparse.Namespace) -> int:
    """Write; return the exit status."""
    from autocalib_ros.pictures.known_views import rectified_renderer

    return views.render_to_file(arguments, 'rectify', lambda known: rectified_renderer(known, arguments.balance))

"""`autocalib rectify`."""

from __future__ import annotations

import argparse

from autocalib_ros.commands import view_options as views

HELP = 'undistort an image or video'
DESCRIPTION = 'Undistort an image or video with a saved calibration of the camera.'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the input and output files and the field of view."""
    views.add_files(parser)
    parser.add_argument(
        '--balance',
        type=float,
        metavar='B',
        help='0: valid pixels only, 1: the whole field of view (default: as the P matrix of the calibration)',
    )


def run(arguments: argparse.Namespace) -> int:
    """Write the undistorted image or video; return the exit status."""
    from autocalib_ros.pictures.known_views import rectified_renderer

    return views.render_to_file(arguments, 'rectify', lambda known: rectified_renderer(known, arguments.balance))

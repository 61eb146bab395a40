"""`autocalib picture`."""

from __future__ import annotations

import argparse

from autocalib_ros.commands import view_options as views

HELP = 'overlay the ground grid and horizon on an image, next to a top-down view'
DESCRIPTION = (
    'Show a calibration in one picture: left, the image with the ground grid and the horizon; right, the top-down '
    'view with the same grid.'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the input and output files."""
    views.add_files(parser, 'calibration.json, or NAME.autocalib.json of the node')


def run(arguments: argparse.Namespace) -> int:
    """Write the picture; return the exit status."""
    from autocalib_ros.pictures.showcase import showcase

    return views.render_to_file(arguments, 'picture', lambda known: lambda image: showcase(known, image))

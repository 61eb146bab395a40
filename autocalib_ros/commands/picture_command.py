"""`autocalib picture`."""

from __future__ import annotations

import argparse

from autocalib_ros.commands import view_options as views

HELP = 'show in one picture what a calibration makes of an image: grid on the road, horizon, road from above'
DESCRIPTION = (
    'One picture that tells what a calibration is: at the left the image with a grid on the road and the '
    'horizon, at the right the road from above with the same grid.'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the files."""
    views.add_files(parser, 'calibration.json, or NAME.autocalib.json of the node')


def run(arguments: argparse.Namespace) -> int:
    """Write; return the exit status."""
    from autocalib_ros.pictures.showcase import showcase

    return views.render_to_file(arguments, 'picture', lambda known: lambda image: showcase(known, image))

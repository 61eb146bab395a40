"""`autocalib topview`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from autocalib_ros.commands import view_options as views

if TYPE_CHECKING:
    from autocalib_ros.offline.view_files import Renderer
    from autocalib_ros.results.saved_camera import SavedCamera

HELP = 'render a top-down view of the road from an image or video'
DESCRIPTION = (
    'Render a top-down view of the road from an image or video with a saved calibration of the camera. The x axis '
    'of the ground frame points right, the y axis up.'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the input and output files, resolution, extent and drawings."""
    views.add_files(parser, 'calibration.json, or NAME.autocalib.json of the node')
    parser.add_argument(
        '--px-per-m', type=float, metavar='P', help='pixels per metre (default: 1000 pixels along the longer side)'
    )
    for axis in 'xy':
        parser.add_argument(
            f'--{axis}',
            type=float,
            nargs=2,
            metavar=('LOW', 'HIGH'),
            help=f'range of {axis} in metres (default: the road in view)',
        )
    parser.add_argument('--grid', action='store_true', help='draw grid lines at round metres')
    parser.add_argument('--scale-bar', action=argparse.BooleanOptionalAction, default=True, help='draw a scale bar')


def run(arguments: argparse.Namespace) -> int:
    """Write the top-down view; return the exit status."""
    from autocalib_ros.pictures.known_views import choose_top_view, top_view_renderer

    def make_renderer(known: SavedCamera) -> Renderer:
        view = choose_top_view(known, arguments.px_per_m, arguments.x, arguments.y)
        return top_view_renderer(known, view, grid=arguments.grid, scale_bar=arguments.scale_bar)

    return views.render_to_file(arguments, 'topview', make_renderer)

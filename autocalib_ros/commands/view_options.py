"""Arguments and file handling shared by `rectify`, `topview` and `picture`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from autocalib_ros.commands import DONE
from autocalib_ros.commands.compare_command import CALIBRATION_FILES

if TYPE_CHECKING:
    from autocalib_ros.config import Polygons
    from autocalib_ros.offline.view_files import Renderer
    from autocalib_ros.results.saved_camera import SavedCamera


def add_files(parser: argparse.ArgumentParser, calibration: str = CALIBRATION_FILES) -> None:
    """Add the calibration, the source of images and the output file."""
    parser.add_argument('calibration', metavar='CALIBRATION', type=Path, help=calibration)
    parser.add_argument('source', metavar='SOURCE', type=Path, help='image, video or recording of that camera')
    parser.add_argument('out', metavar='OUT', type=Path, help='.png or .jpg for one picture, .mp4 or .avi for a video')
    parser.add_argument(
        '--at',
        type=float,
        default=0.0,
        metavar='S',
        help='seconds after the first image: the image of a picture, or the start of a video',
    )
    parser.add_argument('--duration', type=float, metavar='S', help='seconds of a video')
    parser.add_argument('--topic', metavar='T', help='image topic; required if the recording has several')
    parser.add_argument(
        '--params-file',
        type=Path,
        metavar='F',
        help='ROS 2 parameter file of the camera; its ignore_regions are blacked out',
    )
    parser.add_argument('--quiet', action='store_true', help='print neither progress nor the name of the written file')


def render_to_file(arguments: argparse.Namespace, label: str, make_renderer: Callable[[SavedCamera], Renderer]) -> int:
    """Render the images of the source with a saved calibration into a file; return the exit status.

    `make_renderer` gets the camera scaled to the size of the images.
    """
    import numpy as np

    from autocalib_ros.errors import AutocalibError
    from autocalib_ros.offline.view_files import SourceSelection, write_view
    from autocalib_ros.perception.ignore_regions import black_out
    from autocalib_ros.results.saved_camera import read_saved_camera

    known = read_saved_camera(arguments.calibration)
    ignored = _ignored(arguments.params_file)

    def renderer_for(width: int, height: int) -> Renderer:
        scale = np.array([width, height]) / (known.width, known.height)
        polygons = tuple(tuple(map(tuple, (np.array(polygon) + 0.5) * scale - 0.5)) for polygon in ignored)
        try:
            view = make_renderer(known.scaled_to(width, height))
            return lambda image: view(black_out(image, polygons))
        except AutocalibError as error:
            raise type(error)(f'{arguments.calibration}: {error}') from error

    selection = SourceSelection(arguments.topic, arguments.at, arguments.duration)
    width, height = write_view(
        arguments.source, arguments.out, selection, renderer_for, label=label, quiet=arguments.quiet
    )
    if not arguments.quiet:
        print(f'Written to {arguments.out}: {width}x{height}')
    return DONE


def _ignored(params_file: Path | None) -> Polygons:
    """Return the `ignore_regions` polygons of a parameter file, in pixels of the calibrated images."""
    if params_file is None:
        return ()
    from autocalib_ros.config import Options
    from autocalib_ros.offline.parameter_file import override_options, read_params_file

    return override_options(Options(), read_params_file(params_file)).ignored_polygons

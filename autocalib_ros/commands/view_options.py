"""What `rectify`, `topview` and `picture` share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from autocalib_ros.commands import DONE
from autocalib_ros.commands.compare_command import FILES

if TYPE_CHECKING:
    from autocalib_ros.offline.view_files import View
    from autocalib_ros.perception.ignore_regions import Polygons
    from autocalib_ros.results.saved_camera import SavedCamera


def add_files(parser: argparse.ArgumentParser, calibration: str = FILES) -> None:
    """Add the calibration, the images and the result."""
    parser.add_argument('calibration', metavar='CALIBRATION', type=Path, help=calibration)
    parser.add_argument('source', metavar='SOURCE', type=Path, help='image, video or recording of that camera')
    parser.add_argument('out', metavar='OUT', type=Path, help='.png or .jpg: one picture; .mp4 or .avi: a video')
    parser.add_argument('--at', type=float, default=0.0, metavar='S',
                        help='seconds after the first image: which one a picture shows, or where a video begins')
    parser.add_argument('--duration', type=float, metavar='S', help='seconds of a video')
    parser.add_argument('--topic', metavar='T', help='image topic of a recording; needed when there are several')
    parser.add_argument('--params-file', type=Path, metavar='F',
                        help='ROS 2 parameter file of the camera, whose ignore_regions are black in the result')
    parser.add_argument('--quiet', action='store_true', help='no progress, and not what was written')


def write(arguments: argparse.Namespace, label: str, view_of: Callable[[SavedCamera], View]) -> int:
    """Write what `view_of` makes of the camera in images of the source's size; return the exit status."""
    import numpy as np

    from autocalib_ros.errors import AutocalibError
    from autocalib_ros.offline.view_files import Part, write_view
    from autocalib_ros.perception.ignore_regions import black_out
    from autocalib_ros.results.saved_camera import read_saved_camera

    known = read_saved_camera(arguments.calibration)
    ignored = _ignored(arguments.params_file)

    def view_for(width: int, height: int) -> View:
        scale = np.array([width, height]) / (known.width, known.height)
        polygons = tuple(tuple(map(tuple, (np.array(polygon) + 0.5) * scale - 0.5)) for polygon in ignored)
        try:
            view = view_of(known.scaled_to(width, height))
            return lambda image: view(black_out(image, polygons))
        except AutocalibError as error:
            raise type(error)(f'{arguments.calibration}: {error}') from error

    part = Part(arguments.topic, arguments.at, arguments.duration)
    width, height = write_view(arguments.source, arguments.out, part, view_for, label=label, quiet=arguments.quiet)
    if not arguments.quiet:
        print(f'Written to {arguments.out}: {width}x{height}')
    return DONE


def _ignored(params_file: Path | None) -> Polygons:
    """Return the polygons of `ignore_regions` in a parameter file, in pixels of the calibrated images."""
    if params_file is None:
        return ()
    from autocalib_ros.config import Options
    from autocalib_ros.offline.parameter_file import options_with, read_params_file

    return options_with(Options(), read_params_file(params_file)).ignored_polygons

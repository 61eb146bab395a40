"""`autocalib export`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from autocalib_ros.commands import DONE
from autocalib_ros.commands.map_output import MAP
from autocalib_ros.commands.output import print_stderr

HELP = 'write a calibration in the format of another program'
DESCRIPTION = (
    'Write a calibration in the format of another program: homography (3x3 of the rectified image, as text for NumPy, '
    'OpenCV and trafficintelligence), raw-homography (3x3 of the images as delivered), view-transformer (four points '
    'for the ViewTransformer of supervision), opencv (FileStorage YAML), kalibr (camera chain YAML), otrfpts '
    '(reference points of OTVision) and geojson (camera and road in view); the last two need the place in a map, see '
    '--control-points of replay. A 3x3 of raw pixels is refused where the distortion of the lens makes it too wrong.'
)
EXPORT_RANGE_M = 40.0
"""Distance from the foot of the camera up to which the road counts: the last of `calibration.GROUND_DISTANCES_M`."""
MAX_RAW_ERROR_M = 0.5
"""Largest error of a 3x3 homography of raw pixels at 95 % of the road: what a car leaves of its lane on either side."""
FORMATS = ('homography', 'raw-homography', 'view-transformer', 'opencv', 'kalibr', 'otrfpts', 'geojson')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the calibration, the format and the output file."""
    parser.add_argument(
        'calibration', metavar='CALIBRATION', type=Path, help='calibration.json, or NAME.autocalib.json of the node'
    )
    parser.add_argument('--format', choices=FORMATS, required=True, help='format of the output')
    parser.add_argument('--out', type=Path, metavar='FILE', help='file to write (default: stdout)')
    parser.add_argument(
        '--range',
        type=float,
        default=EXPORT_RANGE_M,
        metavar='M',
        help='distance from the foot of the camera up to which the road counts, metres (default: %(default)g)',
    )
    parser.add_argument(
        '--max-error',
        type=float,
        default=MAX_RAW_ERROR_M,
        metavar='M',
        help='largest error of a 3x3 of raw pixels at 95 %% of that road, metres (default: %(default)g)',
    )
    parser.add_argument(
        '--map', type=Path, metavar='FILE', help='map.json of --control-points (default: that beside the calibration)'
    )


def run(arguments: argparse.Namespace) -> int:
    """Write the calibration; return the exit status."""
    from autocalib_ros.offline.export_formats import RAW_FORMATS, ExportedCamera, export, read_placement
    from autocalib_ros.util.files import write_atomically

    camera = ExportedCamera(arguments.calibration, arguments.range)
    beside = arguments.calibration.with_name(MAP)
    path = arguments.map or (beside if beside.exists() else None)
    placement = None if path is None else read_placement(path)
    text = export(camera, arguments.format, placement, arguments.max_error)
    if arguments.format in (*RAW_FORMATS, 'homography'):
        print_stderr(f'{camera.raw.description[0].upper()}{camera.raw.description[1:]}.')
    if arguments.out is None:
        sys.stdout.write(text)
    else:
        write_atomically(arguments.out, text)
    return DONE

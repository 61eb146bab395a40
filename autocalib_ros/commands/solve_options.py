"""Arguments shared by `replay` and `evidence`: solver options, metric scale and known lens."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autocalib_ros.config import Options

if TYPE_CHECKING:
    from autocalib_ros.lens.camera import Camera


def add_solve_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for the solver, the metric scale and the printed output."""
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument(
        '--camera-height',
        type=float,
        metavar='H',
        help='height of the camera above the road in metres; without a metric scale only the lens is calibrated',
    )
    scale.add_argument(
        '--scale-distance',
        type=float,
        nargs=5,
        metavar=('U1', 'V1', 'U2', 'V2', 'METRES'),
        help='alternative: two pixels on the road and the distance between them in metres',
    )
    scale.add_argument(
        '--scale-speed',
        type=float,
        metavar='KM_H',
        help='alternative: mean speed of the moving traffic on the busiest road in km/h',
    )
    parser.add_argument(
        '--camera-info',
        type=Path,
        metavar='FILE',
        help='camera_info_manager file with the known lens; only the pose is estimated',
    )
    parser.add_argument('--params-file', type=Path, metavar='F', help='ROS 2 parameter file with options')
    parser.add_argument('--method', choices=('joint', 'paper'), help='robust method (default) or the published method')
    parser.add_argument(
        '--allow-unit-scale',
        action='store_true',
        help='without a metric scale, give the ground plane in units of the camera height',
    )
    parser.add_argument(
        '-p',
        '--param',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='any option by its full name, for example joint.noise_px=0.7; repeatable',
    )
    parser.add_argument(
        '--quiet', action='store_true', help='print no progress and no summary; refusals still go to stderr'
    )
    parser.add_argument('--json', action='store_true', help='print calibration.json on stdout instead of the summary')


def options_from_arguments(arguments: argparse.Namespace) -> Options:
    """Return the options: defaults, overridden by the parameter file, overridden by the command line."""
    from autocalib_ros.offline.parameter_file import override_options, parse_assignments, read_params_file

    values: dict[str, Any] = read_params_file(arguments.params_file) if arguments.params_file else {}
    values.update(parse_assignments(arguments.param))
    values.update(_scale_values(arguments))
    if arguments.method is not None:
        values['method'] = arguments.method
    if arguments.allow_unit_scale:
        values['allow_unit_scale'] = True
    return override_options(Options(), values)


def _scale_values(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options of the scale source given on the command line, if any."""
    if arguments.camera_height is not None:
        return {'camera_height': arguments.camera_height}
    if arguments.scale_distance is not None:
        *pixels, metres = arguments.scale_distance
        return {
            'scale_from': 'distance',
            'scale.distance_px': ' '.join(f'{value:g}' for value in pixels),
            'scale.distance_m': metres,
        }
    if arguments.scale_speed is not None:
        return {'scale_from': 'speed', 'scale.speed_km_h': arguments.scale_speed}
    return {}


def read_known_lens(arguments: argparse.Namespace, options: Options) -> Camera | None:
    """Read the known lens from --camera-info, else from `camera_info_file` of the parameter file; None without either.

    Raise UsageError if the requested distortion model cannot represent the lens.
    """
    from autocalib_ros.offline.parameter_file import camera_info_file

    file = arguments.camera_info
    if file is None and arguments.params_file is not None:
        file = camera_info_file(arguments.params_file) or None
    if file is None:
        return None
    from autocalib_ros.lens.camera_info import camera_info
    from autocalib_ros.lens.camera_info_yaml import read_camera_info

    lens = read_camera_info(file)
    camera_info(lens, options.distortion_model)  # fails early if the model cannot represent the lens
    return lens

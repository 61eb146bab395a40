"""Arguments shared by `replay` and `evidence`: solver options, metric scale and known lens."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autocalib_ros.commands.map_output import distance_options
from autocalib_ros.config import Options
from autocalib_ros.errors import UsageError

if TYPE_CHECKING:
    from autocalib_ros.lens.camera import Camera
    from autocalib_ros.results.control_points import ControlPoints


def add_solve_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for the solver, the metric scale and the printed output."""
    known = parser.add_argument_group('what is known', 'as many of these as are known; together they have to agree')
    known.add_argument(
        '--camera-height',
        type=float,
        metavar='H',
        help='height of the camera above the road in metres; without any metric scale the size of the vehicles gives '
        'it, to 14 %%',
    )
    known.add_argument(
        '--camera-height-sigma', type=float, metavar='S', help='standard deviation of the height (default: exact)'
    )
    known.add_argument(
        '--distance',
        '--scale-distance',
        dest='distance',
        type=float,
        nargs=5,
        action='append',
        metavar=('U1', 'V1', 'U2', 'V2', 'METRES'),
        help='two pixels on the road and the distance between them in metres; repeatable',
    )
    known.add_argument(
        '--scale-speed', type=float, metavar='KM_H', help='mean speed of the moving traffic on the busiest road in km/h'
    )
    known.add_argument(
        '--control-points',
        type=Path,
        metavar='FILE',
        help='points on the road in pixels and in a map: CSV with u_px, v_px and x_m, y_m or lat, lon; or .otrfpts',
    )
    known.add_argument(
        '--lanes',
        choices=('us', 'uk', 'de', 'fr', 'cn'),
        help='country whose standards give lane width and dash period, as far as dashes of lane lines are seen',
    )
    known.add_argument(
        '--lane-width', type=float, metavar='W', help='width of the lanes in metres, line to line, ± 4 %%'
    )
    known.add_argument(
        '--dash-period', type=float, metavar='P', help='length of a dash and its gap together in metres, ± 2 %%'
    )
    lens = known.add_mutually_exclusive_group()
    lens.add_argument('--focal-px', type=float, metavar='F', help='focal length from the data sheet in pixels, ± 10 %%')
    lens.add_argument('--hfov-deg', type=float, metavar='A', help='field of view across the image in degrees, ± 10 %%')
    known.add_argument('--focal-sigma-px', type=float, metavar='S', help='standard deviation of --focal-px')
    known.add_argument(
        '--roll-sigma-deg',
        type=float,
        metavar='S',
        help='single road: standard deviation of the roll of a level camera in degrees (default: 3)',
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
        '--tracks', type=Path, metavar='FILE', help='write vehicle tracks in metres with speeds (.csv, .parquet)'
    )
    parser.add_argument(
        '--quiet', action='store_true', help='print no progress and no summary; refusals still go to stderr'
    )
    parser.add_argument(
        '--print-params', action='store_true', help='print the options in force as a ROS 2 parameter file, and end'
    )
    parser.add_argument('--json', action='store_true', help='print calibration.json on stdout instead of the summary')


def options_from_arguments(arguments: argparse.Namespace, points: ControlPoints | None = None) -> Options:
    """Return the options: defaults, overridden by the parameter file, overridden by the command line.

    The lengths between control `points` are among them.
    """
    from autocalib_ros.offline.parameter_file import override_options, parse_assignments, read_params_file

    values: dict[str, Any] = read_params_file(arguments.params_file) if arguments.params_file else {}
    values.update(parse_assignments(arguments.param))
    values.update(_known_values(arguments))
    if points is not None:
        values.update(distance_options(points, values))
    if arguments.method is not None:
        values['method'] = arguments.method
    if arguments.allow_unit_scale:
        values['allow_unit_scale'] = True
    return override_options(Options(), values)


def printed_params(arguments: argparse.Namespace, options: Options, needed: str) -> bool:
    """Print the options if asked to, and return whether that is all; UsageError without the `needed` arguments."""
    if arguments.print_params:
        from autocalib_ros.offline.parameter_file import params_yaml

        print(params_yaml(options), end='')
        return True
    if not getattr(arguments, f'{needed.lower()}s'):
        raise UsageError(f'the following arguments are required: {needed} (see autocalib {arguments.command} --help)')
    return False


def control_points(arguments: argparse.Namespace) -> ControlPoints | None:
    """Return the control points of --control-points; None without."""
    if arguments.control_points is None:
        return None
    from autocalib_ros.results.control_points import read_control_points

    return read_control_points(arguments.control_points)


def _known_values(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options for what is known, as far as it is given on the command line."""
    given = {
        'camera_height': arguments.camera_height,
        'camera_height_sigma': arguments.camera_height_sigma,
        'scale.speed_km_h': arguments.scale_speed,
        'lanes.country': arguments.lanes,
        'lanes.width_m': arguments.lane_width,
        'lanes.dash_period_m': arguments.dash_period,
        'lens.focal_px': arguments.focal_px,
        'lens.focal_sigma_px': arguments.focal_sigma_px,
        'lens.hfov_deg': arguments.hfov_deg,
        'joint.roll_prior_deg': arguments.roll_sigma_deg,
    }
    if arguments.distance:
        given['scale.distances'] = '; '.join(' '.join(f'{value:g}' for value in each) for each in arguments.distance)
    return {name: value for name, value in given.items() if value is not None}


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

"""The `autocalib` command: replay a recording, solve its evidence again, simulate one, or demonstrate all."""

from __future__ import annotations

import argparse
import logging
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from autocalib_ros import __version__
from autocalib_ros.config import Options
from autocalib_ros.errors import AutocalibError, UsageError
from autocalib_ros.threads import use_one_thread_for_linear_algebra

if TYPE_CHECKING:
    from autocalib_ros.camera import Camera
    from autocalib_ros.offline.replay import ReplayResult
    from autocalib_ros.offline.sources import Source
    from autocalib_ros.perception.detector.detector import VehicleDetector

# Everything heavy (OpenCV, rosbags, matplotlib) is imported where it is used, so that --help is quick.

CALIBRATED, WRONG_USE, REFUSED, INTERRUPTED = 0, 2, 3, 130
DEFAULT_OUT = Path('autocalib_out')


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return 0 calibrated, 3 refused, 2 wrong usage or unreadable input, 130 interrupted."""
    use_one_thread_for_linear_algebra()
    _silence_libraries()
    _speak_to_any_terminal()
    try:
        with _warnings_on_stderr():
            arguments = _parser(sys.argv[1:] if argv is None else list(argv))
            return arguments.run(arguments)
    except AutocalibError as error:
        print(f'autocalib: error: {error}', file=sys.stderr)
        return WRONG_USE
    except KeyboardInterrupt:
        print(file=sys.stderr)
        return INTERRUPTED
    except SystemExit as leave:  # argparse after --help and --version
        return int(leave.code or 0)


def _silence_libraries() -> None:
    """Keep FFmpeg and OpenCV from writing to stderr on their own: what matters is said in one line."""
    os.environ.setdefault('OPENCV_FFMPEG_LOGLEVEL', '-8')
    os.environ.setdefault('OPENCV_LOG_LEVEL', 'OFF')
    logging.getLogger('matplotlib').setLevel(logging.ERROR)


def _speak_to_any_terminal() -> None:
    """Print a replacement for what a terminal cannot show, such as the plus-minus sign, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, 'reconfigure'):
            stream.reconfigure(errors='replace')


@contextmanager
def _warnings_on_stderr() -> Iterator[None]:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter('autocalib: warning: %(message)s'))
    handler.setLevel(logging.WARNING)
    logger = logging.getLogger('autocalib_ros')
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


class _Parser(argparse.ArgumentParser):
    """argparse that answers wrong usage in one line, through the one place where errors are caught."""

    def error(self, message: str) -> NoReturn:
        """Raise UsageError."""
        raise UsageError(f'{message} (see {self.prog} --help)')


def _parser(argv: list[str]) -> argparse.Namespace:
    parser = _Parser(prog='autocalib', description='Calibrate a fixed roadside camera from the traffic that it sees.')
    parser.add_argument('--version', action='version', version=f'autocalib {__version__}')
    commands = parser.add_subparsers(title='commands', metavar='COMMAND', required=True, parser_class=_Parser)
    _add_replay(commands.add_parser('replay', help='calibrate from a recording', description=(
        'Calibrate from a recording. Exit status: 0 calibrated, 3 refused, 2 wrong usage or unreadable input.')))
    _add_evidence(commands.add_parser('evidence', help='solve saved evidence again with other options', description=(
        'Solve the evidence.npz of a replay again, without its pictures. Options of tracking, motion and buffer shape'
        ' the gathering and change nothing here. Exit status as of replay.')))
    _add_simulate(commands.add_parser('simulate', help='write a recording of simulated traffic with known truth'), argv)
    _add_demo(commands.add_parser('demo', help='simulate traffic, calibrate from it, compare with the truth'))
    _add_benchmark(commands.add_parser('benchmark', help='measure what the program costs on this machine'))
    return parser.parse_args(argv)


def _add_benchmark(parser: argparse.ArgumentParser) -> None:
    what = parser.add_subparsers(title='benchmarks', metavar='WHAT', dest='what', required=True)
    cost = what.add_parser('cost', help='processor time of a frame and of a solution, and memory')
    cost.add_argument('source', metavar='SOURCE', type=Path, help='recording to measure on')
    cost.add_argument('--duration', type=float, metavar='S', help='seconds of it to use')
    accuracy = what.add_parser('accuracy', help='errors against the truth of made-up traffic, by Monte Carlo')
    accuracy.add_argument('--runs', type=int, default=20, metavar='N', help='draws per family (default: %(default)s)')
    accuracy.add_argument('--family', nargs='+', default=[], metavar='NAME', help='kinds of evidence (default: all)')
    accuracy.add_argument('--method', nargs='+', choices=('joint', 'paper'), default=['joint', 'paper'],
                          help='robust method, the published one, or both (default)')
    accuracy.add_argument('--jobs', type=int, default=1, metavar='J', help='processes (default: %(default)s)')
    accuracy.add_argument('--seed', type=int, default=0, metavar='S', help='seed of the draws (default: %(default)s)')
    accuracy.add_argument('--out', type=Path, metavar='FILE', help='CSV to write, one row a run')
    parser.set_defaults(run=_benchmark)


def _benchmark(arguments: argparse.Namespace) -> int:
    if arguments.what == 'cost':
        from autocalib_ros.offline.benchmark import cost

        print(cost(arguments.source, arguments.duration))
        return 0
    from autocalib_ros.offline.accuracy import measure
    from autocalib_ros.offline.accuracy_table import tables

    print(tables(measure(arguments.family, arguments.method, arguments.runs, seed=arguments.seed, jobs=arguments.jobs,
                         out=arguments.out)))
    return 0


def _add_replay(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('source', metavar='SOURCE', type=Path,
                        help='rosbag2 folder, .mcap, .db3, ROS 1 .bag or video file')
    _add_solving(parser)
    parser.add_argument('--topic', metavar='T', help='image topic; needed when there are several')
    parser.add_argument('--out', type=Path, default=DEFAULT_OUT, metavar='DIR', help='folder for the results '
                        '(default: %(default)s)')
    parser.add_argument('--write-bag', type=Path, metavar='BAG',
                        help='write a new rosbag2 with the images, CameraInfo and the ground transform')
    parser.add_argument('--start', type=float, default=0.0, metavar='S', help='seconds to skip at the beginning')
    parser.add_argument('--duration', type=float, metavar='S', help='seconds to use')
    parser.set_defaults(run=_replay)


def _add_evidence(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('file', metavar='FILE.npz', type=Path, help='evidence that a replay has saved')
    _add_solving(parser)
    parser.add_argument('--out', type=Path, metavar='DIR', help='folder for the results (default: nothing is written)')
    parser.add_argument('--json', action='store_true', help='print calibration.json instead of the summary')
    parser.set_defaults(run=_evidence)


def _add_solving(parser: argparse.ArgumentParser) -> None:
    """Add what is told to the solution, whatever it is fed from."""
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument('--camera-height', type=float, metavar='H',
                       help='height of the camera above the road in metres; without any scale only the lens is '
                            'calibrated')
    scale.add_argument('--scale-distance', type=float, nargs=5, metavar=('U1', 'V1', 'U2', 'V2', 'METRES'),
                       help='instead: two pixels on the road, and the metres between them')
    scale.add_argument('--scale-speed', type=float, metavar='KM_H',
                       help='instead: the mean speed of the traffic that flows on the busiest road')
    parser.add_argument('--camera-info', type=Path, metavar='FILE',
                        help='file of camera_info_manager with the known lens: only the pose is solved')
    parser.add_argument('--params-file', type=Path, metavar='F', help='ROS 2 parameter file with options')
    parser.add_argument('--method', choices=('joint', 'paper'), help='robust method (default) or the published one')
    parser.add_argument('--allow-unit-scale', action='store_true',
                        help="without a height, give the ground plane in units of the camera's height")
    parser.add_argument('-p', '--param', action='append', default=[], metavar='NAME=VALUE',
                        help='any option by its full name, for example joint.noise_px=0.7; may be repeated')
    parser.add_argument('--quiet', action='store_true', help='no progress and no summary')


def _add_simulate(parser: argparse.ArgumentParser, argv: list[str]) -> None:
    if 'simulate' not in argv:
        return  # the simulator's options come with the simulator, which takes a while to import
    from autocalib_ros.offline import simulate

    simulate.add_arguments(parser)
    parser.set_defaults(run=lambda arguments: simulate.run(arguments) or 0)


def _add_demo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--out', type=Path, default=DEFAULT_OUT, metavar='DIR', help='folder for the results '
                        '(default: %(default)s)')
    parser.add_argument('--seed', type=int, default=0, metavar='N', help='seed of the simulated traffic')
    parser.add_argument('--scale-from', choices=('height', 'distance', 'speed'), default='height',
                        help='what is given of the truth to tell the scale (default: %(default)s)')
    parser.add_argument('--keep-bag', action='store_true', help='leave the simulated recording in DIR/recording')
    parser.set_defaults(run=_demo)


def _options(arguments: argparse.Namespace) -> Options:
    """Put the options together: defaults, then the parameter file, then the command line."""
    from autocalib_ros.offline.params import options_with, parse_assignments, read_params_file

    values: dict[str, Any] = read_params_file(arguments.params_file) if arguments.params_file else {}
    values.update(parse_assignments(arguments.param))
    values.update(_scale_values(arguments))
    if arguments.method is not None:
        values['method'] = arguments.method
    if arguments.allow_unit_scale:
        values['allow_unit_scale'] = True
    return options_with(Options(), values)


def _scale_values(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options of the one source of the scale that the command line names, if any."""
    if arguments.camera_height is not None:
        return {'camera_height': arguments.camera_height}
    if arguments.scale_distance is not None:
        *pixels, metres = arguments.scale_distance
        return {'scale_from': 'distance', 'scale.distance_px': ' '.join(f'{value:g}' for value in pixels),
                'scale.distance_m': metres}
    if arguments.scale_speed is not None:
        return {'scale_from': 'speed', 'scale.speed_km_h': arguments.scale_speed}
    return {}


def _lens(arguments: argparse.Namespace, options: Options) -> Camera | None:
    """Read the known lens: that of the command line, else the one that the parameter file gives to a live node.

    UsageError where the results could not say it in the distortion model that is asked for.
    """
    from autocalib_ros.offline.params import camera_info_file

    file = arguments.camera_info
    if file is None and arguments.params_file is not None:
        file = camera_info_file(arguments.params_file) or None
    if file is None:
        return None
    from autocalib_ros.camera_info import camera_info, read_camera_info

    lens = read_camera_info(file)
    camera_info(lens, options.distortion_model)
    return lens


def _replay(arguments: argparse.Namespace) -> int:
    options = _options(arguments)
    lens = _lens(arguments, options)
    from autocalib_ros.offline.sources import open_source
    from autocalib_ros.perception.detector.detector import open_detector

    detector = open_detector(options.detector)
    if detector is not None and not arguments.quiet:
        _tell(f'Vehicles by a {detector}')
    source = open_source(arguments.source, arguments.topic, arguments.start, arguments.duration)
    from autocalib_ros.offline import outputs

    outputs.prepare(arguments.out, arguments.write_bag)
    replayed = _replay_and_tell(source, options, arguments.out, lens=lens, detector=detector, quiet=arguments.quiet)
    if arguments.write_bag is not None:
        _write_bag(arguments.write_bag, replayed, source, options)
    return CALIBRATED if replayed.result else REFUSED


def _evidence(arguments: argparse.Namespace) -> int:
    options = _options(arguments)
    lens = _lens(arguments, options)
    from autocalib_ros.evidence import Evidence
    from autocalib_ros.offline import outputs
    from autocalib_ros.offline.replay import solve_again

    evidence, out, quiet = Evidence.load(arguments.file), arguments.out, arguments.quiet
    if out is not None:
        outputs.prepare(out)
    if not quiet:
        _tell_missing_height(options, lens)
    solved = solve_again(evidence, options, lens)
    names = [] if out is None else outputs.write_result(out, solved, arguments.file.name)
    _tell_refusal(solved)
    if arguments.json:
        _print_json(solved)
    elif not quiet:
        _print_summary(solved, out, names)
    return CALIBRATED if solved.result else REFUSED


def _replay_and_tell(source: Source, options: Options, out: Path, *, lens: Camera | None = None,
                     detector: VehicleDetector | None = None, quiet: bool = False) -> ReplayResult:
    """Replay, write the results, and say what came out: the summary on stdout, a refusal's reason on stderr."""
    from autocalib_ros.offline.outputs import write_outputs
    from autocalib_ros.offline.progress import progress_bar
    from autocalib_ros.offline.replay import replay

    if not quiet:
        _tell_missing_height(options, lens)
    with progress_bar(source.total, 'images', 'replay', quiet=quiet) as progress:
        replayed = replay(source, options, progress.update_to, lens=lens, detector=detector)
    names = write_outputs(out, replayed, source)
    _tell_refusal(replayed)
    if not quiet:
        _print_summary(replayed, out, names)
    return replayed


def _tell_missing_height(options: Options, lens: Camera | None) -> None:
    if options.scale_from == 'height' and options.camera_height == 0:
        scale = 'is given in units of that height' if options.allow_unit_scale else 'is left out'
        calibrated = 'the lens is calibrated' if lens is None else 'the lens is known'
        _tell(f'No camera height given: {calibrated}, the ground plane {scale} (see --camera-height, --scale-distance'
              ' and --scale-speed).')


def _tell_refusal(replayed: ReplayResult) -> None:
    from autocalib_ros.offline.summary import remedy, verdict

    if not replayed.result:
        _tell(f'{verdict(replayed.result)} {remedy(replayed.result)}'.rstrip())


def _print_summary(replayed: ReplayResult, out: Path | None, names: list[str]) -> None:
    from autocalib_ros.offline.summary import text_summary

    lines = text_summary(replayed.result, replayed.accepted_at_s).splitlines()
    print('\n'.join(lines if replayed.result else lines[1:]))
    if names:
        print(f'Written to {out}: {", ".join(names)}')


def _print_json(replayed: ReplayResult) -> None:
    """Print what calibration.json holds, and nothing else, so that a program can read it."""
    from autocalib_ros.calibration import calibration_json

    print(calibration_json(replayed.result, accepted_at_s=replayed.accepted_at_s))


def _write_bag(path: Path, replayed: ReplayResult, source: Source, options: Options) -> None:
    if not replayed.result:
        _tell(f'{path} is not written: there is no calibration')
        return
    from autocalib_ros.offline.write_bag import write_bag

    write_bag(path, replayed.result, source, options.tf_parent, options.ignored_polygons)


def _tell(line: str) -> None:
    print(line, file=sys.stderr)


def _demo(arguments: argparse.Namespace) -> int:
    from autocalib_ros.offline import outputs
    from autocalib_ros.offline.demo import compare, options_from, simulate_into
    from autocalib_ros.offline.sources import open_source

    bag = arguments.out / 'recording'
    outputs.prepare(arguments.out, bag)
    try:
        truth = simulate_into(bag, arguments.seed)
        replayed = _replay_and_tell(open_source(bag), options_from(truth, arguments.scale_from), arguments.out)
    finally:
        if not arguments.keep_bag:
            shutil.rmtree(bag, ignore_errors=True)
    comparison = compare(replayed.result, truth)
    if comparison is None:
        return REFUSED
    print(comparison.table())
    if not comparison.good:
        _tell('The demonstration failed: the result is farther from the truth than promised.')
    return CALIBRATED if comparison.good else REFUSED


if __name__ == '__main__':
    sys.exit(main())

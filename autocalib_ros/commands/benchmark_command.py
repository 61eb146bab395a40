"""`autocalib benchmark`."""

from __future__ import annotations

import argparse
from pathlib import Path

from autocalib_ros.commands import DONE, MOVED

HELP = 'measure accuracy and cost, or check results on stored evidence'
DESCRIPTION = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add a parser for each benchmark."""
    what = parser.add_subparsers(title='benchmarks', metavar='WHAT', dest='what', required=True)
    runtime = what.add_parser('cost', help='processor time per frame and per solution, and memory')
    runtime.add_argument('source', metavar='SOURCE', type=Path, help='recording to replay')
    runtime.add_argument('--duration', type=float, metavar='S', help='seconds of the recording to use')
    runtime.add_argument('--history', type=Path, metavar='FILE', help='CSV file to add a row of ratios and errors to')
    runtime.add_argument('--no-replay', action='store_true', help='leave out the whole replay on all cores')
    accuracy = what.add_parser('accuracy', help='errors against ground truth on synthetic traffic, by Monte Carlo')
    accuracy.add_argument('--runs', type=int, default=20, metavar='N', help='draws per family (default: %(default)s)')
    accuracy.add_argument('--family', nargs='+', default=[], metavar='NAME', help='evidence families (default: all)')
    accuracy.add_argument(
        '--method',
        nargs='+',
        choices=('joint', 'paper'),
        default=['joint', 'paper'],
        help='robust method, published method, or both (default)',
    )
    _add_jobs(accuracy)
    _add_seed(accuracy)
    accuracy.add_argument('--out', type=Path, metavar='FILE', help='CSV file to write, one row per run')
    golden = what.add_parser(
        'golden',
        help='compare results on stored evidence with the expected ones',
        description='Solve stored evidence and list every value that moved. Exit status: 0 if nothing moved, 3 '
        'otherwise, also with --update.',
    )
    _add_folder(golden)
    golden.add_argument('--only', nargs='+', default=[], metavar='NAME', help='cases to solve (default: all)')
    golden.add_argument(
        '--tolerance',
        type=float,
        default=0.1,
        metavar='T',
        help='largest change of a number that counts as equal, in units of its stated standard deviation '
        '(default: %(default)s)',
    )
    golden.add_argument('--exact', action='store_true', help='compare numbers to the last digit instead')
    golden.add_argument(
        '--update', action='store_true', help='store the new values of the cases that moved as the expected ones'
    )
    _add_jobs(golden)
    streams = what.add_parser(
        'streams',
        help='uneven time stamps and repeated images, applied to recordings',
        description='Apply faults of time stamps and repeated images to recordings while they are read, and compare '
        'the results with those of the recordings as they are. Exit status: 0 if each verdict is the same, each focal '
        'length within its standard deviation and at least 80 % of the expected tracks are left, 3 otherwise.',
    )
    streams.add_argument('recordings', metavar='RECORDING', nargs='+', type=Path, help='recordings to replay')
    streams.add_argument(
        '--kinds',
        nargs='+',
        default=[],
        metavar='KIND',
        help='faults by name; stamps and repeats are all of one sort (default: both)',
    )
    streams.add_argument('--start', type=float, default=0.0, metavar='S', help='seconds to skip at the start')
    streams.add_argument('--duration', type=float, metavar='S', help='seconds of each recording to use')
    _add_camera_height(streams)
    scenes = what.add_parser(
        'scenes',
        help='errors against ground truth on scenes that are drawn, rendered and replayed',
        description='Draw scenes (layout, pose, lens, size, light), render and compress their pictures, calibrate from '
        'them, and compare errors with the stated standard deviations. Exit status: 0 unless a result is wrong by more '
        'than 5 % or 2 degrees at grade full, 3 otherwise.',
    )
    scenes.add_argument('--count', type=int, default=60, metavar='N', help='number of scenes (default: %(default)s)')
    scenes.add_argument('--first', type=int, default=0, metavar='N', help='number of the first one (default: 0)')
    _add_seed(scenes)
    _add_jobs(scenes)
    scenes.add_argument(
        '--evidence', type=Path, metavar='FOLDER', help='folder that keeps the evidence; what is there is not rendered'
    )
    stability = what.add_parser(
        'stability',
        help='results with a tenth of the vehicles left out',
        description='Solve stored evidence again and again with a tenth of its vehicles left out at random. Exit '
        'status: 0 if at least 95 % of the draws have the verdict of all vehicles and the numbers spread by at most '
        'half a stated standard deviation, 3 otherwise.',
    )
    stability.add_argument('files', metavar='EVIDENCE', nargs='+', type=Path, help='evidence files (.npz)')
    stability.add_argument('--draws', type=int, default=20, metavar='N', help='draws per file (default: %(default)s)')
    _add_camera_height(stability)
    _add_jobs(stability)
    lengths = what.add_parser(
        'lengths',
        help='measured lengths on real roads, predicted from one of them',
        description='Calibrate real cameras from their tracks with one measured length along the road, and one across '
        'it or the mean speed, and compare the other lengths along the road. Exit status: 0 if they are within 2.5 % '
        'in the median and 6 % at the 90th percentile, and 85 to 98 % within 1.96 stated standard deviations, 3 '
        'otherwise.',
    )
    lengths.add_argument(
        'folder', metavar='FOLDER', type=Path, help='one .npz file per camera, in the form of BrnoCompSpeed'
    )
    lengths.add_argument(
        '--draws', type=int, default=3, metavar='N', help='choices of told lengths per camera (default: %(default)s)'
    )
    _add_seed(lengths)
    _add_jobs(lengths)
    variants = what.add_parser(
        'options',
        help='documented options, and pairs of them, on stored evidence with known truth',
        description='Solve stored evidence whose truth is known with other values of the documented options. Exit '
        'status: 0 unless an option makes a result wrong with confidence (3.5 stated standard deviations), 3 '
        'otherwise.',
    )
    _add_folder(variants)
    variants.add_argument('--only', nargs='+', default=[], metavar='OPTION', help='options to vary (default: all)')
    variants.add_argument('--pairs', action='store_true', help='also each pair of options')
    _add_jobs(variants)
    moves = what.add_parser(
        'moves',
        help='camera moves applied to recordings: detection time and measurement error',
        description='Turn and zoom the images of recordings through their lens (truth.json beside them) by known '
        'amounts, with sway, clouds, noise and a jam. Exit status: 0 if each move is detected within 30 s and '
        'measured to 0.3 degrees, and nothing is detected without a move, 3 otherwise.',
    )
    moves.add_argument('recordings', metavar='RECORDING', nargs='+', type=Path, help='recordings of still cameras')
    _add_width(moves, 1280)
    still = what.add_parser(
        'still',
        help='false alarms in hours of images of a camera that stands still',
        description='Play recordings of still cameras for hours in the light and weather of days, with sway, jams and '
        'noise, and show them to the watch of the view; in the first hours also to the perception. Exit status: 0 '
        'unless more than one move, fault or further view is told, 3 otherwise.',
    )
    still.add_argument('recordings', metavar='RECORDING', nargs='+', type=Path, help='recordings of still cameras')
    still.add_argument('--hours', type=float, default=10.0, metavar='H', help='hours of all (default: %(default)s)')
    still.add_argument(
        '--perception-hours', type=float, default=2.0, metavar='H', help='those with perception (default: %(default)s)'
    )
    still.add_argument(
        '--day-hours', type=float, default=5.0, metavar='H', help='hours of a day (default: %(default)s)'
    )
    _add_width(still, 640)
    soaked = what.add_parser(
        'soak',
        help='a day and a night of a live node, faster than real time (needs ROS)',
        description='Run a live node in a process of its own on images of a recording in the light and weather of a '
        'day, and sample its memory, descriptors, threads, log and answer. Some hours have traffic in the images; in '
        'the others its observations come with images of the still road. Exit status: 0 if all is flat, 3 otherwise.',
    )
    soaked.add_argument(
        'recording',
        metavar='RECORDING',
        type=Path,
        help='recording of a still camera; or samples of an earlier run (.csv), to be judged and drawn again',
    )
    soaked.add_argument('--hours', type=float, default=24.0, metavar='H', help='simulated hours (default: %(default)s)')
    soaked.add_argument(
        '--image-hours', type=float, default=1.0, metavar='H', help='those with traffic in the images (default: 1)'
    )
    soaked.add_argument(
        '--day-hours', type=float, default=24.0, metavar='H', help='hours of a day and a night (default: %(default)s)'
    )
    _add_width(soaked, 640)
    _add_camera_height(soaked)
    soaked.add_argument('--log', type=Path, default=Path('soak.log'), metavar='FILE', help='log of the node to write')
    soaked.add_argument('--csv', type=Path, metavar='FILE', help='samples to write')
    soaked.add_argument('--figure', type=Path, metavar='FILE', help='figure to write, as .svg or .png')


def _add_folder(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        'folder',
        metavar='FOLDER',
        nargs='?',
        type=Path,
        default=Path('tests/golden'),
        help='folder with the evidence and expected.json (default: %(default)s)',
    )


def _add_jobs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--jobs', type=int, default=1, metavar='J', help='number of processes (default: %(default)s)')


def _add_seed(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--seed', type=int, default=0, metavar='S', help='seed of the draws (default: %(default)s)')


def _add_width(parser: argparse.ArgumentParser, default: int) -> None:
    parser.add_argument(
        '--width', type=int, default=default, metavar='PX', help='largest width of the images (default: %(default)s)'
    )


def _add_camera_height(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--camera-height', type=float, default=8.0, metavar='H', help='height in metres (default: %(default)s)'
    )


def run(arguments: argparse.Namespace) -> int:
    """Run a benchmark and print its report; return the exit status."""
    if arguments.what == 'cost':
        return _run_cost(arguments)
    if arguments.what == 'golden':
        from autocalib_ros.offline.benchmark import golden

        golden_run = golden.run_cases(
            arguments.folder, arguments.only, tolerance=arguments.tolerance, exact=arguments.exact, jobs=arguments.jobs
        )
        print('\n'.join(golden.format_report(golden_run)))
        if arguments.update:
            golden.update(arguments.folder, golden_run)
        return MOVED if golden_run.moved else DONE
    if arguments.what in BENCHMARK_TABLES:
        return BENCHMARK_TABLES[arguments.what](arguments)
    from autocalib_ros.offline.benchmark.monte_carlo import run_monte_carlo
    from autocalib_ros.offline.benchmark.table import format_tables

    print(
        format_tables(
            run_monte_carlo(
                arguments.family,
                arguments.method,
                arguments.runs,
                seed=arguments.seed,
                jobs=arguments.jobs,
                out=arguments.out,
            )
        )
    )
    return DONE


def _run_cost(arguments: argparse.Namespace) -> int:
    from autocalib_ros.offline.benchmark import cost_history, runtime

    cost = runtime.measure_live_cost(arguments.source, arguments.duration)
    print(runtime.format_cost(cost), flush=True)
    if arguments.history is not None:
        cost_history.add_to_history(arguments.history, cost, arguments.source)
    if not arguments.no_replay:
        print(runtime.measure_replay_speed(arguments.source, arguments.duration))
    return DONE


def _run_streams(arguments: argparse.Namespace) -> int:
    from autocalib_ros.config import Options
    from autocalib_ros.offline.benchmark.streams import measure_streams

    failed = False
    for line, is_failure in measure_streams(
        arguments.recordings,
        arguments.kinds,
        Options(camera_height=arguments.camera_height),
        start_s=arguments.start,
        duration_s=arguments.duration,
    ):
        print(line, flush=True)
        failed |= is_failure
    return MOVED if failed else DONE


def _run_scenes(arguments: argparse.Namespace) -> int:
    from autocalib_ros.offline.benchmark import drawn_scenes as scenes

    runs = []
    print(scenes.HEADER)
    for scene_run in scenes.measure_scenes(
        arguments.count, first=arguments.first, seed=arguments.seed, jobs=arguments.jobs, folder=arguments.evidence
    ):
        runs.append(scene_run)
        print(scenes.format_run(scene_run), flush=True)
    print(scenes.format_summary(runs))
    return MOVED if any(each.wrong for each in runs) else DONE


def _run_stability(arguments: argparse.Namespace) -> int:
    from autocalib_ros.config import Options
    from autocalib_ros.offline.benchmark import stability

    options, stable = Options(camera_height=arguments.camera_height), True
    print(stability.STABILITY_HEADER)
    for each in stability.measure_stability(arguments.files, options, draws=arguments.draws, jobs=arguments.jobs):
        stable &= each.stable
        print(stability.format_stability(each), flush=True)
    return DONE if stable else MOVED


def _run_lengths(arguments: argparse.Namespace) -> int:
    from autocalib_ros.offline.benchmark import lengths

    runs = []
    print(lengths.LENGTHS_HEADER)
    for each in lengths.measure_lengths(
        arguments.folder, draws=arguments.draws, seed=arguments.seed, jobs=arguments.jobs
    ):
        runs.append(each)
        print(lengths.format_lengths(each), flush=True)
    together = [lengths.all_of(runs, told) for told in lengths.TOLD_KINDS]
    print('\n'.join(map(lengths.format_lengths, together)))
    return DONE if all(each.good for each in together) else MOVED


def _run_options(arguments: argparse.Namespace) -> int:
    from autocalib_ros.offline.benchmark import option_variants

    wrong = False
    print(option_variants.VARIANT_HEADER)
    for each in option_variants.measure_variants(
        arguments.folder, pairs=arguments.pairs, jobs=arguments.jobs, only=arguments.only
    ):
        wrong |= each.wrong
        print(option_variants.format_variant(each), flush=True)
    return MOVED if wrong else DONE


def _run_moves(arguments: argparse.Namespace) -> int:
    from autocalib_ros.offline.benchmark import moves

    good = True
    print(moves.MOVES_HEADER)
    for each in moves.measure_moves(arguments.recordings, arguments.width):
        good &= each.is_good
        print(moves.format_move(each), flush=True)
    return DONE if good else MOVED


def _run_still(arguments: argparse.Namespace) -> int:
    from autocalib_ros.offline.benchmark import still_hours

    hours = []
    print(still_hours.STILL_HEADER)
    for each in still_hours.measure_still_hours(
        arguments.recordings,
        arguments.hours,
        perception_hours=arguments.perception_hours,
        day_hours=arguments.day_hours,
        width=arguments.width,
    ):
        hours.append(each)
        print(still_hours.format_still_hour(each), flush=True)
    print(still_hours.format_still_summary(hours))
    return MOVED if sum(each.false_flags for each in hours) > still_hours.ALLOWED_FALSE_FLAGS else DONE


def _run_soak(arguments: argparse.Namespace) -> int:
    from autocalib_ros.offline.benchmark import long_stream, soak

    print(soak.SOAK_HEADER)
    if arguments.recording.suffix == '.csv':
        samples = soak.read_samples(arguments.recording)
        print('\n'.join(map(soak.format_soak_sample, samples)))
    else:
        recording = long_stream.read_short_recording(
            arguments.recording, arguments.width, soak.DENSE_HZ, long_stream.MAX_RECORDED
        )
        plan = soak.SoakPlan(arguments.hours, arguments.image_hours, arguments.day_hours, arguments.camera_height)
        samples = []
        for each in soak.soak(recording, plan, arguments.log):
            samples.append(each)
            print(soak.format_soak_sample(each), flush=True)
            if arguments.csv is not None:
                soak.write_samples(arguments.csv, samples)
    checks = soak.soak_checks(samples)
    print(soak.format_soak_checks(checks))
    if arguments.figure is not None:
        from autocalib_ros.offline.benchmark.soak_figure import write_soak_figure

        write_soak_figure(arguments.figure, samples)
    return DONE if all(check.is_flat for check in checks) else MOVED


BENCHMARK_TABLES = {
    'streams': _run_streams,
    'scenes': _run_scenes,
    'stability': _run_stability,
    'lengths': _run_lengths,
    'options': _run_options,
    'moves': _run_moves,
    'still': _run_still,
    'soak': _run_soak,
}
"""Benchmarks that print one row after the other."""

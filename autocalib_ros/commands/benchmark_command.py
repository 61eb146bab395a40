"""`autocalib benchmark`."""

from __future__ import annotations

import argparse
from pathlib import Path

from autocalib_ros.commands import DONE, MOVED

HELP = 'measure what the program costs on this machine'
DESCRIPTION = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add a parser for each benchmark."""
    what = parser.add_subparsers(title='benchmarks', metavar='WHAT', dest='what', required=True)
    cost = what.add_parser('cost', help='processor time of a frame and of a solution, and memory')
    cost.add_argument('source', metavar='SOURCE', type=Path, help='recording to measure on')
    cost.add_argument('--duration', type=float, metavar='S', help='seconds of it to use')
    accuracy = what.add_parser('accuracy', help='errors against the truth of made-up traffic, by Monte Carlo')
    accuracy.add_argument('--runs', type=int, default=20, metavar='N', help='draws per family (default: %(default)s)')
    accuracy.add_argument('--family', nargs='+', default=[], metavar='NAME', help='kinds of evidence (default: all)')
    accuracy.add_argument(
        '--method',
        nargs='+',
        choices=('joint', 'paper'),
        default=['joint', 'paper'],
        help='robust method, the published one, or both (default)',
    )
    accuracy.add_argument('--jobs', type=int, default=1, metavar='J', help='processes (default: %(default)s)')
    accuracy.add_argument('--seed', type=int, default=0, metavar='S', help='seed of the draws (default: %(default)s)')
    accuracy.add_argument('--out', type=Path, metavar='FILE', help='CSV to write, one row a run')
    golden = what.add_parser(
        'golden',
        help='whether saved evidence still gives the verdicts and numbers that are expected of it',
        description='Solve saved evidence and print what moved. Exit status 0 when nothing did, 3 when something did, '
        'also where --update took it for expected.',
    )
    golden.add_argument(
        'folder',
        metavar='FOLDER',
        nargs='?',
        type=Path,
        default=Path('tests/golden'),
        help='evidence and expected.json (default: %(default)s)',
    )
    golden.add_argument('--only', nargs='+', default=[], metavar='NAME', help='cases to solve (default: all)')
    golden.add_argument(
        '--tolerance',
        type=float,
        default=0.1,
        metavar='T',
        help='a number has moved when it differs by more than this part of its stated standard '
        'deviation (default: %(default)s)',
    )
    golden.add_argument('--exact', action='store_true', help='instead: when it differs in its last digit')
    golden.add_argument(
        '--update', action='store_true', help='of cases in which something moved, expect what was found from now on'
    )
    golden.add_argument('--jobs', type=int, default=1, metavar='J', help='processes (default: %(default)s)')


def run(arguments: argparse.Namespace) -> int:
    """Measure and print."""
    if arguments.what == 'cost':
        from autocalib_ros.offline.benchmark.runtime import cost

        print(cost(arguments.source, arguments.duration))
        return DONE
    if arguments.what == 'golden':
        from autocalib_ros.offline.benchmark import golden

        measured = golden.measure(
            arguments.folder, arguments.only, tolerance=arguments.tolerance, exact=arguments.exact, jobs=arguments.jobs
        )
        print('\n'.join(golden.lines(measured)))
        if arguments.update:
            golden.update(arguments.folder, measured)
        return MOVED if measured.moved else DONE
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

"""`autocalib evidence`."""

from __future__ import annotations

import argparse
from pathlib import Path

from autocalib_ros.commands import DONE, REFUSED
from autocalib_ros.commands.output import print_result, warn_missing_scale
from autocalib_ros.commands.solve_options import add_solve_options, options_from_arguments, read_known_lens

HELP = 'solve saved evidence again with other options'
DESCRIPTION = (
    'Solve the evidence.npz of a replay again, without images. tracking.*, motion.* and buffer.* affect evidence '
    'collection only and are ignored here. Exit status as for replay.'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the evidence file, the solver options and the output folder."""
    parser.add_argument('file', metavar='FILE.npz', type=Path, help='evidence saved by replay')
    add_solve_options(parser)
    parser.add_argument('--out', type=Path, metavar='DIR', help='folder for the results (default: write no files)')


def run(arguments: argparse.Namespace) -> int:
    """Solve saved evidence; return the exit status."""
    options = options_from_arguments(arguments)
    lens = read_known_lens(arguments, options)
    from autocalib_ros.evidence.snapshot import Evidence
    from autocalib_ros.offline import outputs
    from autocalib_ros.offline.replay_recording import solve_evidence

    evidence, out = Evidence.load(arguments.file), arguments.out
    if out is not None:
        outputs.prepare_output_dir(out)
    if not arguments.quiet:
        warn_missing_scale(options, lens)
    solved = solve_evidence(evidence, options, lens)
    names = [] if out is None else outputs.write_result(out, solved, arguments.file.name)
    print_result(solved, out, names, quiet=arguments.quiet, json=arguments.json)
    return DONE if solved.result else REFUSED

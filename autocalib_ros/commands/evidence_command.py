"""`autocalib evidence`."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from autocalib_ros.commands import DONE, REFUSED
from autocalib_ros.commands.output import print_result, warn_missing_scale
from autocalib_ros.commands.solve_options import add_solve_options, options_from_arguments, read_known_lens
from autocalib_ros.config import Options
from autocalib_ros.errors import UsageError

if TYPE_CHECKING:
    from autocalib_ros.evidence.snapshot import Evidence

HELP = 'solve saved evidence again with other options, or the tracks of another program'
DESCRIPTION = (
    'Solve the evidence.npz of a replay again, without images. Or solve tracks of another program: a CSV file with the '
    'columns time_s, vehicle_id, track_id, x_px and y_px, or a MOT file. tracking.* and motion.* affect the collection '
    'of evidence only and are ignored here, as buffer.* is for saved evidence. Exit status as for replay.'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the evidence file, the solver options and the output folder."""
    parser.add_argument('file', metavar='FILE', type=Path, help='evidence.npz of a replay, or tracks (.csv, .txt)')
    parser.add_argument(
        '--image-size', type=int, nargs=2, metavar=('WIDTH', 'HEIGHT'), help='tracks: size of their images in pixels'
    )
    parser.add_argument('--fps', type=float, help='MOT file: frame rate')
    add_solve_options(parser)
    parser.add_argument('--out', type=Path, metavar='DIR', help='folder for the results (default: write no files)')


def run(arguments: argparse.Namespace) -> int:
    """Solve saved evidence; return the exit status."""
    options = options_from_arguments(arguments)
    lens = read_known_lens(arguments, options)
    from autocalib_ros.offline import outputs
    from autocalib_ros.offline.replay_recording import solve_evidence

    evidence, out = _read_evidence(arguments, options), arguments.out
    if out is not None:
        outputs.prepare_output_dir(out)
    if not arguments.quiet:
        warn_missing_scale(options, lens)
    solved = solve_evidence(evidence, options, lens)
    names = [] if out is None else outputs.write_result(out, solved, arguments.file.name)
    print_result(solved, out, names, quiet=arguments.quiet, json=arguments.json)
    return DONE if solved.result else REFUSED


def _read_evidence(arguments: argparse.Namespace, options: Options) -> Evidence:
    """Return saved evidence, or that of a file of tracks; UsageError if the size of the images is not given."""
    from autocalib_ros.evidence.snapshot import Evidence
    from autocalib_ros.offline.track_files import SUFFIXES, evidence_from_file

    if arguments.file.suffix.lower() not in SUFFIXES:
        return Evidence.load(arguments.file)
    if arguments.image_size is None or min(arguments.image_size) < 1:
        raise UsageError(f'{arguments.file} holds tracks: give the size of their images with --image-size WIDTH HEIGHT')
    if arguments.fps is not None and not 0 < arguments.fps < math.inf:
        raise UsageError(f'--fps must be above 0; got {arguments.fps:g}')
    return evidence_from_file(arguments.file, tuple(arguments.image_size), arguments.fps, options.buffer)

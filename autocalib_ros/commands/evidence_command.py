"""`autocalib evidence`."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from autocalib_ros.commands import DONE, REFUSED
from autocalib_ros.commands.output import print_result, warn_missing_scale, write_ground_tracks
from autocalib_ros.commands.solve_options import (
    add_solve_options,
    control_points,
    options_from_arguments,
    printed_params,
    read_known_lens,
)
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
    parser.add_argument(
        'files',
        metavar='FILE',
        nargs='*',
        type=Path,
        help='evidence.npz of a replay, or tracks (.csv, .txt); several evidence.npz of the same view are joined',
    )
    parser.add_argument(
        '--image-size', type=int, nargs=2, metavar=('WIDTH', 'HEIGHT'), help='tracks: size of their images in pixels'
    )
    parser.add_argument('--fps', type=float, help='MOT file: frame rate')
    add_solve_options(parser)
    parser.add_argument('--out', type=Path, metavar='DIR', help='folder for the results (default: write no files)')


def run(arguments: argparse.Namespace) -> int:
    """Solve saved evidence; return the exit status."""
    points = control_points(arguments)
    options = options_from_arguments(arguments, points)
    if printed_params(arguments, options, 'FILE'):
        return DONE
    lens = read_known_lens(arguments, options)
    from autocalib_ros.offline import outputs
    from autocalib_ros.offline.ground_tracks import require_tracks_path
    from autocalib_ros.offline.replay_recording import solve_evidence

    if arguments.tracks is not None:
        require_tracks_path(arguments.tracks)
    evidence, out = _read_evidence(arguments, options), arguments.out
    if out is not None:
        outputs.prepare_output_dir(out)
    if not arguments.quiet:
        warn_missing_scale(options)
    solved = solve_evidence(evidence, options, lens)
    first, more = arguments.files[0], len(arguments.files) - 1
    name = f'{first.name} and {more} more' if more else first.name
    names = [] if out is None else outputs.write_result(out, solved, name)
    print_result(solved, out, names, quiet=arguments.quiet, json=arguments.json, points=points)
    if arguments.tracks is not None:
        write_ground_tracks(arguments.tracks, solved, quiet=arguments.quiet)
    return DONE if solved.result else REFUSED


def _read_evidence(arguments: argparse.Namespace, options: Options) -> Evidence:
    """Return saved evidence, several files joined, or that of a file of tracks.

    UsageError if the size of the images of tracks is not given, or if tracks are among several files.
    """
    from autocalib_ros.evidence.snapshot import Evidence
    from autocalib_ros.offline.join_recordings import join_evidence
    from autocalib_ros.offline.track_files import SUFFIXES, evidence_from_file

    files: list[Path] = arguments.files
    tracks = [file for file in files if file.suffix.lower() in SUFFIXES]
    if not tracks:
        return join_evidence([(Evidence.load(file), str(file)) for file in files], options.gate).all()
    if len(files) > 1:
        raise UsageError(f'{tracks[0]} holds tracks, which have no background to join them by: give it alone')
    if arguments.image_size is None or min(arguments.image_size) < 1:
        raise UsageError(f'{tracks[0]} holds tracks: give the size of their images with --image-size WIDTH HEIGHT')
    if arguments.fps is not None and not 0 < arguments.fps < math.inf:
        raise UsageError(f'--fps must be above 0; got {arguments.fps:g}')
    return evidence_from_file(tracks[0], tuple(arguments.image_size), arguments.fps, options.buffer)

"""`autocalib replay`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from autocalib_ros.commands import DONE, REFUSED
from autocalib_ros.commands.interruption import StopRequest
from autocalib_ros.commands.output import print_stderr, replay_and_report, write_ground_tracks
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
    from autocalib_ros.offline.recordings.sources import Source
    from autocalib_ros.results.calibration import Calibration, Refusal

HELP = 'calibrate from a recording'
DESCRIPTION = 'Calibrate from a recording. Exit status: 0 calibrated, 3 refused, 2 wrong usage or unreadable input.'
DEFAULT_OUT = Path('autocalib_out')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the recording, the solver options and the output files."""
    parser.add_argument(
        'sources',
        metavar='SOURCE',
        nargs='*',
        help='rosbag2 folder, .mcap, .db3, ROS 1 .bag, video file, images (folder or pattern), folder of clips, stream '
        '(rtsp://, http://) or camera device (/dev/video0); several recordings of the same view are joined',
    )
    add_solve_options(parser)
    parser.add_argument('--topic', metavar='T', help='image topic; required if the recording has several')
    parser.add_argument(
        '--out', type=Path, default=DEFAULT_OUT, metavar='DIR', help='folder for the results (default: %(default)s)'
    )
    parser.add_argument(
        '--write-bag',
        type=Path,
        metavar='BAG',
        help='write a new rosbag2 with the images, CameraInfo and the ground transform',
    )
    parser.add_argument(
        '--resume',
        action='store_true',
        help='continue from evidence.npz in the output folder: read only what it does not cover yet',
    )
    parser.add_argument('--start', type=float, default=0.0, metavar='S', help='seconds to skip at the start')
    parser.add_argument('--duration', type=float, metavar='S', help='seconds to use; of a stream, to record')
    parser.add_argument(
        '--rate', type=float, metavar='HZ', help='images per second of image files and of videos without times'
    )


def run(arguments: argparse.Namespace) -> int:
    """Calibrate from a recording; return the exit status."""
    points = control_points(arguments)
    options = options_from_arguments(arguments, points)
    if printed_params(arguments, options, 'SOURCE'):
        return DONE
    lens = read_known_lens(arguments, options)
    from autocalib_ros.offline.recordings.listing import recordings_of
    from autocalib_ros.offline.recordings.open import open_sources
    from autocalib_ros.perception.detector.detector import open_detector
    from autocalib_ros.perception.opencv_threads import pin_opencv_threads

    pin_opencv_threads()
    detector = open_detector(options.detector)
    if detector is not None and not arguments.quiet:
        print_stderr(f'Vehicle tracks from a {detector}')
    if arguments.tracks is not None:
        from autocalib_ros.offline.ground_tracks import require_tracks_path

        require_tracks_path(arguments.tracks)
    stop = StopRequest()
    sources = open_sources(
        recordings_of(arguments.sources), arguments.topic, arguments.start, arguments.duration, arguments.rate, stop
    )
    if arguments.write_bag is not None and len(sources) > 1:
        raise UsageError(f'--write-bag takes one recording, and there are {len(sources)}')
    from autocalib_ros.offline import outputs

    outputs.prepare_output_dir(arguments.out, arguments.write_bag)
    before, named = None, sources
    if arguments.resume:
        before, sources = _resumed(arguments, sources)
    replayed = replay_and_report(
        sources,
        options,
        arguments.out,
        lens=lens,
        detector=detector,
        quiet=arguments.quiet,
        json=arguments.json,
        stop=stop,
        before=before,
        named_after=named,
        points=points,
    )
    if arguments.tracks is not None:
        write_ground_tracks(arguments.tracks, replayed, quiet=arguments.quiet)
    if arguments.write_bag is not None:
        _write_bag(arguments.write_bag, replayed.result, named[0], options)
    return DONE if replayed.result else REFUSED


def _resumed(arguments: argparse.Namespace, sources: list[Source]) -> tuple[Evidence | None, list[Source]]:
    """Return the evidence of the earlier run, None without one, and what is left to read."""
    from autocalib_ros.offline.outputs import EVIDENCE
    from autocalib_ros.offline.resume import read_evidence_to_resume, sources_to_read

    if arguments.start > 0 or (arguments.duration is not None and not all(source.is_live for source in sources)):
        raise UsageError('--resume reads recordings to their end: leave out --start and --duration')
    before = read_evidence_to_resume(arguments.out / EVIDENCE)
    if before is None:
        print_stderr(f'{arguments.out / EVIDENCE} does not exist: no evidence to resume from, so all is read.')
        return None, sources
    left = sources_to_read(sources, before)
    if not arguments.quiet:
        print_stderr(f'Going on from {arguments.out / EVIDENCE}: {len(left)} of {len(sources)} recordings to read.')
    return before, left


def _write_bag(path: Path, result: Calibration | Refusal, source: Source, options: Options) -> None:
    from autocalib_ros.results.calibration import Refusal

    if isinstance(result, Refusal):
        print_stderr(f'{path} is not written: no calibration')
        return
    from autocalib_ros.offline.recordings.write_bag import write_bag

    write_bag(path, result, source, options.tf_parent, options.ignored_polygons)

"""Terminal output of a solution: results on stdout, everything else on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autocalib_ros.commands.interruption import StopRequest
from autocalib_ros.commands.map_output import place_result, placement_lines, write_map
from autocalib_ros.config import Options

if TYPE_CHECKING:
    import numpy as np

    from autocalib_ros.evidence.snapshot import Evidence
    from autocalib_ros.lens.camera import Camera
    from autocalib_ros.offline.recordings.sources import Source
    from autocalib_ros.offline.replay_recording import ReplayResult
    from autocalib_ros.perception.detector.detector import VehicleDetector
    from autocalib_ros.results.calibration import Calibration
    from autocalib_ros.results.control_points import ControlPoints


def print_stderr(line: str) -> None:
    """Print a line on stderr."""
    print(line, file=sys.stderr)


def replay_and_report(
    sources: Sequence[Source],
    options: Options,
    out: Path,
    *,
    lens: Camera | None = None,
    detector: VehicleDetector | None = None,
    quiet: bool = False,
    json: bool = False,
    stop: StopRequest | None = None,
    before: Evidence | None = None,
    named_after: Sequence[Source] | None = None,
    points: ControlPoints | None = None,
    truth: Mapping[str, Any] | None = None,
    on_accepted: Callable[[Calibration, np.ndarray], None] | None = None,
) -> ReplayResult:
    """Replay recordings of one camera, write the output files and print the result.

    `stop` is the request that live streams among the sources ask; `before` is evidence of an earlier run, then the
    results are named after all its sources, `named_after`. Control `points` give the place in the map. With
    the `truth` of a simulation the report compares the result with it. `on_accepted` receives the first calibration.
    """
    from autocalib_ros.offline.outputs import EvidenceFile, write_outputs
    from autocalib_ros.offline.replay_recording import replay
    from autocalib_ros.offline.terminal.progress import progress_bar
    from autocalib_ros.report.figure_process import FigureProcess
    from autocalib_ros.solver_process import BackgroundSolver

    if not quiet:
        warn_missing_scale(options)
    file, stop = EvidenceFile(out), stop or StopRequest()
    totals = [source.total for source in sources]
    total = None if None in totals else sum(one for one in totals if one is not None)
    with closing(FigureProcess()) as figures:
        with (
            closing(BackgroundSolver()) as solver,
            stop.listening(),
            progress_bar(total, 'images', 'replay', quiet=quiet) as progress,
        ):
            replayed = replay(
                sources,
                options,
                progress.update_to,
                lens=lens,
                detector=detector,
                should_stop=stop,
                on_checkpoint=file.write,
                before=before,
                start_solving=solver,
                on_accepted=on_accepted,
                on_last_solution=figures.start,
            )
        if replayed.stopped:
            print_stderr(f'Stopped after {replayed.frames} images; the result is of these.')
        if not quiet:
            _tell_of_images(replayed)
        names = write_outputs(out, replayed, named_after or sources, file, truth, figures)
    print_result(replayed, out, names, quiet=quiet, json=json, points=points)
    return replayed


def _tell_of_images(replayed: ReplayResult) -> None:
    """Tell on stderr what became of the images, where that is not what one expects."""
    if replayed.displacements_px:
        print_stderr(
            f'{1 + len(replayed.displacements_px)} recordings are joined; their views were displaced by up to '
            f'{max(replayed.displacements_px):.2f} px, which is undone.'
        )
    if replayed.repeated:
        print_stderr(f'{replayed.repeated} of {replayed.frames} images repeat an earlier one and are left out.')
    if not replayed.evidence.picture.fills_image:
        print_stderr(replayed.evidence.picture.description)


def write_ground_tracks(path: Path, replayed: ReplayResult, *, quiet: bool) -> None:
    """Write the vehicle tracks of a result; say so, or why there are none."""
    from autocalib_ros.offline.ground_tracks import ground_tracks, write_tracks

    found = replayed.result.candidate
    if not replayed.result or found is None or found.ground is None:
        print_stderr(f'{path} is not written: no calibration with a ground plane')
        return
    tracks = ground_tracks(replayed.evidence, found, replayed.options)
    write_tracks(path, tracks)
    if not quiet:
        vehicles = len(set(tracks.vehicle_id.tolist()))
        print_stderr(f'{path}: {vehicles} road users, {len(tracks.time_s)} rows')


def warn_missing_scale(options: Options) -> None:
    """Warn on stderr if no metric scale is given: the vehicles give a rough one at best."""
    if options.gives_scale:
        return
    if options.allow_unit_scale:
        otherwise = 'the ground plane is given in units of that height'
    else:
        otherwise = (
            'the size of the vehicles gives the scale, to 14 % at best, if enough are seen; else the ground plane is '
            'left out'
        )
    print_stderr(f'No camera height given: {otherwise} (see --camera-height, --distance, --scale-speed and --lanes).')


def print_result(
    replayed: ReplayResult,
    out: Path | None,
    names: list[str],
    *,
    quiet: bool,
    json: bool,
    points: ControlPoints | None = None,
) -> None:
    """Print a refusal on stderr, and the summary or calibration.json on stdout; place it in the map of `points`."""
    from autocalib_ros.offline.terminal.style import coloured, is_terminal, state_colour, terminal_width
    from autocalib_ros.offline.terminal.summary import summary_lines
    from autocalib_ros.report.next_command import next_command
    from autocalib_ros.report.text import remedy, verdict
    from autocalib_ros.results.calibration_json import calibration_json

    result = replayed.result
    if not result:
        print_stderr(coloured(f'{verdict(result)} {remedy(result)}'.rstrip(), state_colour(result), sys.stderr))
    placement = None if points is None else place_result(result, points)
    if placement is not None and points is not None and out is not None:
        names = [*names, write_map(out, placement, points)]
    if json:
        print(calibration_json(result, accepted_at_s=replayed.accepted_at_s, moves=replayed.moves), flush=True)
    if quiet:
        return
    if not json:
        columns = terminal_width(sys.stdout) if is_terminal(sys.stdout) else None
        if result:
            print(coloured(verdict(result), state_colour(result), sys.stdout))
        print('\n'.join(summary_lines(result, replayed.accepted_at_s, columns, replayed.moves)))
        command = next_command(result, replayed.options, out) if out is not None and names else ''
        if command:
            print(f'  to try next: {command}')
    if placement is not None and points is not None:
        print('\n'.join(placement_lines(placement, points)), file=sys.stderr if json else sys.stdout)
    if names:
        print(f'Written to {out}: {", ".join(names)}', file=sys.stderr if json else sys.stdout)

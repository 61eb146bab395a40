"""Faults of streams, uneven stamps and repeated images, applied to recordings: `autocalib benchmark streams`.

Each fault is applied to each recording while it is read, and compared with the recording as it is, or through the same
codec without the fault. The verdict has to be the same, the focal length within its stated standard deviation, and at
least `MIN_TRACKS` of the tracks have to be left, of those that the images can give that are left: see `COMPARED_WITH`
and `SHARE_SEEN`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.offline.benchmark.repeating_source import RepeatingSource
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.recordings.sources import Source
from autocalib_ros.offline.simulate.repeat_faults import REPEAT_FAULTS, RepeatFault, every_image
from autocalib_ros.offline.simulate.stamp_faults import (
    MESSAGE_FAULTS,
    SECOND_NS,
    STAMP_FAULTS,
    RestampedSource,
    StampFault,
    by_message,
    cut,
    second_half,
)
from autocalib_ros.results.calibration import Refusal

EVEN = 'even'
"""The recording as it is."""
MIN_TRACKS = 0.8
"""Least number of tracks, fraction of those of the recording that a fault is compared with."""
MAX_FOCAL_SIGMAS = 1.0
"""Largest difference of the focal length, in its standard deviations of the recording that a fault is compared with."""
MESSAGE_EPOCH_NS = 1_700_000_000 * SECOND_NS
"""Time of the first image of faults that messages carry: headers hold the time of day, recordings begin at zero."""
PARTS: dict[str, StampFault] = {'second_half': second_half, 'cut': cut}
"""Parts of the recording with even stamps, by name."""
COMPARED_WITH = {'started_again': 'second_half', 'pause': 'cut'}
"""Faults that are compared with a part of the recording: with the images that are left. Stamps that begin again are
another recording, of a camera that may have moved: the evidence is reset in the middle, and that of the second half is
left. A pause lacks `RARE_S` of the images, which no stamps bring back; evidence from before it has to stay.
"""
SHARE_SEEN = {'dropped_half': 0.5, 'replaced_1_in_2_jpeg': 0.5}
"""Share of the camera's images that are seen under faults that take away more than a few, 1 under the others. As many
tracks are expected: each vehicle is seen in half as many images, moves twice as far from one to the next, and a track
needs `MIN_TRACK_SAMPLES` of them. Verdict and focal length are expected as without the fault.
"""
GROUPS = {
    'stamps': tuple(name for name in STAMP_FAULTS if name != EVEN),
    'repeats': tuple(REPEAT_FAULTS),
}
"""Kinds of faults by a common name."""
ROW_FORMAT = '{:<28}{:<26}{:>10}{:>9}{:>9}{:>8}{:>8}{:>10}  {:<16}{}'
HEADER_CELLS = ('kind', 'verdict', 'focal px', 'sigma', 'sigmas', 'tracks', '%', 'repeated', 'compared with', '')


@dataclass(frozen=True)
class StreamRun:
    """Outcome of one recording with one fault."""

    kind: str
    verdict: str
    """Grade of the calibration or code of the refusal."""
    tracks: int
    frames: int
    repeated: int
    focal_px: float | None = None
    focal_sigma_px: float | None = None

    def focal_sigmas(self, even: StreamRun) -> float | None:
        """Return the difference of the focal length from that of `even` in its standard deviations."""
        if self.focal_px is None or even.focal_px is None or not even.focal_sigma_px:
            return None
        return (self.focal_px - even.focal_px) / even.focal_sigma_px

    def faults(self, even: StreamRun) -> list[str]:
        """Return what differs too much from the recording to compare with; two refusals are one verdict."""
        sigmas = self.focal_sigmas(even)
        both_refused = self.focal_px is None and even.focal_px is None
        return [
            *(['verdict'] if self.verdict != even.verdict and not both_refused else []),
            *(['focal length'] if sigmas is not None and abs(sigmas) > MAX_FOCAL_SIGMAS else []),
            *(['tracks'] if self.tracks < MIN_TRACKS * SHARE_SEEN.get(self.kind, 1.0) * even.tracks else []),
        ]


def expand_kinds(kinds: Sequence[str]) -> tuple[str, ...]:
    """Return the kinds of faults with groups replaced by their members; all without a name. UsageError if unknown."""
    known = (*STAMP_FAULTS, *REPEAT_FAULTS)
    expanded = [kind for name in kinds or GROUPS for kind in GROUPS.get(name, (name,))]
    unknown = [kind for kind in expanded if kind not in known]
    if unknown:
        raise UsageError(f'no such fault: {", ".join(unknown)}; there are {", ".join((*GROUPS, *known))}')
    return tuple(dict.fromkeys(kind for kind in expanded if kind != EVEN))


def run_streams(source: Source, kinds: Sequence[str], options: Options) -> Iterator[tuple[StreamRun, StreamRun]]:
    """Yield the outcome of a recording with each kind of fault, and that which it is compared with.

    That of each recording to compare with is yielded before its first fault, that of the recording as it is first.
    """
    runs: dict[str, StreamRun] = {}
    for kind in (EVEN, *kinds):
        name = compared_with(kind)
        if name not in runs:
            runs[name] = run_stream(name, _without_fault(source, name), options)
            yield runs[name], runs[name]
        if kind != EVEN:
            yield run_stream(kind, _with_fault(source, kind), options), runs[name]


def compared_with(kind: str) -> str:
    """Return the name of the recording that a kind of fault is compared with."""
    codec = REPEAT_FAULTS[kind].codec if kind in REPEAT_FAULTS else ''
    return COMPARED_WITH.get(kind, f'{EVEN}_{codec}' if codec else EVEN)


def run_stream(kind: str, source: Source, options: Options) -> StreamRun:
    """Gather the evidence of a whole stream and solve it once; InputError without an image."""
    calibrator, frames = AutoCalibrator(options), 0
    for frame in source.frames():
        calibrator.add_image(frame.stamp_ns, frame.image)
        frames += 1
    evidence = calibrator.snapshot()
    if evidence is None:
        raise InputError(f'{source.name} has no images')
    result, repeated = solve(evidence, options), calibrator.repeated
    if isinstance(result, Refusal):
        return StreamRun(kind, result.code, evidence.track_count, frames, repeated)
    return StreamRun(
        kind,
        result.grade,
        evidence.track_count,
        frames,
        repeated,
        focal_px=result.camera.focal_px,
        focal_sigma_px=result.stddev.focal_px,
    )


def format_run(run: StreamRun, even: StreamRun) -> str:
    """Return one row of the table."""
    return ROW_FORMAT.format(
        run.kind,
        run.verdict,
        _cell(run.focal_px, '.1f'),
        _cell(run.focal_sigma_px, '.1f'),
        _cell(run.focal_sigmas(even), '+.2f'),
        run.tracks,
        _cell(100 * run.tracks / even.tracks if even.tracks else None, '.0f'),
        run.repeated,
        even.kind,
        ', '.join(run.faults(even)) or 'ok',
    )


def measure_streams(
    recordings: Sequence[Path],
    kinds: Sequence[str],
    options: Options,
    *,
    start_s: float = 0.0,
    duration_s: float | None = None,
) -> Iterator[tuple[str, bool]]:
    """Yield the lines of the report as they are known, each with whether it is a failed row."""
    kinds = expand_kinds(kinds)
    for path in recordings:
        source = open_source(path, start_s=start_s, duration_s=duration_s)
        yield f'{path}', False
        yield ROW_FORMAT.format(*HEADER_CELLS).rstrip(), False
        for run, even in run_streams(source, kinds, options):
            yield format_run(run, even), bool(run.faults(even))


def _with_fault(source: Source, kind: str) -> Source:
    if kind in REPEAT_FAULTS:
        return RepeatingSource(source, REPEAT_FAULTS[kind])
    if kind in MESSAGE_FAULTS:
        return RestampedSource(source, by_message(STAMP_FAULTS[kind]), epoch_ns=MESSAGE_EPOCH_NS)
    return RestampedSource(source, STAMP_FAULTS[kind])


def _without_fault(source: Source, name: str) -> Source:
    """Return a recording that faults are compared with."""
    if name in PARTS:
        return RestampedSource(source, PARTS[name])
    codec = name.removeprefix(EVEN).removeprefix('_')
    return RepeatingSource(source, RepeatFault(every_image, codec=codec)) if codec else source


def _cell(value: float | None, form: str) -> str:
    return '-' if value is None else format(value, form)

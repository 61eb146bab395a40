"""Measured lengths on the road predicted from one or two of them: `autocalib benchmark lengths`.

Each file holds the tracks of one real camera, lengths that were measured on its road and speeds of its vehicles, as the
data set BrnoCompSpeed (Sochor et al. 2018) gives them. One length along the road is told, with one across it or with
the mean speed; the other lengths along the road are compared with the calibration that follows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from autocalib_ros.config import GateOptions, Options, ScaleOptions
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.snapshot import Evidence, Track
from autocalib_ros.ground import PERTURBATION_SIGMAS, Ground, points_from_foot
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.processes import map_in_order
from autocalib_ros.results.calibration import Calibration

TOLD_SPEED_SIGMA_KM_H = 2.0
"""Standard deviation of the mean speed that is told: tracks and light gates saw other vehicles of the same road, which
vary by 12 km/h."""
HELD_SIGMAS = 1.96
"""Standard deviations within which 95 % of the errors should lie."""
MAX_MEDIAN_ERROR, MAX_P90_ERROR, MIN_HELD, MAX_HELD = 0.025, 0.06, 0.85, 0.98
"""Limits of the relative errors of the lengths that were not told, and of the share within `HELD_SIGMAS`."""
TOLD_KINDS = ('across', 'speed')
"""What is told besides one length along the road."""
LENGTHS_ROW_FORMAT = '{:<18}{:<8}{:>6}{:>9}{:>9}{:>9}{:>9}{:>8}{:>9}'
LENGTHS_HEADER = LENGTHS_ROW_FORMAT.format(
    'camera', 'told', 'draws', 'answered', 'lengths', 'median', 'p90', 'held', 'mean'
)


@dataclass(frozen=True)
class MeasuredRoad:
    """Tracks of one camera, and what was measured on its road."""

    name: str
    evidence: Evidence
    ends_px: np.ndarray
    """Ends u1, v1, u2, v2 of the lengths, shape (n, 4)."""
    metres: np.ndarray
    """Shape (n,)."""
    along: np.ndarray
    """Whether a length lies along the road, shape (n,)."""
    mean_speed_km_h: float


@dataclass(frozen=True)
class LengthsTask:
    """One file, and what is told besides a length along the road."""

    path: Path
    told: str
    draws: int
    seed: int


@dataclass(frozen=True)
class LengthsRun:
    """Errors of the lengths along the road that were not told, over all draws."""

    name: str
    told: str
    draws: int
    refused: tuple[str, ...]
    """Code of each refusal."""
    errors: np.ndarray
    """Logarithms of the calibrated lengths over the measured ones, shape (n,)."""
    sigmas: np.ndarray
    """Standard deviations of `errors`: of the calibration, the pixels and the measurement, shape (n,)."""

    @property
    def held(self) -> float:
        """Share of the errors within `HELD_SIGMAS`."""
        return float(np.mean(np.abs(self.errors) <= HELD_SIGMAS * self.sigmas)) if len(self.errors) else np.nan

    @property
    def good(self) -> bool:
        """Whether errors and standard deviations keep the limits."""
        if not len(self.errors):
            return False
        median, p90 = np.percentile(np.abs(self.errors), [50, 90])
        return bool(median <= MAX_MEDIAN_ERROR and p90 <= MAX_P90_ERROR and MIN_HELD <= self.held <= MAX_HELD)


def read_measured_road(path: Path) -> MeasuredRoad:
    """Read one camera; InputError if the file is none."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            data = {name: stored[name] for name in stored.files}
        points, frames, vehicles = data['flow_px'], data['flow_frames'], data['flow_vehicles']
        size = tuple(data['image_size'].astype(int).tolist())
        begins = np.flatnonzero((np.diff(frames) <= 0) | (np.diff(vehicles) != 0)) + 1
        seconds = (frames - frames.min()) / float(data['fps'])
        parts = zip(np.split(seconds, begins), np.split(points, begins), np.split(vehicles, begins), strict=True)
        tracks = [Track(int(who[0]), times, places.astype(float)) for times, places, who in parts if len(times) > 2]
        ends, metres = data['distance_px'].reshape(-1, 4), data['distance_m'].astype(float)
        along, speed = data['distance_along'].astype(bool), float(data['speed_km_h'].mean())
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f'{path} holds no tracks and measured lengths of a camera: {error}') from error
    collected = EvidenceBuffer(Options().buffer)
    for track in sorted(tracks, key=lambda each: float(each.times_s[-1])):
        collected.add_track(track)
    evidence = collected.snapshot(
        image_size=(size[0], size[1]),
        first_stamp_ns=0,
        newest_stamp_ns=round(float(seconds.max()) * 1e9),
        frames=len(np.unique(frames)),
        drift_px=0.0,
        unfinished=[],
    )
    return MeasuredRoad(path.stem, evidence, ends, metres, along, speed)


def told_options(road: MeasuredRoad, lengths: Sequence[int], *, speed: bool) -> Options:
    """Return options that tell some of the measured lengths, and the mean speed if `speed`."""
    text = '; '.join(' '.join(f'{each:.2f}' for each in (*road.ends_px[at], road.metres[at])) for at in lengths)
    scale = ScaleOptions(
        distances=text, speed_km_h=road.mean_speed_km_h if speed else 0.0, speed_sigma_km_h=TOLD_SPEED_SIGMA_KM_H
    )
    # the stored tracks are a sample of the traffic, and cover less of the image than it does
    return Options(scale=scale, gate=GateOptions(least_grade='assumed', min_coverage=0.0))


def length_errors(road: MeasuredRoad, found: Calibration, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return log errors (n,) of the lengths with indices `at` (n,), and their standard deviations (n,)."""
    scale, ground = ScaleOptions(), Ground.of(found)
    ends = road.ends_px[at].reshape(-1, 2)
    here = (found.camera, ground.rotation, ground.camera_m)
    lengths = _lengths(*here, ends)
    variance = (scale.distance_sigma_m / road.metres[at]) ** 2
    sides = [_lengths(*each, ends) for each in ground.perturbations or []]
    for right, left in zip(sides[::2], sides[1::2], strict=True):
        variance = variance + (np.log(right / left) / (2 * PERTURBATION_SIGMAS)) ** 2
    for step in np.eye(4):  # a pixel of one coordinate of both ends
        moved = ends + scale.pixel_sigma_px * np.tile(step.reshape(2, 2), (len(at), 1))
        variance = variance + np.log(_lengths(*here, moved) / lengths) ** 2
    return np.log(lengths / road.metres[at]), np.sqrt(variance)


def _lengths(camera: Camera, rotation: np.ndarray, camera_m: np.ndarray, ends_px: np.ndarray) -> np.ndarray:
    places = points_from_foot(camera, rotation, camera_m, ends_px)
    return np.asarray(np.hypot(*(places[::2] - places[1::2]).T))


def run_lengths(task: LengthsTask) -> LengthsRun:
    """Tell some lengths of one camera, draw by draw, and compare the other ones along its road."""
    road = read_measured_road(task.path)
    along, across = np.flatnonzero(road.along), np.flatnonzero(~road.along)
    others = across.tolist() if task.told == 'across' else [None]
    choices = list(product(along.tolist(), others))
    order = np.random.default_rng(task.seed).permutation(len(choices))[: task.draws]
    refused, errors, sigmas = [], [np.zeros(0)], [np.zeros(0)]
    for one, other in (choices[each] for each in order):
        told = [one] if other is None else [one, other]
        found = solve(road.evidence, told_options(road, told, speed=other is None))
        if not isinstance(found, Calibration) or found.ground is None:
            refused.append(found.code if not isinstance(found, Calibration) else 'lens')
            continue
        error, sigma = length_errors(road, found, along[along != one])
        errors.append(error)
        sigmas.append(sigma)
    return LengthsRun(road.name, task.told, len(order), tuple(refused), np.concatenate(errors), np.concatenate(sigmas))


def measure_lengths(folder: Path, *, draws: int = 3, seed: int = 0, jobs: int = 1) -> Iterator[LengthsRun]:
    """Yield the outcome of each camera of a folder and each kind of told number. UsageError for wrong arguments."""
    for name, value in (('draws', draws), ('jobs', jobs)):
        if value < 1:
            raise UsageError(f'--{name} must be at least 1; got {value}')
    paths = sorted(folder.glob('*.npz'))
    if not paths:
        raise UsageError(f'{folder} holds no .npz files')
    yield from map_in_order(
        run_lengths, [LengthsTask(path, told, draws, seed) for told in TOLD_KINDS for path in paths], jobs
    )


def all_of(runs: Sequence[LengthsRun], told: str) -> LengthsRun:
    """Return the runs of one kind of told number as one."""
    of_kind = [each for each in runs if each.told == told]
    return LengthsRun(
        'all',
        told,
        sum(each.draws for each in of_kind),
        tuple(code for each in of_kind for code in each.refused),
        np.concatenate([np.zeros(0), *(each.errors for each in of_kind)]),
        np.concatenate([np.zeros(0), *(each.sigmas for each in of_kind)]),
    )


def format_lengths(run: LengthsRun) -> str:
    """Return one row of the table: relative errors in per cent."""
    head = (run.name, run.told, run.draws, run.draws - len(run.refused), len(run.errors))
    codes = f'  {", ".join(sorted(set(run.refused)))}' if run.refused else ''
    if not len(run.errors):
        return LENGTHS_ROW_FORMAT.format(*head, '', '', '', '').rstrip() + codes
    median, p90 = 100 * np.percentile(np.abs(run.errors), [50, 90])
    mean = 100 * run.errors.mean()
    numbers = (f'{median:.1f} %', f'{p90:.1f} %', f'{100 * run.held:.0f} %', f'{mean:+.1f} %')
    return LENGTHS_ROW_FORMAT.format(*head, *numbers) + codes

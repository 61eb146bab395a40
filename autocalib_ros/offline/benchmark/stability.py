"""Stability of results: a tenth of the vehicles left out, draw by draw: `autocalib benchmark stability`.

The verdict and the grade should not hang on single vehicles, and the spread of the draws has to be a fraction of the
stated standard deviation: leaving out a tenth of independent vehicles moves an estimate by a third of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.errors import UsageError
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.offline.benchmark.monte_carlo import nan_if_none
from autocalib_ros.offline.benchmark.processes import map_in_order
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.grades import GRADES

LEFT_OUT_FRACTION = 0.1
MIN_SAME_FRACTION = 0.95
"""Least fraction of the draws with the verdict and grade of all vehicles."""
MAX_SPREAD_SIGMAS = 0.5
"""Largest standard deviation of the draws in stated standard deviations: 0.33 for independent vehicles."""
STABILITY_ROW_FORMAT = '{:<34}{:<22}{:>7}{:>9}{:>8}{:>8}  {}'
STABILITY_HEADER = STABILITY_ROW_FORMAT.format(
    'evidence', 'verdict', 'same %', 'focal', 'tilt', 'roll', 'other verdicts'
)


@dataclass(frozen=True)
class StabilityTask:
    """One file of evidence, and how it is solved."""

    path: Path
    options: Options
    draws: int


@dataclass(frozen=True)
class StabilityRun:
    """Outcome of one file of evidence."""

    name: str
    verdict: str
    """Grade, or code of the refusal, with all vehicles."""
    verdicts: tuple[str, ...]
    """The same of each draw."""
    spread_sigmas: tuple[float, float, float]
    """Standard deviation of focal length, tilt and roll over the draws, in stated standard deviations; nan: none."""

    @property
    def same(self) -> float:
        """Fraction of the draws with the verdict of all vehicles; refusals are one verdict."""
        return float(np.mean([_sort(each) == _sort(self.verdict) for each in self.verdicts]))

    @property
    def stable(self) -> bool:
        """Whether verdict and numbers hang on no tenth of the vehicles."""
        return self.same >= MIN_SAME_FRACTION and not (np.array(self.spread_sigmas) > MAX_SPREAD_SIGMAS).any()


def _sort(verdict: str) -> str:
    return verdict if verdict in GRADES else 'refused'


def run_stability(task: StabilityTask) -> StabilityRun:
    """Solve the evidence with all vehicles, and with a tenth of them left out at random in each draw."""
    evidence = Evidence.load(task.path)
    vehicles = np.unique(evidence.track_vehicles)
    verdict, whole, sigmas = _solved(evidence, task.options)
    verdicts, numbers = [], []
    for draw in range(task.draws):
        generator = np.random.default_rng(draw)
        left_out = generator.choice(vehicles, max(round(LEFT_OUT_FRACTION * len(vehicles)), 1), replace=False)
        found, each, _ = _solved(evidence.without_vehicles(left_out), task.options)
        verdicts.append(found)
        if found == verdict:
            numbers.append(each)
    spread = np.std(np.array(numbers) - whole, axis=0) / sigmas if numbers else np.full(3, np.nan)
    name = task.path.parent.name if task.path.stem == 'evidence' else task.path.stem
    focal, tilt, roll = (float(each) for each in spread)
    return StabilityRun(name, verdict, tuple(verdicts), (focal, tilt, roll))


def _solved(evidence: Evidence, options: Options) -> tuple[str, np.ndarray, np.ndarray]:
    """Return verdict, and log focal length, tilt and roll with their standard deviations, nan where there are none."""
    result = solve(evidence, options)
    if not isinstance(result, Calibration):
        return result.code, np.full(3, np.nan), np.full(3, np.nan)
    sigma, ground = result.stddev, result.ground
    tilts = np.full(2, np.nan) if ground is None else tilt_and_roll_deg(ground.normal_in_camera)
    stated = [nan_if_none(each) for each in (sigma.focal_px, sigma.tilt_deg, sigma.roll_deg)]
    focal = result.camera.focal_px
    return result.grade, np.array([np.log(focal), *tilts]), np.array([stated[0] / focal, *stated[1:]])


def measure_stability(
    paths: Sequence[Path], options: Options, *, draws: int = 20, jobs: int = 1
) -> Iterator[StabilityRun]:
    """Yield the outcome of each file of evidence. Raises UsageError for wrong arguments."""
    for name, value in (('draws', draws), ('jobs', jobs)):
        if value < 1:
            raise UsageError(f'--{name} must be at least 1; got {value}')
    yield from map_in_order(run_stability, [StabilityTask(path, options, draws) for path in paths], jobs)


def format_stability(run: StabilityRun) -> str:
    """Return one row of the table."""
    others = sorted({each for each in run.verdicts if each != run.verdict})
    spread = ['' if np.isnan(each) else f'{each:.2f}' for each in run.spread_sigmas]
    row = STABILITY_ROW_FORMAT.format(run.name, run.verdict, f'{100 * run.same:.0f}', *spread, ', '.join(others))
    return row.rstrip() + ('' if run.stable else '  UNSTABLE')

"""Documented options on stored evidence with known truth: `autocalib benchmark options`.

No option, and no pair of options, may make a result wrong with confidence: beyond `MAX_VARIANT_SIGMAS` of its stated
standard deviations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from autocalib_ros.config import Options
from autocalib_ros.errors import UsageError
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.offline.benchmark.golden import Case, read_cases
from autocalib_ros.offline.benchmark.processes import map_in_order
from autocalib_ros.offline.parameter_file import override_options
from autocalib_ros.results.calibration import Calibration

VARIANTS: tuple[tuple[str, Any], ...] = (
    ('joint.lens_prior', 'kannala_brandt'),
    ('joint.lens_prior', 'equidistant'),
    ('joint.k1_sigma', 0.1),
    ('joint.principal_point_sigma_px', 60.0),
    ('joint.road_angle', 'free'),
    ('joint.road_markings', False),
    ('joint.transverse_edges', False),
    ('joint.roll_prior_deg', 2.0),
    ('joint.max_tracks', 300),
    ('joint.noise_px', 1.0),
    ('joint.drift_px', 0.0),
    ('joint.heading_deg', 1.0),
    ('joint.wander_m', 0.2),
    ('gate.max_sigma_focal_rel', 0.1),
    ('gate.max_sigma_tilt_deg', 3.0),
    ('gate.min_tracks_per_road', 5),
    ('gate.min_coverage', 0.05),
)
"""Options that a person may set without asserting what is false of the evidence, one value each."""
MAX_VARIANT_SIGMAS = 3.5
"""Largest error in stated standard deviations: exceeded by chance by one number in 2000."""
VARIANT_ROW_FORMAT = '{:<64}{:>9}{:>8}{:>10}  {}'
VARIANT_HEADER = VARIANT_ROW_FORMAT.format('options', 'accepted', 'cases', 'worst z', 'of')


@dataclass(frozen=True)
class VariantTask:
    """Options to set, and the cases to solve with them."""

    changes: tuple[tuple[str, Any], ...]
    folder: Path
    cases: tuple[Case, ...]


@dataclass(frozen=True)
class VariantRun:
    """What some options do to all cases."""

    changes: tuple[tuple[str, Any], ...]
    accepted: int
    cases: int
    worst: float
    """Largest error of focal length, tilt or roll, in stated standard deviations."""
    worst_case: str

    @property
    def name(self) -> str:
        """The options as on the command line."""
        return ' '.join(f'{key}={value}' for key, value in self.changes) or '(none)'

    @property
    def wrong(self) -> bool:
        """Whether the options make a result wrong with confidence."""
        return self.worst > MAX_VARIANT_SIGMAS


def run_variant(task: VariantTask) -> VariantRun:
    """Solve all cases with some options."""
    accepted, worst, worst_case = 0, 0.0, ''
    for case in task.cases:
        options = override_options(Options(), {**case.options, **dict(task.changes)})
        result = solve(Evidence.load(task.folder / case.evidence), options)
        if not isinstance(result, Calibration):
            continue
        accepted += 1
        error = _worst_z(result, dict(case.truth or {}))
        if error > worst:
            worst, worst_case = error, case.name
    return VariantRun(task.changes, accepted, len(task.cases), worst, worst_case)


def _worst_z(result: Calibration, truth: dict[str, Any]) -> float:
    """Return the largest error of focal length, tilt and roll in stated standard deviations."""
    sigma = result.stddev
    errors = [(result.camera.focal_px - truth['focal_px'], sigma.focal_px)]
    if result.ground is not None:
        tilt, roll = tilt_and_roll_deg(result.ground.normal_in_camera)
        errors += [(tilt - truth['tilt_deg'], sigma.tilt_deg), (roll - truth['roll_deg'], sigma.roll_deg)]
    return float(max(abs(error) / stated for error, stated in errors if stated))


def measure_variants(
    folder: Path, *, pairs: bool = False, jobs: int = 1, only: Sequence[str] = ()
) -> Iterator[VariantRun]:
    """Yield what each variant, and each pair of them, does to the cases with known truth in a folder.

    `only` names options. Raises UsageError for wrong arguments.
    """
    if jobs < 1:
        raise UsageError(f'--jobs must be at least 1; got {jobs}')
    known = sorted({name for name, _ in VARIANTS})
    for name in only:
        if name not in known:
            raise UsageError(f"no such option '{name}'; there are {', '.join(known)}")
    cases = tuple(
        case
        for case in read_cases(folder)
        if case.truth and case.lens is None and case.options.get('method', 'joint') == 'joint'
    )
    chosen = [variant for variant in VARIANTS if not only or variant[0] in only]
    changes: list[tuple[tuple[str, Any], ...]] = [(), *((variant,) for variant in chosen)]
    if pairs:
        changes += [pair for pair in combinations(chosen, 2) if pair[0][0] != pair[1][0]]
    yield from map_in_order(run_variant, [VariantTask(change, folder, cases) for change in changes], jobs)


def format_variant(run: VariantRun) -> str:
    """Return one row of the table."""
    row = VARIANT_ROW_FORMAT.format(run.name, run.accepted, run.cases, f'{run.worst:.1f}', run.worst_case)
    return row.rstrip() + ('  WRONG' if run.wrong else '')

"""Regression benchmark on stored evidence with expected results: `autocalib benchmark golden`.

A folder holds `expected.json` and the evidence of its cases. Each case is solved with its own options. The report lists
every change: a different verdict or count, or a number that changed by more than a fraction of its stated sigma.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from autocalib_ros.config import Options
from autocalib_ros.errors import AutocalibError, InputError, UsageError
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.processes import map_in_order
from autocalib_ros.offline.parameter_file import override_options
from autocalib_ros.offline.terminal.progress import progress_bar
from autocalib_ros.offline.terminal.style import align_columns
from autocalib_ros.results.calibration import COVARIANCE_PARAMETERS, GROUND_DISTANCES_M, Calibration, Refusal
from autocalib_ros.util.files import write_atomically

EXPECTED = 'expected.json'
VERDICT_FIELDS = ('state', 'grade', 'refusal', 'ground_refusal', 'roads', 'people')
"""Fields compared for equality: verdict, refusal codes, and counts. The first three are the verdict proper."""
RELATIVE_TOLERANCE = 1e-6
"""Largest relative change of a number without a sigma that counts as equal; covers rounding, judgement."""
ABSOLUTE_TOLERANCE = 1e-9
"""Largest absolute change that counts as equal for any number; covers values near zero, judgement."""
FORMAT = 1


@dataclass(frozen=True)
class Outcome:
    """The compared part of a result, found or expected."""

    verdict: Mapping[str, str | int | None]
    """Verdict and counts by field name, see `VERDICT_FIELDS`."""
    numbers: Mapping[str, float] = field(default_factory=dict)
    """Lens and pose by parameter name, see `COVARIANCE_PARAMETERS`."""
    stddev: Mapping[str, float] = field(default_factory=dict)
    """One standard deviation, for the parameters that have one and for road points ahead."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """Evidence, solver inputs and expected result."""

    name: str
    description: str
    made: str
    """How the evidence was generated or recorded."""
    evidence: str
    """File name in the folder; several cases may share a file."""
    options: Mapping[str, Any]
    """Options by full name."""
    lens: Mapping[str, Any] | None = None
    """Known lens (focal_px, principal_point_px, k) of a case in which only the pose is estimated."""
    truth: Mapping[str, Any] | None = None
    """True lens and pose of synthetic evidence. For readers: the benchmark does not compare with it."""
    expected: Outcome | None = None
    """None for a new case."""


@dataclass(frozen=True)
class Moved:
    """A quantity of a case that differs from the expected one."""

    case: str
    quantity: str
    expected: str | float | None
    found: str | float | None
    sigmas: float | None = None
    """Change in units of the expected sigma; None without a sigma."""


@dataclass(frozen=True)
class GoldenRun:
    """Results of the cases, and the differences from the expected ones."""

    cases: tuple[Case, ...]
    found: Mapping[str, Outcome]
    """Results by case name."""
    moved: tuple[Moved, ...]


def run_cases(
    folder: Path,
    only: Sequence[str] = (),
    *,
    tolerance: float = 0.1,
    exact: bool = False,
    jobs: int = 1,
    quiet: bool = False,
) -> GoldenRun:
    """Solve the cases of a folder in alphabetical order and compare them with the expected results.

    `only` selects cases by name, all if empty. `tolerance` is in units of the expected sigma; `exact` compares to the
    last digit. Raise UsageError for wrong arguments, InputError for unreadable files.
    """
    if jobs < 1:
        raise UsageError(f'--jobs must be at least 1; got {jobs}')
    if not 0 <= tolerance < math.inf:
        raise UsageError(f'--tolerance must be at least 0; got {tolerance}')
    cases = select_cases(read_cases(folder), only)
    found: dict[str, Outcome] = {}
    with progress_bar(len(cases), 'cases', 'golden', quiet=quiet) as progress:
        for case, outcome in zip(cases, map_in_order(partial(solve_case, folder), cases, jobs), strict=True):
            found[case.name] = outcome
            progress.update_to(len(found), case.name)
    moved = [
        item
        for case in cases
        for item in differences(case.name, case.expected, found[case.name], tolerance=tolerance, exact=exact)
    ]
    return GoldenRun(tuple(cases), found, tuple(moved))


def update(folder: Path, golden_run: GoldenRun) -> None:
    """Store the results of the cases that moved as expected results; leave all other cases unchanged."""
    changed = {item.case for item in golden_run.moved}
    if changed:
        write_cases(
            folder,
            [
                replace(case, expected=golden_run.found[case.name]) if case.name in changed else case
                for case in read_cases(folder)
            ],
        )


def select_cases(cases: Sequence[Case], names: Sequence[str]) -> list[Case]:
    """Return the cases with these names in their stored order, all cases if `names` is empty, or raise UsageError."""
    known = [case.name for case in cases]
    for name in names:
        if name not in known:
            raise UsageError(f"unknown golden case '{name}'; known cases: {', '.join(known)}")
    return [case for case in cases if not names or case.name in names]


def solve_case(folder: Path, case: Case) -> Outcome:
    """Solve a case; an exception of the solver is an outcome too and does not stop the benchmark."""
    evidence, options = Evidence.load(folder / case.evidence), override_options(Options(), case.options)
    lens = (
        None
        if case.lens is None
        else Camera(
            *evidence.image_size, case.lens['focal_px'], tuple(case.lens['principal_point_px']), tuple(case.lens['k'])
        )
    )
    try:
        return outcome_from_result(solve(evidence, options, lens=lens))
    except AutocalibError:
        raise
    except Exception as error:
        return Outcome(_verdict(state=f'crash:{type(error).__name__}'))


def _verdict(**values: str | int | None) -> dict[str, str | int | None]:
    return {name: values.get(name) for name in VERDICT_FIELDS}


def outcome_from_result(result: Calibration | Refusal) -> Outcome:
    """Return the compared part of a result."""
    if isinstance(result, Refusal):
        return Outcome(_verdict(state='refused', refusal=result.code))
    camera, ground, sigma = result.camera, result.ground, result.stddev
    verdict = _verdict(
        state='calibrated',
        grade=result.grade,
        roads=len(result.road_directions),
        ground_refusal=result.ground_refusal.code if result.ground_refusal else None,
        people=result.evidence.people,
    )
    pose = (None,) * 3 if ground is None else (*tilt_and_roll_deg(ground.normal_in_camera), ground.height_m)
    numbers = (camera.focal_px, *camera.principal_point_px, *camera.k, *pose)
    point = sigma.principal_point_px or (None, None)
    deviations = (
        sigma.focal_px,
        *point,
        sigma.k1,
        sigma.k2,
        None,
        None,
        sigma.tilt_deg,
        sigma.roll_deg,
        sigma.height_m,
    )
    ahead = {
        f'ground_point_{distance:g}_m': value
        for distance, value in zip(GROUND_DISTANCES_M, sigma.ground_point_m, strict=False)
    }
    return Outcome(
        verdict,
        _without_none(dict(zip(COVARIANCE_PARAMETERS, numbers, strict=True))),
        _without_none({**dict(zip(COVARIANCE_PARAMETERS, deviations, strict=True)), **ahead}),
    )


def _without_none(values: Mapping[str, float | None]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items() if value is not None}


def differences(
    case: str, expected: Outcome | None, found: Outcome, *, tolerance: float = 0.1, exact: bool = False
) -> list[Moved]:
    """Return the quantities that moved; if the verdict changed, only the verdict.

    Numbers may change by `tolerance` times their expected sigma, sigmas by `tolerance` times themselves, and numbers
    without a sigma, or with sigma 0, by `RELATIVE_TOLERANCE` times themselves. With `exact`, every change counts.
    """
    if expected is None:
        return [Moved(case, 'state', 'new', found.verdict['state'])]
    moved = [
        Moved(case, name, expected.verdict[name], found.verdict[name])
        for name in VERDICT_FIELDS
        if expected.verdict[name] != found.verdict[name]
    ]
    if any(item.quantity in VERDICT_FIELDS[:3] for item in moved):
        return moved
    allowed = {name: tolerance * sigma for name, sigma in expected.stddev.items()}
    for kind, before, after in (('', expected.numbers, found.numbers), ('sigma of ', expected.stddev, found.stddev)):
        for name in dict.fromkeys([*before, *after]):
            old, new = before.get(name), after.get(name)
            if _is_same(old, new, 0.0 if exact else allowed.get(name, 0.0), exact=exact):
                continue
            sigma = expected.stddev.get(name)
            sigmas = (new - old) / sigma if sigma and old is not None and new is not None else None
            moved.append(Moved(case, kind + name, old, new, sigmas))
    return moved


def _is_same(expected: float | None, found: float | None, allowed: float, *, exact: bool) -> bool:
    if exact or expected is None or found is None:
        return expected == found
    return abs(found - expected) <= max(allowed, RELATIVE_TOLERANCE * abs(expected), ABSOLUTE_TOLERANCE)


def format_report(golden_run: GoldenRun) -> list[str]:
    """Return the table of changes and a summary line."""
    count, moved = len(golden_run.cases), golden_run.moved
    cases = f'{count} case{"" if count == 1 else "s"}'
    if not moved:
        return [f'{cases}: nothing moved']
    rows: list[tuple[str, ...]] = [('case', 'quantity', 'expected', 'found', 'sigmas')]
    rows += [
        (
            item.case,
            item.quantity,
            *_cells(item.expected, item.found),
            '-' if item.sigmas is None else f'{item.sigmas:+.2g}',
        )
        for item in moved
    ]
    touched = len({item.case for item in moved})
    return [*align_columns(rows), f'{cases}: {len(moved)} value{"" if len(moved) == 1 else "s"} moved in {touched}']


def _cells(expected: str | float | None, found: str | float | None) -> tuple[str, str]:
    """Return two values as text with enough digits to distinguish them."""
    for digits in (6, 10, 17):
        cells = tuple(
            f'{value:.{digits}g}' if isinstance(value, float) else '-' if value is None else str(value)
            for value in (expected, found)
        )
        if cells[0] != cells[1]:
            break
    return cells[0], cells[1]


def read_cases(folder: Path) -> list[Case]:
    """Read the cases of a folder in alphabetical order, or raise InputError."""
    path = folder / EXPECTED
    if not path.is_file():
        raise InputError(
            f'{folder} holds no golden evidence (no {EXPECTED}): give the folder that does, tests/golden in the '
            'source tree'
        )
    try:
        document = json.loads(path.read_text(encoding='utf-8'))
        if document['format'] != FORMAT:
            raise InputError(f'{path} has format {document["format"]}; expected {FORMAT}')
        return [_case(name, entry) for name, entry in sorted(document['cases'].items())]
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f'{path} holds no expected values ({type(error).__name__}: {error})') from error


def _case(name: str, entry: Mapping[str, Any]) -> Case:
    expected = entry['expected']
    return Case(
        name=name,
        description=entry['description'],
        made=entry['made'],
        evidence=entry['evidence'],
        options=entry['options'],
        lens=entry.get('lens'),
        truth=entry.get('truth'),
        expected=None
        if expected is None
        else Outcome(
            _verdict(**{word: expected[word] for word in VERDICT_FIELDS}), expected['numbers'], expected['stddev']
        ),
    )


def write_cases(folder: Path, cases: Sequence[Case]) -> None:
    """Write the cases in alphabetical order, numbers in full precision."""
    document = {'format': FORMAT, 'cases': {case.name: _entry(case) for case in sorted(cases, key=lambda it: it.name)}}
    write_atomically(folder / EXPECTED, json.dumps(document, indent=1, allow_nan=False) + '\n')


def _entry(case: Case) -> dict[str, Any]:
    expected = case.expected
    optional = {name: value for name, value in (('lens', case.lens), ('truth', case.truth)) if value is not None}
    return {
        'description': case.description,
        'made': case.made,
        'evidence': case.evidence,
        'options': case.options,
        **optional,
        'expected': None
        if expected is None
        else {**expected.verdict, 'numbers': expected.numbers, 'stddev': expected.stddev},
    }

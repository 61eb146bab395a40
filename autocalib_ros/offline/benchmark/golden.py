"""Saved evidence with the verdict and the numbers that it has to give: `autocalib benchmark golden`.

A folder holds `expected.json` and the evidence of its cases, each solved with the options of the case. Whatever moves
is told: a verdict or a count that is another, a number that is off by more than a part of its stated sigma.
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
from autocalib_ros.offline.benchmark.processes import in_order
from autocalib_ros.offline.parameter_file import override_options
from autocalib_ros.offline.terminal.progress import progress_bar
from autocalib_ros.offline.terminal.style import align_columns
from autocalib_ros.results.calibration import COVARIANCE_PARAMETERS, GROUND_DISTANCES_M, Calibration, Refusal
from autocalib_ros.util.files import write_atomically

EXPECTED = 'expected.json'
WORDS = ('state', 'grade', 'refusal', 'ground_refusal', 'roads', 'people')
"""What is compared as it stands: the verdict, the codes of its refusals, and counts."""
SAME = 1e-6
"""A number without a sigma has moved when it differs by this part of itself."""
SAME_AS_ZERO = 1e-9
"""Numbers that differ by less than this are the same, however small they are."""
FORMAT = 1


@dataclass(frozen=True)
class Outcome:
    """What a solution gave, or has to give."""

    words: Mapping[str, str | int | None]
    """By the names of `WORDS`."""
    numbers: Mapping[str, float] = field(default_factory=dict)
    """Lens and pose, by the names of `COVARIANCE_PARAMETERS`."""
    stddev: Mapping[str, float] = field(default_factory=dict)
    """One sigma of those that have one, and of road points ahead."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """Evidence, what the solution is told, and what has to come of it."""

    name: str
    description: str
    made: str
    """How the evidence was made."""
    evidence: str
    """File in the folder; several cases may share one."""
    options: Mapping[str, Any]
    """By their full names."""
    lens: Mapping[str, Any] | None = None
    """The known lens, focal_px, principal_point_px and k, where the pose alone is solved."""
    truth: Mapping[str, Any] | None = None
    """Lens and pose that the evidence was made with; for people, nothing is compared with it."""
    expected: Outcome | None = None
    """None of a case that is new."""


@dataclass(frozen=True)
class Moved:
    """One quantity of a case that is not what it was expected to be."""

    case: str
    quantity: str
    expected: str | float | None
    found: str | float | None
    sigmas: float | None = None
    """The change in stated sigmas, where there are any."""


@dataclass(frozen=True)
class Measured:
    """What cases gave, and what of it is not as expected."""

    cases: tuple[Case, ...]
    found: Mapping[str, Outcome]
    """By the names of the cases."""
    moved: tuple[Moved, ...]


def measure(
    folder: Path,
    only: Sequence[str] = (),
    *,
    tolerance: float = 0.1,
    exact: bool = False,
    jobs: int = 1,
    quiet: bool = False,
) -> Measured:
    """Solve the cases of a folder, or `only` some of them by name, in the order of their names."""
    if jobs < 1:
        raise UsageError(f'--jobs is 1 or more; got {jobs}')
    if not 0 <= tolerance < math.inf:
        raise UsageError(f'--tolerance is 0 or more; got {tolerance}')
    cases = chosen(read_cases(folder), only)
    found: dict[str, Outcome] = {}
    with progress_bar(len(cases), 'cases', 'golden', quiet=quiet) as progress:
        for case, outcome in zip(cases, in_order(partial(outcome_of, folder), cases, jobs), strict=True):
            found[case.name] = outcome
            progress.update_to(len(found), case.name)
    moved = [
        item
        for case in cases
        for item in differences(case.name, case.expected, found[case.name], tolerance=tolerance, exact=exact)
    ]
    return Measured(tuple(cases), found, tuple(moved))


def update(folder: Path, measured: Measured) -> None:
    """Expect what was found from now on, of the cases in which something moved; all else stays as it is."""
    changed = {item.case for item in measured.moved}
    if changed:
        write_cases(
            folder,
            [
                replace(case, expected=measured.found[case.name]) if case.name in changed else case
                for case in read_cases(folder)
            ],
        )


def chosen(cases: Sequence[Case], names: Sequence[str]) -> list[Case]:
    """Return the cases with these names in their own order, all of them for none, or raise UsageError."""
    known = [case.name for case in cases]
    for name in names:
        if name not in known:
            raise UsageError(f"no golden case is called '{name}'; there are {', '.join(known)}")
    return [case for case in cases if not names or case.name in names]


def outcome_of(folder: Path, case: Case) -> Outcome:
    """Solve a case; a solver that fails is an outcome too, and does not end the benchmark."""
    evidence, options = Evidence.load(folder / case.evidence), override_options(Options(), case.options)
    lens = (
        None
        if case.lens is None
        else Camera(
            *evidence.image_size, case.lens['focal_px'], tuple(case.lens['principal_point_px']), tuple(case.lens['k'])
        )
    )
    try:
        return told(solve(evidence, options, lens=lens))
    except AutocalibError:
        raise
    except Exception as error:
        return Outcome(_words(state=f'crash:{type(error).__name__}'))


def _words(**given: str | int | None) -> dict[str, str | int | None]:
    return {name: given.get(name) for name in WORDS}


def told(result: Calibration | Refusal) -> Outcome:
    """Return what is compared of a result."""
    if isinstance(result, Refusal):
        return Outcome(_words(state='refused', refusal=result.code))
    camera, ground, sigma = result.camera, result.ground, result.stddev
    words = _words(
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
        words,
        _given(dict(zip(COVARIANCE_PARAMETERS, numbers, strict=True))),
        _given({**dict(zip(COVARIANCE_PARAMETERS, deviations, strict=True)), **ahead}),
    )


def _given(values: Mapping[str, float | None]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items() if value is not None}


def differences(
    case: str, expected: Outcome | None, found: Outcome, *, tolerance: float = 0.1, exact: bool = False
) -> list[Moved]:
    """Return what moved; where the verdict is another, that alone.

    A number may differ by `tolerance` of its expected sigma, and a sigma by that part of itself; without a sigma, or
    with one of 0, by `SAME` of itself. With `exact` nothing may differ.
    """
    if expected is None:
        return [Moved(case, 'state', 'new', found.words['state'])]
    moved = [
        Moved(case, name, expected.words[name], found.words[name])
        for name in WORDS
        if expected.words[name] != found.words[name]
    ]
    if any(item.quantity in WORDS[:3] for item in moved):
        return moved
    allowed = {name: tolerance * sigma for name, sigma in expected.stddev.items()}
    for kind, before, after in (('', expected.numbers, found.numbers), ('sigma of ', expected.stddev, found.stddev)):
        for name in dict.fromkeys([*before, *after]):
            old, new = before.get(name), after.get(name)
            if _same(old, new, 0.0 if exact else allowed.get(name, 0.0), exact=exact):
                continue
            sigma = expected.stddev.get(name)
            sigmas = (new - old) / sigma if sigma and None not in (old, new) else None
            moved.append(Moved(case, kind + name, old, new, sigmas))
    return moved


def _same(expected: float | None, found: float | None, allowed: float, *, exact: bool) -> bool:
    if exact or expected is None or found is None:
        return expected == found
    return abs(found - expected) <= max(allowed, SAME * abs(expected), SAME_AS_ZERO)


def lines(measured: Measured) -> list[str]:
    """Return what moved as a table, and the line that sums it up."""
    count, moved = len(measured.cases), measured.moved
    cases = f'{count} case{"" if count == 1 else "s"}'
    if not moved:
        return [f'{cases}: nothing moved']
    rows = [('case', 'quantity', 'expected', 'found', 'sigmas')]
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
    """Return two values in as many digits as tell them apart."""
    for digits in (6, 10, 17):
        cells = tuple(
            f'{value:.{digits}g}' if isinstance(value, float) else '-' if value is None else str(value)
            for value in (expected, found)
        )
        if cells[0] != cells[1]:
            break
    return cells[0], cells[1]


def read_cases(folder: Path) -> list[Case]:
    """Read the cases of a folder in the order of their names, or raise InputError."""
    path = folder / EXPECTED
    if not path.is_file():
        raise InputError(
            f'{folder} holds no golden evidence (no {EXPECTED}): give the folder that does, tests/golden '
            'in the sources of this program'
        )
    try:
        document = json.loads(path.read_text(encoding='utf-8'))
        if document['format'] != FORMAT:
            raise InputError(f'{path} is of format {document["format"]}, not {FORMAT}')
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
        else Outcome(_words(**{word: expected[word] for word in WORDS}), expected['numbers'], expected['stddev']),
    )


def write_cases(folder: Path, cases: Sequence[Case]) -> None:
    """Write the cases in the order of their names, numbers in full precision."""
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
        else {**expected.words, 'numbers': expected.numbers, 'stddev': expected.stddev},
    }

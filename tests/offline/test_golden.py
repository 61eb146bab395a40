"""Golden evidence: comparison rules, the command, and the stored cases."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from autocalib_ros.cli import main
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.benchmark import golden
from autocalib_ros.offline.benchmark.golden import (
    Case,
    GoldenRun,
    Moved,
    Outcome,
    differences,
    format_report,
    outcome_from_result,
    read_cases,
    run_cases,
    select_cases,
    solve_case,
    write_cases,
)
from synthetic_results import full_result, junction_evidence, lens_result, refusal

STORED = Path(__file__).parents[1] / 'golden'
CALIBRATED = {'state': 'calibrated', 'grade': 'full', 'refusal': None, 'ground_refusal': None, 'roads': 2, 'people': 0}
REFUSED = {**dict.fromkeys(CALIBRATED), 'state': 'refused', 'refusal': 'no_motion'}
EXPECTED = Outcome(
    CALIBRATED, {'focal_px': 560.0, 'k1': 0.01, 'k2': 0.0, 'height_m': 8.0}, {'focal_px': 4.0, 'k1': 0.002, 'k2': 0.0}
)
FULL = full_result(junction_evidence())
NONE = refusal(junction_evidence())
QUICK = ('bend', 'pedestrians', 'two_roads')


def with_numbers(**changes: float) -> Outcome:
    return replace(EXPECTED, numbers={**EXPECTED.numbers, **changes})


def with_sigmas(**changes: float) -> Outcome:
    return replace(EXPECTED, stddev={**EXPECTED.stddev, **changes})


def names(moved: list[Moved]) -> list[str]:
    return [item.quantity for item in moved]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with the quick cases only."""
    cases = [case for case in read_cases(STORED) if case.name in QUICK]
    for case in cases:
        shutil.copy(STORED / case.evidence, tmp_path)
    write_cases(tmp_path, cases)
    return tmp_path


def expect(folder: Path, case: str, **changes: Any) -> None:
    """Change the expected result of a case."""
    path = folder / golden.EXPECTED
    document = json.loads(path.read_text())
    document['cases'][case]['expected'].update(changes)
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(
    ('found', 'moved'),
    [
        (EXPECTED, []),
        (with_numbers(focal_px=560.39), []),
        (with_numbers(focal_px=559.59), ['focal_px']),
        (with_numbers(k1=0.01019), []),
        (with_numbers(k1=0.01021), ['k1']),
        (with_numbers(k2=1e-10), []),  # fixed at zero
        (with_numbers(k2=1e-6), ['k2']),
        (with_numbers(height_m=8.000007), []),  # without a sigma: a millionth of itself
        (with_numbers(height_m=8.00001), ['height_m']),
        (with_sigmas(focal_px=4.39), []),  # of a sigma, a tenth of itself
        (with_sigmas(focal_px=3.59), ['sigma of focal_px']),
        (with_sigmas(k2=1e-4), ['sigma of k2']),
    ],
)
def test_a_number_moves_when_it_leaves_a_tenth_of_its_sigma(found: Outcome, moved: list[str]) -> None:
    assert names(differences('case', EXPECTED, found)) == moved


def test_a_change_is_reported_in_expected_sigmas() -> None:
    (item,) = differences('case', EXPECTED, with_numbers(focal_px=558.0))
    assert item == Moved('case', 'focal_px', 560.0, 558.0, pytest.approx(-0.5))
    (item,) = differences('case', EXPECTED, with_numbers(height_m=8.1))
    assert item.sigmas is None


def test_the_tolerance_is_a_part_of_the_sigma() -> None:
    assert names(differences('case', EXPECTED, with_numbers(focal_px=561.9), tolerance=0.5)) == []
    assert names(differences('case', EXPECTED, with_numbers(focal_px=560.1), tolerance=0.01)) == ['focal_px']


def test_exact_compares_to_the_last_digit() -> None:
    assert differences('case', EXPECTED, EXPECTED, exact=True) == []
    nearly = with_numbers(focal_px=float(np.nextafter(560.0, 561.0)))
    assert names(differences('case', EXPECTED, nearly, exact=True)) == ['focal_px']
    assert differences('case', EXPECTED, nearly) == []


def test_a_changed_verdict_is_reported_alone() -> None:
    assert names(differences('case', EXPECTED, Outcome(REFUSED))) == ['state', 'grade', 'refusal', 'roads', 'people']
    other = Outcome({**REFUSED, 'refusal': 'horizon'})
    assert differences('case', Outcome(REFUSED), other) == [Moved('case', 'refusal', 'no_motion', 'horizon')]


def test_a_changed_count_is_reported_with_the_numbers() -> None:
    found = replace(with_numbers(focal_px=562.0), verdict={**CALIBRATED, 'people': 3})
    assert names(differences('case', EXPECTED, found)) == ['people', 'focal_px']


def test_a_number_that_comes_or_goes_has_moved() -> None:
    without = replace(EXPECTED, numbers={'focal_px': 560.0, 'k1': 0.01, 'k2': 0.0})
    assert differences('case', EXPECTED, without) == [Moved('case', 'height_m', 8.0, None)]
    assert differences('case', without, EXPECTED) == [Moved('case', 'height_m', None, 8.0)]


def test_a_new_case_has_moved() -> None:
    assert differences('case', None, EXPECTED) == [Moved('case', 'state', 'new', 'calibrated')]


def test_the_outcome_of_a_full_result_has_lens_pose_and_sigmas() -> None:
    outcome = outcome_from_result(FULL)
    assert (outcome.verdict['state'], outcome.verdict['grade'], outcome.verdict['refusal']) == (
        'calibrated',
        'full',
        None,
    )
    assert list(outcome.numbers) == list(golden.COVARIANCE_PARAMETERS)
    assert outcome.numbers['focal_px'] == FULL.camera.focal_px
    assert outcome.stddev['focal_px'] == FULL.stddev.focal_px


def test_the_outcome_of_a_lens_alone_and_of_a_refusal_has_their_codes() -> None:
    lens, none = outcome_from_result(lens_result(FULL)), outcome_from_result(NONE)
    assert lens.verdict['grade'] == 'lens' and 'tilt_deg' not in lens.numbers
    assert none.verdict == {**REFUSED, 'refusal': NONE.code} and not none.numbers


def test_the_report_lists_and_counts_changes() -> None:
    case = Case(name='a', description='', made='', evidence='a.npz', options={})
    assert format_report(GoldenRun((case,), {}, ())) == ['1 case: nothing moved']
    assert format_report(GoldenRun((case,) * 26, {}, ())) == ['26 cases: nothing moved']
    moved = (
        Moved('a', 'focal_px', 560.0, 558.0, -0.5),
        Moved('a', 'grade', 'full', None),
        Moved('a', 'k1', 0.01, 0.010000000001),
    )
    head, *rows, last = format_report(GoldenRun((case,) * 2, {}, moved))
    assert head.split() == ['case', 'quantity', 'expected', 'found', 'sigmas']
    assert [row.split() for row in rows] == [
        ['a', 'focal_px', '560', '558', '-0.5'],
        ['a', 'grade', 'full', '-', '-'],
        ['a', 'k1', '0.01', '0.010000000001000001', '-'],
    ]
    assert last == '2 cases: 3 values moved in 1'


def test_cases_are_chosen_by_name_in_their_own_order() -> None:
    cases = read_cases(STORED)
    assert [case.name for case in select_cases(cases, ['two_roads', 'bend'])] == ['bend', 'two_roads']
    assert select_cases(cases, []) == cases


def test_a_solver_that_fails_is_an_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError('singular')

    monkeypatch.setattr(golden, 'solve', fail)
    (case,) = select_cases(read_cases(STORED), ['bend'])
    assert solve_case(STORED, case).verdict['state'] == 'crash:LinAlgError'


def test_written_cases_are_read_back_unchanged(tmp_path: Path) -> None:
    cases = read_cases(STORED)
    write_cases(tmp_path, cases[::-1])
    assert read_cases(tmp_path) == cases
    assert (tmp_path / golden.EXPECTED).read_text() == (STORED / golden.EXPECTED).read_text()


@pytest.mark.parametrize('text', ['{', '[]', '{"format": 1, "cases": {"a": {}}}', '{"format": 2, "cases": {}}'])
def test_a_file_without_expected_values_is_wrong_input(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / golden.EXPECTED).write_text(text)
    assert main(['benchmark', 'golden', str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert golden.EXPECTED in error and error.count('\n') == 1


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['nowhere'], 'nowhere holds no golden evidence (no expected.json): give the folder that does, tests/golden'),
        ([str(STORED), '--only', 'unheard_of'], "unknown golden case 'unheard_of'; known cases: bend"),
        ([str(STORED), '--jobs', '0'], '--jobs must be at least 1; got 0'),
        ([str(STORED), '--tolerance', '-1'], '--tolerance must be at least 0; got -1'),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['benchmark', 'golden', *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1


def test_evidence_that_is_missing_is_wrong_input(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / 'bend.npz').unlink()
    assert main(['benchmark', 'golden', str(folder), '--only', 'bend']) == 2
    assert 'bend.npz' in capsys.readouterr().err


@pytest.mark.solve
def test_nothing_moved_is_status_0(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (folder / golden.EXPECTED).read_text()
    assert main(['benchmark', 'golden', str(folder), '--only', 'bend', '--update']) == 0
    assert capsys.readouterr().out == '1 case: nothing moved\n'
    assert (folder / golden.EXPECTED).read_text() == before


@pytest.mark.solve
def test_changes_are_printed_with_status_3_until_they_are_expected(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    right = (folder / golden.EXPECTED).read_text()
    expect(folder, 'bend', refusal='horizon')
    expect(folder, 'pedestrians', refusal='horizon')
    wrong = (folder / golden.EXPECTED).read_text()
    command = ['benchmark', 'golden', str(folder), '--only', 'bend']
    assert main(command) == 3
    printed = capsys.readouterr().out.splitlines()
    assert printed[1].split()[:3] == ['bend', 'refusal', 'horizon']
    assert printed[-1] == '1 case: 1 value moved in 1'
    assert (folder / golden.EXPECTED).read_text() == wrong
    assert main([*command, '--update']) == 3  # the run itself found a change
    assert main(command) == 0
    expect(folder, 'pedestrians', refusal=json.loads(right)['cases']['pedestrians']['expected']['refusal'])
    assert json.loads((folder / golden.EXPECTED).read_text()) == json.loads(
        right
    )  # cases that were not solved are unchanged


def test_stored_cases_and_stored_evidence_belong_together() -> None:
    cases = read_cases(STORED)
    assert {case.evidence for case in cases} == {path.name for path in STORED.glob('*.npz')}
    assert all(case.description and case.made and case.expected for case in cases)
    assert sum(path.stat().st_size for path in STORED.glob('*.npz')) < 3.2e6
    grades = {case.expected.verdict['grade'] for case in cases}
    assert grades == {None, 'full', 'fair', 'coarse', 'lens', 'unit_scale'}


def test_stored_evidence_has_edges_outlines_and_markings() -> None:
    stored = [Evidence.load(path) for path in sorted(STORED.glob('*.npz'))]
    for name in ('edges_px', 'outlines_px', 'still_lines_px'):
        assert any(len(getattr(evidence, name)) for evidence in stored)
    assert any(evidence.track_kinds.any() for evidence in stored)


@pytest.mark.parametrize(
    'case',
    [
        pytest.param(case, id=case.name)
        for case in read_cases(STORED)
        if case.truth and case.expected.verdict['state'] == 'calibrated' and case.options.get('method') != 'paper'
    ],
)
def test_expected_results_agree_with_the_ground_truth(case: Case) -> None:
    numbers, sigmas = case.expected.numbers, case.expected.stddev
    for name in ('focal_px', 'tilt_deg', 'roll_deg'):
        if name in numbers:
            assert abs(numbers[name] - case.truth[name]) <= 3 * sigmas[name] + 1e-9, name


@pytest.mark.solve
def test_quick_cases_have_not_moved() -> None:
    """The whole set is solved by `autocalib benchmark golden`, which .ci/run calls."""
    golden_run = run_cases(STORED, ['bend', 'one_road', 'pedestrians', 'two_roads', 'two_roads_paper'], quiet=True)
    assert not golden_run.moved, '\n'.join(format_report(golden_run))


@pytest.mark.slow
def test_processes_do_not_change_a_digit(folder: Path) -> None:
    alone, shared = (run_cases(folder, jobs=jobs, quiet=True) for jobs in (1, 2))
    assert alone.found == shared.found

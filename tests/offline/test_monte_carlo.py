"""The accuracy benchmark: errors of results with known faults, tables of synthetic runs, and a small complete run."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import autocalib_ros
from autocalib_ros.cli import main
from autocalib_ros.errors import InputError
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.monte_carlo import (
    Run,
    Task,
    compare_calibrations,
    distance_error,
    draw_evidence,
    mean_ray_error_deg,
    open_csv,
    run_method,
    run_monte_carlo,
    run_task,
)
from autocalib_ros.offline.benchmark.table import falsely_accepted, format_tables, is_overconfident
from autocalib_ros.offline.synthetic.junction import Junction, pose
from autocalib_ros.results.calibration import Calibration, EvidenceSummary, Figures, Refusal, StandardDeviations
from autocalib_ros.results.refusals import Reason

JUNCTION = Junction()
TASK = Task('standard', 0, 7, ('joint',))
SUMMARY = EvidenceSummary(
    image_size=(1280, 720), seconds=60.0, frames=600, tracks=60, segments=0, vehicles=60, coverage=0.5
)


def calibration(camera: Camera, ground: GroundPlane | None, stddev: StandardDeviations) -> Calibration:
    return Calibration(
        method='joint',
        grade='full' if ground else 'lens',
        assumptions=(),
        camera=camera,
        ground=ground,
        ground_refusal=None,
        road_directions=np.eye(3)[:2],
        stddev=stddev,
        paper=None,
        evidence=SUMMARY,
        newest_stamp_ns=0,
    )


def plane(tilt_deg: float = 32.0, roll_deg: float = 1.0, heading_deg: float = 35.0) -> GroundPlane:
    return GroundPlane(pose(tilt_deg, roll_deg, heading_deg).T, JUNCTION.height_m)


def run(**changes: object) -> Run:
    fields = {
        'family': 'standard',
        'method': 'joint',
        'run': 0,
        'accepted': True,
        'code': '',
        'grade': 'full',
        'focal_error': 0.01,
        'focal_sigma': 0.01,
        'rays_deg': 0.2,
        'normal_deg': 0.5,
        'tilt_error_deg': 0.3,
        'tilt_sigma_deg': 0.2,
        'roll_error_deg': 0.4,
        'roll_sigma_deg': 0.5,
        'distance_error': 0.02,
        'cpu_s': 1.0,
    }
    return Run(**{**fields, **changes})  # type: ignore[arg-type]


def refused(code: str, **changes: object) -> Run:
    return Run(
        **{'family': 'standard', 'method': 'joint', 'run': 0, 'accepted': False, 'code': code, 'cpu_s': 3.0, **changes}
    )  # type: ignore[arg-type]


def cells(text: str, block: str, name: str) -> list[str]:
    """Return the words of the line of a family in the block with the given title."""
    part = next(part for part in text.split('\n\n') if block in part.splitlines()[0])
    return next(line for line in part.splitlines() if line.startswith(name)).split()


def test_the_truth_has_no_error() -> None:
    stddev = StandardDeviations(focal_px=5.6, tilt_deg=0.2, roll_deg=0.3)
    found = compare_calibrations(
        TASK, 'joint', calibration(JUNCTION.camera, plane(heading_deg=10.0), stddev), JUNCTION, 1.5
    )
    errors = (
        found.focal_error,
        found.rays_deg,
        found.normal_deg,
        found.tilt_error_deg,
        found.roll_error_deg,
        found.distance_error,
    )
    np.testing.assert_allclose(errors, 0.0, atol=1e-6)  # the heading of the ground frame is free
    assert (found.family, found.run, found.grade, found.cpu_s) == ('standard', 7, 'full', 1.5)
    assert (found.focal_sigma, found.tilt_sigma_deg, found.roll_sigma_deg) == (pytest.approx(0.01), 0.2, 0.3)


def test_known_faults_are_measured_in_their_units() -> None:
    camera = replace(JUNCTION.camera, focal_px=1.02 * JUNCTION.camera.focal_px)
    result = calibration(camera, plane(tilt_deg=33.0, roll_deg=0.5), StandardDeviations())
    found = compare_calibrations(TASK, 'joint', result, JUNCTION, 1.0)
    assert found.focal_error == pytest.approx(0.02)
    assert found.tilt_error_deg == pytest.approx(1.0)
    assert found.roll_error_deg == pytest.approx(0.5)  # the pose's roll turns the image, this one the camera
    assert found.normal_deg == pytest.approx(np.hypot(1.0, 0.5 * np.cos(np.radians(32.5))), abs=0.01)
    assert np.isnan(found.focal_sigma) and np.isnan(found.tilt_sigma_deg)


def test_a_lens_alone_has_no_error_of_the_plane() -> None:
    found = compare_calibrations(TASK, 'joint', calibration(JUNCTION.camera, None, StandardDeviations()), JUNCTION, 1.0)
    assert found.accepted and np.isnan([found.normal_deg, found.tilt_error_deg, found.distance_error]).all()


def test_a_refusal_keeps_its_code() -> None:
    refusal = Refusal.from_reason(Reason('no_motion', '', ''), 'joint', SUMMARY, Figures())
    found = compare_calibrations(TASK, 'joint', refusal, JUNCTION, 2.0)
    assert (found.accepted, found.code, found.cpu_s, found.grade) == (False, 'no_motion', 2.0, '')


def test_a_refusal_has_the_grade_of_its_candidate_and_the_view_of_the_draw() -> None:
    candidate = replace(calibration(JUNCTION.camera, plane(), StandardDeviations()), grade='assumed')
    refusal = Refusal.from_reason(Reason('grade_too_low', '', ''), 'joint', SUMMARY, Figures())
    found = compare_calibrations(TASK, 'joint', replace(refusal, candidate=candidate), JUNCTION, 2.0)
    assert found.grade == 'assumed'
    assert found.true_tilt_deg == pytest.approx(32.0) and found.road_yaw_deg == pytest.approx(35.0)


@pytest.mark.solve
def test_a_solver_that_fails_does_not_end_the_benchmark() -> None:
    found = run_method(TASK, 'unheard_of', *draw_evidence('few', 0, 0))
    assert (found.accepted, found.code) == (False, 'crash:UsageError')


def test_turning_the_camera_is_no_error_of_its_rays() -> None:
    true = Camera.equidistant(1280, 720, 560.0)
    shifted = Camera(1280, 720, 560.0, (659.5, 359.5))
    assert mean_ray_error_deg(true, true) == pytest.approx(0.0, abs=1e-9)
    assert mean_ray_error_deg(shifted, true) < 0.3  # 20 px are two degrees, most of which is a rotation
    assert mean_ray_error_deg(replace(true, focal_px=1.05 * 560.0), true) > 1.0


def test_a_plane_tilted_by_a_degree_falsifies_distances_by_some_per_cent() -> None:
    assert distance_error(JUNCTION.camera, plane(), JUNCTION) == pytest.approx(0.0, abs=1e-9)
    assert 0.01 < distance_error(JUNCTION.camera, plane(tilt_deg=33.0), JUNCTION) < 0.1
    assert distance_error(JUNCTION.camera, plane(tilt_deg=-80.0), JUNCTION) == np.inf  # the road is above the horizon


@pytest.mark.solve
@pytest.mark.parametrize('family', ['highway', 'long_bend', 'roundabout_arms', 'skew_turning', 'tee', 'sparse'])
def test_families_of_scenes_are_solved_without_a_crash(family: str) -> None:
    results = run_task(Task(family, 0, 0, ('paper', *(['joint'] if family == 'sparse' else []))))  # the quickest
    assert not any(result.code.startswith('crash') for result in results)
    assert not any(is_overconfident(result) for result in results)


def test_a_run_can_be_drawn_again_alone() -> None:
    (_, first), (_, again), (_, other) = (draw_evidence('few', 3, number) for number in (1, 1, 2))
    np.testing.assert_array_equal(first.points_px, again.points_px)
    assert not np.array_equal(first.points_px[:20], other.points_px[:20])
    assert not np.array_equal(first.points_px[:20], draw_evidence('few', 4, 1)[1].points_px[:20])


@pytest.mark.parametrize(
    ('changes', 'wrong'),
    [
        ({}, False),
        ({'focal_error': -0.031}, True),
        ({'focal_error': 0.06, 'focal_sigma': 0.05}, True),
        ({'focal_error': 0.049, 'focal_sigma': float('nan')}, False),
        ({'focal_error': -0.051, 'focal_sigma': float('nan')}, True),
        ({'tilt_error_deg': -1.1}, True),
        ({'tilt_error_deg': 0.9}, False),
        ({'roll_error_deg': 1.4}, False),
        ({'roll_error_deg': 1.6}, True),
        ({'tilt_error_deg': 9.0, 'tilt_sigma_deg': float('nan')}, False),
    ],
)
def test_false_is_what_its_own_sigmas_or_five_per_cent_forbid(changes: dict[str, object], wrong: bool) -> None:
    assert falsely_accepted(run(**changes)) is wrong
    assert not falsely_accepted(refused('no_motion', **{name: changes[name] for name in changes}))


@pytest.mark.parametrize(
    ('changes', 'beyond'),
    [
        ({}, False),
        ({'focal_error': 0.031}, True),
        ({'focal_error': 0.06, 'focal_sigma': 0.05}, False),  # false all the same: more than five per cent
        ({'tilt_error_deg': -0.61}, True),  # less than a degree, and three of its own sigmas
        ({'roll_error_deg': 1.4}, False),
        ({'roll_error_deg': -1.6}, True),
        ({'focal_error': 0.4, 'focal_sigma': float('nan')}, False),
        ({'tilt_error_deg': float('nan'), 'roll_error_deg': float('nan')}, False),
    ],
)
def test_beyond_is_what_its_own_sigmas_forbid(changes: dict[str, object], beyond: bool) -> None:
    assert is_overconfident(run(**changes)) is beyond
    assert not is_overconfident(refused('no_motion', **{name: changes[name] for name in changes}))


@pytest.mark.parametrize(
    ('family', 'title'),
    [('standard', 'determines the calibration: stated'), ('roundabout', 'does not, or that is misleading: stated')],
)
def test_table_flags_what_is_beyond_its_own_sigmas_in_either_list(family: str, title: str) -> None:
    runs = [
        run(family=family),
        run(family=family, tilt_error_deg=0.7),
        run(family=family, focal_error=0.2),
        refused('horizon', family=family),
    ]
    words = cells(format_tables(runs), title, family)
    assert words[4:6] == ['1', '2']
    assert re.search(r'false +beyond', format_tables(runs))


def test_table_counts_acceptance_refusals_and_errors() -> None:
    runs = [
        run(focal_error=0.03, normal_deg=0.5),
        run(focal_error=-0.01, normal_deg=1.5),
        refused('horizon'),
        refused('no_motion'),
        refused('no_motion'),
    ]
    assert cells(format_tables(runs), 'determines the calibration: errors', 'standard') == [
        'standard',
        'joint',
        '5',
        '40',
        'no_motion',
        '+1.00',
        '2.83',
        '2.00',
        '3.00',
        '1.00',
        '1.50',
        '0.200',
        '2.00',
    ]


def test_table_holds_errors_against_their_sigmas() -> None:
    runs = [
        run(focal_error=0.01),
        run(focal_error=0.07),
        run(tilt_error_deg=0.5, roll_error_deg=-1.5),
        run(normal_deg=float('nan'), tilt_error_deg=float('nan'), roll_error_deg=float('nan'), grade='lens'),
        refused('horizon'),
    ]
    # focal z 1, 7, 1, 1; tilt z 1.5, 1.5, 2.5; roll z 0.8, 0.8, -3
    assert cells(format_tables(runs), 'determines the calibration: stated', 'standard') == [
        'standard',
        'joint',
        '5',
        '80',
        '1',
        '1',
        '75',
        '75',
        '67',
        '67',
        '3.61',
        '1.89',
        '1.40',
    ]


def test_table_shows_a_dash_where_there_is_nothing() -> None:
    paper = [run(method='paper', focal_sigma=float('nan'), tilt_sigma_deg=float('nan'), roll_sigma_deg=float('nan'))]
    assert cells(format_tables(paper), 'stated', 'standard')[7:12] == ['-'] * 5
    assert cells(format_tables([refused('horizon')]), 'errors', 'standard')[5:] == ['-'] * 8


def test_methods_stand_beneath_each_other_and_lines_fit_a_terminal() -> None:
    runs = [
        run(family=family, method=method, focal_error=-12.3456, normal_deg=123.456)
        for family in ('lane_changes', 'distortion_free_skew')
        for method in ('joint', 'paper')
    ]
    runs.append(refused('crash:LinAlgError', family='noise', run=4))
    text = format_tables(runs)
    assert max(map(len, text.splitlines())) <= 120
    lines = [line.split()[:2] for line in text.splitlines()]
    place = lines.index(['lane_changes', 'joint'])
    assert lines[place + 1] == ['lane_changes', 'paper']
    assert 'does not, or that is misleading' in text
    assert text.endswith('1 solutions crashed:\n  noise 4 (joint, LinAlgError)')


def test_csv_has_a_row_a_run_and_leaves_blank_what_is_not_given(tmp_path: Path) -> None:
    with open_csv(tmp_path / 'new' / 'runs.csv') as write:
        write([run(run=1), refused('horizon', run=2)])
    with (tmp_path / 'new' / 'runs.csv').open(newline='') as stream:
        first, second = csv.DictReader(stream)
    assert (first['run'], first['accepted'], float(first['focal_error'])) == ('1', 'True', 0.01)
    assert (second['run'], second['code'], second['focal_error']) == ('2', 'horizon', '')


def test_an_unwritable_csv_is_reported_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='cannot write'):
        run_monte_carlo(['many'], ['joint'], 1000, out=tmp_path, quiet=True)


@pytest.mark.solve
def test_benchmark_runs_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'runs.csv'
    assert main(['benchmark', 'accuracy', '--runs', '2', '--family', 'standard', '--out', str(out)]) == 0
    printed = capsys.readouterr()
    assert cells(printed.out, 'errors', 'standard')[:3] == ['standard', 'joint', '2']
    with out.open(newline='') as stream:
        rows = list(csv.DictReader(stream))
    assert [row['method'] + row['run'] for row in rows] == ['joint0', 'paper0', 'joint1', 'paper1']
    assert not any(row['code'].startswith('crash') for row in rows)
    assert '2 of 2 draws' in printed.err


@pytest.mark.solve
@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--family', 'unheard_of'], "unknown evidence family 'unheard_of'; known families: standard, few"),
        (['--runs', '0'], '--runs must be at least 1; got 0'),
        (['--jobs', '0'], '--jobs must be at least 1; got 0'),
        (['--seed', '-1'], '--seed must be at least 0; got -1'),
        (['--method', 'magic'], "invalid choice: 'magic'"),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['benchmark', 'accuracy', *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1


def test_the_cost_benchmark_is_still_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['benchmark', 'cost', 'nowhere.mp4']) == 2
    assert 'nowhere.mp4 does not exist' in capsys.readouterr().err


@pytest.mark.dds
def test_module_runs_the_benchmark_too() -> None:
    done = subprocess.run(
        [sys.executable, '-m', 'autocalib_ros', 'benchmark', 'accuracy', '--help'],
        capture_output=True,
        cwd=Path(autocalib_ros.__file__).parents[1],
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0 and done.stdout.startswith('usage: autocalib benchmark accuracy')

"""What a refusal shows: words about the road, how near each requirement is, what was found, and what to try."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autocalib_ros.cli import _parse_arguments
from autocalib_ros.config import LensOptions, Options, ScaleOptions
from autocalib_ros.estimation.road_sketch import plausible_horizon, sketch_roads
from autocalib_ros.estimation.solution import append_reason
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.offline.synthetic.junction import Junction, pose
from autocalib_ros.report.next_command import next_command
from autocalib_ros.report.requirements import needs
from autocalib_ros.report.scene import ReportScene
from autocalib_ros.report.sketch_figures import (
    line_directions,
    roads_so_far,
    sketch_note,
    still_lines,
    still_lines_note,
)
from autocalib_ros.report.text import headline, measured, verdict
from autocalib_ros.results.calibration import Figures, Refusal
from autocalib_ros.results.grades import HelpfulMeasure
from autocalib_ros.results.refusals import REFUSALS, Reason, reason
from autocalib_ros.results.road_words import ROAD_WORDS, in_road_words
from solved_once import evidence_once

ROAD = Junction(
    road_angles_deg=(0.0,), turning_fraction=0.0, camera_from_ground=pose(30.0, 0.0, 20.0), centre_m=(20.0, -4.0)
)
OPTIONS = Options(camera_height=8.0)
OPEN, FEW = (
    reason('no_agreement', contrast=1.18, limit=1.3),
    reason('too_few_vehicles', 'single_road', vehicles=7, limit=8),
)


def refusal(why: Reason) -> Refusal:
    return Refusal.from_reason(why, 'joint', evidence_once(ROAD).summary(), Figures())


def scene(why: Reason) -> ReportScene:
    return ReportScene(
        result=refusal(why), evidence=evidence_once(ROAD), background=None, options=OPTIONS, source='road'
    )


@pytest.fixture
def joined() -> Reason:
    why = append_reason(OPEN, FEW, asks_less=True)
    assert isinstance(why, Reason)
    return why


def test_every_code_has_words_for_the_road() -> None:
    assert {key.partition('/')[0] for key in ROAD_WORDS} == {entry.code for entry in REFUSALS}
    causes = {f'{entry.code}/{cause}' for entry in REFUSALS for cause in entry.variants}
    assert {key for key in ROAD_WORDS if '/' in key} <= causes


def test_a_refusal_speaks_of_the_road_and_then_of_the_numbers(joined: Reason) -> None:
    result = refusal(joined)
    assert headline(result) == (
        'Not calibrated: no lens curvature is visible, and too few vehicles follow one straight road.'
    )
    assert measured(result).startswith('Focal length not identifiable') and measured(result) in verdict(result)
    far = reason('too_few_tracks', 'far', tracks=3, all=200, limit=40)
    assert in_road_words(far.code, far.values) == 'vehicles are followed only far away'
    assert in_road_words('unheard_of', {}) == ''


def test_the_same_reason_twice_is_told_once() -> None:
    most, more = (reason('turning_traffic', fraction=share, limit=0.5, roads=2) for share in (0.1, 0.4))
    why = append_reason(most, more, asks_less=True)
    assert isinstance(why, Reason) and why.message == more.message and ';' not in headline(refusal(why))
    rows = needs(refusal(why), evidence_once(ROAD), OPTIONS.gate)
    assert [row.found for row in rows if row.name == 'vehicles that follow straight roads'] == ['40%']


def test_each_requirement_shows_how_near_it_is(joined: Reason) -> None:
    short = replace(refusal(joined), evidence=replace(refusal(joined).evidence, seconds=3.0))
    rows = {row.name: row for row in needs(short, evidence_once(ROAD), OPTIONS.gate)}
    assert (rows['recording'].found, rows['recording'].needed) == ('3 s', 'about 10 s or more')
    assert (rows['vehicles on one straight road'].found, rows['vehicles on one straight road'].needed) == (
        '7',
        'at least 8',
    )
    assert rows['lens curvature seen in straight traffic'].found == '1.18'
    missing = [name for name, row in rows.items() if not row.met]
    assert len(missing) == 3 and 'image coverage' not in missing


def test_the_certainty_of_lengths_is_a_number_beside_its_limit() -> None:
    rough = {'grade': 'assumed', 'least': 'coarse', 'limit': 0.25, 'focal': 0.4, 'helpful': ''}
    rows = needs(refusal(reason('grade_too_low', along=0.34, across=0.12, **rough)), evidence_once(ROAD), OPTIONS.gate)
    assert (rows[-1].found, rows[-1].needed) == ('± 34% along the view, ± 12% across it', 'grade coarse: at most ± 25%')
    lens = refusal(reason('grade_too_low', 'lens', along=None, across=None, **rough))
    assert needs(lens, evidence_once(ROAD), OPTIONS.gate)[-1].found.startswith('The lens alone is known')


def test_a_sketch_shows_where_the_road_vanishes() -> None:
    sketch = sketch_roads(evidence_once(ROAD), OPTIONS)
    assert sketch is not None and sketch.shares[0] > 0.7
    # the true vanishing point, by the assumed lens: a sketch is right to a few degrees
    along, _ = ROAD.camera.project(ROAD.camera_from_ground[:, 0][None])
    found, _ = sketch.camera.project(np.array([sketch.directions[0], -sketch.directions[0]]))
    assert np.hypot(*(found - along).T).min() < 0.1 * ROAD.camera.width
    assert roads_so_far(scene(OPEN)) is not None and 'a camera without roll' in sketch_note(scene(OPEN))


@pytest.mark.parametrize(('roll_deg', 'is_shown'), [(0.0, True), (40.0, True), (60.0, False), (180.0, False)])
def test_a_horizon_is_sketched_if_it_is_nearly_level_and_the_traffic_below_it(roll_deg: float, is_shown: bool) -> None:
    roll = np.radians(roll_deg)
    up = np.array([np.sin(roll), -np.cos(roll), 0.0])
    below = np.array([[-np.sin(roll), np.cos(roll), 2.0]])
    assert (plausible_horizon(up, below) is not None) == is_shown
    assert plausible_horizon(up, np.concatenate([below, -below])) is None


def test_too_little_traffic_has_no_sketch() -> None:
    nothing = evidence_once(ROAD).select_tracks(np.arange(5))
    assert sketch_roads(nothing, OPTIONS) is None
    assert roads_so_far(replace(scene(OPEN), evidence=nothing)) is None


@pytest.mark.parametrize(
    ('why', 'options', 'command'),
    [
        (FEW, OPTIONS, 'autocalib replay NEW_RECORDING --resume --camera-height 8 --out out'),
        (OPEN, OPTIONS, 'autocalib evidence out/evidence.npz --camera-height 8 --hfov-deg DEGREES --out out'),
        (
            reason('too_little_curvature', focal_px=900.0, sigma=0.4, limit=0.25),
            OPTIONS,
            'autocalib evidence out/evidence.npz --camera-height 8 --hfov-deg DEGREES --out out',
        ),
        (
            reason('no_height'),
            Options(lens=LensOptions(hfov_deg=60.0)),
            'autocalib evidence out/evidence.npz --hfov-deg 60 --camera-height METRES --out out',
        ),
        (
            reason('distortion_model', misfit='', instead=''),
            replace(OPTIONS, distortion_model='plumb_bob'),
            'autocalib evidence out/evidence.npz --camera-height 8 -p distortion_model:=equidistant --out out',
        ),
        (
            reason('scale_off_road', u=1.0, v=2.0, angle_deg=1.0, side='above', limit_deg=1.7),
            Options(scale=ScaleOptions(distance_px='1 2 300 2', distance_m=9.0)),
            'autocalib evidence out/evidence.npz --distance U1 V1 U2 V2 METRES --out out',
        ),
        (
            reason('poor_coverage', coverage=0.1, limit=0.15),
            OPTIONS,
            'autocalib replay NEW_RECORDING --camera-height 8 --out out',
        ),
    ],
)
def test_the_command_to_try_next_can_be_copied(why: Reason, options: Options, command: str) -> None:
    assert next_command(refusal(why), options, Path('out')) == command
    assert next_command(refusal(why), options, None) == ''
    numbers = {'METRES': '8.0', 'DEGREES': '60', 'U1': '1', 'V1': '2', 'U2': '3', 'V2': '4'}
    words = [numbers.get(word, word) for word in shlex.split(command)]
    assert _parse_arguments(words[1:]).command == words[1]


def test_a_helpful_measure_is_told_to_the_saved_evidence(full) -> None:
    helped = replace(full.result, helpful=HelpfulMeasure('focal', 0.03))
    assert next_command(helped, OPTIONS, Path('a b')).startswith("autocalib evidence 'a b/evidence.npz'")
    assert next_command(replace(full.result, helpful=None), OPTIONS, Path('out')) == ''


def test_lines_are_coloured_by_the_direction_of_the_road(full) -> None:
    truth = GroundPlane(ROAD.camera_from_ground.T, 8.0)
    ends_m = np.array(
        [[[15, -3, 0], [18, -3, 0]], [[16, -6, 0], [16, -3, 0]], [[16, -4, 0], [16, -4, 3]], [[15, -6, 0], [18, -3, 0]]]
    )
    pixels, _ = ROAD.camera.project((ends_m.reshape(-1, 3) - [0, 0, 8.0]) @ ROAD.camera_from_ground.T)
    lines = pixels.reshape(-1, 4)
    assert line_directions(ROAD.camera, truth.rotation.T, lines).tolist() == [0, 1, 2, -1]
    seen = replace(full, evidence=replace(full.evidence, still_lines_px=lines))
    assert still_lines(seen) is not None and still_lines(full) is None
    assert 'not needed' in still_lines_note(seen)

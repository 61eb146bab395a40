"""The report of every kind of result, built by hand."""

from __future__ import annotations

import base64
import html
import re
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from matplotlib.text import Text

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera_info import rectified_matrix
from autocalib_ros.pictures.views import ground_to_image, image_to_ground, round_length
from autocalib_ros.report.lens_figures import in_undistorted, line_error_px
from autocalib_ros.report.page import ENTRIES, write_report
from autocalib_ros.report.requirements import needs
from autocalib_ros.report.road_figures import accuracy_note, top_view
from autocalib_ros.report.scene import MAX_SNAPSHOTS, SolutionSnapshot, append_snapshot
from autocalib_ros.report.speed_figures import speed_histogram, speeds_above, track_pieces_on_road, vehicle_speeds
from autocalib_ros.report.text import history_rows, how_sure, next_step, number_rows, verdict
from autocalib_ros.report.traffic_figures import kept_tracks
from autocalib_ros.results.calibration import Refusal, Residuals
from synthetic_results import SPEED_M_S, junction_evidence

pytestmark = pytest.mark.render

ALL = {entry.name for entry in ENTRIES} - {'roads_so_far', 'still_lines'}
"""What a calibration shows whose scene has no lines."""
ON_THE_ROAD = {'ground_grid', 'top_view', 'speeds', 'speed_histogram'}
OF_TRAFFIC = {'all_tracks', 'coverage'}
VOID = {'meta', 'img', 'br', 'link', 'input'}


class Balanced(HTMLParser):
    """Checks that every tag is closed in its turn."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def text_of(path) -> str:
    """Return the words of a page, without its pictures."""
    text = re.sub('base64,[^"]+', '', path.read_text())
    parser = Balanced()
    parser.feed(text)
    assert not parser.open
    return html.unescape(text)


def figures(path) -> set[str]:
    return {figure.stem for figure in (path.parent / 'figures').iterdir()}


def drawn(scene) -> set[str]:
    """Return which figures there are for a scene; drawing is quick, rendering is not."""
    return {entry.name for entry in ENTRIES if entry.draw(scene) is not None}


def test_a_calibration_shows_everything(full, written):
    text = text_of(written('full'))
    assert verdict(full.result) in text
    assert figures(written('full')) == ALL
    assert 'the two roads are perpendicular' in text
    for row in number_rows(full.result, full.accepted_at_s):
        assert row.value in text
    assert all(entry.title in text for entry in ENTRIES if entry.name in ALL)


def test_other_users_cannot_read_what_shows_the_street(written):
    page = written('full')
    assert not any(path.stat().st_mode & 0o007 for path in (page, *(page.parent / 'figures').glob('*.png')))


def test_names_of_files_cannot_break_the_page(written):
    assert 'clip &lt;1&gt;.mp4' in written('full').read_text()


def test_the_opening_has_uncertainty_assumptions_and_next_step(written):
    opening = text_of(written('full')).partition('<nav>')[0]
    assert 'focal length 140.0 ± 1.5 px; the camera looks 40.0 ± 0.2 degrees down from 8.00 m' in opening
    assert 'Focal length ± 1.1 %; tilt ± 0.20 and roll ± 0.10 degrees' in opening
    assert re.search('Assumed:.*the two roads are perpendicular', opening)
    assert re.search('Next step:.*use the files', opening)


def test_a_lens_without_ground_plane_gives_the_reason(written):
    text = text_of(written('lens_only'))
    assert 'one_direction' in text
    assert 'Aim at a crossing.' in text
    assert figures(written('lens_only')) == ALL - ON_THE_ROAD


def test_a_refusal_explains_itself_and_replaces_an_older_report(tmp_path, refused):
    (tmp_path / 'figures').mkdir()
    (tmp_path / 'figures' / 'top_view.png').touch()
    write_report(tmp_path / 'report.html', refused)
    text = text_of(tmp_path / 'report.html')
    assert 'Not calibrated: too little traffic was seen.' in text and 'Only 12 of 40 tracks were seen.' in text
    assert 'Record at a busier time.' in text
    assert figures(tmp_path / 'report.html') == OF_TRAFFIC | {'roads_so_far'}


def test_the_paper_s_method_shows_the_tracks_it_kept_and_knows_no_sigma(full):
    sigmas = replace(full.result.stddev, focal_px=None, tilt_deg=None, roll_deg=None, height_m=None)
    given = replace(full.result.figures, track_labels=np.full(full.evidence.track_count, -1), residuals=Residuals())
    paper = replace(full, result=replace(full.result, method='paper', covariance=None, stddev=sigmas, figures=given))
    assert 'gives no uncertainty' in how_sure(paper.result)
    assert 'is unknown' in accuracy_note(paper)
    assert len(paper.paths(0)) == len(given.paper_tracks) > 0
    assert drawn(paper) == ALL - {'residuals', 'residual_map'}


def test_a_result_of_turning_traffic_alone_shows_its_points(full):
    given = full.result.figures
    turning = replace(
        given,
        track_labels=np.full(full.evidence.track_count, -1),
        residuals=replace(given.residuals, roads=np.full(len(given.residuals.roads), -1)),
    )
    scene = replace(full, result=replace(full.result, road_directions=np.zeros((0, 3)), figures=turning))
    assert drawn(scene) == ALL - {'straightness'}
    words = [text.get_text() for text in kept_tracks(scene).findobj(Text)]
    assert f'on turning vehicles: {len(scene.turning_px)} points' in words


@pytest.mark.parametrize('background', [True, False])
def test_without_a_scale_nothing_is_in_metres(full, background):
    result = replace(
        full.result, grade='unit_scale', covariance=None, ground=GroundPlane(full.result.ground.rotation, 1.0, False)
    )
    scene = replace(full, result=result, background=full.background if background else None)
    assert drawn(scene) == ALL
    assert 'Give the height of the camera' in next_step(result)
    for figure in (top_view(scene), speeds_above(scene), speed_histogram(scene)):
        words = [text.get_text() for text in figure.findobj(Text)]
        assert any('camera heights' in word for word in words)
        assert not any(word.endswith((' m', ', m', 'km/h')) for word in words)


def test_a_restored_calibration_without_traffic_shows_the_ground(full):
    nothing = full.evidence.select_tracks(np.zeros(0, int))
    assert {'ground_grid', 'top_view', 'undistorted', 'directions'} <= drawn(
        replace(full, evidence=nothing, moments=())
    )


def test_no_traffic_at_all_still_gives_a_page(tmp_path, refused):
    nothing = refused.evidence.select_tracks(np.zeros(0, int))
    write_report(tmp_path / 'report.html', replace(refused, evidence=nothing, background=None))
    assert 'Not calibrated' in text_of(tmp_path / 'report.html')
    assert figures(tmp_path / 'report.html') == set()


def test_the_page_is_self_contained_and_holds_the_figures(written):
    text = written('full').read_text()
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text)
    assert 'http' not in re.sub('base64,[^"]+', '', text)
    shown = [
        cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        for data in re.findall('src="data:image/[a-z]+;base64,([^"]+)"', text)
    ]
    for one, name in zip(shown, (entry.name for entry in ENTRIES if entry.name in ALL), strict=True):
        other = cv2.imread(str(written('full').parent / 'figures' / f'{name}.png'))
        assert one.shape == other.shape and one.shape[1] > 900
        assert np.abs(one.astype(int) - other).mean() < 8  # JPEG of noise


def test_the_same_scene_gives_the_same_page(tmp_path, refused, written):
    write_report(tmp_path / 'report.html', refused)
    assert (tmp_path / 'report.html').read_bytes() == written('refused').read_bytes()


@pytest.mark.parametrize(
    ('code', 'change', 'missing'),
    [
        ('camera_moving', {'drift_px': 9.0}, 'stationary camera'),
        ('too_few_tracks', {}, 'tracks of moving traffic'),
        ('given_lens', {}, 'a lens that belongs to the images'),
    ],
)
def test_a_missing_requirement_is_in_a_table(full, code, change, missing):
    evidence = replace(full.evidence, **change)
    if code == 'given_lens':  # enough of everything
        evidence = replace(evidence, track_vehicles=np.zeros(99, int))
    refusal = Refusal(code=code, message='x', remedy='y', method='joint', evidence=full.result.evidence)
    rows = needs(refusal, evidence, full.options.gate)
    assert missing in [row.name for row in rows if not row.met]
    assert all(row.found for row in rows)


def test_requirements_are_listed_for_a_missing_ground_plane_but_not_for_a_full_calibration(full, lens_only):
    assert 'One direction only.' in [row.found for row in needs(lens_only.result, full.evidence, full.options.gate)]
    assert not needs(full.result, full.evidence, full.options.gate)


def test_the_speed_of_points_above_the_road_is_that_of_their_vehicles(full):
    given = full.options.scale.point_height_m
    scene = replace(full, evidence=junction_evidence(above_m=given))
    speeds, roads = vehicle_speeds(scene, track_pieces_on_road(scene))
    # exact but for pieces of half a second that begin at samples
    assert speeds == pytest.approx(np.full(len(speeds), 3.6 * SPEED_M_S), rel=1e-6)
    assert set(roads) <= {-1, 0, 1} and {0, 1} <= set(roads)


def test_points_on_the_road_itself_look_slower_by_their_height(full):
    speeds, _ = vehicle_speeds(full, track_pieces_on_road(full))
    share = 1 - full.options.scale.point_height_m / full.result.ground.height_m
    assert speeds == pytest.approx(np.full(len(speeds), 3.6 * SPEED_M_S * share), rel=1e-6)


def test_moments_are_few_and_the_newest_is_among_them(full):
    moments = ()
    for second in range(10 * MAX_SNAPSHOTS):
        summary = replace(full.result.evidence, seconds=float(second))
        moments = append_snapshot(moments, replace(full.result, evidence=summary))
        assert len(moments) <= MAX_SNAPSHOTS + 1 and moments[-1].seconds == second
    assert moments[0].seconds == 0.0


def test_moments_of_an_earlier_time_go_when_time_begins_anew(full):
    early = replace(full.result, evidence=replace(full.result.evidence, seconds=5.0))
    assert append_snapshot((SolutionSnapshot(60.0), SolutionSnapshot(70.0)), early) == (SolutionSnapshot.of(early),)


def test_a_plane_without_scale_is_not_given_in_metres(full):
    result = replace(full.result, grade='unit_scale', ground=GroundPlane(full.result.ground.rotation, 1.0, False))
    assert 'not given' in verdict(result)
    assert ' m' not in next(row.value for row in number_rows(result) if row.name == 'camera height')


def test_ground_and_image_agree(full):
    camera, ground = full.result.camera, full.result.ground
    points = np.array([[8.0, 8.0, 0.0], [5.0, 12.0, 0.0]])
    assert image_to_ground(camera, ground, ground_to_image(camera, ground, points)) == pytest.approx(points[:, :2])


def test_nothing_on_the_ground_lies_above_the_horizon(full):
    assert np.isnan(image_to_ground(full.result.camera, full.result.ground, np.array([160.0, -60.0]))).all()


def test_exact_tracks_are_straight_in_the_undistorted_picture(full):
    # exact but for the rounding of double precision
    camera = full.result.camera
    assert line_error_px(in_undistorted(camera, rectified_matrix(camera), full.evidence.track(3).points_px)) < 1e-9


@pytest.mark.parametrize(('length', 'nice'), [(0.7, 0.5), (1.0, 1.0), (3.9, 2.0), (64.0, 50.0), (10.0, 10.0)])
def test_scales_have_round_lengths(length, nice):
    assert round_length(length) == pytest.approx(nice)


def test_the_newest_versions_of_a_calibration_come_first():
    history = [{'time': f'{number:02d}', 'cause': 'solved'} for number in range(20)]
    rows = history_rows(history)
    assert [row.name for row in rows] == [f'version of {number:02d}' for number in range(19, 7, -1)]
    assert len(history_rows(history[:3])) == 3

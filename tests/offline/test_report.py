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

from autocalib_ros.calibration import GroundPlane
from autocalib_ros.camera_info import rectified_matrix
from autocalib_ros.offline.report import write_report
from autocalib_ros.offline.report.lens_figures import in_undistorted, line_error_px
from autocalib_ros.offline.summary import number_rows, verdict
from autocalib_ros.pictures.views import ground_to_image, image_to_ground, nice_length

ALL = {'ground_grid', 'top_view', 'all_tracks', 'kept_tracks', 'undistorted', 'straightness', 'focal_sweep',
       'orientation_histogram', 'directions'}
VOID = {'meta', 'img', 'br', 'link'}


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


def page(tmp_path, replayed) -> str:
    write_report(tmp_path / 'report.html', replayed, 'clip <1>.mp4')
    text = (tmp_path / 'report.html').read_text()
    parser = Balanced()
    parser.feed(text)
    assert not parser.open
    return text


def figures(tmp_path) -> set[str]:
    return {path.stem for path in (tmp_path / 'figures').iterdir()}


def test_a_calibration_shows_everything(tmp_path, full):
    text = page(tmp_path, full)
    assert verdict(full.result) in html.unescape(text)
    assert figures(tmp_path) == ALL
    assert 'the two roads are perpendicular' in text
    assert 'clip &lt;1&gt;.mp4' in text
    for row in number_rows(full.result, full.accepted_at_s):
        assert row.value in html.unescape(text)


def test_a_lens_without_ground_says_why(tmp_path, lens_only):
    text = page(tmp_path, lens_only)
    assert 'one_direction' in text
    assert 'Aim at a crossing.' in text
    assert figures(tmp_path) == ALL - {'ground_grid', 'top_view'}


def test_a_refusal_explains_itself_and_replaces_an_older_report(tmp_path, refused):
    (tmp_path / 'figures').mkdir()
    (tmp_path / 'figures' / 'top_view.png').touch()
    text = page(tmp_path, refused)
    assert 'Not calibrated: only 12 of 40 tracks were seen.' in text
    assert 'Record at a busier time.' in text
    assert figures(tmp_path) == {'all_tracks'}


def test_the_page_is_self_contained(tmp_path, refused):
    text = page(tmp_path, refused)
    assert not re.findall(r'(?:src|href)="(?!data:)', text)
    assert 'http' not in text
    embedded = [base64.b64decode(data) for data in re.findall('base64,([^"]+)"', text)]
    assert embedded == [(tmp_path / 'figures' / 'all_tracks.png').read_bytes()]
    assert cv2.imdecode(np.frombuffer(embedded[0], np.uint8), cv2.IMREAD_COLOR).shape[1] > 900


def test_no_traffic_at_all_still_gives_a_page(tmp_path, refused):
    nothing = refused.evidence.selected(np.zeros(0, int))
    assert 'Not calibrated' in page(tmp_path, replace(refused, evidence=nothing, background=None))
    assert figures(tmp_path) == set()


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
    assert nice_length(length) == pytest.approx(nice)

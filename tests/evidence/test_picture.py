"""Tests of the picture inside the images: its centre, what it hides, and files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.helpers.synthetic_results import junction_evidence

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.adjustment.lens_prior import PRINCIPAL_POINT_SIGMA_FRACTION, lens_priors
from autocalib_ros.evidence.picture import Picture
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.results.statements import assumption

BELOW = Picture((640, 480), (0.0, 0.0, 640.0, 360.0))
"""Black rows below a picture of 16:9."""
COVERED = Picture((640, 360), (0.0, 0.0, 640.0, 300.0))
"""A strip of 60 rows drawn over a picture of 16:9, or a picture that somebody cut."""


def test_a_whole_picture_has_the_centre_of_the_image() -> None:
    whole = Picture.whole((640, 360))
    assert whole.fills_image and whole.centre_px == (319.5, 179.5) and not whole.looks_cut


def test_bars_beside_a_picture_of_sensor_shape_hide_nothing() -> None:
    assert BELOW.centre_px == (319.5, 179.5) and BELOW.centre_sigma_px == (0.0, 0.0) and not BELOW.looks_cut


def test_a_strip_that_leaves_another_shape_covers_the_picture_of_a_whole_image() -> None:
    # the centre of the whole image, 179.5, or that of what is seen, 149.5
    assert COVERED.is_covered and COVERED.looks_cut
    assert COVERED.lens_centre_px == (319.5, 179.5) and COVERED.centre_sigma_px == (0.0, 30.0)


def test_bars_beside_a_cut_picture_leave_its_centre_uncertain() -> None:
    cut = Picture((640, 420), (0.0, 0.0, 640.0, 300.0))
    assert not cut.is_covered and cut.looks_cut
    assert cut.lens_centre_px == (319.5, 149.5) and cut.centre_sigma_px == (0.0, 60.0)


def test_the_description_says_what_is_no_picture_and_what_may_be_cut() -> None:
    assert BELOW.description == (
        'The picture is 640x360 at (0, 0) in images of 640x480: 120 rows below are no picture.'
    )
    assert 'cover a part, within 30 px down' in COVERED.description


def test_equal_bars_on_both_sides_leave_the_centre() -> None:
    letterbox = Picture((640, 480), (0.0, 59.0, 640.0, 420.0))
    assert letterbox.centre_px == (319.5, 239.0) and not letterbox.looks_cut


def test_an_image_of_no_sensor_shape_was_cut_from_one() -> None:
    # the smallest sensor shape around 640x240 is 17:9
    across, down = Picture.whole((640, 240)).centre_sigma_px
    assert across == 0.0 and down == pytest.approx((640 / (17 / 9) - 240) / np.sqrt(12.0))


@pytest.mark.parametrize(
    'size', [(1280, 720), (640, 480), (704, 576), (720, 480), (854, 480), (1920, 1088), (480, 640)]
)
def test_usual_images_are_whole(size: tuple[int, int]) -> None:
    assert not Picture.whole(size).looks_cut


def test_a_circle_has_its_own_centre_and_is_whole() -> None:
    circle = Picture((640, 360), (170.0, 15.0, 490.0, 335.0), (330.0, 175.0, 160.0))
    assert circle.centre_px == (329.5, 174.5) and not circle.looks_cut


def test_a_picture_scales_with_the_images() -> None:
    circle = Picture((640, 360), (170.0, 15.0, 490.0, 335.0), (330.0, 175.0, 160.0))
    twice = circle.in_images_of((1280, 720))
    assert twice.rectangle == (340.0, 30.0, 980.0, 670.0) and twice.circle == (660.0, 350.0, 320.0)
    assert BELOW.scaled(1.5, 1.0, (960, 480)).rectangle == (0.0, 0.0, 960.0, 360.0)


def test_a_picture_outside_of_the_images_is_an_error() -> None:
    with pytest.raises(ValueError, match='641'):
        Picture((640, 360), (0.0, 0.0, 641.0, 360.0))


def test_the_words_name_size_place_and_images() -> None:
    assert str(BELOW) == '640x360 at (0, 0) in images of 640x480'


def test_the_prior_of_the_principal_point_is_that_of_the_picture() -> None:
    prior = lens_priors((640, 480), JointOptions(), BELOW)[0]
    assert prior.centre.principal_point_px == (319.5, 179.5)
    np.testing.assert_allclose(prior.sigma[1:3], PRINCIPAL_POINT_SIGMA_FRACTION * 640)
    assert (prior.centre.width, prior.centre.height) == (640, 480)


def test_the_prior_widens_across_a_strip_that_may_cover_the_picture() -> None:
    prior = lens_priors((640, 360), JointOptions(), COVERED)[0]
    np.testing.assert_allclose(prior.sigma[1:3], (6.4, np.hypot(6.4, 30.0)))


def test_a_given_standard_deviation_is_not_widened() -> None:
    prior = lens_priors((640, 360), JointOptions(principal_point_sigma_px=0.0), COVERED)[0]
    np.testing.assert_allclose(prior.sigma[1:3], 0.0)


def test_the_image_circle_holds_the_principal_point_where_it_would_be_loose() -> None:
    circle = Picture((640, 360), (170.0, 15.0, 490.0, 335.0), (330.0, 175.0, 160.0))
    prior = lens_priors((640, 360), JointOptions(), circle)[0]
    assert prior.centre.principal_point_px == (329.5, 174.5)
    np.testing.assert_allclose(prior.with_loose_principal_point().sigma[1:3], prior.sigma[1:3])
    assert lens_priors((640, 360), JointOptions())[0].with_loose_principal_point().sigma[1] == 64.0


def test_evidence_keeps_the_picture_in_its_file(tmp_path: Path) -> None:
    evidence = junction_evidence()
    width, height = evidence.image_size
    picture = Picture((width, height), (0.0, 0.0, width, height - 20.0), (100.0, 80.0, 60.0))
    replace(evidence, picture=picture).save(tmp_path / 'evidence.npz')
    assert Evidence.load(tmp_path / 'evidence.npz').picture == picture


def test_evidence_without_a_picture_fills_the_images(tmp_path: Path) -> None:
    junction_evidence().save(tmp_path / 'evidence.npz')
    with np.load(tmp_path / 'evidence.npz') as data:
        assert 'picture' not in data
    assert Evidence.load(tmp_path / 'evidence.npz').picture.fills_image


def test_evidence_in_images_of_another_size_scales_its_picture() -> None:
    evidence = junction_evidence()
    width, height = evidence.image_size
    picture = Picture((width, height), (0.0, 0.0, width / 2, float(height)))
    wide = replace(replace(evidence, picture=picture), image_size=(2 * width, height))
    assert wide.picture.rectangle == (0.0, 0.0, float(width), float(height))
    assert wide.select_tracks(np.arange(2)).picture == wide.picture


@pytest.mark.parametrize(
    ('values', 'words'),
    [
        ({}, 'at the image centre ± 6 px'),
        ({'picture': str(BELOW)}, 'at the centre of the picture (640x360 at (0, 0) in images of 640x480) ± 6 px'),
        (
            {'picture': str(COVERED), 'covered': True, 'sigma_down_px': 30.7},
            'at the image centre, of which bars cover a part (seen: 640x300 at (0, 0) in images of 640x360), '
            '± 6 px across and 31 px down',
        ),
    ],
)
def test_the_assumption_names_the_picture(values: dict[str, object], words: str) -> None:
    assert assumption('principal_point', sigma_px=6.4, **values).text == f'principal point {words}'

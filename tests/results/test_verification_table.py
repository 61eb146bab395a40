"""Rows of the verification table: what passes, and how it is worded."""

import numpy as np
import pytest

from autocalib_ros.results.verification_table import (
    VERIFIED_QUANTITIES,
    VerificationRow,
    summarise_verification,
    verified,
)


@pytest.mark.parametrize(
    ('kind', 'value', 'limit', 'passed'),
    [
        ('k1_prior', 3.5, 3.5, True),
        ('k1_prior', 3.6, 3.5, False),
        ('below_horizon', 0.95, 0.95, True),
        ('below_horizon', 0.94, 0.95, False),
        ('halves_focal', np.nan, 0.03, False),
        ('focal_sigma', np.inf, 0.05, False),
    ],
)
def test_a_value_passes_on_its_side_of_the_limit(kind, value, limit, passed):
    assert verified(kind, value, limit).passed is passed


def test_a_row_tells_value_limit_and_cost():
    assert str(verified('focal_sigma', 0.0123, 0.05)) == (
        'standard deviation of the focal length 1.23 % (at most 5 %): passed'
    )
    assert str(verified('below_horizon', 0.9, 0.95)) == (
        'tracked points below the horizon 90 % (at least 95 %): failed: no calibration'
    )
    assert verified('halves_normal', np.inf, 1.5).value_text == 'unknown'


def test_a_summary_counts_and_names_what_failed():
    good, bad = verified('k1_prior', 1.0, 3.5), verified('lane_markings', 0.02, 0.5)
    assert summarise_verification(()) == ''
    assert summarise_verification((good, good)) == '2 of 2 checks passed'
    assert summarise_verification((good, bad)) == (
        '1 of 2 checks passed; probability that traffic and lane markings are both right 2 % (at least 50 %): '
        'failed: grade fair at most'
    )


def test_a_row_of_a_newer_version_is_still_shown():
    assert str(VerificationRow('of_tomorrow', 2.0, 1.0, False)) == 'of_tomorrow 2 (at most 1): failed'


def test_every_quantity_has_a_name_of_its_own():
    names = [quantity.name for quantity in VERIFIED_QUANTITIES.values()]
    assert len(set(names)) == len(names)


def test_only_a_failed_check_that_costs_the_grade_lowers_it() -> None:
    assert verified('vehicle_size', 0.5, 0.25).lowers_grade
    assert not verified('vehicle_size', 0.1, 0.25).lowers_grade
    assert not verified('pixel_aspect', 9.0, 4.0).lowers_grade

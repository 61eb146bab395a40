"""The period of dashes and the width of lanes, from bars on the road."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from dashed_road import LINES_M, PERIOD_M, bars_seen, dashes
from pinhole_road import PINHOLE, ROAD

from autocalib_ros.config import LaneOptions
from autocalib_ros.errors import UsageError
from autocalib_ros.estimation.lanes.lane_dashes import LanePattern, measure_lanes
from autocalib_ros.estimation.lanes.lane_scales import ToldLanes, lane_scales
from autocalib_ros.estimation.lanes.lane_standards import LANE_STANDARDS
from autocalib_ros.estimation.verification.scale import Scale
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.synthetic.junction import synthetic_evidence

NORMAL, ALONG = ROAD.normal_in_camera, ROAD.camera_from_ground[:, 0]
HEIGHT_M = ROAD.height_m


@cache
def traffic() -> Evidence:
    return synthetic_evidence(replace(ROAD, vehicles=15), np.random.default_rng(0))


def pattern(stripes: np.ndarray, pitch_deg: float = 0.0, sigma_deg: float = 1.0) -> LanePattern | None:
    """Measure bars in a plane that is wrong by a pitch."""
    turn = np.radians(pitch_deg)
    normal = np.cos(turn) * NORMAL + np.sin(turn) * ALONG
    evidence = replace(traffic(), stripes_px=stripes)
    return measure_lanes(evidence, PINHOLE, normal, ALONG, np.radians(sigma_deg))


def clutter(count: int, seed: int) -> np.ndarray:
    """Bars of any place on the road and any length, along it."""
    generator = np.random.default_rng(seed)
    starts = np.column_stack([generator.uniform(8.0, 60.0, count), generator.uniform(-9.0, 9.0, count)])
    ends = starts + np.column_stack([generator.uniform(1.0, 5.0, count), generator.normal(0.0, 0.1, count)])
    return bars_seen(ROAD, np.stack([starts, ends], axis=1), generator)


@pytest.mark.parametrize('clutter_bars', [0, 25])
def test_period_and_width_are_those_of_the_road(clutter_bars: int) -> None:
    stripes = np.vstack([dashes(ROAD, np.random.default_rng(1)), clutter(clutter_bars, 2)])
    found = pattern(stripes)
    # pixel noise of some per cent in each spacing, a fifth of that in their mean
    assert found.period(PINHOLE, NORMAL) == pytest.approx(PERIOD_M / HEIGHT_M, rel=0.03)
    assert found.width(PINHOLE, NORMAL) == pytest.approx((LINES_M[1] - LINES_M[0]) / HEIGHT_M, rel=0.03)
    assert found.spacings >= 6 and 0.03 <= found.period_sigma < 0.05


def test_in_a_wrong_plane_the_dashes_grow_with_distance() -> None:
    found = pattern(dashes(ROAD, np.random.default_rng(1)), pitch_deg=-1.0)
    right = found.change_with_distance(PINHOLE, NORMAL)
    wrong = np.cos(0.0175) * NORMAL - np.sin(0.0175) * ALONG
    assert abs(right.mean) < 2.5 * right.sigma
    assert abs(found.change_with_distance(PINHOLE, wrong).mean) > 3.0 * right.sigma
    # the dashes are found all the same, and are of the road where it is
    assert found.period(PINHOLE, NORMAL) == pytest.approx(PERIOD_M / HEIGHT_M, rel=0.03)


@pytest.mark.parametrize('seed', range(4))
def test_bars_without_a_period_show_none(seed: int) -> None:
    assert pattern(clutter(80, seed)) is None


def crosswalks(*places_m: float) -> np.ndarray:
    """Stripes of crosswalks at some places along the road."""
    lateral = np.arange(-6.5, 7.0, 1.0)
    ends = np.array([[[along, y], [along + 3.0, y]] for along in places_m for y in lateral])
    return bars_seen(ROAD, ends, np.random.default_rng(3))


@pytest.mark.parametrize('apart_m', [12.0, 18.0, 24.0])
def test_stripes_of_two_crosswalks_are_no_dashes(apart_m: float) -> None:
    assert pattern(crosswalks(14.0, 14.0 + apart_m)) is None


def test_dashes_between_crosswalks_show_their_own_period() -> None:
    stripes = np.vstack([crosswalks(14.0, 38.0), dashes(ROAD, np.random.default_rng(1), period_m=6.0)])
    found = pattern(stripes)
    assert found is None or found.period(PINHOLE, NORMAL) == pytest.approx(6.0 / HEIGHT_M, rel=0.03)


@pytest.mark.parametrize('seed', range(3))
def test_faint_dashes_between_bright_ones_double_no_period(seed: int) -> None:
    bright, faint = (dashes(ROAD, np.random.default_rng(seed)) for _ in range(2))
    way = 0.5 * (bright[1:, :4] - bright[:-1, :4])  # halfway to the next one of the line
    faint = faint[:-1].copy()
    faint[:, :4] += way
    faint[:, 4] *= 0.25
    assert pattern(np.vstack([bright, faint])) is None


@pytest.mark.parametrize('seed', range(4))
def test_hidden_dashes_do_not_double_the_period(seed: int) -> None:
    generator = np.random.default_rng(seed)
    stripes = dashes(ROAD, generator, period_m=6.0)
    found = pattern(stripes[generator.uniform(size=len(stripes)) < 0.7])
    assert found is None or found.period(PINHOLE, NORMAL) == pytest.approx(6.0 / HEIGHT_M, rel=0.04)


def test_a_second_period_of_other_lines_is_a_rival() -> None:
    generator = np.random.default_rng(1)
    lines = [(6.0, (-3.5, 3.5)), (9.0, (-7.0, 0.0, 7.0))]
    found = pattern(np.vstack([dashes(ROAD, generator, period_m=each, lines_m=at) for each, at in lines]))
    period = found.period(PINHOLE, NORMAL) * HEIGHT_M
    assert sorted([period, period * found.rival]) == pytest.approx([6.0, 9.0], rel=0.05)
    # which of the two is told, another length has to say
    told = ToldLanes.of(LaneOptions(dash_period_m=period))
    height = Scale(lambda *_: HEIGHT_M, 0.1, True, 'scale_height')
    assert lane_scales(found, told, PINHOLE, NORMAL, []) == []
    assert len(lane_scales(found, told, PINHOLE, NORMAL, [height])) == 1
    wrong = Scale(lambda *_: HEIGHT_M / found.rival, 0.1, True, 'scale_height')
    assert lane_scales(found, told, PINHOLE, NORMAL, [wrong]) == []


def test_the_length_of_the_dashes_tells_a_multiple_of_the_prescribed_period() -> None:
    found = pattern(dashes(ROAD, np.random.default_rng(1)))
    assert found.dash_share(PINHOLE, NORMAL) == pytest.approx(0.25, rel=0.1)
    told = replace(ToldLanes.of(LaneOptions(country='us')), width_m=0.0)  # 3.05 of 12.19 m
    assert [scale.kind for scale in lane_scales(found, told, PINHOLE, NORMAL, [])] == ['scale_dashes']
    assert lane_scales(found, replace(told, dash_shares=(0.5,)), PINHOLE, NORMAL, []) == []
    every_other = pattern(dashes(ROAD, np.random.default_rng(1), dash_m=1.0))
    if every_other is not None:  # a twelfth is painted nowhere
        told = ToldLanes.of(LaneOptions(dash_period_m=PERIOD_M))
        assert lane_scales(every_other, told, PINHOLE, NORMAL, []) == []


def test_without_bars_or_traffic_there_is_no_pattern() -> None:
    assert pattern(np.zeros((0, 5))) is None
    assert pattern(dashes(ROAD, np.random.default_rng(1))[:5]) is None


def scales(lanes: LaneOptions, *others: Scale) -> list[Scale]:
    found = pattern(dashes(ROAD, np.random.default_rng(1)))
    return lane_scales(found, ToldLanes.of(lanes), PINHOLE, NORMAL, list(others))


def test_what_is_told_gives_the_camera_height() -> None:
    by_width, by_period = scales(LaneOptions(width_m=3.5, dash_period_m=PERIOD_M))
    assert (by_width.kind, by_period.kind) == ('scale_lanes', 'scale_dashes')
    for scale in (by_width, by_period):
        assert scale.height(PINHOLE, NORMAL) == pytest.approx(HEIGHT_M, rel=0.03)
        assert 0.03 < scale.sigma / HEIGHT_M < 0.07


def test_of_the_periods_of_a_country_the_one_that_fits_is_taken() -> None:
    height = Scale(lambda *_: HEIGHT_M, 0.1, True, 'scale_height')
    assert [scale.values['period_m'] for scale in scales(LaneOptions(country='de'), height)[1:]] == [12.0]
    between = Scale(lambda *_: HEIGHT_M * 10.4 / 12.0, 0.1, True, 'scale_height')
    assert [scale.kind for scale in scales(LaneOptions(country='de'), between)] == ['scale_lanes']


def test_nothing_told_is_no_scale() -> None:
    assert scales(LaneOptions()) == []
    assert lane_scales(None, ToldLanes.of(LaneOptions(country='us')), PINHOLE, NORMAL, []) == []


def test_countries_of_the_option_have_standards() -> None:
    choices = LaneOptions.__dataclass_fields__['country'].metadata['choices']
    assert set(choices) == {'none', *LANE_STANDARDS}


def test_a_sigma_without_its_number_is_refused() -> None:
    with pytest.raises(UsageError, match=r"'lanes.width_sigma_m' needs 'lanes.width_m'"):
        LaneOptions(width_sigma_m=0.1)

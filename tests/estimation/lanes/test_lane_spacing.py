"""Lines and rows of vehicles that repeat across a road give the width of a lane; nothing else does."""

from dataclasses import replace

import numpy as np
import pytest
from dashed_road import bars_seen
from lane_traffic import FOUR_LANES, traffic
from pinhole_road import PINHOLE, ROAD

from autocalib_ros.config import LaneOptions, ScaleOptions
from autocalib_ros.estimation.lanes.lane_scales import ToldLanes, spacing_scales
from autocalib_ros.estimation.lanes.lane_spacing import LaneSpacing, measure_lane_spacing
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.evidence.snapshot import Evidence
from solved_once import evidence_once

NORMAL, ALONG = ROAD.normal_in_camera, ROAD.camera_from_ground[:, 0]
HEIGHT_M, LANE_M = ROAD.height_m, 3.5


def lines(*across_m: float, starts_m: tuple[float, ...] = (10.0, 17.0, 24.0, 31.0), length_m: float = 6.0) -> Evidence:
    ends = np.array([[[x, y], [x + length_m, y]] for y in across_m for x in starts_m])
    seen = bars_seen(ROAD, ends, np.random.default_rng(1)) if len(ends) else np.zeros((0, 5))
    return replace(evidence_once(ROAD), stripes_px=seen)


def measured(evidence: Evidence, flow: TrackSet) -> LaneSpacing | None:
    return measure_lane_spacing(evidence, flow, PINHOLE, NORMAL, ALONG)


def test_lines_at_equal_spacing_give_the_width() -> None:
    found = measured(lines(-7.0, -3.5, 0.0, 3.5, 9.0), traffic(FOUR_LANES))
    assert found is not None and found.kind == 'lines'
    assert found.width(PINHOLE, NORMAL) * HEIGHT_M == pytest.approx(LANE_M, rel=2.5 * found.sigma)
    assert 0.03 <= found.sigma < 0.05


def test_rows_of_vehicles_give_the_width_over_their_points() -> None:
    found = measured(lines(), traffic(FOUR_LANES))
    assert found is not None and found.kind == 'vehicles'
    assert found.width(PINHOLE, NORMAL) * (HEIGHT_M - 0.7) == pytest.approx(LANE_M, rel=2.0 * found.sigma)
    (scale,) = spacing_scales(found, ToldLanes.of(LaneOptions(width_m=3.5)), ScaleOptions(), PINHOLE, NORMAL)
    assert scale.kind == 'scale_lanes' and 0.07 < scale.sigma / HEIGHT_M < 0.12
    assert scale.height(PINHOLE, NORMAL) == pytest.approx(HEIGHT_M, abs=2.0 * scale.sigma)
    assert spacing_scales(found, ToldLanes.of(LaneOptions()), ScaleOptions(), PINHOLE, NORMAL) == []


def test_the_stripes_of_a_crosswalk_are_no_lines() -> None:
    zebra = lines(*np.arange(-7.0, 7.5, 1.0).tolist(), starts_m=(16.0,), length_m=4.0)
    found = measured(zebra, traffic(FOUR_LANES))
    assert found is not None and found.kind == 'vehicles'


@pytest.mark.parametrize(
    'lanes',
    [{1.0: (1.75,), -1.0: (-1.75,)}, {1.0: (1.75, 5.25)}, {1.0: tuple(np.linspace(-6.0, 6.0, 48).tolist())}],
    ids=['one lane each way', 'two lanes', 'anywhere'],
)
def test_a_spacing_that_does_not_repeat_gives_nothing(lanes: dict[float, tuple[float, ...]]) -> None:
    assert measured(lines(-3.5, 3.5), traffic(lanes)) is None


def test_without_traffic_there_is_nothing() -> None:
    assert measured(lines(-3.5, 0.0, 3.5), traffic(FOUR_LANES).subset(np.arange(0))) is None

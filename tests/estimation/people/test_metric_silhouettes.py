"""Metric sizes of bodies on the road, from their silhouettes."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.estimation.people.metric_silhouettes import measure_silhouettes
from autocalib_ros.offline.synthetic.junction import Junction, pose
from silhouette_evidence import box, outline

JUNCTION = Junction(camera_from_ground=pose(32.0, 0.0, 0.0))


def measured(size_m: tuple[float, float, float], place_m: tuple[float, float], heading: float):
    row = outline(JUNCTION, box(size_m, np.array(place_m), heading))
    return measure_silhouettes(row[None], JUNCTION.camera, JUNCTION.normal_in_camera, JUNCTION.height_m)


@pytest.mark.parametrize('place_m', [(12.0, 0.0), (20.0, 10.0), (18.0, -12.0), (35.0, 3.0)])
@pytest.mark.parametrize('turned_deg', [0.0, 45.0, 90.0])
def test_the_width_is_that_across_the_line_of_sight(place_m: tuple[float, float], turned_deg: float) -> None:
    length, width, turned = 4.0, 1.7, np.radians(turned_deg)
    sizes = measured((length, width, 1.5), place_m, np.arctan2(place_m[1], place_m[0]) + turned)
    across = length * np.sin(turned) + width * np.cos(turned)
    # tolerance: the distance is that of the nearest corner, and eight points miss a little of the body
    assert 0.8 * across < sizes.width[0] < 1.15 * across
    assert sizes.azimuth[0] == pytest.approx(np.arctan2(place_m[1], place_m[0]), abs=0.05)


@pytest.mark.parametrize('distance_m', [10.0, 20.0, 30.0])
def test_the_height_of_a_thin_object_is_exact(distance_m: float) -> None:
    sizes = measured((0.1, 0.5, 1.8), (distance_m, 0.0), 0.0)
    assert sizes.height[0] == pytest.approx(1.8, abs=0.1)
    assert sizes.distance[0] == pytest.approx(distance_m, abs=0.1 + 0.02 * distance_m)


def test_a_rider_is_half_as_wide_as_a_car_at_any_place_and_heading() -> None:
    generator = np.random.default_rng(1)
    for _ in range(50):
        place, heading = generator.uniform([8.0, -12.0], [30.0, 12.0]), generator.uniform(0, 2 * np.pi)
        rider, car = (measured(size, tuple(place), heading).width[0] for size in ((1.75, 0.6, 1.75), (3.6, 1.6, 1.45)))
        assert rider < 0.6 * car

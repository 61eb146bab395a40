"""Tracks on a road that bends."""

import numpy as np
import pytest
from pinhole_road import PINHOLE, ROAD

from autocalib_ros.estimation.single_road.bent_road import BEND_LOG_PRIOR, BENDS, BentRoad
from autocalib_ros.geometry.great_circles import (
    circle_pixel_scale,
    quadratic_forms,
    scatter,
    squared_distances,
    unproject_rays,
)


def tracks_on_arcs(radius_m: float) -> np.ndarray:
    """Return pixels (6, 10, 2) of tracks on concentric arcs, tangent to the road 20 m ahead."""
    along = np.linspace(12.0, 28.0, 10)
    lanes = np.linspace(-5.0, 5.0, 6)[:, None]
    radius = radius_m - lanes
    across = lanes + radius - np.sign(radius) * np.sqrt(radius**2 - (along - 20.0) ** 2)
    points = np.stack([np.broadcast_to(along, across.shape), across, np.full(across.shape, -ROAD.height_m)], axis=-1)
    pixels, valid = PINHOLE.project(points @ ROAD.camera_from_ground.T)
    assert valid.all()
    return pixels


@pytest.mark.parametrize('radius_m', [100.0, -250.0])
def test_tracks_are_straight_at_the_curvature_of_the_road(radius_m: float) -> None:
    rays = unproject_rays(PINHOLE, tracks_on_arcs(radius_m))
    samples = np.full(rays.bearings.shape[:2], 0.1)
    scale = circle_pixel_scale(rays, samples)
    along = ROAD.camera_from_ground[:, 0]
    bent = BentRoad.about(rays, samples * scale * scale, along, 0.0, np.ones(len(samples)))
    distances = squared_distances(bent.forms(BENDS), along[None]).reshape(len(BENDS), -1).mean(axis=1)
    true_bend = ROAD.height_m / radius_m
    spacing = np.gradient(BENDS)[np.argmin(np.abs(BENDS - true_bend))]
    assert abs(BENDS[np.argmin(distances)] - true_bend) < spacing
    assert distances.min() < 0.02 * distances[len(BENDS) // 2]


def test_without_a_bend_nothing_changes() -> None:
    rays = unproject_rays(PINHOLE, tracks_on_arcs(100.0))
    samples = np.full(rays.bearings.shape[:2], 0.1)
    scale = circle_pixel_scale(rays, samples)
    bent = BentRoad.about(rays, samples * scale * scale, ROAD.camera_from_ground[:, 0], 0.0, np.ones(len(samples)))
    np.testing.assert_allclose(bent.forms(np.zeros(1)), quadratic_forms(scatter(rays, samples, scale)), rtol=1e-9)


def test_bends_to_either_side_are_as_probable_and_straight_roads_the_most() -> None:
    np.testing.assert_allclose(BENDS, -BENDS[::-1], atol=1e-15)
    density = BEND_LOG_PRIOR - np.log(np.gradient(BENDS))
    assert np.argmax(density) == len(BENDS) // 2
    assert 0.9 < np.exp(BEND_LOG_PRIOR).sum() < 1.0

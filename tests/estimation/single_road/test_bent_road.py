"""Tracks on a road that bends."""

from dataclasses import replace

import numpy as np
import pytest
from pinhole_road import PINHOLE, ROAD

from autocalib_ros.estimation.markings.road_segments import ProjectedSegments
from autocalib_ros.estimation.single_road.bent_road import (
    BEND_LOG_PRIOR,
    BENDS,
    Bend,
    BentRoad,
    RoadPlane,
    across_and_up,
)
from autocalib_ros.geometry.great_circles import (
    circle_pixel_scale,
    circle_scatter,
    quadratic_forms,
    squared_distances,
    unproject_rays,
)

ALONG, UP = ROAD.camera_from_ground[:, 0], ROAD.camera_from_ground[:, 2]
LEVEL_ACROSS, LEVEL_UP = (each[0] for each in across_and_up(ALONG, np.zeros(1)))
TURN_RAD = -float(np.arctan2(UP @ LEVEL_ACROSS, UP @ LEVEL_UP))
"""Of the plane of the road from that of a level camera."""


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


def straightened(radius_m: float, bends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean squared distances (bends,) from straight paths, and forms (2, 6, bends * tracks)."""
    rays = unproject_rays(PINHOLE, tracks_on_arcs(radius_m))
    samples = np.full(rays.bearings.shape[:2], 0.1)
    plane = RoadPlane.under(ALONG, TURN_RAD, rays.bearings, samples)
    forms = BentRoad.on(plane, rays.bearings, samples * circle_pixel_scale(rays, samples) ** 2).forms(bends)
    return squared_distances(forms, ALONG[None]).reshape(len(bends), -1).mean(axis=1), forms


@pytest.mark.parametrize('radius_m', [100.0, -250.0])
def test_tracks_are_straight_at_the_curvature_of_the_road(radius_m: float) -> None:
    distances, _ = straightened(radius_m, BENDS)
    true_bend = ROAD.height_m / radius_m
    spacing = np.gradient(BENDS)[np.argmin(np.abs(BENDS - true_bend))]
    assert abs(BENDS[np.argmin(distances)] - true_bend) < spacing
    assert distances.min() < 0.02 * distances[len(BENDS) // 2]


def test_without_a_bend_nothing_changes() -> None:
    rays = unproject_rays(PINHOLE, tracks_on_arcs(100.0))
    matrix = circle_scatter(rays, np.full(rays.bearings.shape[:2], 0.1))
    np.testing.assert_allclose(straightened(100.0, np.zeros(1))[1], quadratic_forms(matrix), rtol=1e-9)


def test_segments_of_a_bend_are_turned_to_its_tangent_and_uprights_stay() -> None:
    curvature, ahead_m = ROAD.height_m / 100.0, np.array([12.0, 20.0, 28.0])
    headings = np.arctan((ahead_m - 20.0) / 100.0)
    places = np.column_stack([ahead_m, (ahead_m - 20.0) ** 2 / 200.0, np.full(3, -ROAD.height_m)])
    tangents = np.column_stack([np.cos(headings), np.sin(headings), np.zeros(3)])
    plane = replace(RoadPlane.under(ALONG, TURN_RAD, -UP, np.ones(())), middle=20.0 / ROAD.height_m)
    for directions, expected in ((tangents, ALONG), (np.tile([0.0, 0.0, 1.0], (3, 1)), UP)):
        ends = [PINHOLE.project((places + step * directions) @ ROAD.camera_from_ground.T)[0] for step in (-0.25, 0.25)]
        segments = ProjectedSegments.from_camera(PINHOLE, np.hstack(ends))
        turned = Bend(plane, curvature).straightened(segments)
        assert np.abs(turned.residuals(expected)).max() < np.radians(0.3)
    assert np.abs(segments.residuals(UP)).max() < np.radians(0.1)


def test_bends_to_either_side_are_as_probable_and_straight_roads_the_most() -> None:
    np.testing.assert_allclose(BENDS, -BENDS[::-1], atol=1e-15)
    density = BEND_LOG_PRIOR - np.log(np.gradient(BENDS))
    assert np.argmax(density) == len(BENDS) // 2
    assert 0.9 < np.exp(BEND_LOG_PRIOR).sum() < 1.0

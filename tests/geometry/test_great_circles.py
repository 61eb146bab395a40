"""Great circles through tracks, with residuals in observed pixels."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.estimation.observations.track_set import select_tracks
from autocalib_ros.geometry.great_circles import (
    Rays,
    bearing_change,
    fit_circles,
    fit_circles_through,
    orthonormal_basis,
    unproject_rays,
)
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence

CAMERA = Camera(1280, 720, 400.0, (639.5, 359.5), (0.02, 0.0, 0.0, 0.0))


def straight_paths(count: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (count, 14, 2) of parallel straight paths in space, and their direction (3,)."""
    generator = np.random.default_rng(2)
    direction = np.array([0.8, 0.1, 0.6]) / np.linalg.norm([0.8, 0.1, 0.6])
    start = generator.uniform((-8, 2, 4), (0, 5, 12), (count, 1, 3))
    points = start + np.linspace(0, 8, 14)[None, :, None] * direction
    return CAMERA.project(points)[0], direction


def uniform(pixels: np.ndarray) -> np.ndarray:
    return np.full(pixels.shape[:2], 1.0 / pixels.shape[1])


def test_straight_paths_lie_on_great_circles() -> None:
    pixels, _ = straight_paths()
    _, distance2, _ = fit_circles(unproject_rays(CAMERA, pixels), uniform(pixels))
    assert np.sqrt(distance2).max() < 1e-4  # px; the paths are exact


def test_circles_contain_the_direction_of_travel() -> None:
    pixels, direction = straight_paths()
    normals, _, _ = fit_circles(unproject_rays(CAMERA, pixels), uniform(pixels))
    np.testing.assert_allclose(normals @ direction, 0.0, atol=1e-6)


def test_a_circle_through_the_true_direction_costs_nothing() -> None:
    pixels, direction = straight_paths()
    _, _, matrix = fit_circles(unproject_rays(CAMERA, pixels), uniform(pixels))
    normals, distance2 = fit_circles_through(matrix, np.tile(direction, (len(pixels), 1)))
    assert np.sqrt(distance2).max() < 1e-4
    np.testing.assert_allclose(normals @ direction, 0.0, atol=1e-12)


@pytest.mark.parametrize('place', [(640.0, 360.0), (30.0, 40.0), (1200.0, 100.0)])
def test_distances_are_observed_pixels(place: tuple[float, float]) -> None:
    # a circle through one pixel, seen from the pixel two further along the image gradient
    rays = unproject_rays(CAMERA, np.array(place))
    normal, _ = orthonormal_basis(rays.bearings)
    slope = (
        np.array([unproject_rays(CAMERA, np.array(place) + step).bearings @ normal for step in 1e-3 * np.eye(2)]) / 1e-3
    )
    moved = np.array(place) + 2.0 * slope / np.linalg.norm(slope)
    assert abs(unproject_rays(CAMERA, moved).distance_px(normal)) == pytest.approx(2.0, rel=0.01)


def test_ray_derivatives_match_finite_differences() -> None:
    place, step = np.array([900.0, 200.0]), 1e-4
    outward = (place - CAMERA.principal_point_px) / np.linalg.norm(place - CAMERA.principal_point_px)
    around = np.array([-outward[1], outward[0]])
    rays = unproject_rays(CAMERA, place)

    def slope(along: np.ndarray) -> np.ndarray:
        ahead, behind = (unproject_rays(CAMERA, place + sign * step * along).bearings for sign in (1, -1))
        return (ahead - behind) / (2 * step)

    np.testing.assert_allclose(rays.radial, slope(outward), atol=1e-8)
    np.testing.assert_allclose(rays.tangential, slope(around), atol=1e-8)


def test_ray_derivatives_of_other_pixels_are_those_by_u_and_v() -> None:
    camera = Camera(720, 576, 448.0, (359.5, 287.5), (0.02, 0.0, 0.0, 0.0), pixel_aspect=64 / 45, skew=0.01)
    place, step = np.array([500.0, 150.0]), 1e-4
    rays = unproject_rays(camera, place)
    for found, along in ((rays.radial, [1.0, 0.0]), (rays.tangential, [0.0, 1.0])):
        ahead, behind = (unproject_rays(camera, place + sign * step * np.array(along)).bearings for sign in (1, -1))
        np.testing.assert_allclose(found, (ahead - behind) / (2 * step), atol=1e-8)
    np.testing.assert_allclose(rays.bearings, camera.unproject(place)[0], atol=1e-9)
    change = bearing_change(
        Rays(rays.bearings[None], rays.radial[None], rays.tangential[None]),
        camera,
        place[None],
        np.array([[0.01, -0.02]]),
    )
    np.testing.assert_allclose(
        change[0], camera.unproject(place + [0.01, -0.02])[0] - camera.unproject(place)[0], atol=1e-8
    )


def test_rays_stay_finite_at_the_principal_point() -> None:
    rays = unproject_rays(CAMERA, np.array(CAMERA.principal_point_px))
    assert isinstance(rays, Rays)
    assert np.isfinite(rays.distance_px(np.array([1.0, 0.0, 0.0])))


def test_selection_respects_its_limit_and_spreads_over_vehicles() -> None:
    evidence = synthetic_evidence(Junction(vehicles=60, points_per_vehicle=8), np.random.default_rng(0))
    tracks = select_tracks(evidence, 60)
    assert len(tracks) == 60
    assert len(np.unique(tracks.vehicles)) > 30  # of 60: no vehicle crowds the others out


def test_selection_weights_sum_to_one() -> None:
    tracks = select_tracks(synthetic_evidence(Junction(), np.random.default_rng(0)), 100)
    np.testing.assert_allclose(tracks.weights.sum(axis=1), 1.0)


def test_the_basis_of_one_direction_is_that_of_many() -> None:
    directions = np.concatenate([np.random.default_rng(0).normal(size=(20, 3)), np.eye(3)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for number, basis in enumerate(zip(*orthonormal_basis(directions), strict=True)):
        np.testing.assert_allclose(orthonormal_basis(directions[number]), basis, atol=1e-15)

"""Closed-form derivatives of the residuals of line segments agree with numerical ones."""

from __future__ import annotations

import numpy as np

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.adjustment.lens_prior import lens_priors
from autocalib_ros.estimation.markings.grid_mixture import _GridState
from autocalib_ros.estimation.markings.road_segments import ProjectedSegments
from autocalib_ros.geometry.robust_kernels import wrap_undirected
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import pose


def test_derivatives_by_the_plane_and_the_skew_are_those_of_small_steps() -> None:
    camera = Camera(1280, 720, 560.0, (639.5, 359.5), (0.03, 0.0, 0.0, 0.0))
    ends = np.random.default_rng(0).uniform((0, 0, 0, 0), (1280, 720, 1280, 720), (40, 4))
    projected = ProjectedSegments.from_camera(camera, ends)
    prior = lens_priors((1280, 720), JointOptions())[0]
    state = _GridState(camera, pose(35.0, 2.0, 40.0), 0.02)
    step = 1e-6
    numerical = [
        wrap_undirected(
            projected.residuals(state.moved(step * unit, prior).directions)
            - projected.residuals(state.moved(-step * unit, prior).directions)
        )
        / (2 * step)
        for unit in np.eye(len(prior.free) + 4)[len(prior.free) :]
    ]
    exact = projected.residual_changes(state.directions, state.direction_changes)
    np.testing.assert_allclose(exact, numerical, rtol=1e-6, atol=1e-6)

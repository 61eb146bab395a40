"""Tracks on a road that bends: what they would look like if it were straight, as a function of its curvature.

A bend that is seen from the side looks like the curve that barrel distortion gives a straight road. Only lanes on both
sides of the principal point tell them apart, so that the curvature of the road has to stay free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.single_road.direction_mixture import across_and_up
from autocalib_ros.geometry.great_circles import Rays, quadratic_forms

USUAL_BEND = 0.02
"""Scale of the Cauchy distribution of the curvature, times the camera height: half of the roads have a radius of more
than 50 heights, 400 m for a camera at 8 m. Judgement."""
MAX_BEND = 0.25
"""Largest curvature, times the camera height: a radius of 32 m for a camera at 8 m."""
BENDS = np.sinh(np.linspace(-1.0, 1.0, 41) * np.arcsinh(MAX_BEND / 2e-3)) * 2e-3
"""Curvatures that are tried, times the camera height, shape (n,): closer to each other about a straight road."""
BEND_LOG_PRIOR = np.log(np.gradient(BENDS) * USUAL_BEND / (USUAL_BEND**2 + BENDS**2) / np.pi)
"""Log of the prior probability of each of them, shape (n,)."""
REACH_HEIGHTS = 6.0
"""Distance from the middle of the traffic, in camera heights, up to which the road bends; it is straight beyond."""
FARTHEST_HEIGHTS = 30.0
"""Distance from the camera, in camera heights, beyond which points lie there."""


@dataclass(frozen=True)
class BentRoad:
    """Scatter matrices of tracks on a bent road, straightened: a second-degree polynomial of the curvature."""

    scatters: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Coefficients, of shape (tracks, 3, 3) each."""

    @classmethod
    def about(
        cls, rays: Rays, squared_scale: np.ndarray, along: np.ndarray, turn_rad: float, weights: np.ndarray
    ) -> BentRoad:
        """Return the tracks about a direction of the road (3,), which is its tangent in the middle of them.

        Rays have a weight times squared pixel scale each, shape (tracks, samples); tracks weigh `weights` (tracks,).
        """
        across, up = (each[0] for each in across_and_up(along, np.array([turn_rad])))
        below = np.maximum(-rays.bearings @ up, 1.0 / FARTHEST_HEIGHTS)
        distances = rays.bearings @ along / below
        middle = np.average(distances, weights=weights[:, None] * (squared_scale > 0))
        away = np.abs(distances - middle)
        squares = np.where(away < REACH_HEIGHTS, away**2, REACH_HEIGHTS * (2.0 * away - REACH_HEIGHTS))
        aside = -0.5 * (squares * below)[..., None] * across  # change of a ray by the curvature
        straight, bent = (each.transpose(0, 2, 1) * squared_scale[:, None] for each in (rays.bearings, aside))
        mixed = bent @ rays.bearings
        return cls((straight @ rays.bearings, mixed + mixed.transpose(0, 2, 1), bent @ aside))

    def forms(self, bends: np.ndarray) -> np.ndarray:
        """Return the quadratic forms of the straightened tracks at curvatures (n,) times the camera height.

        Of shape (2, 6, n * tracks), all tracks of the first curvature first.
        """
        constant, linear, square = self.scatters
        by = bends[:, None, None, None]
        return quadratic_forms((constant + by * (linear + by * square)).reshape(-1, 3, 3))

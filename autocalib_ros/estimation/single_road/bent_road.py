"""Tracks on a road that bends: what they would look like if it were straight, as a function of its curvature.

A bend that is seen from the side looks like the curve that barrel distortion gives a straight road. Only lanes on both
sides of the principal point tell them apart, so that the curvature of the road has to stay free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.estimation.adjustment.parameters import level_normal
from autocalib_ros.estimation.markings.road_segments import ProjectedSegments
from autocalib_ros.geometry.great_circles import quadratic_forms
from autocalib_ros.geometry.small_matrices import cross

USUAL_BEND = 0.02
"""Scale of the Cauchy distribution of the curvature, times the camera height: half of the roads have a radius of more
than 50 heights, 400 m for a camera at 8 m. Judgement."""
MAX_BEND = 0.25
"""Largest curvature, times the camera height: a radius of 32 m for a camera at 8 m."""
BENDS = np.sinh(np.linspace(-1.0, 1.0, 41) * np.arcsinh(MAX_BEND / 3e-3)) * 3e-3
"""Curvatures that are tried, times the camera height, shape (n,): closer to each other about a straight road."""
BEND_LOG_PRIOR = np.log(np.gradient(BENDS) * USUAL_BEND / (USUAL_BEND**2 + BENDS**2) / np.pi)
"""Log of the prior probability of each of them, shape (n,)."""
REACH_HEIGHTS = 6.0
"""Distance from the middle of the traffic, in camera heights, up to which the road bends; it is straight beyond."""
FARTHEST_HEIGHTS = 30.0
"""Distance from the camera, in camera heights, beyond which points lie there."""


@dataclass(frozen=True)
class RoadPlane:
    """The plane of a road and its tangent in the middle of the traffic."""

    axes: np.ndarray
    """Directions along the tangent, across it and up, rows of (3, 3)."""
    middle: float
    """Where the traffic is in the mean, along the tangent from the camera, in camera heights."""

    @classmethod
    def under(cls, along: np.ndarray, turn_rad: float, bearings: np.ndarray, weights: np.ndarray) -> RoadPlane:
        """Return the plane with a turn about the tangent (3,), in the middle of bearings (..., 3) that weigh (...)."""
        across, up = (each[0] for each in across_and_up(along, np.array([turn_rad])))
        plane = cls(np.stack([along, across, up]), 0.0)
        return replace(plane, middle=float(np.average(plane.away(bearings), weights=weights)))

    def below(self, bearings: np.ndarray) -> np.ndarray:
        """Return how much bearings (..., 3) point to the road, the cosine of the angle to its normal, shape (...)."""
        return np.maximum(-bearings @ self.axes[2], 1.0 / FARTHEST_HEIGHTS)

    def away(self, bearings: np.ndarray) -> np.ndarray:
        """Return how far bearings (..., 3) meet the road beyond the middle, along the tangent, in camera heights."""
        return bearings @ self.axes[0] / self.below(bearings) - self.middle

    def asides(self, bearings: np.ndarray) -> np.ndarray:
        """Return the change of bearings (..., 3) by the curvature of the road, shape (..., 3)."""
        away = np.abs(self.away(bearings))
        squares = np.where(away < REACH_HEIGHTS, away**2, REACH_HEIGHTS * (2.0 * away - REACH_HEIGHTS))
        return -0.5 * (squares * self.below(bearings))[..., None] * self.axes[1]


@dataclass(frozen=True)
class Bend:
    """A bend of a road in its plane."""

    plane: RoadPlane
    curvature: float
    """Times the camera height."""

    def straightened(self, segments: ProjectedSegments) -> ProjectedSegments:
        """Rotate segments about the normal of the road, by the angle of the road at their places from its tangent."""
        away = np.clip(self.plane.away(segments.bearings), -REACH_HEIGHTS, REACH_HEIGHTS)
        turns = Rotation.from_rotvec(-np.arctan(self.curvature * away)[:, None] * self.plane.axes[2])
        return ProjectedSegments(*(turns.apply(each) for each in (segments.bearings, segments.along, segments.circles)))


@dataclass(frozen=True)
class BentRoad:
    """Scatter matrices of tracks on a bent road, straightened: a second-degree polynomial of the curvature."""

    plane: RoadPlane
    scatters: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Coefficients, of shape (tracks, 3, 3) each."""

    @classmethod
    def on(cls, plane: RoadPlane, bearings: np.ndarray, squared_scale: np.ndarray) -> BentRoad:
        """Return tracks with bearings (tracks, samples, 3), of a weight times squared pixel scale each."""
        aside = plane.asides(bearings)
        straight, bent = (each.transpose(0, 2, 1) * squared_scale[:, None] for each in (bearings, aside))
        mixed = bent @ bearings
        return cls(plane, (straight @ bearings, mixed + mixed.transpose(0, 2, 1), bent @ aside))

    def forms(self, bends: np.ndarray) -> np.ndarray:
        """Return the quadratic forms of the straightened tracks at curvatures (n,) times the camera height.

        Of shape (2, 6, n * tracks), all tracks of the first curvature first.
        """
        constant, linear, square = self.scatters
        by = bends[:, None, None, None]
        return quadratic_forms((constant + by * (linear + by * square)).reshape(-1, 3, 3))


def across_and_up(along: np.ndarray, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions across a road (3,) and up from it at turns (t,) from a level camera, shape (t, 3) each."""
    up = level_normal(along)
    up = -up if up[1] > 0 else up
    level = cross(up, along)
    cosine, sine = np.cos(turns)[:, None], np.sin(turns)[:, None]
    return cosine * level + sine * up, cosine * up - sine * level

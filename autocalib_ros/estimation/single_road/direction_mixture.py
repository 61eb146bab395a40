"""Segments along, across and upright to a road: a mixture of their image angles, as a function of the turn about it.

Each segment lies along the road, across it, upright, or at any other angle. The peaks are Student's t distributions of
the angle in the image, not of that on the sphere, whose scale changes with the lens. Shares and spreads are refitted
for every lens (profile likelihood).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.estimation.markings.road_segments import ProjectedSegments
from autocalib_ros.estimation.single_road.bent_road import Bend, across_and_up
from autocalib_ros.geometry.great_circles import SegmentRays
from autocalib_ros.geometry.robust_kernels import student_density, student_weight
from autocalib_ros.geometry.small_matrices import cross
from autocalib_ros.lens.camera import Camera

START_SHARES = (0.3, 0.2, 0.1)
"""Initial shares of the segments along, across and upright."""
MIN_SHARE, MAX_SHARES = 0.01, 0.95
"""Least share of one direction, and the largest sum."""
MIXTURE_ROUNDS = 3
"""Rounds of expectation-maximisation; shares and spreads then change by a few per cent at most."""
SEARCHED_TURNS_RAD = np.radians(np.arange(-40.0, 40.1, 2.5))
"""Turns from a level camera at which the best one is looked for."""
TURNS_RAD = np.radians(np.arange(-12.0, 12.01, 0.75))
"""Turns about the best one at which the likelihood is evaluated."""


@dataclass(frozen=True)
class SegmentKind:
    """How well segments of one kind, of vehicles or of the still scene, show directions."""

    end_sigma_px: float
    """Standard deviation of an end point, across the segment."""
    min_spreads_rad: np.ndarray
    """Least spread about the road (in the image), about the direction across, and about the upright, shape (3,)."""
    max_spreads_rad: np.ndarray


VEHICLE_EDGES = SegmentKind(0.6, np.radians([2.0, 1.0, 3.0]), np.radians([6.0, 3.0, 5.0]))
"""Bumpers and roof lines are square to the road apart from their bulge; pillars lean by several degrees. Judgement."""
STILL_SEGMENTS = SegmentKind(0.5, np.radians([0.5, 0.7, 1.0]), np.radians([2.0, 2.0, 3.0]))
"""Lane markings, kerbs, stop lines, posts and buildings; some posts lean. Judgement."""


@dataclass(frozen=True)
class Tilts:
    """Errors common to all segments of one kind, radians: rotations of one direction against the others."""

    across_rad: float = 0.0
    """Of the direction across, about the road."""
    upright_rad: float = 0.0
    """Of the upright, about the road: bank of the road, or leaning bodies."""
    grade_rad: float = 0.0
    """Of the upright, about the direction across."""


@dataclass(frozen=True)
class DirectionMixture:
    """The mixture of segments of one kind, with its fitted shares and spreads."""

    kind: SegmentKind
    ends_px: np.ndarray
    """x0, y0, x1, y1, shape (n, 4)."""
    weights: np.ndarray
    """Independent observations that each segment counts as, shape (n,)."""
    shares: tuple[float, float, float] = START_SHARES
    spreads_rad: tuple[float, float, float] | None = None
    """Spreads; None: the geometric mean of their limits."""
    tilts: Tilts = Tilts()

    def through(self, camera: Camera, along: np.ndarray, bend: Bend | None = None) -> SeenSegments:
        """Return the segments as seen through a lens about a road with the direction `along` (3,), or along a bend."""
        segments = SegmentRays.through(camera, self.ends_px)
        length2 = np.maximum((segments.along * segments.along).sum(axis=1), 1e-30)
        moved = cross(segments.along, segments.aside)
        stretch = np.sqrt((moved * moved).sum(axis=1)) / length2
        noise = self.kind.end_sigma_px * np.sqrt(2.0) / segments.lengths_px
        bearings, forward = segments.rays.bearings, segments.along / np.sqrt(length2)[:, None]
        projected = ProjectedSegments(bearings, forward, cross(bearings, forward))
        return SeenSegments(projected if bend is None else bend.straightened(projected), along, stretch, noise)

    @property
    def spreads(self) -> np.ndarray:
        """Spreads of the three directions, radians, shape (3,)."""
        middle = np.sqrt(self.kind.min_spreads_rad * self.kind.max_spreads_rad)
        return middle if self.spreads_rad is None else np.array(self.spreads_rad)

    def peaks(self, seen: SeenSegments, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return densities times shares, residuals and standard deviations at turns (t,), shape (3, t, n) each."""
        residuals, leverages = seen.residuals(turns, self.tilts)
        spreads = self.spreads[:, None, None] * leverages
        sigmas = np.hypot(seen.noise * seen.stretch, spreads)
        shares = np.array(self.shares)[:, None, None]
        return shares * student_density(residuals, sigmas) * seen.stretch, residuals, sigmas

    @property
    def others(self) -> float:
        """Density of the segments at any other angle."""
        return (1.0 - sum(self.shares)) / np.pi

    def log_likelihood(self, seen: SeenSegments, turns: np.ndarray) -> np.ndarray:
        """Return the log likelihood at turns (t,), shape (t,)."""
        return np.log(self.peaks(seen, turns)[0].sum(axis=0) + self.others) @ self.weights

    def fitted(self, seen: SeenSegments, turn: float) -> DirectionMixture:
        """Return the mixture after one round of expectation-maximisation at a turn."""
        each, residuals, sigmas = (values[:, 0] for values in self.peaks(seen, np.array([turn])))
        responsibilities = each / (each.sum(axis=0) + self.others) * self.weights
        sums = np.maximum(responsibilities.sum(axis=1), 1e-9)
        shares = np.clip(sums / self.weights.sum(), MIN_SHARE, 1.0)
        shares = shares * min(1.0, MAX_SHARES / float(shares.sum()))
        noise = seen.noise * seen.stretch
        leverage2 = np.maximum((sigmas**2 - noise**2) / self.spreads[:, None] ** 2, 1e-6)
        excess = (student_weight(residuals, sigmas) * residuals**2 - noise**2) / leverage2
        spreads = np.sqrt(np.maximum((responsibilities * excess).sum(axis=1) / sums, 0.0))
        spreads = np.clip(spreads, self.kind.min_spreads_rad, self.kind.max_spreads_rad)
        return replace(self, shares=tuple(shares.tolist()), spreads_rad=tuple(spreads.tolist()))

    def without(self) -> DirectionMixture:
        """Return the mixture without segments."""
        return replace(self, ends_px=self.ends_px[:0], weights=self.weights[:0])

    @property
    def empty(self) -> bool:
        """Whether there is no segment."""
        return not len(self.weights)


@dataclass(frozen=True)
class SeenSegments:
    """Segments through one lens about one road."""

    projected: ProjectedSegments
    along: np.ndarray
    """Direction of the road, shape (3,)."""
    stretch: np.ndarray
    """Change of the angle on the sphere by that in the image, shape (n,)."""
    noise: np.ndarray
    """Standard deviation of the angle in the image, shape (n,)."""

    def residuals(self, turns: np.ndarray, tilts: Tilts) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals from the three directions at turns (t,), and their change by a tilt of the direction.

        Both of shape (3, t, n). The spread about the road itself is one of angles in the image.
        """
        across, up = across_and_up(self.along, turns)
        across, up = (
            np.cos(tilts.across_rad) * across + np.sin(tilts.across_rad) * up,
            np.cos(tilts.upright_rad) * up - np.sin(tilts.upright_rad) * across,
        )
        up = np.cos(tilts.grade_rad) * up + np.sin(tilts.grade_rad) * self.along
        count, size = len(turns), len(self.noise)
        residuals, leverages = np.empty((3, count, size)), np.empty((3, count, size))
        residuals[0] = self.projected.residuals(self.along)
        leverages[0] = self.stretch
        for index, directions in ((1, across), (2, up)):
            residuals[index] = self.projected.residuals(directions)
            aside = cross(directions, self.along[None])
            changes = [
                self.projected.residual_changes(directions, np.broadcast_to(by, directions.shape))
                for by in (self.along, aside)
            ]
            leverages[index] = np.hypot(*changes)
        return residuals, leverages

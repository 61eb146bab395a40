"""Which lens and plane bring most lines to two directions square to each other, and to the upright one.

A mixture of three peaks, each Student's distribution, and a uniform rest: shares and a scale of the noise are fitted,
the lens, the plane and the angle between the two directions solved by damped Gauss-Newton steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.estimation.adjustment.covariance import jackknife_covariance
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.markings.road_segments import ProjectedSegments, RoadSegments
from autocalib_ros.geometry.robust_kernels import student_density, student_weight, wrap_undirected
from autocalib_ros.lens.camera import Camera

LINE_END_SIGMA_PX, MARKING_SIGMA_RAD = 0.4, np.radians(0.5)
"""Standard deviation of an end of a line, across it, in the image; and of painted lines about their direction on the
road. A scale for both is fitted."""
RIGHT_ANGLE_SIGMA_RAD = np.radians(1.0)
"""Standard deviation of the angle between the two directions from a right one: junctions are built to about that."""
POST_SIGMA_RAD = np.radians(1.0)
"""Standard deviation of posts from the upright."""
MIN_NOISE_SCALE, MAX_NOISE_SCALE = 0.15, 2.0
MIN_DEPRESSION_SINE = 0.1
"""Sine of the angle below the horizon from which on lines are on the road: ten heights of the camera away. What is
farther is too foreshortened to tell from what stands there."""
ANNEALING_ROUNDS, FINAL_ROUNDS, MAX_DAMPING_TRIALS = 8, 40, 8
CONVERGED_STEP = 1e-5
START_FRACTIONS = np.array([0.35, 0.35, 0.1])[:, None]
MIN_DIRECTION_FRACTION, MAX_DIRECTION_FRACTION, MAX_ALIGNED_FRACTION = 0.02, 0.9, 0.95
GRID_DERIVATIVE_STEP = 1e-5
LENS_CACHE_SIZE = 8
"""Lenses whose sight is kept: that of a pose, and those a step of a parameter away. Most steps leave the lens."""


@dataclass(frozen=True)
class MarkingGrid:
    """A lens, and a plane with two directions in it, nearly square to each other, to which lines are parallel."""

    prior: LensPrior
    camera: Camera
    rotation: np.ndarray
    """camera_from_plane, shape (3, 3): the first direction is x, the normal, up, is z."""
    skew_rad: float
    """How much more than a quarter of a turn the second direction is from the first."""
    cost: float
    """Negative logarithm of how probable the lines are, with the prior."""
    fractions: np.ndarray
    """Of the lines along the two directions and the upright one, shape (3,)."""
    responsibilities: np.ndarray
    """Probability of each line to be along each, shape (3, n)."""
    laplace_term: float
    """Half the logarithm of the determinant of the information: what Laplace's approximation adds to the cost."""
    covariance: np.ndarray
    """Of steps of the free parameters of the lens, turns of the plane about its axes, and `skew_rad`."""

    @property
    def negative_log_evidence(self) -> float:
        """Negative logarithm of how probable the lines are under any lens and plane near this one."""
        return self.cost + self.laplace_term


def annealed_costs(lines: RoadSegments, camera: Camera, planes: np.ndarray, width_rad: float) -> np.ndarray:
    """Negative logarithm of how probable lines are with widened peaks, seen by a lens over planes (n, 3, 3); (n,)."""
    projected, sigmas = ProjectedSegments.from_camera(camera, lines.ends_px), np.hypot(_noise_rad(lines), width_rad)
    each = START_FRACTIONS * student_density(projected.residuals(planes.transpose(0, 2, 1)), sigmas)
    each[:, :2] *= (planes[:, :, 2] @ projected.bearings.T < -MIN_DEPRESSION_SINE)[:, None]
    return -np.log(each.sum(axis=1) + (1.0 - START_FRACTIONS.sum()) / np.pi) @ lines.weights


def _noise_rad(lines: RoadSegments) -> np.ndarray:
    return LINE_END_SIGMA_PX * np.sqrt(2.0) / lines.lengths_px


@dataclass(frozen=True)
class _GridState:
    """What is solved for: a lens, and a plane with its two directions."""

    camera: Camera
    rotation: np.ndarray
    skew_rad: float = 0.0

    @property
    def directions(self) -> np.ndarray:
        """The two directions, and the upright one, shape (3, 3)."""
        along, across, up = self.rotation.T
        return np.stack([along, np.cos(self.skew_rad) * across - np.sin(self.skew_rad) * along, up])

    def moved(self, step: np.ndarray, prior: LensPrior) -> _GridState:
        """Return the pose after a step of the lens, of turns about the axes of the plane, and of the angle."""
        lens = len(prior.free)
        return _GridState(
            prior.moved(self.camera, step[:lens]),
            self.rotation @ Rotation.from_rotvec(step[lens : lens + 3]).as_matrix(),
            self.skew_rad + float(step[lens + 3]),
        )


class _GridMixture:
    """What poses make of lines, while shares and scale are fitted."""

    def __init__(self, lines: RoadSegments, prior: LensPrior) -> None:
        self.lines, self.prior, self.weights, self._noise = lines, prior, lines.weights, _noise_rad(lines)
        self.fractions, self.scale = START_FRACTIONS[:, 0], 1.0
        self._through = lru_cache(maxsize=LENS_CACHE_SIZE)(
            partial(ProjectedSegments.from_camera, ends_px=lines.ends_px)
        )

    def residuals(self, pose: _GridState) -> np.ndarray:
        """Of each direction, shape (3, n)."""
        return self._through(pose.camera).residuals(pose.directions)

    def sigmas(self, pose: _GridState, width_rad: float) -> np.ndarray:
        """What is expected of them, shape (3, n)."""
        leverages = self._through(pose.camera).leverages(pose.directions[:2], pose.rotation[:, 2])
        askew = np.concatenate([MARKING_SIGMA_RAD * leverages, np.full((1, len(self.lines)), POST_SIGMA_RAD)])
        return np.sqrt(self.scale**2 * (self._noise**2 + askew**2) + width_rad**2)

    def cost(self, pose: _GridState, sigmas: np.ndarray) -> tuple[float, np.ndarray]:
        """Negative logarithm of the probability, and of each line to be along each direction, shape (3, n)."""
        projected = self._through(pose.camera)
        each = self.fractions[:, None] * student_density(projected.residuals(pose.directions), sigmas)
        each[:2] *= projected.bearings @ pose.rotation[:, 2] < -MIN_DEPRESSION_SINE
        density = each.sum(axis=0) + (1.0 - self.fractions.sum()) / np.pi
        known = np.append(self.prior.deviations(pose.camera), pose.skew_rad / RIGHT_ANGLE_SIGMA_RAD)
        return float(-np.log(density) @ self.weights + 0.5 * known @ known), each / density

    def fit_fractions(self, responsibilities: np.ndarray) -> None:
        """One round of maximisation for the shares."""
        fractions = np.clip(
            responsibilities @ self.weights / self.weights.sum(), MIN_DIRECTION_FRACTION, MAX_DIRECTION_FRACTION
        )
        self.fractions = fractions * min(1.0, MAX_ALIGNED_FRACTION / fractions.sum())

    def fit_scale(self, responsibilities: np.ndarray, residuals: np.ndarray, sigmas: np.ndarray) -> None:
        """One round of maximisation for the scale."""
        squared, held = (residuals / sigmas) ** 2, responsibilities * self.weights
        trusted = held * student_weight(residuals, sigmas) * squared
        self.scale *= float(np.sqrt(trusted.sum() / max(held.sum(), 1e-12)))
        self.scale = float(np.clip(self.scale, MIN_NOISE_SCALE, MAX_NOISE_SCALE))

    def linearised(
        self, pose: _GridState, responsibilities: np.ndarray, sigmas: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (n, p) and information (n, p, p) of each line by the parameters, their weights aside."""
        here, size = self.residuals(pose), len(self.prior.free) + 4
        slopes = np.stack(
            [
                wrap_undirected(self.residuals(pose.moved(GRID_DERIVATIVE_STEP * unit, self.prior)) - here)
                / GRID_DERIVATIVE_STEP
                for unit in np.eye(size)
            ],
            axis=-1,
        )
        pull = responsibilities * student_weight(here, sigmas) / sigmas**2
        return (((pull * here)[..., None] * slopes).sum(axis=0), np.einsum('kn,kni,knj->nij', pull, slopes, slopes))

    def known(self, pose: _GridState) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (p,) and information (p,) of what is known before of lens and angle."""
        lens = len(self.prior.free)
        gradient, information = np.zeros(lens + 4), np.zeros(lens + 4)
        gradient[:lens], information[:lens] = self.prior.deviations(pose.camera), self.prior.information
        gradient[-1], information[-1] = pose.skew_rad / RIGHT_ANGLE_SIGMA_RAD**2, RIGHT_ANGLE_SIGMA_RAD**-2
        return gradient, information


def refine_grid(
    lines: RoadSegments, prior: LensPrior, camera: Camera, rotation: np.ndarray, widths_rad: tuple[float, ...]
) -> MarkingGrid:
    """Solve from a start: shares, scale, and damped Gauss-Newton steps on the mixture's probability."""
    mixture, pose = _GridMixture(lines, prior), _GridState(camera, rotation)
    for width_rad in widths_rad:
        damping = 1e-3
        for _ in range(ANNEALING_ROUNDS if width_rad else FINAL_ROUNDS):
            sigmas = mixture.sigmas(pose, width_rad)
            mixture.fit_fractions(mixture.cost(pose, sigmas)[1])
            if not width_rad:
                mixture.fit_scale(mixture.cost(pose, sigmas)[1], mixture.residuals(pose), sigmas)
                sigmas = mixture.sigmas(pose, width_rad)
            stepped = _damped_step(mixture, pose, sigmas, damping)
            if stepped is None:
                break
            pose, size, damping = stepped
            if size < CONVERGED_STEP:
                break
    sigmas = mixture.sigmas(pose, 0.0)
    cost, responsibilities = mixture.cost(pose, sigmas)
    gradients, curvatures = mixture.linearised(pose, responsibilities, sigmas)
    _, known = mixture.known(pose)
    covariance = jackknife_covariance(gradients, curvatures, lines.weights, np.zeros(len(lines)), lines.groups, known)
    units = np.append(np.ones(len(known) - 1), RIGHT_ANGLE_SIGMA_RAD)
    information = (np.tensordot(lines.weights, curvatures, 1) + np.diag(known + 1e-9)) * np.outer(units, units)
    return MarkingGrid(
        prior,
        pose.camera,
        pose.rotation,
        pose.skew_rad,
        cost,
        mixture.fractions,
        responsibilities,
        float(0.5 * np.linalg.slogdet(information)[1]),
        covariance,
    )


def _damped_step(
    mixture: _GridMixture, pose: _GridState, sigmas: np.ndarray, damping: float
) -> tuple[_GridState, float, float] | None:
    """Return the pose after a step that lowers the cost, its size and the next damping; None where none does."""
    cost, responsibilities = mixture.cost(pose, sigmas)
    gradients, curvatures = mixture.linearised(pose, responsibilities, sigmas)
    pull, known = mixture.known(pose)
    gradient = mixture.weights @ gradients + pull
    information = np.tensordot(mixture.weights, curvatures, 1) + np.diag(known)
    for _ in range(MAX_DAMPING_TRIALS):
        damped = information + damping * np.diag(np.diag(information)) + 1e-9 * np.eye(len(gradient))
        step = np.clip(-np.linalg.solve(damped, gradient), -0.5, 0.5)
        there = pose.moved(step, mixture.prior)
        if mixture.cost(there, sigmas)[0] <= cost:
            return there, float(np.abs(step).max()), max(damping / 10.0, 1e-6)
        damping *= 10.0
    return None

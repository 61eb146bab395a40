"""Lens and plane that align most segments with two perpendicular directions on the road and the vertical one.

A mixture of three Student's t peaks and uniform outliers, as of a Manhattan frame. Fractions and a noise scale are
fitted by expectation-maximisation; lens, plane and the angle between the two directions by damped Gauss-Newton steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np

from autocalib_ros.estimation.adjustment.covariance import jackknife_covariance
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.adjustment.parameters import RIGHT_ANGLE_SIGMA_RAD
from autocalib_ros.estimation.markings.road_segments import ProjectedSegments, RoadSegments
from autocalib_ros.geometry.great_circles import middles_and_ways
from autocalib_ros.geometry.lens_slopes import PolarRays
from autocalib_ros.geometry.robust_kernels import STUDENT_FREEDOM, student_density, student_weight
from autocalib_ros.geometry.small_matrices import cross, rotation_matrix
from autocalib_ros.lens.camera import Camera

LINE_END_SIGMA_PX, MARKING_SIGMA_RAD = 0.4, np.radians(0.5)
"""Standard deviations before scaling: of an end point of a segment, across it, in pixels; and of the direction of
markings on the road. Judgement."""
POST_SIGMA_RAD = np.radians(1.0)
"""Standard deviation of posts from the vertical. Judgement."""
MIN_NOISE_SCALE, MAX_NOISE_SCALE = 0.15, 2.0
"""Limits of the noise scale."""
MIN_DEPRESSION_SINE = 0.1
"""Sine of the smallest angle below the horizon for segments on the road, ten camera heights away. Farther ones are
too foreshortened to be distinguished from upright structures."""
ANNEALING_ROUNDS, FINAL_ROUNDS, MAX_DAMPING_TRIALS = 8, 40, 8
"""Iterations at each width of the annealing, iterations at the end, and trials of the damping in one iteration."""
CONVERGED_STEP = 1e-5
"""Largest component of a step at convergence."""
START_FRACTIONS = np.array([0.35, 0.35, 0.1])[:, None]
"""Initial fractions of the two directions and the vertical one."""
MIN_DIRECTION_FRACTION, MAX_DIRECTION_FRACTION, MAX_ALIGNED_FRACTION = 0.02, 0.9, 0.95
"""Limits of the fraction of one direction, and of their sum."""
LENS_CACHE_SIZE = 2
"""Lenses whose projected segments are cached: that of a state, and that of the one that is tried next."""


@dataclass(frozen=True)
class MarkingGrid:
    """Lens, plane and two nearly perpendicular directions in it, with which segments are aligned."""

    prior: LensPrior
    camera: Camera
    rotation: np.ndarray
    """camera_from_plane, shape (3, 3): the first direction is x, the normal, up, is z."""
    skew_rad: float
    """Angle between the two directions, minus pi / 2."""
    cost: float
    """Negative log-posterior."""
    fractions: np.ndarray
    """Fractions of the segments along the two directions and the vertical one, shape (3,)."""
    responsibilities: np.ndarray
    """Probability of each segment to be along each direction, shape (3, n)."""
    laplace_term: float
    """Half the log-determinant of the information: the term that Laplace's approximation adds to the cost."""
    covariance: np.ndarray
    """Covariance of steps of the free lens parameters, rotations of the plane about its axes, and `skew_rad`."""

    @property
    def negative_log_evidence(self) -> float:
        """Negative log-evidence, in nats, by Laplace's approximation."""
        return self.cost + self.laplace_term


def annealed_costs(segments: RoadSegments, camera: Camera, planes: np.ndarray, width_rad: float) -> np.ndarray:
    """Negative log-likelihood of the segments with widened peaks, for one lens and planes (n, 3, 3); shape (n,)."""
    projected = ProjectedSegments.from_camera(camera, segments.ends_px)
    sigmas = np.hypot(_noise_rad(segments), width_rad)
    each = START_FRACTIONS * student_density(projected.residuals(planes.transpose(0, 2, 1)), sigmas)
    each[:, :2] *= (planes[:, :, 2] @ projected.bearings.T < -MIN_DEPRESSION_SINE)[:, None]
    return -np.log(each.sum(axis=1) + (1.0 - START_FRACTIONS.sum()) / np.pi) @ segments.weights


def _noise_rad(segments: RoadSegments) -> np.ndarray:
    """Standard deviation of the direction of each segment, from the noise of its ends, shape (n,)."""
    return LINE_END_SIGMA_PX * np.sqrt(2.0) / segments.lengths_px


@dataclass(frozen=True, eq=False)
class _GridState:
    """The estimated state: a lens, and a plane with its two directions."""

    camera: Camera
    rotation: np.ndarray
    skew_rad: float = 0.0

    @cached_property
    def directions(self) -> np.ndarray:
        """The two directions and the vertical one, shape (3, 3)."""
        return self._in_plane @ self.rotation.T

    @property
    def _in_plane(self) -> np.ndarray:
        """The directions in the frame of the plane, shape (3, 3)."""
        return np.array([[1.0, 0.0, 0.0], [-math.sin(self.skew_rad), math.cos(self.skew_rad), 0.0], [0.0, 0.0, 1.0]])

    @property
    def direction_changes(self) -> np.ndarray:
        """Derivatives of the directions by rotations about the axes of the plane, and by the skew, shape (4, 3, 3)."""
        changes = np.zeros((4, 3, 3))
        changes[:3] = cross(np.eye(3)[:, None], self._in_plane)
        changes[3, 1, :2] = -math.cos(self.skew_rad), -math.sin(self.skew_rad)
        return changes @ self.rotation.T

    def moved(self, step: np.ndarray, prior: LensPrior) -> _GridState:
        """Return the state after a step of the lens, of rotations about the axes of the plane, and of the skew."""
        size = len(prior.free)
        lens, turn, skew = step[:size], step[size : size + 3], step[size + 3]
        return _GridState(
            prior.moved(self.camera, lens) if lens.any() else self.camera,
            self.rotation @ rotation_matrix(turn) if turn.any() else self.rotation,
            self.skew_rad + float(skew),
        )


class _GridMixture:
    """Likelihood of the segments given a state, and the fractions and noise scale that are fitted to them."""

    def __init__(self, segments: RoadSegments, prior: LensPrior) -> None:
        self.segments, self.prior, self.weights, self._noise = segments, prior, segments.weights, _noise_rad(segments)
        self.fractions, self.scale = START_FRACTIONS[:, 0], 1.0
        self._middles_px, self._ways_px = middles_and_ways(segments.ends_px)
        self._project = lru_cache(maxsize=LENS_CACHE_SIZE)(
            partial(ProjectedSegments.from_camera, ends_px=segments.ends_px)
        )
        self.residuals = lru_cache(maxsize=1)(self._residuals)

    def _residuals(self, state: _GridState) -> np.ndarray:
        """Residuals from each direction, shape (3, n)."""
        return self._project(state.camera).residuals(state.directions)

    def sigmas(self, state: _GridState, width_rad: float) -> np.ndarray:
        """Their standard deviations, shape (3, n)."""
        directions, up = state.directions[:2], state.rotation[:, 2]
        leverages = self._project(state.camera).residual_changes(directions, cross(up, directions))
        direction_sigmas = np.concatenate(
            [MARKING_SIGMA_RAD * leverages, np.full((1, len(self.segments)), POST_SIGMA_RAD)]
        )
        return np.sqrt(self.scale**2 * (self._noise**2 + direction_sigmas**2) + width_rad**2)

    def cost(self, state: _GridState, sigmas: np.ndarray) -> tuple[float, np.ndarray]:
        """Negative log-posterior, and the responsibilities (3, n)."""
        projected = self._project(state.camera)
        each = self.fractions[:, None] * student_density(self.residuals(state), sigmas)
        each[:2] *= projected.bearings @ state.rotation[:, 2] < -MIN_DEPRESSION_SINE
        density = each.sum(axis=0) + (1.0 - self.fractions.sum()) / np.pi
        deviations = np.append(self.prior.deviations(state.camera), state.skew_rad / RIGHT_ANGLE_SIGMA_RAD)
        return float(-np.log(density) @ self.weights + 0.5 * deviations @ deviations), each / density

    def fit_fractions(self, responsibilities: np.ndarray) -> None:
        """Maximisation step of the fractions."""
        fractions = np.clip(
            responsibilities @ self.weights / self.weights.sum(), MIN_DIRECTION_FRACTION, MAX_DIRECTION_FRACTION
        )
        self.fractions = fractions * min(1.0, MAX_ALIGNED_FRACTION / fractions.sum())

    def fit_scale(self, responsibilities: np.ndarray, residuals: np.ndarray, sigmas: np.ndarray) -> None:
        """Maximisation step of the noise scale."""
        squared, weights = (residuals / sigmas) ** 2, responsibilities * self.weights
        robust_squares = weights * student_weight(residuals, sigmas) * squared
        self.scale *= float(np.sqrt(robust_squares.sum() / max(weights.sum(), 1e-12)))
        self.scale = float(np.clip(self.scale, MIN_NOISE_SCALE, MAX_NOISE_SCALE))

    def linearised(
        self, state: _GridState, responsibilities: np.ndarray, sigmas: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals (3, n), Jacobian (3, n, p) by the parameters, and weights (3, n) before those of the segments."""
        projected, lens = self._project(state.camera), len(self.prior.free)
        here = self.residuals(state)
        jacobian = np.empty((*here.shape, lens + 4))
        rays = PolarRays(state.camera, self._middles_px, projected.bearings)
        slopes = rays.heading_slopes(self._ways_px, state.directions, self.prior.free)
        for column, (slope, unit) in enumerate(zip(slopes, self.prior.units, strict=True)):
            jacobian[..., column] = slope * unit
        turns = projected.residual_changes(state.directions, state.direction_changes)
        jacobian[..., lens:] = np.moveaxis(turns, 0, -1)
        return here, jacobian, responsibilities * student_weight(here, sigmas) / sigmas**2

    def prior_terms(self, state: _GridState) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (p,) and information (p,) of the prior of lens and skew."""
        lens = len(self.prior.free)
        gradient, information = np.zeros(lens + 4), np.zeros(lens + 4)
        gradient[:lens], information[:lens] = self.prior.deviations(state.camera), self.prior.information
        gradient[-1], information[-1] = state.skew_rad / RIGHT_ANGLE_SIGMA_RAD**2, RIGHT_ANGLE_SIGMA_RAD**-2
        return gradient, information


def refine_grid(
    segments: RoadSegments, prior: LensPrior, camera: Camera, rotation: np.ndarray, widths_rad: tuple[float, ...]
) -> MarkingGrid:
    """Solve from an initial lens and plane, annealing the widths of the peaks."""
    mixture, state = _GridMixture(segments, prior), _GridState(camera, rotation)
    for width_rad in widths_rad:
        damping = 1e-3
        for _ in range(ANNEALING_ROUNDS if width_rad else FINAL_ROUNDS):
            sigmas = mixture.sigmas(state, width_rad)
            mixture.fit_fractions(mixture.cost(state, sigmas)[1])
            if not width_rad:
                mixture.fit_scale(mixture.cost(state, sigmas)[1], mixture.residuals(state), sigmas)
                sigmas = mixture.sigmas(state, width_rad)
            stepped = _damped_step(mixture, state, sigmas, damping)
            if stepped is None:
                break
            state, size, damping = stepped
            if size < CONVERGED_STEP:
                break
    sigmas = mixture.sigmas(state, 0.0)
    cost, responsibilities = mixture.cost(state, sigmas)
    residuals, jacobian, weights = mixture.linearised(state, responsibilities, sigmas)
    gradients = ((weights * residuals)[..., None] * jacobian).sum(axis=0)
    curvatures = np.einsum('kn,kni,knj->nij', weights, jacobian, jacobian)
    _, prior_information = mixture.prior_terms(state)
    # the Hessian also has the derivatives of the robust weights and of the responsibilities: a multiple of g g^T
    aligned = responsibilities.sum(axis=0)
    second_order = -segments.weights * (2.0 / (STUDENT_FREEDOM + 1.0) + 1.0 - aligned) / np.maximum(aligned, 0.05)
    covariance = jackknife_covariance(
        gradients, curvatures, segments.weights, second_order, segments.groups, prior_information
    )
    units = np.append(np.ones(len(prior_information) - 1), RIGHT_ANGLE_SIGMA_RAD)
    information = (np.tensordot(segments.weights, curvatures, 1) + np.diag(prior_information + 1e-9)) * np.outer(
        units, units
    )
    return MarkingGrid(
        prior,
        state.camera,
        state.rotation,
        state.skew_rad,
        cost,
        mixture.fractions,
        responsibilities,
        float(0.5 * np.linalg.slogdet(information)[1]),
        covariance,
    )


def _damped_step(
    mixture: _GridMixture, state: _GridState, sigmas: np.ndarray, damping: float
) -> tuple[_GridState, float, float] | None:
    """Return the state after a step that lowers the cost, its size and the next damping; None if no step does."""
    cost, responsibilities = mixture.cost(state, sigmas)
    residuals, jacobian, weights = mixture.linearised(state, responsibilities, sigmas)
    prior_gradient, prior_information = mixture.prior_terms(state)
    weighted = (mixture.weights * weights)[..., None] * jacobian
    gradient = np.tensordot(residuals, weighted, 2) + prior_gradient
    information = np.tensordot(weighted, jacobian, ((0, 1), (0, 1))) + np.diag(prior_information)
    for _ in range(MAX_DAMPING_TRIALS):
        damped = information + damping * np.diag(np.diag(information)) + 1e-9 * np.eye(len(gradient))
        step = np.clip(-np.linalg.solve(damped, gradient), -0.5, 0.5)
        there = state.moved(step, mixture.prior)
        if mixture.cost(there, sigmas)[0] <= cost:
            return there, float(np.abs(step).max()), max(damping / 10.0, 1e-6)
        damping *= 10.0
    return None

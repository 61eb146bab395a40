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
from autocalib_ros.estimation.markings.road_segments import Lines, Sight
from autocalib_ros.geometry.robust_kernels import folded, robust, student
from autocalib_ros.lens.camera import Camera

END_PX, PAINTED_RAD = 0.4, np.radians(0.5)
"""Standard deviation of an end of a line, across it, in the image; and of painted lines about their direction on the
road. A scale for both is fitted."""
ASKEW_RAD = np.radians(1.0)
"""Standard deviation of the angle between the two directions from a right one: junctions are built to about that."""
LEAN_RAD = np.radians(1.0)
"""Standard deviation of posts from the upright."""
LEAST_SCALE, LARGEST_SCALE = 0.15, 2.0
LOWEST = 0.1
"""Sine of the angle below the horizon from which on lines are on the road: ten heights of the camera away. What is
farther is too foreshortened to tell from what stands there."""
ROUNDS, LAST_ROUNDS, TRIALS = 8, 40, 8
SETTLED = 1e-5
START_SHARES = np.array([0.35, 0.35, 0.1])[:, None]
LEAST_SHARE, LARGEST_SHARE, LARGEST_SUM = 0.02, 0.9, 0.95
DIFFERENCE = 1e-5
LENSES_KEPT = 8
"""Lenses whose sight is kept: that of a pose, and those a step of a parameter away. Most steps leave the lens."""


@dataclass(frozen=True)
class Grid:
    """A lens, and a plane with two directions in it, nearly square to each other, to which lines are parallel."""

    prior: LensPrior
    camera: Camera
    rotation: np.ndarray
    """camera_from_plane, shape (3, 3): the first direction is x, the normal, up, is z."""
    askew_rad: float
    """How much more than a quarter of a turn the second direction is from the first."""
    cost: float
    """Negative logarithm of how probable the lines are, with the prior."""
    shares: np.ndarray
    """Of the lines along the two directions and the upright one, shape (3,)."""
    members: np.ndarray
    """Probability of each line to be along each, shape (3, n)."""
    volume: float
    """Half the logarithm of the determinant of the information: what Laplace's approximation adds to the cost."""
    covariance: np.ndarray
    """Of steps of the free parameters of the lens, turns of the plane about its axes, and `askew_rad`."""

    @property
    def improbability(self) -> float:
        """Negative logarithm of how probable the lines are under any lens and plane near this one."""
        return self.cost + self.volume


def widened_costs(lines: Lines, camera: Camera, planes: np.ndarray, widened: float) -> np.ndarray:
    """Negative logarithm of how probable lines are with widened peaks, seen by a lens over planes (n, 3, 3); (n,)."""
    sight, sigmas = Sight.through(camera, lines.ends_px), np.hypot(_noise_rad(lines), widened)
    each = START_SHARES * student(sight.misses(planes.transpose(0, 2, 1)), sigmas)
    each[:, :2] *= (planes[:, :, 2] @ sight.bearings.T < -LOWEST)[:, None]
    return -np.log(each.sum(axis=1) + (1.0 - START_SHARES.sum()) / np.pi) @ lines.weights


def _noise_rad(lines: Lines) -> np.ndarray:
    return END_PX * np.sqrt(2.0) / lines.lengths_px


@dataclass(frozen=True)
class _Pose:
    """What is solved for: a lens, and a plane with its two directions."""

    camera: Camera
    rotation: np.ndarray
    askew_rad: float = 0.0

    @property
    def directions(self) -> np.ndarray:
        """The two directions, and the upright one, shape (3, 3)."""
        along, across, up = self.rotation.T
        return np.stack([along, np.cos(self.askew_rad) * across - np.sin(self.askew_rad) * along, up])

    def moved(self, step: np.ndarray, prior: LensPrior) -> _Pose:
        """Return the pose after a step of the lens, of turns about the axes of the plane, and of the angle."""
        lens = len(prior.free)
        return _Pose(prior.moved(self.camera, step[:lens]),
                     self.rotation @ Rotation.from_rotvec(step[lens:lens + 3]).as_matrix(),
                     self.askew_rad + float(step[lens + 3]))


class _Mixture:
    """What poses make of lines, while shares and scale are fitted."""

    def __init__(self, lines: Lines, prior: LensPrior) -> None:
        self.lines, self.prior, self.weights, self._noise = lines, prior, lines.weights, _noise_rad(lines)
        self.shares, self.scale = START_SHARES[:, 0], 1.0
        self._through = lru_cache(maxsize=LENSES_KEPT)(partial(Sight.through, ends_px=lines.ends_px))

    def misses(self, pose: _Pose) -> np.ndarray:
        """Of each direction, shape (3, n)."""
        return self._through(pose.camera).misses(pose.directions)

    def sigmas(self, pose: _Pose, widened: float) -> np.ndarray:
        """What is expected of them, shape (3, n)."""
        levers = self._through(pose.camera).levers(pose.directions[:2], pose.rotation[:, 2])
        askew = np.concatenate([PAINTED_RAD * levers, np.full((1, len(self.lines)), LEAN_RAD)])
        return np.sqrt(self.scale**2 * (self._noise**2 + askew**2) + widened**2)

    def cost(self, pose: _Pose, sigmas: np.ndarray) -> tuple[float, np.ndarray]:
        """Negative logarithm of the probability, and of each line to be along each direction, shape (3, n)."""
        sight = self._through(pose.camera)
        each = self.shares[:, None] * student(sight.misses(pose.directions), sigmas)
        each[:2] *= sight.bearings @ pose.rotation[:, 2] < -LOWEST
        density = each.sum(axis=0) + (1.0 - self.shares.sum()) / np.pi
        known = np.append(self.prior.deviations(pose.camera), pose.askew_rad / ASKEW_RAD)
        return float(-np.log(density) @ self.weights + 0.5 * known @ known), each / density

    def fit_shares(self, members: np.ndarray) -> None:
        """One round of maximisation for the shares."""
        shares = np.clip(members @ self.weights / self.weights.sum(), LEAST_SHARE, LARGEST_SHARE)
        self.shares = shares * min(1.0, LARGEST_SUM / shares.sum())

    def fit_scale(self, members: np.ndarray, misses: np.ndarray, sigmas: np.ndarray) -> None:
        """One round of maximisation for the scale."""
        squared, held = (misses / sigmas) ** 2, members * self.weights
        trusted = held * robust(misses, sigmas) * squared
        self.scale *= float(np.sqrt(trusted.sum() / max(held.sum(), 1e-12)))
        self.scale = float(np.clip(self.scale, LEAST_SCALE, LARGEST_SCALE))

    def linearised(self, pose: _Pose, members: np.ndarray, sigmas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (n, p) and information (n, p, p) of each line by the parameters, their weights aside."""
        here, size = self.misses(pose), len(self.prior.free) + 4
        slopes = np.stack([folded(self.misses(pose.moved(DIFFERENCE * unit, self.prior)) - here) / DIFFERENCE
                           for unit in np.eye(size)], axis=-1)
        pull = members * robust(here, sigmas) / sigmas**2
        return (((pull * here)[..., None] * slopes).sum(axis=0),
                np.einsum('kn,kni,knj->nij', pull, slopes, slopes))

    def known(self, pose: _Pose) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (p,) and information (p,) of what is known before of lens and angle."""
        lens = len(self.prior.free)
        gradient, information = np.zeros(lens + 4), np.zeros(lens + 4)
        gradient[:lens], information[:lens] = self.prior.deviations(pose.camera), self.prior.information
        gradient[-1], information[-1] = pose.askew_rad / ASKEW_RAD**2, ASKEW_RAD**-2
        return gradient, information


def settled_grid(lines: Lines, prior: LensPrior, camera: Camera, rotation: np.ndarray,
                 widening: tuple[float, ...]) -> Grid:
    """Solve from a start: shares, scale, and damped Gauss-Newton steps on the mixture's probability."""
    mixture, pose = _Mixture(lines, prior), _Pose(camera, rotation)
    for widened in widening:
        damping = 1e-3
        for _ in range(ROUNDS if widened else LAST_ROUNDS):
            sigmas = mixture.sigmas(pose, widened)
            mixture.fit_shares(mixture.cost(pose, sigmas)[1])
            if not widened:
                mixture.fit_scale(mixture.cost(pose, sigmas)[1], mixture.misses(pose), sigmas)
                sigmas = mixture.sigmas(pose, widened)
            stepped = _stepped(mixture, pose, sigmas, damping)
            if stepped is None:
                break
            pose, size, damping = stepped
            if size < SETTLED:
                break
    sigmas = mixture.sigmas(pose, 0.0)
    cost, members = mixture.cost(pose, sigmas)
    gradients, curvatures = mixture.linearised(pose, members, sigmas)
    _, known = mixture.known(pose)
    covariance = jackknife_covariance(gradients, curvatures, lines.weights, np.zeros(len(lines)), lines.groups, known)
    units = np.append(np.ones(len(known) - 1), ASKEW_RAD)
    information = (np.tensordot(lines.weights, curvatures, 1) + np.diag(known + 1e-9)) * np.outer(units, units)
    return Grid(prior, pose.camera, pose.rotation, pose.askew_rad, cost, mixture.shares, members,
                float(0.5 * np.linalg.slogdet(information)[1]), covariance)


def _stepped(mixture: _Mixture, pose: _Pose, sigmas: np.ndarray, damping: float) -> tuple[_Pose, float, float] | None:
    """Return the pose after a step that lowers the cost, its size and the next damping; None where none does."""
    cost, members = mixture.cost(pose, sigmas)
    gradients, curvatures = mixture.linearised(pose, members, sigmas)
    pull, known = mixture.known(pose)
    gradient = mixture.weights @ gradients + pull
    information = np.tensordot(mixture.weights, curvatures, 1) + np.diag(known)
    for _ in range(TRIALS):
        damped = information + damping * np.diag(np.diag(information)) + 1e-9 * np.eye(len(gradient))
        step = np.clip(-np.linalg.solve(damped, gradient), -0.5, 0.5)
        there = pose.moved(step, mixture.prior)
        if mixture.cost(there, sigmas)[0] <= cost:
            return there, float(np.abs(step).max()), max(damping / 10.0, 1e-6)
        damping *= 10.0
    return None

"""Two peaks a quarter of a turn apart, and a uniform rest: what edges on vehicles tell of the turn about their road.

Vehicles, not edges, are independent. Each peak is Student's distribution, as wide as noise and bodies make it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.observations.track_set import kish_weight
from autocalib_ros.geometry.robust_kernels import student_density, student_weight, wrap_undirected

EDGE_CORRELATION = 0.3
"""How much the errors of one vehicle's edges correlate: the same bumper is seen again and again."""
MIN_SPREAD_RAD, MAX_SPREAD_RAD = np.radians([0.5, 3.0]), np.radians([3.0, 5.0])
"""Of edges about the direction across and the upright one, to any side. What is meant to be square to the road is so,
but for its rounding; pillars lean and bodies narrow towards the roof by degrees."""
BULGE_RAD, BULGE_SIGMA_RAD = np.radians(2.5), np.radians(1.5)
"""Bodies are convex seen from above: of a bumper of 1.8 m that bulges by 4 cm, the half that faces the camera is turned
by 2.5 degrees; from hardly any to twice that is found on the road."""
SYSTEMATIC_SIGMA_RAD = np.radians([0.75, 1.5])
"""What edges of all vehicles may have in common besides: the ends of bumpers rise, sides lean inwards."""
MAX_PEAK_FRACTION = 0.95
"""Of the edges in the peaks: some are always of neither."""
MAX_TURN_RAD = np.pi / 4
"""Beyond it from where turns are counted, across and upright are one another's."""
TURN_GRID_SIZE = 180
"""Turns at which the mixture is looked at: half a degree apart, no wider than the least spread."""
EM_ROUNDS = 6
"""Of expectation and maximisation: shares and spreads have settled to a few per cent by then."""
BOOTSTRAP_SAMPLES = 200


@dataclass(frozen=True)
class EdgeTurns:
    """What edges tell of the rotation about a road."""

    turns_rad: np.ndarray
    """Shape (n,), modulo half a turn."""
    sigmas_rad: np.ndarray
    """By noise, shape (n,)."""
    angle_to_road_rad: np.ndarray
    """Angle between the edge and the way to the road's vanishing point, 0 to a quarter of a turn, shape (n,)."""
    leverage: np.ndarray
    """How much the turn changes with a rotation of the edge about the ground's normal, shape (n,), not negative."""
    bulge_leverage: np.ndarray
    """How much it changes with the bulge of a vehicle's end, of which the near half is seen, shape (n,)."""


@dataclass(frozen=True)
class TransversePeak:
    """The mixture fitted: where the direction across the road lies, and what tells it."""

    turn_rad: float
    """Between plus and minus `MAX_TURN_RAD`."""
    sigma_rad: float
    weights: np.ndarray
    """How much each edge pulls on the turn, shape (n,)."""
    vehicles: int
    """Number of vehicles in the peaks, one with less than half an edge in them counted by that."""


def find_transverse_peak(observed: EdgeTurns, vehicles: np.ndarray, generator: np.random.Generator) -> TransversePeak:
    """Fit the mixture to what edges of vehicles (n,) tell.

    Expectation and maximisation for shares and spreads, and for how much the ends of vehicles bulge; the turn by
    looking at all of them; its standard deviation by drawing vehicles anew, with that of the bulge and with what all
    edges have in common.
    """
    turns = (np.arange(TURN_GRID_SIZE) / TURN_GRID_SIZE * 2 - 1) * MAX_TURN_RAD
    weights, mixture = kish_weight(vehicles, EDGE_CORRELATION), _EdgeMixture(observed)
    for _ in range(EM_ROUNDS):
        turn = _peak_position(turns, weights @ mixture.log_density(turns))
        mixture = mixture.maximisation_step(turn, weights)
    _, owners = np.unique(vehicles, return_inverse=True)
    by_vehicle = np.zeros((int(owners.max()) + 1, TURN_GRID_SIZE))
    np.add.at(by_vehicle, owners, weights[:, None] * mixture.log_density(turns))
    turn = _peak_position(turns, by_vehicle.sum(axis=0))
    drawn = generator.multinomial(len(by_vehicle), np.full(len(by_vehicle), 1.0 / len(by_vehicle)), BOOTSTRAP_SAMPLES)
    residuals = np.array([_peak_position(turns, total) - turn for total in drawn @ by_vehicle])
    responsibilities, pulls = mixture.responsibilities(turn)
    pulls = pulls * weights
    fractions = pulls.sum(axis=1) / max(float(pulls.sum()), 1e-30)
    lever, bulge_sigma = mixture.bulge_effect(pulls[0])
    common = np.array([fractions[0] * lever * bulge_sigma, *(fractions * SYSTEMATIC_SIGMA_RAD)])
    in_peaks = np.minimum(2.0 * np.bincount(owners, responsibilities.sum(axis=0)), 1.0)
    return TransversePeak(
        turn, float(np.sqrt(np.mean(residuals**2) + common @ common)), pulls.sum(axis=0), int(in_peaks.sum())
    )


@dataclass(frozen=True)
class _EdgeMixture:
    """A state of the mixture: index 0 are edges across the road, 1 upright ones."""

    observed: EdgeTurns
    fractions: tuple[float, float] = (0.3, 0.1)
    spreads_rad: tuple[float, float] = tuple(np.sqrt(MIN_SPREAD_RAD * MAX_SPREAD_RAD).tolist())
    bulge_rad: float = float(BULGE_RAD)

    def _leverages(self) -> np.ndarray:
        """How much an edge is turned by being off its direction to any side, shape (2, n)."""
        return np.stack([np.sqrt(1.0 + self.observed.leverage**2), np.ones(len(self.observed.leverage))])

    def _residuals(self, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far edges lie from the peaks at turns (turns,), (2, n, turns), and what is expected of it (2, n, 1)."""
        off = self.observed.turns_rad[:, None] - turns
        bulged = off - self.bulge_rad * self.observed.bulge_leverage[:, None]
        sigmas = np.hypot(self.observed.sigmas_rad, np.array(self.spreads_rad)[:, None] * self._leverages())
        return np.stack([wrap_undirected(bulged), wrap_undirected(off - np.pi / 2)]), sigmas[:, :, None]

    def _densities(self, residuals: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
        """Of each peak, by its share (2, n, turns)."""
        return np.array(self.fractions)[:, None, None] * student_density(residuals, sigmas)

    @property
    def _outlier_density(self) -> float:
        """Density of what is in neither peak."""
        return (1.0 - sum(self.fractions)) / np.pi

    def log_density(self, turns: np.ndarray) -> np.ndarray:
        """Logarithm of each edge's density with the direction across the road at turns (turns,), shape (n, turns)."""
        return np.log(self._densities(*self._residuals(turns)).sum(axis=0) + self._outlier_density)

    def responsibilities(self, turn: float) -> tuple[np.ndarray, np.ndarray]:
        """Probability of each edge to be of either peak, and how much it then pulls on the turn: (2, n) both."""
        residuals, sigmas = self._residuals(np.array([turn]))
        each = self._densities(residuals, sigmas)[:, :, 0]
        responsibilities = each / (each.sum(axis=0) + self._outlier_density)
        return responsibilities, responsibilities * student_weight(residuals, sigmas)[:, :, 0] / sigmas[:, :, 0] ** 2

    def bulge_effect(self, pull: np.ndarray) -> tuple[float, float]:
        """How much a bulge of one turns the estimate, by the pulls (n,) of edges across; and its standard deviation."""
        mean = float(pull @ self.observed.bulge_leverage / max(pull.sum(), 1e-30))
        information = float(pull @ (self.observed.bulge_leverage - mean) ** 2) + BULGE_SIGMA_RAD**-2
        return mean, information**-0.5

    def maximisation_step(self, turn: float, weights: np.ndarray) -> _EdgeMixture:
        """Return the mixture after one round with the direction across the road at a turn, edges weighing (n,)."""
        responsibilities, pulls = self.responsibilities(turn)
        residuals, sigmas = self._residuals(np.array([turn]))
        squared = (student_weight(residuals, sigmas) * residuals**2)[:, :, 0]
        held, pull = responsibilities * weights, pulls[0] * weights
        sums = np.maximum(held.sum(axis=1), 1e-9)
        beyond = (held * (squared - self.observed.sigmas_rad**2) / self._leverages() ** 2).sum(axis=1) / sums
        spreads = np.clip(np.sqrt(np.maximum(beyond, 0.0)), MIN_SPREAD_RAD, MAX_SPREAD_RAD)
        lever, sigma = self.bulge_effect(pull)
        off = residuals[0, :, 0] + self.bulge_rad * self.observed.bulge_leverage
        bulge = (pull @ ((self.observed.bulge_leverage - lever) * off) + BULGE_RAD / BULGE_SIGMA_RAD**2) * sigma**2
        fractions = sums / max(weights.sum(), sums.sum() / MAX_PEAK_FRACTION)
        return _EdgeMixture(self.observed, tuple(fractions.tolist()), tuple(spreads.tolist()), float(bulge))


def _peak_position(at: np.ndarray, values: np.ndarray) -> float:
    """Where values (n,) on an even grid are highest, by a parabola through three."""
    top = int(np.clip(np.argmax(values), 1, len(at) - 2))
    before, here, after = values[top - 1 : top + 2]
    bend = before - 2 * here + after
    shift = np.clip(0.5 * (before - after) / bend, -1.0, 1.0) if bend < 0 else 0.0
    return float(at[top] + shift * (at[1] - at[0]))

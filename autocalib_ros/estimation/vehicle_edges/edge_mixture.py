"""Mixture model of the turns of vehicle edges about their road: two peaks 90 degrees apart, and uniform outliers.

Independent samples are vehicles, not edges. Each peak is a Student's t distribution whose scale follows from noise and
from the shapes of vehicles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.observations.track_set import kish_weight
from autocalib_ros.geometry.robust_kernels import student_density, student_weight, wrap_undirected

EDGE_CORRELATION = 0.3
"""Correlation of the errors of the edges of one vehicle: the same bumper is seen repeatedly. Judgement."""
MIN_SPREAD_RAD, MAX_SPREAD_RAD = np.radians([0.5, 3.0]), np.radians([3.0, 5.0])
"""Limits of the spread of edges about the transverse and the vertical direction. Transverse edges are square to the
road apart from their bulge; pillars lean and bodies narrow towards the roof by several degrees."""
BULGE_RAD, BULGE_SIGMA_RAD = np.radians(2.5), np.radians(1.5)
"""Prior of the bulge, mean and standard deviation. Vehicles are convex seen from above: on a bumper of 1.8 m that
bulges by 4 cm, the half that faces the camera is rotated by 2.5 degrees. On real vehicles it is between 0 and twice
that."""
SYSTEMATIC_SIGMA_RAD = np.radians([0.75, 1.5])
"""Standard deviation of an error common to all vehicles, of transverse and vertical edges: bumpers rise at their ends,
sides lean inwards. Judgement."""
MAX_PEAK_FRACTION = 0.95
"""Largest fraction of the edges in both peaks together; there are always outliers. Judgement."""
MAX_TURN_RAD = np.pi / 4
"""Turns are searched up to this; excess_variances it, transverse and vertical would swap."""
TURN_GRID_SIZE = 180
"""Turns at which the mixture is evaluated: half a degree apart, no wider than the smallest spread."""
EM_ROUNDS = 6
"""Expectation-maximisation rounds; fractions and spreads then change by a few per cent at most."""
BOOTSTRAP_SAMPLES = 200


@dataclass(frozen=True)
class EdgeTurns:
    """Turn of each edge about a road, as if it were perpendicular to the road, and its error."""

    turns_rad: np.ndarray
    """Shape (n,), modulo pi."""
    sigmas_rad: np.ndarray
    """Standard deviation from noise, shape (n,)."""
    angle_to_road_rad: np.ndarray
    """Angle between the edge and the direction to the road's vanishing point, 0 to pi / 2, shape (n,)."""
    leverage: np.ndarray
    """Derivative of the turn by a rotation of the edge about the ground normal, shape (n,), not negative."""
    bulge_leverage: np.ndarray
    """Derivative of the turn by the bulge of the vehicle's end, of which the near half is seen, shape (n,)."""


@dataclass(frozen=True)
class TransversePeak:
    """Result of the mixture fit: the transverse direction and how much each edge contributes."""

    turn_rad: float
    """Turn of the transverse direction, within plus and minus `MAX_TURN_RAD`."""
    sigma_rad: float
    weights: np.ndarray
    """Weight of each edge in the turn, shape (n,)."""
    vehicles: int
    """Number of vehicles in the peaks; a vehicle with less than half an edge in them counts in proportion."""


def find_transverse_peak(observed: EdgeTurns, vehicles: np.ndarray, generator: np.random.Generator) -> TransversePeak:
    """Fit the mixture to the turns of edges of vehicles (n,).

    Fractions, spreads and bulge by expectation-maximisation; the turn by grid search; its standard deviation by a
    bootstrap over vehicles, combined with the uncertainty of the bulge and the error common to all vehicles.
    """
    turns = (np.arange(TURN_GRID_SIZE) / TURN_GRID_SIZE * 2 - 1) * MAX_TURN_RAD
    weights, mixture = kish_weight(vehicles, EDGE_CORRELATION), _EdgeMixture(observed)
    for _ in range(EM_ROUNDS):
        turn = _peak_position(turns, weights @ mixture.log_density(turns))
        mixture = mixture.maximisation_step(turn, weights)
    _, vehicle_ids = np.unique(vehicles, return_inverse=True)
    by_vehicle = np.zeros((int(vehicle_ids.max()) + 1, TURN_GRID_SIZE))
    np.add.at(by_vehicle, vehicle_ids, weights[:, None] * mixture.log_density(turns))
    turn = _peak_position(turns, by_vehicle.sum(axis=0))
    resampled = generator.multinomial(
        len(by_vehicle), np.full(len(by_vehicle), 1.0 / len(by_vehicle)), BOOTSTRAP_SAMPLES
    )
    deviations = np.array([_peak_position(turns, total) - turn for total in resampled @ by_vehicle])
    responsibilities, turn_weights = mixture.responsibilities(turn)
    turn_weights = turn_weights * weights
    fractions = turn_weights.sum(axis=1) / max(float(turn_weights.sum()), 1e-30)
    mean_leverage, bulge_sigma = mixture.bulge_effect(turn_weights[0])
    common = np.array([fractions[0] * mean_leverage * bulge_sigma, *(fractions * SYSTEMATIC_SIGMA_RAD)])
    in_peaks = np.minimum(2.0 * np.bincount(vehicle_ids, responsibilities.sum(axis=0)), 1.0)
    return TransversePeak(
        turn, float(np.sqrt(np.mean(deviations**2) + common @ common)), turn_weights.sum(axis=0), int(in_peaks.sum())
    )


@dataclass(frozen=True)
class _EdgeMixture:
    """Parameters of the mixture; index 0 are transverse edges, 1 vertical ones."""

    observed: EdgeTurns
    fractions: tuple[float, float] = (0.3, 0.1)
    spreads_rad: tuple[float, float] = tuple(np.sqrt(MIN_SPREAD_RAD * MAX_SPREAD_RAD).tolist())
    bulge_rad: float = float(BULGE_RAD)

    def _leverages(self) -> np.ndarray:
        """Derivative of the turn by a deviation of the edge in any direction, shape (2, n)."""
        return np.stack([np.sqrt(1.0 + self.observed.leverage**2), np.ones(len(self.observed.leverage))])

    def _residuals(self, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals of the edges from the peaks at turns (turns,), shape (2, n, turns), and their sigmas (2, n, 1)."""
        offsets = self.observed.turns_rad[:, None] - turns
        without_bulge = offsets - self.bulge_rad * self.observed.bulge_leverage[:, None]
        sigmas = np.hypot(self.observed.sigmas_rad, np.array(self.spreads_rad)[:, None] * self._leverages())
        return np.stack([wrap_undirected(without_bulge), wrap_undirected(offsets - np.pi / 2)]), sigmas[:, :, None]

    def _densities(self, residuals: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
        """Density of each peak times its fraction, shape (2, n, turns)."""
        return np.array(self.fractions)[:, None, None] * student_density(residuals, sigmas)

    @property
    def _outlier_density(self) -> float:
        """Density of the outliers times their fraction."""
        return (1.0 - sum(self.fractions)) / np.pi

    def log_density(self, turns: np.ndarray) -> np.ndarray:
        """Log-density of each edge with the transverse direction at turns (turns,), shape (n, turns)."""
        return np.log(self._densities(*self._residuals(turns)).sum(axis=0) + self._outlier_density)

    def responsibilities(self, turn: float) -> tuple[np.ndarray, np.ndarray]:
        """Probability of each edge to belong to each peak, and its weight in the turn: (2, n) both."""
        residuals, sigmas = self._residuals(np.array([turn]))
        each = self._densities(residuals, sigmas)[:, :, 0]
        responsibilities = each / (each.sum(axis=0) + self._outlier_density)
        return responsibilities, responsibilities * student_weight(residuals, sigmas)[:, :, 0] / sigmas[:, :, 0] ** 2

    def bulge_effect(self, transverse_weights: np.ndarray) -> tuple[float, float]:
        """Derivative of the turn by the bulge, given weights (n,) of transverse edges; sigma of the bulge."""
        mean = float(transverse_weights @ self.observed.bulge_leverage / max(transverse_weights.sum(), 1e-30))
        information = float(transverse_weights @ (self.observed.bulge_leverage - mean) ** 2) + BULGE_SIGMA_RAD**-2
        return mean, information**-0.5

    def maximisation_step(self, turn: float, weights: np.ndarray) -> _EdgeMixture:
        """Return the mixture after one round with the transverse direction at a turn and edges weighted by (n,)."""
        responsibilities, turn_weights = self.responsibilities(turn)
        residuals, sigmas = self._residuals(np.array([turn]))
        squared = (student_weight(residuals, sigmas) * residuals**2)[:, :, 0]
        weighted, transverse_weights = responsibilities * weights, turn_weights[0] * weights
        sums = np.maximum(weighted.sum(axis=1), 1e-9)
        excess_variances = (weighted * (squared - self.observed.sigmas_rad**2) / self._leverages() ** 2).sum(
            axis=1
        ) / sums
        spreads = np.clip(np.sqrt(np.maximum(excess_variances, 0.0)), MIN_SPREAD_RAD, MAX_SPREAD_RAD)
        mean_leverage, sigma = self.bulge_effect(transverse_weights)
        offsets = residuals[0, :, 0] + self.bulge_rad * self.observed.bulge_leverage
        bulge = (
            transverse_weights @ ((self.observed.bulge_leverage - mean_leverage) * offsets)
            + BULGE_RAD / BULGE_SIGMA_RAD**2
        ) * sigma**2
        fractions = sums / max(weights.sum(), sums.sum() / MAX_PEAK_FRACTION)
        return _EdgeMixture(self.observed, tuple(fractions.tolist()), tuple(spreads.tolist()), float(bulge))


def _peak_position(grid: np.ndarray, values: np.ndarray) -> float:
    """Position of the highest of values (n,) on a regular grid, by a parabola through three."""
    top = int(np.clip(np.argmax(values), 1, len(grid) - 2))
    before, middle, after = values[top - 1 : top + 2]
    curvature = before - 2 * middle + after
    shift = np.clip(0.5 * (before - after) / curvature, -1.0, 1.0) if curvature < 0 else 0.0
    return float(grid[top] + shift * (grid[1] - grid[0]))

"""The rotation of the ground plane about a road, from edges that vehicles have across the road and upright.

Bumpers, windscreens and roof lines are perpendicular to the motion, in the plane of the road; pillars are perpendicular
to both. An image edge lies on a great circle with a normal m. The directions perpendicular to the road d are

    v(turn) = across cos(turn) + (d x across) sin(turn)

and an edge along one of them says which: m . v(turn) = 0. So the turns of many vehicles' edges gather at the direction
across the road, and a quarter of a turn from there at the upright one, whatever the rest does: a mixture of two peaks
and a uniform rest, with vehicles as its independent units. Which peak is which is told by a camera that is not rolled
by 45 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.camera import Camera
from autocalib_ros.estimation.great_circles import TrackSet, earlier_ones, independence, rays_of
from autocalib_ros.estimation.joint import JointFit
from autocalib_ros.estimation.small_matrices import cross, dot
from autocalib_ros.estimation.state import State, level_normal
from autocalib_ros.evidence import Evidence

MAX_EDGES = 1000
"""Edges in one estimate, the longest of each vehicle in turn."""
BESIDE_S = 0.3
"""An edge is of the straight ride of its vehicle when it was seen during a track of it on the road, or so near to it:
between two searches for points."""
END_PX = 0.5
"""Standard deviation of an end of an edge, across it."""
ALONG_ROAD_RAD = np.radians(20.0)
"""An edge that leads so nearly towards the road's vanishing point runs along the vehicle."""
LARGEST_SIGMA_RAD = np.radians(5.0)
"""An edge whose noise leaves its turn less sure tells nothing: a short one, or one seen squarely from the side."""
CORRELATION = 0.3
"""How much the errors of one vehicle's edges correlate: the same bumper is seen again and again."""
LEAST_SPREAD_RAD, LARGEST_SPREAD_RAD = np.radians([0.5, 3.0]), np.radians([3.0, 5.0])
"""Of edges about the direction across and the upright one, in any direction. What is meant to be square to the road is
so, but for its rounding; pillars lean and bodies narrow towards the roof by degrees."""
ROUNDING_RAD, ROUNDING_SIGMA_RAD = np.radians(2.5), np.radians(1.5)
"""Bodies are convex seen from above: of a bumper of 1.8 m that bulges by 4 cm, the half that faces the camera is turned
by 2.5 degrees; from none to twice that is found on the road."""
SYSTEMATIC_RAD = np.radians([0.75, 1.5])
"""What edges of all vehicles may have in common besides: the ends of bumpers rise, sides lean inwards."""
FREEDOM = 4.0
"""Of Student's distribution about a peak: edges of wheels and lamps make long tails."""
LARGEST_TURN = np.pi / 4
"""Rotation about the road from where a camera without roll would have it, beyond which across and upright are one
another's."""
STEPS = 180
"""Turns at which the mixture is looked at: half a degree apart, below any spread."""
ROUNDS = 6
"""Of expectation and maximisation: shares and spreads have settled to a few per cent by then."""
RESAMPLES = 200
MIN_VEHICLES = 8
"""Vehicles whose edges make the peaks; of fewer, one askew or one that changes lanes counts too much."""
MAX_SIGMA_RAD = np.radians(4.0)
"""An estimate that is less sure is none: the resampled ones lie all over, as they do where there are no peaks."""


@dataclass(frozen=True)
class RoadEdges:
    """Edges on vehicles that drive along a road."""

    ends_px: np.ndarray
    """x0, y0, x1, y1, shape (n, 4)."""
    vehicles: np.ndarray
    """Shape (n,)."""

    def __len__(self) -> int:
        return len(self.vehicles)

    def subset(self, keep: np.ndarray) -> RoadEdges:
        """Return the edges that `keep`, a mask or indices, selects."""
        return RoadEdges(self.ends_px[keep], self.vehicles[keep])


def edges_on_road(evidence: Evidence, tracks: TrackSet) -> RoadEdges:
    """Return the edges seen on vehicles while they left tracks, all of which follow one road straight."""
    keep = np.zeros(len(evidence.edges_px), bool)
    for vehicle in np.unique(tracks.vehicles):
        times = tracks.sample_times_s[tracks.vehicles == vehicle]
        edges = np.flatnonzero(evidence.edge_vehicles == vehicle)
        seen = evidence.edge_times_s[edges, None]
        during = (seen >= times.min(axis=1) - BESIDE_S) & (seen <= times.max(axis=1) + BESIDE_S)
        keep[edges] = during.any(axis=1)
    return RoadEdges(evidence.edges_px[keep], evidence.edge_vehicles[keep].astype(int))


@dataclass(frozen=True)
class Turns:
    """What edges tell of the rotation about a road."""

    turns_rad: np.ndarray
    """Shape (n,), modulo half a turn."""
    sigmas_rad: np.ndarray
    """By noise, shape (n,)."""
    apart_rad: np.ndarray
    """Angle between the edge and the way to the road's vanishing point, 0 to a quarter of a turn, shape (n,)."""
    leverage: np.ndarray
    """How much an edge that is not square to the road, by a rotation about the ground's normal, is turned by that: (n,),
    not negative."""
    rounding: np.ndarray
    """The same with its sign and size for an end of a vehicle that bulges, of which the near half is seen: (n,)."""

    def subset(self, keep: np.ndarray) -> Turns:
        """Return those of the edges that `keep`, a mask or indices, selects."""
        return Turns(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))

    @property
    def tells(self) -> np.ndarray:
        """Which edges tell of the rotation, shape (n,)."""
        return (self.apart_rad > ALONG_ROAD_RAD) & (self.sigmas_rad < LARGEST_SIGMA_RAD)


def turns_of(camera: Camera, along: np.ndarray, across: np.ndarray, ends_px: np.ndarray) -> Turns:
    """Return the turns about a road `along` (3,), counted from `across` (3,), of edges (n, 4)."""
    middle, step = (ends_px[:, :2] + ends_px[:, 2:]) / 2, ends_px[:, 2:] - ends_px[:, :2]
    length = np.maximum(np.hypot(*step.T), 1e-9)
    rays = rays_of(camera, middle)
    outward = middle - camera.principal_point_px
    outward = outward / np.maximum(np.hypot(*outward.T), 1e-9)[:, None]

    def moved(way: np.ndarray) -> np.ndarray:
        """Change of the bearing for one pixel along a way (n, 2) in the image."""
        return (rays.radial * (way * outward).sum(axis=1)[:, None]
                + rays.tangential * (way[:, 1] * outward[:, 0] - way[:, 0] * outward[:, 1])[:, None])

    unit = step / length[:, None]
    circles = cross(rays.bearings, moved(unit))
    slopes = cross(rays.bearings, moved(np.column_stack([-unit[:, 1], unit[:, 0]])))
    basis = np.stack([across, np.cross(along, across)])
    (p, q), (slope_p, slope_q) = basis @ circles.T, basis @ slopes.T
    aside2 = np.maximum(p * p + q * q, 1e-30)
    turns = np.arctan2(-p, q)
    towards = cross(rays.bearings, along[None])
    cosine = np.abs(dot(circles, towards)) / np.maximum(np.sqrt(dot(circles, circles) * dot(towards, towards)), 1e-30)
    # m . (v + yaw d + turn d x v) = 0
    leverage = np.abs(circles @ along) / np.sqrt(aside2)
    ahead = rays.bearings @ along
    beside, above = (rays.bearings * (np.column_stack([np.cos(turns), np.sin(turns)]) @ basis)).sum(axis=1), (
        rays.bearings * (np.column_stack([-np.sin(turns), np.cos(turns)]) @ basis)).sum(axis=1)
    oblique = beside / np.maximum(np.hypot(ahead, beside), 1e-9)
    return Turns(turns, np.abs(p * slope_q - q * slope_p) / aside2 * END_PX * np.sqrt(2.0) / length,
                 np.arccos(np.minimum(cosine, 1.0)), leverage, oblique * np.sign(above) * leverage)


@dataclass(frozen=True)
class Peaks:
    """The mixture fitted: where the direction across the road lies, and what every edge has to do with it."""

    turn_rad: float
    """Between plus and minus `LARGEST_TURN`."""
    sigma_rad: float
    weights: np.ndarray
    """How much each edge pulls on the turn, as one across the road and as an upright one, shape (n, 2)."""
    members: np.ndarray
    """Probability of each edge to be of either peak, shape (n, 2)."""
    vehicles: float
    """Number of vehicles that make the peaks, one with less than half of an edge in them counted by that."""


def find_peaks(told: Turns, vehicles: np.ndarray, generator: np.random.Generator) -> Peaks:
    """Fit the mixture to what edges of vehicles (n,) tell.

    Expectation and maximisation for shares and spreads, and for how much the ends of vehicles bulge; the turn by
    looking at all of them; its standard deviation by drawing vehicles anew, with that of the bulge and with what all
    edges have in common.
    """
    turns = (np.arange(STEPS) / STEPS * 2 - 1) * LARGEST_TURN
    weights, mixture = independence(vehicles, CORRELATION), _Mixture(told)
    for _ in range(ROUNDS):
        turn = _highest(turns, weights @ mixture.log_density(turns))
        mixture = mixture.maximised(turn, weights)
    _, owners = np.unique(vehicles, return_inverse=True)
    count = int(owners.max()) + 1
    by_vehicle = np.zeros((count, STEPS))
    np.add.at(by_vehicle, owners, weights[:, None] * mixture.log_density(turns))
    turn = _highest(turns, by_vehicle.sum(axis=0))
    drawn = generator.multinomial(count, np.full(count, 1.0 / count), RESAMPLES)
    misses = np.array([_highest(turns, total) - turn for total in drawn @ by_vehicle])
    members, pulls = mixture.members(turn)
    pulls = pulls * weights[:, None]
    shares = pulls.sum(axis=0) / max(float(pulls.sum()), 1e-30)
    lever, bulge_sigma = mixture.bulging(turn, weights)
    sigma = np.sqrt(np.mean(misses**2) + (shares[0] * lever * bulge_sigma) ** 2 + ((shares * SYSTEMATIC_RAD) ** 2).sum())
    of_vehicle = np.bincount(owners, members.sum(axis=1))
    return Peaks(turn, float(sigma), pulls, members, float(np.minimum(2.0 * of_vehicle, 1.0).sum()))


@dataclass(frozen=True)
class _Mixture:
    """Two peaks, each of Student's distribution, and a uniform rest."""

    told: Turns
    shares: tuple[float, float] = (0.3, 0.1)
    spreads_rad: tuple[float, float] = tuple(np.sqrt(LEAST_SPREAD_RAD * LARGEST_SPREAD_RAD))
    bulge_rad: float = float(ROUNDING_RAD)

    def _misses(self, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far edges lie from the peaks at turns (turns,), and their standard deviations: (2, n, turns), (2, n, 1).

        An edge that is off its direction by an angle to any side is turned by more the longer the lever.
        """
        off = self.told.turns_rad[:, None] - turns
        bulged = off - self.bulge_rad * self.told.rounding[:, None]
        lever = np.stack([np.sqrt(1.0 + self.told.leverage**2), np.ones(len(off))])
        sigmas = np.hypot(self.told.sigmas_rad, np.array(self.spreads_rad)[:, None] * lever)
        return np.stack([folded(bulged), folded(off - np.pi / 2)]), sigmas[:, :, None]

    def _densities(self, misses: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
        """Of each peak, by its share (2, n, turns)."""
        apart = 1.0 + (misses / sigmas) ** 2 / FREEDOM
        return np.array(self.shares)[:, None, None] * STUDENT / sigmas / (apart * apart * np.sqrt(apart))

    def log_density(self, turns: np.ndarray) -> np.ndarray:
        """Logarithm of each edge's density with the direction across the road at turns (turns,), shape (n, turns)."""
        return np.log(self._densities(*self._misses(turns)).sum(axis=0) + (1.0 - sum(self.shares)) / np.pi)

    def members(self, turn: float) -> tuple[np.ndarray, np.ndarray]:
        """Probability of each edge to be of either peak, and how much it then pulls on the turn: (n, 2) both."""
        misses, sigmas = self._misses(np.array([turn]))
        each = self._densities(misses, sigmas)[:, :, 0]
        members = each / (each.sum(axis=0) + (1.0 - sum(self.shares)) / np.pi)
        pulls = members * _robust(misses, sigmas)[:, :, 0] / sigmas[:, :, 0] ** 2
        return members.T, pulls.T

    def bulging(self, turn: float, weights: np.ndarray) -> tuple[float, float]:
        """How much a bulge of one turns what is estimated, and the standard deviation to which it is told."""
        _, pulls = self.members(turn)
        pull = pulls[:, 0] * weights
        mean = float(pull @ self.told.rounding / max(pull.sum(), 1e-30))
        information = float(pull @ (self.told.rounding - mean) ** 2) + ROUNDING_SIGMA_RAD**-2
        return mean, information**-0.5

    def maximised(self, turn: float, weights: np.ndarray) -> _Mixture:
        """Return the mixture after one round with the direction across the road at a turn, edges weighing (n,)."""
        members, pulls = self.members(turn)
        misses, sigmas = self._misses(np.array([turn]))
        misses, robust = misses[:, :, 0], _robust(misses, sigmas)[:, :, 0]
        held = members.T * weights
        sums = np.maximum(held.sum(axis=1), 1e-9)
        lever2 = np.stack([1.0 + self.told.leverage**2, np.ones(len(weights))])
        beyond = (held * (robust * misses**2 - self.told.sigmas_rad**2) / lever2).sum(axis=1) / sums
        spreads = np.clip(np.sqrt(np.maximum(beyond, 0.0)), LEAST_SPREAD_RAD, LARGEST_SPREAD_RAD)
        mean, sigma = self.bulging(turn, weights)
        pull, apart = pulls[:, 0] * weights, self.told.rounding - mean
        without = misses[0] + self.bulge_rad * self.told.rounding
        bulge = (pull @ (apart * without) + ROUNDING_RAD / ROUNDING_SIGMA_RAD**2) * sigma**2
        shares = np.minimum(sums / weights.sum(), LARGEST_SHARE)
        return _Mixture(self.told, tuple(shares.tolist()), tuple(spreads.tolist()), float(bulge))


STUDENT = 0.375
"""Density of Student's distribution with `FREEDOM` at its middle, for a scale of one."""
LARGEST_SHARE = 0.45
"""Of the edges in one peak: some are always of neither."""


def _robust(misses: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    return (FREEDOM + 1.0) / (FREEDOM + (misses / sigmas) ** 2)


def folded(turns_rad: np.ndarray) -> np.ndarray:
    """Bring angles of undirected edges to within a quarter of a turn of 0."""
    return turns_rad - np.pi * np.rint(turns_rad / np.pi)


def _highest(at: np.ndarray, values: np.ndarray) -> float:
    """Where values (n,) on an even grid are highest, by a parabola through three."""
    top = int(np.clip(np.argmax(values), 1, len(at) - 2))
    before, here, after = values[top - 1:top + 2]
    bend = before - 2 * here + after
    shift = np.clip(0.5 * (before - after) / bend, -1.0, 1.0) if bend < 0 else 0.0
    return float(at[top] + shift * (at[1] - at[0]))


@dataclass(frozen=True)
class SquareVehicles:
    """The direction across the road of a solution by the edges of vehicles that are taken as square to it."""

    edges: RoadEdges
    weights: np.ndarray
    """How much each pulls on the direction, shape (n,)."""
    origin: np.ndarray
    """Unit vector (3,) from which turns are counted: the direction across the road at the solution, by edges alone."""
    at_solution_rad: np.ndarray
    """Turns of the edges at the solution, shape (n,)."""
    step_sigma_rad: float
    """Standard deviation of the rotation about the road for a known lens."""
    vehicles: int
    turn_rad: float = 0.0
    """A rotation about the road that another assumption adds."""
    besides: str = ''
    """That assumption in words."""

    def across(self, state: State, step_rad: float = 0.0) -> np.ndarray:
        """Direction (3,) across the first road at a state near the solution, rotated about the road by a step."""
        along = state.directions[0]
        across = self.origin - (self.origin @ along) * along
        across /= np.linalg.norm(across)
        moved = folded(turns_of(state.camera, along, across, self.edges.ends_px).turns_rad - self.at_solution_rad)
        turn = float(self.weights @ moved) / float(self.weights.sum()) + self.turn_rad + step_rad
        return np.cos(turn) * across + np.sin(turn) * np.cross(along, across)

    @property
    def words(self) -> str:
        """What is assumed."""
        return (f'edges of {self.vehicles} vehicles taken as square to it: '
                f'+- {np.degrees(self.step_sigma_rad):.1f} degrees about the road{self.besides}')


def square_vehicles(evidence: Evidence, fit: JointFit, tracks: TrackSet,
                    generator: np.random.Generator) -> SquareVehicles | None:
    """Find the direction across the first road by edges of the vehicles that follow it; None where they do not tell."""
    edges = edges_on_road(evidence, tracks.subset(fit.explained() & (fit.labels == 0)))
    state = fit.state
    along = state.directions[0]
    level = np.cross(level_normal(along), along)
    return _square_to(edges, state, level / np.linalg.norm(level), generator)


def _square_to(edges: RoadEdges, state: State, level: np.ndarray,
               generator: np.random.Generator) -> SquareVehicles | None:
    """Estimate from edges, turns counted from the direction across the road (3,) that a camera without roll has."""
    along = state.directions[0]
    edges = edges.subset(turns_of(state.camera, along, level, edges.ends_px).tells)
    length = np.hypot(*(edges.ends_px[:, 2:] - edges.ends_px[:, :2]).T)
    edges = edges.subset(np.argsort(-length, kind='stable'))
    edges = edges.subset(np.sort(np.argsort(earlier_ones(edges.vehicles), kind='stable')[:MAX_EDGES]))
    if len(np.unique(edges.vehicles)) < MIN_VEHICLES:
        return None
    peaks = find_peaks(turns_of(state.camera, along, level, edges.ends_px), edges.vehicles, generator)
    if peaks.vehicles < MIN_VEHICLES or not peaks.sigma_rad <= MAX_SIGMA_RAD:
        return None
    origin = np.cos(peaks.turn_rad) * level + np.sin(peaks.turn_rad) * np.cross(along, level)
    at_solution = turns_of(state.camera, along, origin, edges.ends_px).turns_rad
    return SquareVehicles(edges, peaks.weights.sum(axis=1), origin, at_solution, peaks.sigma_rad, int(peaks.vehicles))

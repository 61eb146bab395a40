"""Rotation of the ground plane about a road, from transverse and vertical edges of vehicles.

Bumpers, windscreens and roof lines are perpendicular to the motion, in the plane of the road; pillars are
perpendicular to both. An image edge lies on a great circle with a normal m. The directions perpendicular to the road d
are

    v(turn) = across cos(turn) + (d x across) sin(turn)

and an edge along one of them determines it: m . v(turn) = 0. So the turns of the edges of many vehicles cluster at the
transverse direction and, 90 degrees from there, at the vertical one, among outliers (`edge_mixture.py`). Which is
which follows from a camera roll below 45 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState, level_normal
from autocalib_ros.estimation.observations.track_set import TrackSet, count_earlier
from autocalib_ros.estimation.vehicle_edges.edge_mixture import EdgeTurns, find_transverse_peak
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.great_circles import SegmentRays
from autocalib_ros.geometry.robust_kernels import wrap_undirected
from autocalib_ros.geometry.small_matrices import cross, dot
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.statements import Statement, assumption

MAX_EDGES = 1000
"""Most edges in one estimate, the longest of each vehicle in turn."""
MAX_TIME_TO_TRACK_S = 0.3
"""Edges count if they were seen during a track of their vehicle on the road, or within this time of it."""
EDGE_END_SIGMA_PX = 0.5
"""Standard deviation of an end point of an edge, across the edge. Judgement."""
MIN_ANGLE_TO_ROAD_RAD = np.radians(20.0)
"""Edges nearer to the direction of the road's vanishing point run along the vehicle. Judgement."""
MAX_EDGE_SIGMA_RAD = np.radians(5.0)
"""Largest standard deviation of the turn of an edge: short edges, and edges seen squarely from the side, exceed it."""
MIN_PEAK_VEHICLES = 8
"""Fewest vehicles in the peaks; among fewer, one that stands askew or changes lanes weighs too much. Judgement."""
MAX_TURN_SIGMA_RAD = np.radians(4.0)
"""Largest accepted standard deviation: where there are no peaks, the bootstrap samples scatter widely. Judgement."""


@dataclass(frozen=True)
class VehicleEdges:
    """Edges of vehicles that drive along a road."""

    ends_px: np.ndarray
    """x0, y0, x1, y1, shape (n, 4)."""
    vehicles: np.ndarray
    """Shape (n,)."""

    def __len__(self) -> int:
        return len(self.vehicles)

    def subset(self, keep: np.ndarray) -> VehicleEdges:
        """Return the edges that `keep`, a mask or indices, selects."""
        return VehicleEdges(self.ends_px[keep], self.vehicles[keep])


def select_vehicle_edges(evidence: Evidence, tracks: TrackSet) -> VehicleEdges:
    """Return the edges of vehicles seen during their tracks, all of which follow one road straight."""
    keep = np.zeros(len(evidence.edges_px), bool)
    for vehicle in np.unique(tracks.vehicles):
        times = tracks.sample_times_s[tracks.vehicles == vehicle]
        edges = np.flatnonzero(evidence.edge_vehicles == vehicle)
        seen = evidence.edge_times_s[edges, None]
        during = (seen >= times.min(axis=1) - MAX_TIME_TO_TRACK_S) & (seen <= times.max(axis=1) + MAX_TIME_TO_TRACK_S)
        keep[edges] = during.any(axis=1)
    return VehicleEdges(evidence.edges_px[keep], evidence.edge_vehicles[keep].astype(int))


def edge_turns(camera: Camera, along: np.ndarray, across: np.ndarray, ends_px: np.ndarray) -> EdgeTurns:
    """Return the turns of edges (n, 4) about a road `along` (3,), counted from `across` (3,)."""
    edges = SegmentRays.through(camera, ends_px)
    bearings = edges.rays.bearings
    circles, slopes = cross(bearings, edges.along), cross(bearings, edges.aside)
    basis = np.stack([across, np.cross(along, across)])
    (p, q), (slope_p, slope_q) = basis @ circles.T, basis @ slopes.T
    aside2 = np.maximum(p * p + q * q, 1e-30)
    turns = np.arctan2(-p, q)
    towards = cross(bearings, along[None])
    cosine = np.abs(dot(circles, towards)) / np.maximum(np.sqrt(dot(circles, circles) * dot(towards, towards)), 1e-30)
    # an edge along v + yaw d is met at the turn yaw (m . d) / (m . (d x v)), and m is perpendicular to bearing and v
    leverage = np.abs(circles @ along) / np.sqrt(aside2)
    ahead, (beside, above) = bearings @ along, basis @ bearings.T
    beside, above = np.cos(turns) * beside + np.sin(turns) * above, np.cos(turns) * above - np.sin(turns) * beside
    oblique = beside / np.maximum(np.hypot(ahead, beside), 1e-9)
    return EdgeTurns(
        turns,
        np.abs(p * slope_q - q * slope_p) / aside2 * EDGE_END_SIGMA_PX * np.sqrt(2.0) / edges.lengths_px,
        np.arccos(np.minimum(cosine, 1.0)),
        leverage,
        oblique * np.sign(above) * leverage,
    )


@dataclass(frozen=True)
class TransverseDirection:
    """Direction across the road of a solution, from vehicle edges that are assumed square to it."""

    edges: VehicleEdges
    weights: np.ndarray
    """Weight of each edge in the direction, shape (n,)."""
    origin: np.ndarray
    """Unit vector (3,) from which turns are counted: the transverse direction at the solution, from edges alone."""
    reference_turns_rad: np.ndarray
    """Turns of the edges at the solution, shape (n,)."""
    step_sigma_rad: float
    """Standard deviation of the rotation about the road, for a known lens."""
    vehicles: int
    """Vehicles whose edges were used."""
    turn_rad: float = 0.0
    """Rotation about the road that another assumption adds."""
    level_sigma_deg: float | None = None
    """Sigma of the roll, degrees, if the direction combines the edges with a level camera."""

    def across(self, state: AdjustmentState, step_rad: float = 0.0) -> np.ndarray:
        """Direction (3,) across the first road at a state near the solution, after a rotation about the road."""
        along = state.directions[0]
        across = self.origin - (self.origin @ along) * along
        across /= np.linalg.norm(across)
        moved = wrap_undirected(
            edge_turns(state.camera, along, across, self.edges.ends_px).turns_rad - self.reference_turns_rad
        )
        turn = float(self.weights @ moved) / float(self.weights.sum()) + self.turn_rad + step_rad
        return np.cos(turn) * across + np.sin(turn) * np.cross(along, across)

    @property
    def assumption(self) -> Statement:
        """The assumption as a statement."""
        return assumption(
            'transverse_edges',
            vehicles=self.vehicles,
            sigma_deg=np.degrees(self.step_sigma_rad),
            level_sigma_deg=self.level_sigma_deg,
        )


def find_transverse_direction(
    evidence: Evidence, fit: Adjustment, tracks: TrackSet, generator: np.random.Generator
) -> TransverseDirection | None:
    """Find the direction across the first road from edges of the vehicles on it; None if undetermined."""
    following = tracks.subset(fit.inliers() & (fit.labels == 0))
    return transverse_direction_at(select_vehicle_edges(evidence, following), fit.state, generator)


def transverse_direction_at(
    edges: VehicleEdges, state: AdjustmentState, generator: np.random.Generator
) -> TransverseDirection | None:
    """Find the direction across the first road of a state from edges; None if undetermined."""
    along = state.directions[0]
    # turns are counted from where a camera without roll has that direction
    level = np.cross(level_normal(along), along)
    level /= np.linalg.norm(level)
    turns = edge_turns(state.camera, along, level, edges.ends_px)
    edges = edges.subset((turns.angle_to_road_rad > MIN_ANGLE_TO_ROAD_RAD) & (turns.sigmas_rad < MAX_EDGE_SIGMA_RAD))
    edges = _longest_round_robin(edges)
    if len(np.unique(edges.vehicles)) < MIN_PEAK_VEHICLES:
        return None
    peaks = find_transverse_peak(edge_turns(state.camera, along, level, edges.ends_px), edges.vehicles, generator)
    if peaks.vehicles < MIN_PEAK_VEHICLES or not peaks.sigma_rad <= MAX_TURN_SIGMA_RAD:
        return None
    origin = np.cos(peaks.turn_rad) * level + np.sin(peaks.turn_rad) * np.cross(along, level)
    at_solution = edge_turns(state.camera, along, origin, edges.ends_px).turns_rad
    return TransverseDirection(edges, peaks.weights, origin, at_solution, peaks.sigma_rad, peaks.vehicles)


def _longest_round_robin(edges: VehicleEdges) -> VehicleEdges:
    """Keep at most `MAX_EDGES`, the longest of each vehicle first."""
    length = np.hypot(*(edges.ends_px[:, 2:] - edges.ends_px[:, :2]).T)
    edges = edges.subset(np.argsort(-length, kind='stable'))
    return edges.subset(np.sort(np.argsort(count_earlier(edges.vehicles), kind='stable')[:MAX_EDGES]))

"""A start of its own for half of the traffic: the roads that this half shows through the lens of the whole.

A camera that turned in the middle of a recording shows every road twice. The whole then takes one road from one view,
and another from the other; from there, each half finds again what the whole has.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.straight.consensus import consensus_directions
from autocalib_ros.estimation.straight.initialisation import MIN_ROAD_SEPARATION_DEG

CONSENSUS_SEED = 0
"""Seed of the consensus of a half: the same traffic gives the same result."""


def turned_start(state: AdjustmentState, part: TrackSet) -> AdjustmentState | None:
    """Return a state of the whole turned to the two roads of some of the tracks; None if these show no two roads.

    Of all ways in which the roads may correspond, the smallest turn.
    """
    if len(state.angles_rad) < 2:
        return None
    found = consensus_directions(state.camera, part, np.random.default_rng(CONSENSUS_SEED)).directions
    if len(found) < 2:
        return None
    turns = [
        Rotation.align_vectors(directions, known)[0]
        for known in (state.directions[list(pair)] for pair in permutations(range(len(state.angles_rad)), 2))
        for directions in (found * np.array(signs)[:, None] for signs in product((1.0, -1.0), repeat=2))
        if _is_alike(directions, known)
    ]
    if not turns:
        return None
    least = min(turns, key=lambda turn: float(turn.magnitude()))
    return replace(state, rotation=least.as_matrix() @ state.rotation)


def _is_alike(directions: np.ndarray, known: np.ndarray) -> bool:
    """Whether two directions (2, 3) enclose the angle of two known ones, but for less than that between two roads."""
    angles = [np.degrees(np.arccos(np.clip(pair[0] @ pair[1], -1.0, 1.0))) for pair in (directions, known)]
    return bool(abs(angles[0] - angles[1]) < MIN_ROAD_SEPARATION_DEG)

"""Which of the evidence is of vehicles."""

from __future__ import annotations

import numpy as np

from autocalib_ros.evidence.snapshot import Evidence, TrackKind


def drop_pedestrians(evidence: Evidence) -> tuple[Evidence, np.ndarray]:
    """Return the evidence without the tracks of people, and the indices (n,) of those that are left.

    Who walks or cycles keeps to no lane, sways, and has nothing rigid: no model of a road or of a body is of them.
    The published method takes the lens from every track; that is left to it.
    """
    kept = np.flatnonzero(evidence.track_kinds != TrackKind.PERSON)
    return (evidence if len(kept) == evidence.track_count else evidence.select_tracks(kept)), kept

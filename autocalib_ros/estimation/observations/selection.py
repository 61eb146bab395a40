"""Selection of the evidence that comes from vehicles."""

from __future__ import annotations

import numpy as np

from autocalib_ros.evidence.snapshot import Evidence, TrackKind


def drop_pedestrians(evidence: Evidence) -> tuple[Evidence, np.ndarray]:
    """Return the evidence without pedestrians and cyclists, and the indices (n,) of the tracks that are kept.

    They keep to no lane, sway and are not rigid, so no model of a road or a body fits them. The published method uses
    every track and is given all of them.
    """
    kept = np.flatnonzero(evidence.track_kinds != TrackKind.PERSON)
    return (evidence if len(kept) == evidence.track_count else evidence.select_tracks(kept)), kept

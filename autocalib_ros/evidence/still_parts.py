"""Evidence of the still parts of a stream: the present one, and the longest one of before. Never mixed.

Each takes the memory of one `EvidenceBuffer`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from autocalib_ros.config import BufferOptions
from autocalib_ros.evidence.buffer import EvidenceBuffer


@dataclass
class StillPart:
    """Evidence of one still view of the camera."""

    buffer: EvidenceBuffer
    start_s: float
    """Time of its first image, seconds since the first of the stream."""
    newest_s: float = 0.0
    """Time of its newest image, seconds since the first of the stream."""
    frames: int = 0
    tracks_seen: int = 0


class StillParts:
    """Parts by the number of their view."""

    def __init__(self, options: BufferOptions) -> None:
        self._options = options
        self._parts: dict[int, StillPart] = {}

    def part(self, view: int, time_s: float = 0.0) -> StillPart:
        """Return the part of a view; a new one begins at `time_s`."""
        if view not in self._parts:
            self._parts[view] = StillPart(EvidenceBuffer(self._options), time_s)
        return self._parts[view]

    def keep_only(self, views: Collection[int]) -> None:
        """Drop the parts of all other views: no later image can belong to them."""
        self._parts = {view: part for view, part in self._parts.items() if view in views}

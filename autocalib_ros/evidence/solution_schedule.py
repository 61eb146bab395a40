"""When a new solution is worth trying: once there is evidence enough, then as it grows."""

from __future__ import annotations

from autocalib_ros.config import Options
from autocalib_ros.evidence.still_parts import StillPart

WORTHWHILE_GROWTH = 1.0 / 0.85**2
"""Growth of the evidence that cuts a standard deviation by 15 %, since it falls with the root of the tracks."""


class SolutionSchedule:
    """Decides by the images and their stamps alone, so that a live run and a replay solve the same evidence."""

    def __init__(self, options: Options) -> None:
        self._options = options
        self._restart(None)

    def _restart(self, part: StillPart | None) -> None:
        """Plan the first solution of the evidence of a still part."""
        self._part = part
        self._accepted: tuple[StillPart, int, int] | None = None
        self._due_s = self._options.first_solve_s + (0.0 if part is None else part.start_s)
        self._due_tracks = float(self._options.gate.min_tracks)

    def is_due(self, part: StillPart, time_s: float) -> bool:
        """Whether to solve the evidence of a part now, seconds since the first image; if so, plan the next solution."""
        if part is not self._part:
            self._restart(part)
        if time_s < self._due_s or part.tracks_seen < self._due_tracks or not self._is_worth_it(part):
            return False
        tracks = max(part.buffer.track_count, self._options.gate.min_tracks)
        self._due_tracks = part.tracks_seen + (self._options.solve_growth - 1.0) * tracks
        self._due_s = time_s + self._options.solve_interval_s
        return True

    def accepted(self, part: StillPart, tracks: int) -> None:
        """Record that evidence of this many tracks gave a calibration: the next solution is due when it can be better.

        That is when the evidence could cut a standard deviation by 15 %, or when all of it is newer, which verifies the
        calibration by other traffic.
        """
        self._accepted = (part, tracks, part.tracks_seen)

    def _is_worth_it(self, part: StillPart) -> bool:
        """Whether a new solution can be better than an accepted one, or verify it by other traffic."""
        accepted_part, tracks, seen = self._accepted or (None, 0, 0)
        if accepted_part is not part:
            return True
        return part.buffer.track_count >= WORTHWHILE_GROWTH * tracks or part.tracks_seen - seen >= tracks

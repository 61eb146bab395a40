"""KLT tracker: points on moving objects, tracked by pyramidal Lucas-Kanade optical flow (Bouguet 2001)."""

from __future__ import annotations

import cv2
import numpy as np

from autocalib_ros.config import TrackingOptions
from autocalib_ros.evidence.snapshot import Track
from autocalib_ros.perception.frame_gate import match_grey_levels

MAX_TRACK_SAMPLES = 256
"""Most images of one track; a longer one is finished and continued as a new track."""
MIN_TRACK_SAMPLES = 6
"""Least number of samples of a kept track."""
MIN_DISPLACEMENT = 0.02
"""Shortest displacement of a kept track, fraction of the image width. Judgement."""
STATIONARY_S = 1.0
"""Time over which a point must move, seconds."""
STATIONARY_PX = 1.5
"""Least displacement in `STATIONARY_S`, pixels; the track of a slower point ends."""
MAX_GAP_S = 1.0
"""Longest interval between two images, seconds; a longer one ends all tracks."""
GAP_INTERVALS = 2.3
"""Ratio to the previous frame interval above which an interval is a gap, across which velocity predicts."""
GAP_TOLERANCE = 0.25
"""Largest distance from the predicted position after a gap, fraction of the displacement, at least `MAX_TURN_PX`: a
vehicle at 10 m/s that brakes hard for a second misses the prediction by a fifth.
"""
MAX_TURN_PX = 3.0
MAX_TURN_FRACTION = 0.6
MIN_STEP_RATIO, MAX_STEP_RATIO = 0.3, 2.3
"""Continuity of a point that moves more than `MAX_TURN_PX` per image: its next step deviates sideways by at most
`MAX_TURN_PX` or `MAX_TURN_FRACTION` of the step, and its length ratio lies within these limits, which a late or lost
image can cause. A point that stops dead has stuck to an occluder; one that jumps has found another object. Judgement.
"""


class PointTracker:
    """Tracks points from image to image and returns finished tracks, in pixels of the tracked image.

    Tracks end where the mask `excluded` (H, W) is not 0.
    """

    def __init__(self, options: TrackingOptions, excluded: np.ndarray | None = None) -> None:
        self._options, self._excluded = options, excluded
        self._grey: np.ndarray | None = None
        self._time_s = self._interval_s = 0.0
        slots = options.max_points
        self._history = np.zeros((slots, MAX_TRACK_SAMPLES, 3))
        self._count = np.zeros(slots, int)
        self._vehicle = np.zeros(slots, int)
        self._step = np.zeros((slots, 2))

    def follow(self, grey: np.ndarray, time_s: float) -> list[Track]:
        """Track all points into a new grey image (H, W); return the tracks that ended."""
        finished: list[Track] = []
        if self._grey is not None:
            interval_s = time_s - self._time_s
            gap = interval_s > GAP_INTERVALS * self._interval_s > 0
            if not 0 < interval_s <= MAX_GAP_S:
                finished = self.finish_all()
            else:
                before = match_grey_levels(self._grey, grey) if gap else self._grey
                finished = self._follow(before, grey, time_s, interval_s / self._interval_s if gap else 1.0)
            self._interval_s = self._interval_s if gap else interval_s
        self._grey, self._time_s = grey, time_s
        return finished

    def _follow(self, before: np.ndarray, after: np.ndarray, time_s: float, steps: float) -> list[Track]:
        """Track all points, predicted `steps` times their last step ahead: 1, or more across a gap."""
        active = np.flatnonzero(self._count)
        if not len(active):
            return []
        start, predicted = self._current_positions(active), steps * self._step[active]
        found, followed = self._flow(before, after, start, start + predicted)
        step = found - start
        known = self._count[active] > 1
        followed &= (
            known & _near_prediction(predicted, step) if steps > 1 else ~(known & _is_discontinuous(predicted, step))
        )
        kept = active[followed]
        self._history[kept, self._count[kept]] = np.column_stack([np.full(len(kept), time_s), found[followed]])
        self._count[kept] += 1
        self._step[kept] = step[followed] / steps
        ended = np.concatenate([active[~followed], kept[self._is_stationary(kept, time_s)]])
        finished = self._finish(ended)
        return finished + self._restart_full(np.flatnonzero(self._count == MAX_TRACK_SAMPLES))

    def _flow(
        self, before: np.ndarray, after: np.ndarray, start: np.ndarray, guess: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Track forwards from a guess and back at full resolution; return positions (n, 2) and their validity (n,)."""
        side = self._options.window_px
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02)
        origin = _as_opencv_points(start)
        found, forward, _ = cv2.calcOpticalFlowPyrLK(
            before,
            after,
            origin,
            _as_opencv_points(guess),
            winSize=(side, side),
            maxLevel=self._options.pyramid_levels,
            criteria=criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        back, backward, _ = cv2.calcOpticalFlowPyrLK(
            after,
            before,
            found,
            origin.copy(),
            winSize=(side, side),
            maxLevel=0,
            criteria=criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        round_trip_px = np.hypot(*(back - origin)[:, 0].T)
        found = found[:, 0].astype(float)
        margin, (height, width) = side / 2, after.shape
        inside = ((found >= margin) & (found < [width - margin, height - margin])).all(axis=1)
        if self._excluded is not None:
            columns, rows = np.round(np.clip(found, 0, [width - 1, height - 1])).astype(int).T
            inside &= self._excluded[rows, columns] == 0
        good = (
            (forward.ravel() == 1) & (backward.ravel() == 1) & (round_trip_px <= self._options.round_trip_px) & inside
        )
        return found, good

    def _current_positions(self, slots: np.ndarray) -> np.ndarray:
        return self._history[slots, self._count[slots] - 1, 1:]

    def _is_stationary(self, slots: np.ndarray, time_s: float) -> np.ndarray:
        """Return the mask of the slots whose points moved less than `STATIONARY_PX` in the last `STATIONARY_S`."""
        if not len(slots):
            return np.zeros(0, bool)
        times = self._history[slots, :, 0]
        filled = np.arange(MAX_TRACK_SAMPLES) < self._count[slots, None]
        earlier = ((times <= time_s - STATIONARY_S) & filled).sum(axis=1) - 1
        old_enough = earlier >= 0
        then = self._history[slots, np.maximum(earlier, 0), 1:]
        return old_enough & (np.hypot(*(self._current_positions(slots) - then).T) < STATIONARY_PX)

    def positions(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the current positions (n, 2) of the tracked points and their vehicle ids (n,)."""
        active = np.flatnonzero(self._count)
        return self._current_positions(active), self._vehicle[active]

    def steps(self) -> np.ndarray:
        """Return the displacements (n, 2) since the previous image, in the order of `positions`."""
        return self._step[np.flatnonzero(self._count)]

    def add_points(self, points_px: np.ndarray, vehicles: np.ndarray) -> None:
        """Start tracks at points (n, 2), best first, in cells of the spacing that no tracked point occupies."""
        spacing = self._options.min_spacing_px
        near, _ = self.positions()
        taken = {(int(x), int(y)) for x, y in near // spacing}
        free = iter(np.flatnonzero(self._count == 0))
        for point, cell, vehicle in zip(
            points_px, np.floor(points_px / spacing).astype(int).tolist(), vehicles, strict=True
        ):
            if tuple(cell) in taken:
                continue
            slot = next(free, None)
            if slot is None:
                return
            taken.add((cell[0], cell[1]))
            self._history[slot, 0] = (self._time_s, *point)
            self._count[slot], self._vehicle[slot], self._step[slot] = 1, vehicle, 0.0

    def tails(self, steps: int) -> np.ndarray:
        """Return the last positions of the tracked points, (n, steps, 2), newest last.

        The first position is repeated for points with a shorter history.
        """
        active = np.flatnonzero(self._count)
        newest = self._count[active, None] - 1
        return self._history[active[:, None], np.maximum(newest - np.arange(steps)[::-1], 0), 1:]

    def unfinished(self) -> list[Track]:
        """Return the tracks so far of the points still tracked."""
        return self._tracks(np.flatnonzero(self._count))

    def finish_all(self) -> list[Track]:
        """End all tracks and return them."""
        return self._finish(np.flatnonzero(self._count))

    def _finish(self, slots: np.ndarray) -> list[Track]:
        tracks = self._tracks(slots)
        self._count[slots] = 0
        return tracks

    def _restart_full(self, slots: np.ndarray) -> list[Track]:
        """Finish tracks that are full and continue their points as new tracks."""
        tracks = self._tracks(slots)
        self._history[slots, 0] = self._history[slots, MAX_TRACK_SAMPLES - 1]
        self._count[slots] = 1
        return tracks

    def _tracks(self, slots: np.ndarray) -> list[Track]:
        tracks = (self._track(slot) for slot in slots)
        return [track for track in tracks if track is not None]

    def _track(self, slot: int) -> Track | None:
        """Resample the path of a point evenly by arc length; None if it is too short."""
        path = self._history[slot, : self._count[slot]]
        width = self._grey.shape[1] if self._grey is not None else 1
        if len(path) < MIN_TRACK_SAMPLES or np.hypot(*(path[-1, 1:] - path[0, 1:])) < MIN_DISPLACEMENT * width:
            return None
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, 1:], axis=0).T))])
        wanted = np.linspace(0.0, along[-1], min(self._options.max_samples, len(path)))
        chosen = np.unique(np.searchsorted(along, wanted - 1e-9))
        if len(chosen) < MIN_TRACK_SAMPLES:
            return None
        return Track(int(self._vehicle[slot]), path[chosen, 0].copy(), path[chosen, 1:].copy())


def _near_prediction(predicted: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return the mask (n,) of steps (n, 2) across a gap that end near their predictions (n, 2)."""
    return np.hypot(*(step - predicted).T) <= np.maximum(MAX_TURN_PX, GAP_TOLERANCE * np.hypot(*predicted.T))


def _is_discontinuous(before: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Return the mask (n,) of steps (n, 2) that do not continue the previous steps (n, 2)."""
    speed = np.maximum(np.hypot(*before.T), 1e-9)
    along = (before * now).sum(axis=1) / speed
    deviation = np.abs(before[:, 0] * now[:, 1] - before[:, 1] * now[:, 0]) / speed
    astray = deviation > np.maximum(MAX_TURN_PX, MAX_TURN_FRACTION * speed)
    uneven = (along < MIN_STEP_RATIO * speed) | (along > np.maximum(MAX_STEP_RATIO * speed, speed + MAX_TURN_PX))
    return (speed > MAX_TURN_PX) & (astray | uneven)


def _as_opencv_points(points_px: np.ndarray) -> np.ndarray:
    """Return points (n, 2) as a new contiguous array (n, 1, 2) float32, as OpenCV needs it."""
    return np.ascontiguousarray(points_px, np.float32).reshape(-1, 1, 2)

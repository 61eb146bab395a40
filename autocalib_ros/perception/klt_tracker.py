"""KLT tracker: points on moving objects, tracked by pyramidal Lucas-Kanade optical flow (Bouguet 2001)."""

from __future__ import annotations

from collections import deque

import numpy as np

from autocalib_ros.config import TrackingOptions
from autocalib_ros.evidence.snapshot import Track
from autocalib_ros.perception.frame_gate import match_grey_levels
from autocalib_ros.perception.sparse_flow import follow_points

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
"""Ratio to the usual interval between images above which an interval is a gap, across which velocity predicts."""
USUAL_INTERVALS, USUAL_QUANTILE = 31, 0.75
"""Intervals whose upper quartile is the usual one: a second or two, so that a change of the rate is followed within a
second. The upper quartile, because up to half of the images are repeats or lost at random without being gaps."""
FRAME_QUANTILE = 0.25
"""Quantile of these intervals that is one frame of the camera: where half of the images are lost at random, half of the
intervals are single, and the upper quartile is two frames or three."""
SHORTEST_INTERVAL = 0.5
"""Fraction of a frame below which an interval is in doubt, and a frame is taken for velocities."""
SAME_INTERVAL = 0.05
"""Relative difference up to which the ratio of two intervals is one of whole frames: less than the velocity of a
vehicle changes."""
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
MIN_FAST_POINTS = 5
"""Least number of points faster than `MAX_TURN_PX` per image that tell a repeated image."""
UNCHANGED, UNCHANGED_FRACTION = 0.5, 2 / 3
"""Largest change of the surroundings of a point that stands still, fraction of their contrast (where a fast point was,
they change by all of it) and of the change at the place where it should be (an edge along its path looks the same at
both), and the fraction of the fast points that stand still in a repeated image. Vehicles do not
stop together from one image to the next; points stick to an occluder one by one.
"""
ONE_STEP_FRACTION = 2 / 3
"""Fraction of the moving points that make one more of their steps in an image that follows at the usual interval. From
image to image one in ten or twenty is lost; after a pause few find their surroundings again, and hardly two of them
where one step leads."""
MIN_SCALED_STEP_PX = 1.0
"""Least step, pixels per image, of a point that tells how far points moved across repeated images: noise is a fifth."""
MAX_SCALED_POINTS = 60
"""Most points that tell it; their median is then known to a few percent."""


class PointTracker:
    """Tracks points from image to image and returns finished tracks, in pixels of the tracked image.

    Tracks end where the mask `excluded` (H, W) is not 0.
    """

    def __init__(self, options: TrackingOptions, excluded: np.ndarray | None = None) -> None:
        self._options, self._excluded = options, excluded
        self._grey: np.ndarray | None = None
        self._time_s = self._interval_s = 0.0
        self._repeats = 0
        self._intervals_s: deque[float] = deque(maxlen=USUAL_INTERVALS)
        self._times_s: deque[float] = deque(maxlen=MAX_TRACK_SAMPLES)
        """Times of the last images; each point was in all of them since its track started."""
        slots = options.max_points
        self._history = np.zeros((slots, MAX_TRACK_SAMPLES, 3))
        self._count = np.zeros(slots, int)
        self._vehicle = np.zeros(slots, int)
        self._step = np.zeros((slots, 2))

    def is_repeat(self, grey: np.ndarray, time_s: float) -> bool:
        """Return whether the fast points all stand still in a grey image (H, W): it repeats the last one."""
        if self._grey is None or not 0 < time_s - self._time_s <= MAX_GAP_S:
            return False
        fast = np.flatnonzero((self._count > 1) & (np.hypot(*self._step.T) > MAX_TURN_PX))
        if len(fast) < MIN_FAST_POINTS:
            return False
        positions = self._current_positions(fast)
        here, there = (self._windows(grey.shape, points) for points in (positions, positions + self._step[fast]))
        before, after, moved = _pixels(self._grey, here), _pixels(grey, here), _pixels(grey, there)
        change, change_if_moved = (np.abs(image - before).mean(axis=1) for image in (after, moved))
        contrast = np.abs(before - before.mean(axis=1, keepdims=True)).mean(axis=1)
        unchanged = change < UNCHANGED * np.minimum(contrast, change_if_moved)
        return bool(unchanged.mean() > UNCHANGED_FRACTION)

    def moved_one_step(self, grey: np.ndarray) -> bool:
        """Return whether the moving points are one step further in a grey image (H, W), whatever time has passed.

        False with fewer than `MIN_FAST_POINTS` of them. After a pause of some seconds other things are in their places,
        and after lost images they are two steps further or more.
        """
        if self._grey is None or self._repeats:
            return False
        fastest = self._fastest(np.flatnonzero(self._count))
        if len(fastest) < MIN_FAST_POINTS:
            return False
        start, step = self._current_positions(fastest), self._step[fastest]
        found, good = self._flow(self._grey, grey, start, start + step)
        good &= np.hypot(*(found - start - step).T) <= GAP_TOLERANCE * np.hypot(*step.T)
        return bool(good.mean() > ONE_STEP_FRACTION)

    def _windows(self, shape: tuple[int, ...], points_px: np.ndarray) -> np.ndarray:
        """Return the indices (n, window_px squared) of the pixels around points (n, 2) in an image of `shape`."""
        reach = np.arange(self._options.window_px) - self._options.window_px // 2
        columns, rows = np.round(points_px).astype(int).T[..., None] + reach
        rows, columns = np.clip(rows, 0, shape[0] - 1), np.clip(columns, 0, shape[1] - 1)
        return (rows[:, :, None] * shape[1] + columns[:, None, :]).reshape(len(points_px), -1)

    def skip_repeat(self) -> None:
        """Count a repeated image that is left out: the next step is over one more frame interval."""
        self._repeats += 1

    def exclude(self, excluded: np.ndarray | None) -> None:
        """Replace the mask `excluded` (H, W) at which tracks end."""
        self._excluded = excluded

    def follow(self, grey: np.ndarray, time_s: float) -> list[Track]:
        """Track all points into a grey image (H, W) unless it is a repeat; return the tracks that ended."""
        if self.is_repeat(grey, time_s):
            self.skip_repeat()
            return []
        return self.follow_new(grey, time_s)

    def follow_new(self, grey: np.ndarray, time_s: float) -> list[Track]:
        """Track all points into a grey image (H, W) that is no repeat; return the tracks that ended."""
        finished: list[Track] = []
        intervals, self._repeats = self._repeats + 1, 0
        if self._grey is not None:
            interval_s = time_s - self._time_s
            if not 0 < interval_s <= MAX_GAP_S:
                finished = self.finish_all()
                self._times_s.clear()
            else:
                self._intervals_s.append(interval_s / intervals)  # repeats are images too
                frame_s, usual_s = np.quantile(self._intervals_s, (FRAME_QUANTILE, USUAL_QUANTILE)).tolist()
                gap = interval_s > GAP_INTERVALS * usual_s
                before = match_grey_levels(self._grey, grey) if gap else self._grey
                interval_s = frame_s if interval_s < SHORTEST_INTERVAL * frame_s else interval_s
                finished = self._follow(before, grey, time_s, interval_s, gap, after_repeats=intervals > 1)
                if intervals == 1 or not self._interval_s:
                    self._interval_s = interval_s
        self._grey, self._time_s = grey, time_s
        self._times_s.append(time_s)
        return finished

    def _follow(
        self, before: np.ndarray, after: np.ndarray, time_s: float, interval_s: float, gap: bool, after_repeats: bool
    ) -> list[Track]:
        """Track all points, predicted by their velocity over the interval; across a gap they must end near there.

        After repeats the points tell how many of their steps they moved; the steps stay those of one interval.
        """
        active = np.flatnonzero(self._count)
        if not len(active):
            return []
        steps = _whole(interval_s / self._interval_s if self._interval_s > 0 else 1.0)
        if after_repeats:
            steps = self._measured_steps(before, after, active, max(steps, 1.0))
        start = self._current_positions(active)
        predicted = self._step[active] * steps
        known = self._count[active] > 1
        if gap:
            known |= self._predict_new(active, known, predicted)
        found, followed = self._flow(before, after, start, start + predicted)
        step = found - start
        near = gap and not after_repeats
        followed &= known & _near_prediction(predicted, step) if near else ~(known & _is_discontinuous(predicted, step))
        kept = active[followed]
        self._history[kept, self._count[kept]] = np.column_stack([np.full(len(kept), time_s), found[followed]])
        self._count[kept] += 1
        self._step[kept] = step[followed] / (steps if after_repeats else 1.0)
        ended = np.concatenate([active[~followed], kept[self._is_stationary(kept, time_s)]])
        finished = self._finish(ended)
        return finished + self._restart_full(np.flatnonzero(self._count == MAX_TRACK_SAMPLES))

    def _measured_steps(self, before: np.ndarray, after: np.ndarray, active: np.ndarray, most: float) -> float:
        """Return how many of their last steps the points moved across repeats: `most` if nothing moves.

        The stamps do not tell: of a camera of 25 images per second that is recorded with 30, the image after a repeat
        is one step on; after a stall, as many as intervals passed.
        """
        fastest = self._fastest(active)
        measured, support = most, 0
        if not len(fastest):
            return measured
        start, step = self._current_positions(fastest), self._step[fastest]
        for guess in (*2.0 ** np.arange(np.ceil(np.log2(most))), most):
            found, good = self._flow(before, after, start, start + guess * step)
            ratio = ((found - start) * step).sum(axis=1) / (step**2).sum(axis=1)
            good &= (ratio >= MIN_STEP_RATIO) & (ratio <= MAX_STEP_RATIO * most)
            if not good.any():
                continue
            middle = float(np.median(ratio[good]))
            agreeing = int((good & (np.abs(ratio - middle) <= GAP_TOLERANCE * middle)).sum())
            if agreeing > support:
                measured, support = middle, agreeing
        return measured

    def _fastest(self, active: np.ndarray) -> np.ndarray:
        """Return the slots (n,) of the points whose steps tell a velocity, fastest first."""
        speed = np.hypot(*self._step[active].T) * (self._count[active] > 1)
        fastest = active[np.argsort(-speed, kind='stable')[:MAX_SCALED_POINTS]]
        return fastest[np.hypot(*self._step[fastest].T) >= MIN_SCALED_STEP_PX]

    def _predict_new(self, active: np.ndarray, known: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """Predict new points (not `known`) by the median of their vehicle, in place; return the mask (n,) of these."""
        vehicles = self._vehicle[active]
        found = np.zeros(len(active), bool)
        for vehicle in np.unique(vehicles[~known]):
            same = vehicles == vehicle
            if (same & known).any():
                predicted[same & ~known] = np.median(predicted[same & known], axis=0)
                found |= same & ~known
        return found

    def _flow(
        self, before: np.ndarray, after: np.ndarray, start: np.ndarray, guess: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Track forwards from a guess and back at full resolution; return positions (n, 2) and their validity (n,)."""
        options = self._options
        ends, round_trip_px, tracked = follow_points(
            before, after, start, guess, window_px=options.window_px, levels=options.pyramid_levels
        )
        found = ends.astype(float)
        margin, (height, width) = options.window_px / 2, after.shape
        inside = ((found >= margin) & (found < [width - margin, height - margin])).all(axis=1)
        if self._excluded is not None:
            columns, rows = np.round(np.clip(found, 0, [width - 1, height - 1])).astype(int).T
            inside &= self._excluded[rows, columns] == 0
        return found, tracked & (round_trip_px <= options.round_trip_px) & inside

    def _current_positions(self, slots: np.ndarray) -> np.ndarray:
        return self._history[slots, self._count[slots] - 1, 1:]

    def _is_stationary(self, slots: np.ndarray, time_s: float) -> np.ndarray:
        """Return the mask of the slots whose points moved less than `STATIONARY_PX` in the last `STATIONARY_S`."""
        if not len(slots):
            return np.zeros(0, bool)
        newer = 1 + sum(1 for earlier_s in self._times_s if earlier_s > time_s - STATIONARY_S)
        earlier = self._count[slots] - 1 - newer
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


def _pixels(grey: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return the pixels (n, m) of a grey image (H, W) at indices, as float32."""
    return grey.ravel().take(indices).astype(np.float32)


def _whole(ratio: float) -> float:
    """Return a ratio of two intervals, as one of whole numbers of frames where it is near one to them."""
    frames = round(max(ratio, 1.0 / ratio))
    nearest = float(frames) if ratio >= 1.0 else 1.0 / frames
    return nearest if abs(ratio - nearest) <= SAME_INTERVAL * nearest else ratio


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

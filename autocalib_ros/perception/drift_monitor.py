"""Does the camera stand still: follows the background of its view, and says where another view begins."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import cv2
import numpy as np

from autocalib_ros.evidence.stillness import Stillness, ViewChange, ViewChangeKind
from autocalib_ros.perception.background import median
from autocalib_ros.perception.background_motion import LAMP_QUANTILE, PictureMotion
from autocalib_ros.perception.ratio_test import distinctive_matches
from autocalib_ros.perception.reductions import Reductions
from autocalib_ros.perception.still_view import StillView

WIDTH_PX = 640
"""Image width at which the background is followed."""
SETTLED_S = 2.0
"""Time for which another view has to stand before it counts, seconds: longer than a shutter is closed, shorter than
any scene from which traffic can be learnt."""
GRACE_S = 0.5
"""Time for which images that do not show the view are used as before, seconds: a lorry close by hides it for longer
only in a queue."""
SEARCH_INTERVAL_S = 0.25
"""Least interval between two wide searches for a view that is lost, seconds."""
SEARCH_FEATURES = 600
"""Most keypoints by which two views are compared, once when the view changes."""
MIN_COMMON_KEYPOINTS = 12
"""Least keypoints that two views of one scene have in common, on one similarity of four parameters."""
MIN_COMMON_SHARE = 0.25
"""Least share of the keypoint matches on that similarity. Judgement: chance gives two or three."""
COMMON_PX = 3.0
"""Distance within which matches lie on one similarity, pixels of the reduced image: a zoom lens is no exact one."""
MIN_ZOOM = 1.02
"""Least zoom factor that is called a zoom: below it the displacement in pixels says more."""
CALM_INTERVAL_S = 0.1
"""Least interval between two measurements of a view without sway, seconds: a third of the period of the fastest sway,
3 Hz, so that it is noticed in its first periods."""
SAMPLE_INTERVAL_S, SAMPLES = 0.25, 5
"""Interval and number of images whose median is tried as a view that no single image shows: on a full road most corners
of one image lie on vehicles, which drive on within half a second."""
SETTLED_SHARE = 0.95
"""Least share of the images of the first rest position within the sway: fewer show that the camera came to rest only
then."""
BLIND_S = 5.0
"""Time after which images are used although no background was ever seen in them, seconds: by night there may be nothing
but lamps, and nothing says then that the camera moves."""
MAX_ZOOM = 5.0
"""Largest zoom factor between two views that have keypoints in common; beyond it matches have collapsed to a point."""
MAX_CHANGES = 64
"""Newest changes of the view in memory."""


@dataclass(frozen=True)
class DriftLimits:
    """What counts as standing still, pixels of the images passed to `DriftMonitor.update`."""

    drift_px: float = 3.0
    """Largest lasting displacement."""
    sway_px: float = 6.4
    """Largest displacement about the rest position."""
    least_sway_px: float = 0.25
    """Least sway that is compensated."""


@dataclass(frozen=True)
class ImagePose:
    """What one image says about the camera."""

    view: int
    """Number of the still view; evidence of different numbers does not belong together."""
    is_usable: bool
    """False while the camera moves or shows something else."""
    motion: PictureMotion = field(default_factory=PictureMotion)
    """Motion of the picture from the pose of the evidence, to be compensated; the identity if it stands still."""

    @property
    def is_compensated(self) -> bool:
        """Whether there is a motion to compensate."""
        return self.motion.shift != 0 or self.motion.scale != 1


class DriftMonitor:
    """Follows one stream; keeps the present view and the longest one of before, which may come back.

    Corners are detected only where the mask `ignored` (H, W) is 0.
    """

    def __init__(self, limits: DriftLimits | None = None, ignored: np.ndarray | None = None) -> None:
        self._limits, self._ignored = limits or DriftLimits(), ignored
        self._factor = 1.0
        self._view: StillView | None = None
        self._kept: StillView | None = None
        self._candidate: StillView | None = None
        self._unsettled_s: float | None = None
        self._search_due_s = self._due_s = -np.inf
        self._seen_s = -np.inf
        self._is_away = self._is_left = False
        self._samples: deque[tuple[float, np.ndarray]] = deque(maxlen=SAMPLES)
        self._numbers = 0
        self._changes: deque[ViewChange] = deque(maxlen=MAX_CHANGES)
        self._newest_s = 0.0
        self._lowest = self._highest = np.zeros(2)

    def exclude(self, ignored: np.ndarray | None) -> None:
        """Replace the mask `ignored` (H, W); corners there are dropped."""
        self._ignored = ignored
        for view in filter(None, (self._view, self._kept, self._candidate)):
            view.exclude(self._ignored_of(view.size))

    def update(self, grey: np.ndarray, time_s: float, reductions: Reductions | None = None) -> ImagePose:
        """Take a grey image (H, W); say whether it shows the present view, and how far the picture moved.

        There may be `reductions` of the image.
        """
        self._newest_s, reductions = time_s, reductions or Reductions(grey)
        view = self._view
        if self._is_left and view is not None:
            self._is_left = False
            reduced = self._reduced(reductions, grey.shape)
            new = self._new_view(self._next_number(), reduced, time_s)
            new.position = view.position + view.last.shift
            self._adopt(new, ViewChange(ViewChangeKind.TURN, time_s, time_s, view.moved_px * self._factor))
            return ImagePose(new.number, True)
        if view is not None and self._unsettled_s is None and time_s < self._due_s:
            return ImagePose(view.number, True)
        reduced = self._reduced(reductions, grey.shape)
        if view is None or not view.reference.is_textured:
            view = self._begin_or_wait(view, reduced, time_s)
        else:
            motion = view.motion_to(reduced)
            if motion is not None and self._is_near(view, motion):
                return self._take(view, reduced, motion, time_s)
            view = self._seek(view, reduced, motion, time_s)
        return ImagePose(view.number, self._is_trusted(view, time_s))

    def _is_trusted(self, view: StillView, time_s: float) -> bool:
        """Whether to use an image that does not show the view: for a moment, or where there never was anything."""
        if self._unsettled_s is None:
            return True
        if view.still_s < GRACE_S:
            return time_s - max(self._unsettled_s, self._seen_s) >= BLIND_S
        return not self._is_away and time_s - self._unsettled_s < GRACE_S

    def image_of_view(self, number: int) -> tuple[np.ndarray, np.ndarray | None] | None:
        """Return the reference image (h, w) of a view in memory, in the pose of its evidence, and what to ignore."""
        view = next((one for one in (self._view, self._kept) if one is not None and one.number == number), None)
        return None if view is None else (view.image_of_evidence(), view.ignored)

    def leave(self) -> None:
        """Begin another view with the next image: the camera is known to have moved."""
        self._is_left = self._view is not None

    def change_limits(self, limits: DriftLimits) -> None:
        """Take other limits from the next image on."""
        self._limits = limits

    def _reduced(self, reductions: Reductions, shape: tuple[int, ...]) -> np.ndarray:
        """Return an image of `shape` in the size at which views are compared."""
        self._factor = max(1.0, shape[1] / WIDTH_PX)
        return reductions.at((round(shape[1] / self._factor), round(shape[0] / self._factor)))

    def _begin_or_wait(self, view: StillView | None, reduced: np.ndarray, time_s: float) -> StillView:
        """Begin with the first image that has corners: dark, foggy or covered ones say nothing about the pose."""
        if view is None or time_s >= self._search_due_s:
            self._search_due_s = time_s + SEARCH_INTERVAL_S
            number, start_s = (self._next_number(), time_s) if view is None else (view.number, view.start_s)
            view = self._new_view(number, reduced, time_s)
            view.start_s = start_s
            self._view = view
        return view

    def _next_number(self) -> int:
        self._numbers += 1
        return self._numbers - 1

    def _new_view(self, number: int, reduced: np.ndarray, time_s: float) -> StillView:
        ignored = self._ignored_of((reduced.shape[1], reduced.shape[0]))
        return StillView(number, reduced, time_s, ignored, self._limits.least_sway_px / self._factor)

    def _ignored_of(self, size: tuple[int, int]) -> np.ndarray | None:
        return None if self._ignored is None else cv2.resize(self._ignored, size, interpolation=cv2.INTER_NEAREST)

    def _is_near(self, view: StillView, motion: PictureMotion) -> bool:
        """Whether an image is within the sway about the rest position, which is twice as wide until that is known."""
        limit = self._limits.sway_px / self._factor * (1.0 if view.first_rest is not None else 2.0)
        return view.distance_px(motion, view.rest) <= limit

    def _take(self, view: StillView, reduced: np.ndarray, motion: PictureMotion, time_s: float) -> ImagePose:
        self._unsettled_s, self._candidate, self._is_away = None, None, False
        compensation = view.take(reduced, motion, time_s)
        self._due_s = -np.inf if view.is_swaying else time_s + CALM_INTERVAL_S
        self._travel(view.position + motion.shift)
        if view.displacement_px > self._limits.drift_px / self._factor:
            self._leave_by_drift(view, reduced, time_s)
        elif view.first_rest is not None and not view.is_confirmed:
            within = view.share_within(self._limits.sway_px / self._factor)
            view.is_confirmed = within >= SETTLED_SHARE and view.halves_px <= self._limits.drift_px / self._factor
            if not view.is_confirmed:
                self._leave_by_drift(view, reduced, time_s)
        return ImagePose(view.number, True, compensation.enlarged(self._factor))

    def _leave_by_drift(self, view: StillView, reduced: np.ndarray, time_s: float) -> None:
        """Begin another view where the rest position is displaced for good, or was none."""
        slow = view.is_confirmed and not view.moved_at_once
        start_s = view.left_s() if view.is_confirmed and not slow else view.start_s
        amount = (view.moved_px if view.is_confirmed else view.spread_px) * self._factor
        new = self._new_view(self._next_number(), reduced, time_s)
        new.position = view.position + view.last.shift
        if not view.is_confirmed:
            view.still_s = 0.0
        self._adopt(new, ViewChange(ViewChangeKind.DRIFT if slow else ViewChangeKind.TURN, start_s, time_s, amount))

    def _seek(self, view: StillView, reduced: np.ndarray, motion: PictureMotion | None, time_s: float) -> StillView:
        """Find out what an image shows that is not near the rest position: the view again, an earlier one, another."""
        if self._unsettled_s is None:
            self._unsettled_s, self._search_due_s = time_s, time_s
            self._samples.clear()
        self._is_away = motion is not None
        if motion is not None:
            view.last = motion
            self._travel(view.position + motion.shift)
        elif time_s >= self._search_due_s:
            self._search_due_s = time_s + SEARCH_INTERVAL_S
            for known in filter(None, (view, self._kept)):
                found = known.motion_to(reduced, wide=True)
                if found is None or not self._is_near(known, found):
                    continue
                known.last = found
                if known.motion_to(reduced) is None:  # the light is another one, or this is a fade
                    if time_s - self._unsettled_s < SETTLED_S:
                        continue
                    known.replace_reference(self._new_view(-1, reduced, time_s).reference, found)
                self._come_back(known, found, time_s)
                return known
        self._try(view, reduced, time_s)
        return self._view or view

    def _come_back(self, known: StillView, motion: PictureMotion, time_s: float) -> None:
        """Go on with a view that was there before."""
        known.last, known.newest_s = motion, time_s
        if known is not self._view:
            start_s = time_s if self._unsettled_s is None else self._unsettled_s
            self._changes.append(ViewChange(ViewChangeKind.CUT, start_s, time_s))
            self._view, self._kept = known, self._view
        self._unsettled_s = self._candidate = None

    def _try(self, view: StillView, reduced: np.ndarray, time_s: float) -> None:
        """Follow a candidate for the next view; adopt it when it has stood for `SETTLED_S`."""
        if not self._samples or time_s - self._samples[-1][0] >= SAMPLE_INTERVAL_S:
            self._samples.append((time_s, reduced))
        candidate = self._candidate
        if candidate is None:
            self._candidate = self._new_view(-1, reduced, time_s)
            self._candidate.position = view.position + view.last.shift
            return
        motion = candidate.motion_to(reduced)
        if motion is None:
            if time_s >= self._due_s:
                self._due_s = time_s + CALM_INTERVAL_S
                self._candidate = self._next_candidate(reduced, time_s)
            return
        self._seen_s = time_s
        self._travel(candidate.position + motion.shift)
        if candidate.distance_px(motion, candidate.rest) > self._limits.drift_px / self._factor:
            self._candidate = self._new_view(-1, reduced, time_s)
            self._candidate.position = candidate.position + motion.shift
            return
        candidate.take(reduced, motion, time_s)
        if time_s - candidate.start_s >= SETTLED_S:
            self._settle(view, candidate, time_s)

    def _settle(self, view: StillView, candidate: StillView, time_s: float) -> None:
        """Compare a candidate that has stood with the views in memory: one of them in other light, or another one."""
        start_s = candidate.start_s if self._unsettled_s is None else self._unsettled_s
        if self._is_away:  # the view is still recognised, elsewhere
            self._adopt(candidate, self._described(view.last.after(view.rest.inverse()), start_s, time_s))
            return
        known = [one for one in (view, self._kept) if one is not None]
        common = [_similarity_of_views(one.reference.image, candidate.reference.image) for one in known]
        for one, motion in zip(known, common, strict=True):
            if motion is not None and self._is_near(one, motion.after(one.base)):
                one.replace_reference(candidate.reference, motion.after(one.base))
                self._come_back(one, one.base, time_s)
                return
        self._adopt(candidate, self._described(common[0], start_s, time_s))

    def _next_candidate(self, reduced: np.ndarray, time_s: float) -> StillView:
        """Return the next candidate after one that was lost: the median of some images in turn with a single one."""
        if len(self._samples) < SAMPLES:
            return self._new_view(-1, reduced, time_s)
        start_s = self._samples[0][0]
        new = self._new_view(-1, median([image for _, image in self._samples]), time_s)
        self._samples.clear()
        if new.motion_to(reduced) is not None:
            new.start_s = start_s
        return new

    def _adopt(self, new: StillView, change: ViewChange) -> None:
        """Make another view the present one; keep the longer of the earlier ones."""
        new.number = self._next_number() if new.number < 0 else new.number
        if change.kind is not ViewChangeKind.CUT or self._view is None or self._view.still_s >= SETTLED_S:
            self._changes.append(change)
        else:  # what was there before was no view: images full of traffic, or a fade
            self._view = None
        if self._kept is None or (self._view is not None and self._view.still_s >= self._kept.still_s):
            self._kept = self._view
        self._view, self._candidate, self._unsettled_s = new, None, None

    def _described(self, motion: PictureMotion | None, start_s: float, time_s: float) -> ViewChange:
        """Say how another view differs from the one before by the motion between them; None if there is none."""
        if motion is None:
            return ViewChange(ViewChangeKind.CUT, start_s, time_s)
        factor = abs(motion.scale)
        if max(factor, 1 / factor) >= MIN_ZOOM:
            return ViewChange(ViewChangeKind.ZOOM, start_s, time_s, factor)
        moved_px = 0.0 if self._view is None else motion.largest_px(self._view.size) * self._factor
        return ViewChange(ViewChangeKind.TURN, start_s, time_s, moved_px)

    def _travel(self, position: complex) -> None:
        place = np.array([position.real, position.imag])
        self._lowest, self._highest = np.minimum(self._lowest, place), np.maximum(self._highest, place)

    @property
    def newest_change(self) -> ViewChange | None:
        """The newest change of the view, in pixels of the images passed to `update`; None without one."""
        return self._changes[-1] if self._changes else None

    @property
    def drift_px(self) -> float:
        """Largest lasting displacement of the present view, pixels of the images passed to `update`."""
        return 0.0 if self._view is None else self._drift_px(self._view)

    def _drift_px(self, view: StillView) -> float:
        """Return the lasting displacement in a view; between halves of it until its rest position is known."""
        return (view.drift_px if view.is_confirmed else view.halves_px) * self._factor

    @property
    def views(self) -> dict[int, float]:
        """Numbers of the views in memory, the present one last, with the seconds that each was seen and still."""
        known = [view for view in (self._kept, self._view) if view is not None]
        return {view.number: view.still_s for view in known}

    def stillness(self, number: int) -> tuple[float, Stillness]:
        """Return the drift in pixels of a view in memory, and how still the camera stood in it."""
        view = next(view for view in (self._view, self._kept) if view is not None and view.number == number)
        return self._drift_px(view), Stillness(
            start_s=view.start_s,
            end_s=max(view.newest_s, view.start_s),
            recorded_s=self._newest_s,
            sway_px=view.sway_px * self._factor,
            travel_px=float(np.hypot(*(self._highest - self._lowest))) * self._factor,
            changes=(*self._changes, *self._unfinished()),
        )

    def _unfinished(self) -> tuple[ViewChange, ...]:
        """Return the change that is going on, if it lasts for longer than `SETTLED_S`."""
        if self._unsettled_s is None or self._newest_s - self._unsettled_s < SETTLED_S or self._view is None:
            return ()
        candidate = self._candidate
        amount = 0.0 if candidate is None else abs(candidate.position - self._view.position) * self._factor
        return (ViewChange(ViewChangeKind.MOTION, self._unsettled_s, self._newest_s, amount),)


def _similarity_of_views(before: np.ndarray, after: np.ndarray) -> PictureMotion | None:
    """Return the motion that takes most keypoints of one grey image (H, W) to another of one scene; None if none does.

    SIFT (Lowe 2004), ratio test, RANSAC with OpenCV's fixed seed.
    """
    sift = cv2.SIFT_create(SEARCH_FEATURES)  # type: ignore[attr-defined]  # for OpenCV 4.5
    (points, words), (others, other_words) = (
        sift.detectAndCompute(_stretched(image), None) for image in (before, after)
    )
    if words is None or other_words is None or min(len(points), len(others)) < MIN_COMMON_KEYPOINTS:
        return None
    good = distinctive_matches(words, other_words)
    if len(good) < MIN_COMMON_KEYPOINTS:
        return None
    starts = np.array([points[index].pt for index in good[:, 0]])
    ends = np.array([others[index].pt for index in good[:, 1]])
    matrix, inliers = cv2.estimateAffinePartial2D(starts, ends, ransacReprojThreshold=COMMON_PX)
    if matrix is None or inliers.sum() < max(MIN_COMMON_KEYPOINTS, MIN_COMMON_SHARE * len(good)):
        return None
    scale = complex(matrix[0, 0], matrix[1, 0])
    if not 1 / MAX_ZOOM <= abs(scale) <= MAX_ZOOM:
        return None
    centre = complex((before.shape[1] - 1) / 2, (before.shape[0] - 1) / 2)
    return PictureMotion(scale * centre + complex(matrix[0, 2], matrix[1, 2]) - centre, scale)


def _stretched(image: np.ndarray) -> np.ndarray:
    """Return a grey image (H, W) that fills the range of grey levels but for lamps: keypoints need contrast."""
    low, high = (float(level) for level in np.quantile(image[::2, ::2], (1 - LAMP_QUANTILE, LAMP_QUANTILE)))
    return np.clip((image - low) * (255.0 / max(high - low, 16.0)), 0, 255).astype(np.uint8)

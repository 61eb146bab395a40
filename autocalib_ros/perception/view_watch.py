"""Watches the view that belongs to a calibration: does the camera still stand as it did, and does it see anything.

About once a second the image is registered to the reference of the calibration. A single registration is good to a
hundredth of a degree; sway and noise are told from a move by the mean over several seconds against its own scatter.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property

import cv2
import numpy as np

from autocalib_ros.config import Polygons
from autocalib_ros.errors import UsageError
from autocalib_ros.lens.camera import Camera
from autocalib_ros.perception.background import median
from autocalib_ros.perception.ignore_regions import IgnoreMask, union
from autocalib_ros.perception.picture_faults import (
    BLURRED_RATIO,
    Detail,
    FreezeDetector,
    PictureFault,
    exposure_fault,
)
from autocalib_ros.perception.view_registration import ViewPose, ViewReference, normalised, registered_image
from autocalib_ros.results.camera_move import (
    MAX_BUMP_DEG,
    MIN_MOVE_ZOOM,
    CameraMove,
    MoveKind,
    kind_of_move,
    rotation_angle_deg,
)

CHECK_S = 1.2
"""Mean interval between two registrations, seconds."""
INTERVAL_SPREAD = 0.4
"""How much single intervals differ from it, as a fraction: evenly spaced ones would see a mast that sways once a second
always in the same place."""
MIN_MOVE_DEG = 0.2
"""Least lasting turn that is told, degrees: 0.7 m on the road 40 m from a camera of 8 m, the standard deviation of a
good calibration. Moves of 0.3 degrees are to be told for certain."""
MIN_MOVE_PX = 0.4
"""The same in pixels of the registered image, for lenses so wide that it is more: compressed video moves its corners
together by a fraction of a pixel."""
ZOOM_AS_DEGREES = 20.0
"""Degrees by which a zoom by e moves the borders of a usual picture: 1 % counts like the least move."""
MOVE_WINDOW_S, MIN_MOVE_SAMPLES = 15.0, 8
"""Time over which turns are averaged, seconds: three periods of the slowest mast (0.2 Hz), and half of the 30 s within
which a move is to be told."""
LARGE_MOVE_FACTOR, LARGE_MOVE_S, MIN_LARGE_SAMPLES = 3.0, 6.0, 4
"""Moves larger than this multiple of the least one are told after this many seconds."""
MIN_PARALLAX_DEG, PARALLAX_SIGMAS, PARALLAX_BY_LENS = 0.1, 5.0, 0.02
"""Least angle between the turns of near and far that tells a shift, degrees: 3 cm at 15 m, and five times what turns by
up to 3 degrees of rendered scenes show without one; in its standard deviations; and relative to the turn."""
NO_COMMON_TURN_DEG, NO_COMMON_SHARE = 1.5, 0.5
"""Angle that stands for a half of the picture in which no turn is common, degrees, more than 0.3 m show at 12 m; and
the part of the corners that agreed before below which that is so: a jam in the way covers fewer."""
MOVE_SIGMAS = 5.0
"""A move is larger than this number of standard errors of the mean: in 36,000 registrations, which are not independent,
less than one exceeds them by chance."""
AGREEING_SHARE = 0.8
"""Share of the registrations that are nearer to the mean than to the pose of the calibration: a move stays, sway and
gusts come back."""
SETTLE_S, MIN_SETTLED_SAMPLES = 10.0, 6
"""Time after a move for which the camera has to stand before the move is measured, seconds."""
SETTLED_DEG = 0.08
"""Largest difference of the halves of that time, degrees. Judgement: half of what is told."""
VERIFY_SAMPLES = 3
"""Registrations at the pose of the calibration that verify it after a start, a change of the view or blindness."""
FAULT_S = 4.0
"""Time after which a picture that says nothing is told, seconds: longer than a shutter is closed (2 s), and it is told
within 10 s."""
SHARPNESS_PERIOD = 3
"""Registrations between two measurements of the sharpness, which cost a quarter of one."""
UNSEEN_S = 20.0
"""Time for which a picture with outlines may not show the view before that is told, seconds: a lorry or a bus in front
of the lens waits no longer but in a jam."""
REPLACED_S = 6.0
"""The same where nothing in the picture is as it was, seconds: no vehicle covers all of it, and consumers are told
within 10 s."""
REPLACED_CORRELATION = 0.2
"""Correlation with the reference below which nothing is as it was; half a picture of traffic leaves 0.4."""
COMPARED_SIZE = (80, 45)
"""Size at which that is computed: small turns and sway change little."""
CANDIDATE_S = 4.0
"""Time for which another view has to stand before it counts as one, seconds."""
CLEAR_CHECKS = 3
"""Images in a row without a fault that end one, where the view is not recognised either: noise in a covered picture
looks like outlines now and then."""
SEARCHES_S = (1.0, 5.0, 15.0)
"""Intervals between searches for a lost view: in the first ten seconds, the first minute, and later, seconds. One takes
as long as twenty registrations."""
MEMORY_S = 60.0
"""Time for which registrations are kept, seconds."""
WORN_VIEW_SHARE = 0.65
"""Fraction of its first share of agreeing corners below which a reference gets a successor: light and shadow have
changed. Judgement."""
MAX_REFERENCES = 6
"""Most references: day, night, dusk, dawn, rain and snow."""
REFERENCE_IMAGES = 7
"""Images whose median is a reference: no vehicle is in it that drove on within three seconds."""
MIN_RENEWAL_S = 20.0
"""Least interval between two references, seconds."""
MIN_TOLD_SWAY_DEG = 0.03
"""Least amplitude of sway that is told, degrees: three times the scatter of a registration."""


class ViewCondition(str, Enum):
    """How the present view relates to that of the calibration."""

    UNKNOWN = 'unknown'
    """There is no reference, or nothing was registered yet."""
    STILL = 'still'
    SWAYING = 'swaying'
    MOVED = 'moved'
    BLIND = 'blind'

    @property
    def is_seen(self) -> bool:
        """Whether the picture shows the view of the calibration."""
        return self in (ViewCondition.STILL, ViewCondition.SWAYING)


@dataclass(frozen=True)
class ViewReport:
    """What the watch knows after an image."""

    condition: ViewCondition = ViewCondition.UNKNOWN
    since_s: float = 0.0
    """When the condition began."""
    checked_s: float = 0.0
    """When the view was registered last at all."""
    move: CameraMove | None = None
    """Of condition MOVED; not measured (`is_measured`) while the camera still turns, or shows another view."""
    fault: PictureFault | None = None
    """Of condition BLIND."""
    sway_deg: float = 0.0
    """Amplitude of the sway."""
    share: float = 0.0
    """Fraction of the corners of the reference that agree."""
    is_watched: bool = False
    """Whether there is a view to be compared with; without one only pictures that say nothing are told."""

    def __str__(self) -> str:
        if self.condition is ViewCondition.MOVED and self.move is not None:
            return str(self.move) if self.move.is_measured or self.move.kind is MoveKind.OTHER_VIEW else 'turning'
        if self.fault is not None:
            return self.fault.value
        return f'sway {self.sway_deg:.2f} degrees' if self.condition is ViewCondition.SWAYING else self.condition.value


@dataclass(frozen=True)
class KnownView:
    """An image of the calibrated view in some light, with the pose of its camera since the calibration."""

    image: np.ndarray
    """Grey, uint8 (h, w), at most `REGISTERED_WIDTH_PX` wide, without traffic."""
    ignored: np.ndarray | None = None
    """Mask (h, w) of pixels that are no picture of the scene."""
    pose: ViewPose = field(default_factory=ViewPose.identity)


@dataclass(frozen=True)
class _Sample:
    time_s: float
    pose: ViewPose

    @cached_property
    def turn_deg(self) -> np.ndarray:
        return np.degrees(self.pose.turn_rad)

    @cached_property
    def unzoomed(self) -> ViewPose:
        """The pose if the zoom did not change."""
        return self.pose.without_zoom()

    @cached_property
    def unzoomed_turn_deg(self) -> np.ndarray:
        return np.degrees(self.unzoomed.turn_rad)


class _Reference:
    """A known view ready for registration."""

    def __init__(self, known: KnownView, camera: Camera) -> None:
        self.known = known
        self.view = ViewReference(known.image, camera, known.ignored)
        self.detail = Detail(known.image)
        self._first_shares: list[float] = []

    def is_worn(self, share: float) -> bool:
        """Take the share of a registration; return whether it is much less than at first."""
        if len(self._first_shares) < VERIFY_SAMPLES:
            self._first_shares.append(share)
        return share < WORN_VIEW_SHARE * float(np.mean(self._first_shares))


class ViewWatch:
    """Watches one stream of grey images; times are seconds on any clock that does not stop. Not thread-safe."""

    def __init__(self) -> None:
        self.report = ViewReport()
        self.size: tuple[int, int] | None = None
        """Width and height of the images of the calibration; None without one."""
        self._references: list[_Reference] = []
        self._ignored_polygons: Polygons = ()
        self._checks = 0
        self._due_s = -math.inf
        self._newest_s = -math.inf
        self._freeze = FreezeDetector()
        self._forget()

    def _forget(self) -> None:
        """Forget what was seen, not the references."""
        self._samples: deque[_Sample] = deque(maxlen=256)
        self._images: deque[tuple[float, np.ndarray]] = deque(maxlen=REFERENCE_IMAGES)
        self._last = ViewPose.identity()
        self._unseen_s: float | None = None
        self._fault: tuple[PictureFault, float] | None = None
        self._clear, self._blurred, self._replaced = 0, False, False
        self._search_due_s = self._near_s = -math.inf
        self._begun_s = math.inf
        self._candidate: tuple[ViewReference, float] | None = None
        self._renewed_s = -math.inf

    def begin(self, views: Sequence[KnownView], camera: Camera) -> None:
        """Watch the view of another calibration, of which some images and the lens are known.

        Views of another shape than the lens, or with too few outlines to be found again, are not used.
        """
        self._forget()
        self._references = [
            reference
            for view in views[:MAX_REFERENCES]
            if (small := _scaled_lens(camera, view.image.shape)) is not None
            and (reference := _Reference(view, small)).view.is_registrable
        ]
        self.size = (camera.width, camera.height)
        self.report = ViewReport()
        self._due_s = -math.inf

    def succeed(self, view: KnownView, camera: Camera) -> None:
        """Watch the view of a newer calibration; where the camera stands as before, go on with what is known of it."""
        small = _scaled_lens(camera, view.image.shape)
        calm = self.report.condition.is_seen
        since = None
        if calm and small is not None and self.camera is not None and self.size == (camera.width, camera.height):
            since = self._registered(registered_image(view.image, self._registered_size))
        if since is None or small is None or float(np.linalg.norm(np.degrees(since.turn_rad))) > self._least_move_deg:
            self.begin([view], camera)
            return
        new = _Reference(view, small)
        if not new.view.is_registrable:
            return
        back = _inverse(since.without_zoom())
        self._references = [
            new,
            *(
                _Reference(replace(one.known, pose=one.known.pose.after(back)), small)
                for one in self._references
                if one.known.image.shape == view.image.shape
            ),
        ][:MAX_REFERENCES]
        self._samples.clear()
        self._images.clear()
        self._last = self._last.after(back)

    def end(self) -> None:
        """Watch no view any more, but for pictures that say nothing."""
        self._forget()
        self._references, self.report, self.size = [], ViewReport(), None

    def ignore(self, polygons: Polygons) -> None:
        """Leave regions out of the views that are added from now on, in pixels of the images of the calibration."""
        self._ignored_polygons = polygons

    def _masked(self, image: np.ndarray, pose: ViewPose | None = None) -> KnownView:
        """Return an image (H, W) as a view in which ignored regions are black, and its corners elsewhere."""
        first = self._references[0].known
        mask = None
        if self.size is not None:
            mask = IgnoreMask(self._ignored_polygons, self.size, image.shape[1::-1]).near(0)
        if mask is not None:
            image = np.where(mask > 0, np.uint8(0), image)
        return KnownView(image, union(first.ignored, mask), pose or ViewPose.identity())

    @property
    def views(self) -> tuple[KnownView, ...]:
        """Images of the calibrated view so far, for the next start."""
        return tuple(reference.known for reference in self._references)

    @property
    def camera(self) -> Camera | None:
        """Lens of the calibration for images of the registered size; None without one."""
        return self._references[0].view.camera if self._references else None

    @property
    def _registered_size(self) -> tuple[int, int] | None:
        camera = self.camera
        return None if camera is None else (camera.width, camera.height)

    def lasting_turn_deg(self) -> np.ndarray | None:
        """Return mean pan, tilt and roll since the calibration over `MOVE_WINDOW_S`, degrees (3,); None if unknown."""
        turns, _ = self._window(self._newest_s - MOVE_WINDOW_S)
        return turns.mean(axis=0) if len(turns) >= MIN_MOVE_SAMPLES else None

    def newest_view(self, since_s: float) -> KnownView | None:
        """Return the median of the images seen since a time, such as that of a move; None if there are too few."""
        images = [image for time_s, image in self._images if time_s > since_s + CHECK_S]
        if len(images) < VERIFY_SAMPLES or not self._references:
            return None
        return self._masked(median(images))

    def rebase(self, move: CameraMove) -> None:
        """Take the pose after a move for that of the calibration, whose pose was mended by it."""
        back = ViewPose(move.rotation.T, 0.0, np.zeros((4, 4)))
        for reference in self._references:
            known = reference.known
            reference.known = replace(known, pose=known.pose.after(back))
        self._samples = deque(
            (replace(one, pose=one.pose.after(back)) for one in self._samples if one.time_s > move.time_s),
            maxlen=self._samples.maxlen,
        )
        self._last = self._last.after(back)
        shown = self.newest_view(move.time_s) if move.kind is MoveKind.REAIM else None
        if shown is not None:  # little of the earlier views is seen
            self._add_reference(shown, self._references[0].view.camera)
        self._images.clear()
        self.report = ViewReport(ViewCondition.STILL, self._newest_s, self._newest_s, share=self.report.share)

    def is_due(self, time_s: float) -> bool:
        """Whether an image of this time is looked at."""
        return time_s >= self._due_s or time_s < self._newest_s

    def update(self, image: np.ndarray, time_s: float) -> ViewReport:
        """Take an image, grey (H, W) or BGR (H, W, 3), in the shape of the calibrated ones; return the report."""
        if not self.is_due(time_s):
            return self.report
        if time_s < self._newest_s:  # the clock was set back
            self._forget()
            self.report = replace(self.report, since_s=time_s, checked_s=time_s)
        self._checks += 1
        place = (self._checks * 0.6180339887) % 1.0 - 0.5
        self._due_s, self._newest_s = time_s + CHECK_S * (1.0 + 2.0 * INTERVAL_SPREAD * place), time_s
        image = registered_image(image, self._registered_size)
        frozen = self._freeze.is_frozen(image, time_s)
        pattern = normalised(image)
        pose = self._register(pattern, time_s)
        if pose is not None:
            self._samples.append(_Sample(time_s, pose))
            self._unseen_s = self._candidate = None
            while time_s - self._samples[0].time_s > MEMORY_S:
                self._samples.popleft()
        elif self._unseen_s is None:
            self._unseen_s = time_s
        self._judge_fault(image, pattern, pose, frozen, time_s)
        self.report = replace(self._judged(image, pose, time_s), is_watched=bool(self._references))
        if pose is not None:
            self._renew(image, pose, time_s)
        return self.report

    def _register(self, pattern: np.ndarray, time_s: float) -> ViewPose | None:
        """Return the pose of a normalised image since the calibration; None if it is not recognised."""
        usable = [one for one in self._references if one.view.image.shape == pattern.shape]
        if not usable:
            return None
        near = self._near(pattern)
        if near is not None:
            self._near_s = time_s
            return self._found(*near)
        self._begun_s = min(self._begun_s, time_s)
        if time_s < self._search_due_s:
            return None
        lost_s = time_s - (self._begun_s if math.isinf(self._near_s) else self._near_s)
        # a move is measured from several searches, where the reference is out of reach
        turning = self.report.move is not None and not self.report.move.is_measured
        self._search_due_s = time_s + SEARCHES_S[(lost_s > 10.0 and not turning) + (lost_s > 60.0)]
        for reference in usable[:2]:
            since = self._last.after(_inverse(reference.known.pose))
            found = reference.view.near_by_outlines(pattern, since) or reference.view.anywhere(pattern)
            if found is not None:
                return self._found(reference, reference.view.near(pattern, found) or found)
        self._replaced = all(_correlation(one.view.pattern, pattern) < REPLACED_CORRELATION for one in usable)
        return None

    def _registered(self, image: np.ndarray) -> ViewPose | None:
        """Return the pose of an image since the calibration, near the last one; None if it is not recognised."""
        near = self._near(normalised(image))
        return None if near is None else near[1].after(near[0].known.pose)

    def _near(self, pattern: np.ndarray) -> tuple[_Reference, ViewPose] | None:
        """Return the first reference that a normalised image shows near the last pose, and its pose since that."""
        for reference in self._references:
            if reference.view.image.shape == pattern.shape:
                found = reference.view.near(pattern, self._last.after(_inverse(reference.known.pose)))
                if found is not None:
                    return reference, found
        return None

    def _found(self, reference: _Reference, pose: ViewPose) -> ViewPose:
        """Go on from a reference that was recognised; return the pose since the calibration."""
        self._references.remove(reference)
        self._references.insert(0, reference)
        self._last = pose.after(reference.known.pose)
        return self._last

    def _judge_fault(
        self, image: np.ndarray, pattern: np.ndarray, pose: ViewPose | None, frozen: bool, time_s: float
    ) -> None:
        """Note which fault the picture has, and since when."""
        fault = PictureFault.FROZEN if frozen else self._fault_of(image, pattern, pose)
        self._clear = 0 if fault is not None else self._clear + 1
        if fault is None:
            if pose is not None or self._clear >= CLEAR_CHECKS:
                self._fault = None
        elif self._fault is None:
            self._fault = (fault, time_s)
        else:
            self._fault = (fault, self._fault[1])

    def _fault_of(self, image: np.ndarray, pattern: np.ndarray, pose: ViewPose | None) -> PictureFault | None:
        """Return the fault of a single image."""
        if pose is None:
            is_empty = bool(self._references) and not self._has_outlines(image, pattern)
            return exposure_fault(image) or (PictureFault.COVERED if is_empty else None)
        if self._checks % SHARPNESS_PERIOD == 0:  # and else as before
            first = self._references[0]
            since = pose.after(_inverse(first.known.pose))
            self._blurred = first.detail.sharpness(first.view.aligned(image, since)) < BLURRED_RATIO
        return PictureFault.BLURRED if self._blurred else None

    def _has_outlines(self, image: np.ndarray, pattern: np.ndarray) -> bool:
        """Whether an image, normalised its pattern, has enough corners to be found again."""
        if self._candidate is not None:
            candidate, _ = self._candidate
            if candidate.image.shape == image.shape and candidate.near(pattern, ViewPose.identity()):
                return True
        first = self._references[0]
        new = ViewReference(image, first.view.camera, self._masked(image).ignored, pattern)
        self._candidate = (new, self._newest_s)
        return new.is_registrable

    def _judged(self, image: np.ndarray, pose: ViewPose | None, time_s: float) -> ViewReport:
        """Return the report after an image."""
        before = self.report
        if self._fault is not None:
            kind, since_s = self._fault
            if kind is PictureFault.FROZEN or time_s - since_s >= FAULT_S:
                return self._changed(ViewCondition.BLIND, since_s, fault=kind)
        if not self._references:
            return self._changed(ViewCondition.UNKNOWN, time_s)
        if pose is None:
            return self._judge_unseen(time_s)
        self.report = before = replace(before, checked_s=time_s, share=pose.share)
        if before.condition is ViewCondition.BLIND and self._fault is None:
            self._samples = deque([self._samples[-1]], maxlen=self._samples.maxlen)
            return replace(before, condition=ViewCondition.UNKNOWN, since_s=time_s, fault=None)
        if before.condition is ViewCondition.MOVED:
            return self._judge_moved(time_s)
        moved = self._noticed(time_s)
        if moved is not None:
            self.report = self._changed(ViewCondition.MOVED, moved.time_s, move=moved)
            return self._judge_moved(time_s)
        if before.condition is ViewCondition.UNKNOWN and not self._is_verified():
            return before
        sway_deg = self._sway_deg()
        condition = ViewCondition.SWAYING if sway_deg > MIN_TOLD_SWAY_DEG else ViewCondition.STILL
        return replace(self._changed(condition, time_s), sway_deg=sway_deg)

    def _changed(
        self,
        condition: ViewCondition,
        since_s: float,
        *,
        move: CameraMove | None = None,
        fault: PictureFault | None = None,
    ) -> ViewReport:
        """Return the report with a condition, which goes on if it is that of before."""
        before = self.report
        if before.condition is condition:
            return replace(before, move=move, fault=fault, sway_deg=0.0)
        return ViewReport(condition, since_s, before.checked_s, move, fault, 0.0, before.share)

    def _judge_unseen(self, time_s: float) -> ViewReport:
        """Return the report after an image that has outlines but not those of the view."""
        limit_s = REPLACED_S if self._replaced else UNSEEN_S
        if self._unseen_s is None or time_s - self._unseen_s < limit_s:
            return self.report
        stands = self._candidate is not None and time_s - self._candidate[1] >= CANDIDATE_S
        if stands:
            move = CameraMove(MoveKind.OTHER_VIEW, self._unseen_s)
            return self._changed(ViewCondition.MOVED, self._unseen_s, move=move)
        if self.report.condition is ViewCondition.MOVED or time_s - self._unseen_s < limit_s + CANDIDATE_S / 2:
            return self.report
        return self._changed(ViewCondition.BLIND, self._unseen_s, fault=PictureFault.UNRECOGNISED)

    def _window(self, since_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return turns in degrees (n, 3) and logarithms of the zoom (n,) since a time; 1 % or less is no zoom."""
        chosen = [one for one in self._samples if one.time_s >= since_s]
        zooms = np.array([one.pose.log_zoom for one in chosen])
        zoomed = len(zooms) > 0 and abs(zooms.mean()) > math.log(MIN_MOVE_ZOOM)
        turns = [one.turn_deg if zoomed else one.unzoomed_turn_deg for one in chosen]
        return np.array(turns).reshape(-1, 3), zooms

    def _scatter(self) -> tuple[float, float]:
        """Return the scatter of single turns in degrees and of the logarithm of the zoom, robust against one step."""
        turns, zooms = self._window(self._newest_s - 2 * MOVE_WINDOW_S)
        if len(turns) < MIN_LARGE_SAMPLES:
            return math.inf, math.inf
        # differences of neighbours: a step shows in one of them, sway that is faster than a few seconds in all
        steps = np.median(np.abs(np.diff(turns, axis=0)), axis=0) / (0.6745 * math.sqrt(2.0))
        zoom = float(np.median(np.abs(np.diff(zooms)))) / (0.6745 * math.sqrt(2.0))
        return float(np.linalg.norm(steps)), zoom

    @property
    def _least_move_deg(self) -> float:
        camera = self.camera
        return max(MIN_MOVE_DEG, 0.0 if camera is None else math.degrees(MIN_MOVE_PX / camera.focal_px))

    def _noticed(self, time_s: float) -> CameraMove | None:
        """Return a move that lasts, not measured yet; None if there is none."""
        scatter_deg, zoom_scatter = self._scatter()
        for seconds, factor, least in (
            (MOVE_WINDOW_S, 1.0, MIN_MOVE_SAMPLES),
            (LARGE_MOVE_S, LARGE_MOVE_FACTOR, MIN_LARGE_SAMPLES),
        ):
            turns, zooms = self._window(time_s - seconds)
            if len(turns) < least:
                continue
            mean, root = turns.mean(axis=0), math.sqrt(len(turns))
            size = float(np.linalg.norm(mean))
            nearer = np.linalg.norm(turns - mean, axis=1) < np.linalg.norm(turns, axis=1)
            turned = size > max(factor * self._least_move_deg, MOVE_SIGMAS * scatter_deg / root)
            is_turned = turned and nearer.mean() >= AGREEING_SHARE
            change = abs(float(zooms.mean()))
            is_zoomed = change > max(factor * math.log(MIN_MOVE_ZOOM), MOVE_SIGMAS * zoom_scatter / root) and (
                (np.sign(zooms) == np.sign(zooms.mean())).mean() >= AGREEING_SHARE
            )
            if is_turned or is_zoomed:
                return CameraMove(kind_of_move(size, math.exp(change if is_zoomed else 0.0)), self._left_s())
        return None

    def _left_s(self) -> float:
        """Return when the camera was last nearer to the pose of the calibration than to that of now."""
        rows = np.array([[*one.turn_deg, ZOOM_AS_DEGREES * one.pose.log_zoom] for one in self._samples])
        now = rows[-3:].mean(axis=0)
        near = np.flatnonzero(np.linalg.norm(rows, axis=1) < np.linalg.norm(rows - now, axis=1))
        return self._samples[int(near[-1]) if len(near) else 0].time_s

    def _judge_moved(self, time_s: float) -> ViewReport:
        """Return the report of a camera that has moved: measured when it stands, still when it is back."""
        before = self.report
        move = before.move
        if move is None:
            return before
        # not the image in which it moved, which may show both
        since_s = max(time_s - SETTLE_S, move.time_s + CHECK_S)
        turns, zooms = self._window(since_s)
        if len(turns) < MIN_SETTLED_SAMPLES:
            return before
        scatter_deg, zoom_scatter = self._scatter()
        root, half = math.sqrt(len(turns)), len(turns) // 2
        difference = np.linalg.norm(turns[:half].mean(axis=0) - turns[half:].mean(axis=0))
        zooming = abs(float(zooms[:half].mean() - zooms[half:].mean()))
        if difference > max(SETTLED_DEG, 4.0 * scatter_deg / math.sqrt(half)) or zooming > max(
            math.log(MIN_MOVE_ZOOM) / 2, 4.0 * zoom_scatter / math.sqrt(half)
        ):
            return before
        mean, zoom = turns.mean(axis=0), math.exp(float(zooms.mean()))
        size = float(np.linalg.norm(mean))
        if max(zoom, 1 / zoom) <= MIN_MOVE_ZOOM:
            zoom = 1.0
            if size < 0.5 * self._least_move_deg:
                return self._changed(ViewCondition.STILL, time_s)
        seen = [one for one in self._samples if one.time_s >= since_s]
        poses = [one.pose if zoom != 1.0 else one.unzoomed for one in seen]
        covariance = np.mean([pose.covariance for pose in poses], axis=0)
        spread = turns.std(axis=0, ddof=1) / root
        sigma = np.sqrt(spread**2 + np.degrees(np.degrees(np.diag(covariance)[:3])))
        pan, tilt, roll = (float(value) for value in mean)
        parallax_deg = self._parallax_deg(move.time_s, size) if zoom == 1.0 else 0.0
        sigma = np.hypot(sigma, parallax_deg)
        measured = CameraMove(
            kind_of_move(size, zoom),
            move.time_s,
            pan,
            tilt,
            roll,
            zoom,
            (float(sigma[0]), float(sigma[1]), float(sigma[2])),
            parallax_deg,
        )
        if move.is_measured and move.kind is measured.kind:
            angle_deg = rotation_angle_deg(measured.rotation @ move.rotation.T)
            if angle_deg < self._least_move_deg and abs(math.log(zoom / move.zoom)) < math.log(MIN_MOVE_ZOOM):
                return before
        return self._changed(ViewCondition.MOVED, before.since_s, move=measured)

    def _parallax_deg(self, since_s: float, turn_deg: float) -> float:
        """Return the significant angle by which what is near turned otherwise than what is far, degrees; else 0."""
        shown = self.newest_view(since_s)
        if shown is None or turn_deg > MAX_BUMP_DEG:
            return 0.0
        first = self._references[0]
        found = first.view.parallax(normalised(shown.image), self._last.after(_inverse(first.known.pose)))
        if found is None:
            before, after = (
                [one.pose.share for one in self._samples if (one.time_s > since_s) == is_after]
                for is_after in (False, True)
            )
            lost = bool(before) and float(np.median(after)) < NO_COMMON_SHARE * float(np.median(before))
            return NO_COMMON_TURN_DEG if lost else 0.0
        angle_deg, sigma_deg = (math.degrees(value) for value in found)
        least = max(MIN_PARALLAX_DEG, PARALLAX_SIGMAS * sigma_deg, PARALLAX_BY_LENS * turn_deg)
        return angle_deg if angle_deg > least else 0.0

    def _is_verified(self) -> bool:
        """Whether the newest registrations show the pose of the calibration."""
        turns, zooms = self._window(-math.inf)
        if len(turns) < VERIFY_SAMPLES:
            return False
        size = float(np.linalg.norm(turns[-VERIFY_SAMPLES:].mean(axis=0)))
        return size < self._least_move_deg and abs(float(zooms[-VERIFY_SAMPLES:].mean())) < math.log(MIN_MOVE_ZOOM)

    def _sway_deg(self) -> float:
        """Return the amplitude of the sway: that of a sine with the scatter of the turns."""
        scatter_deg, _ = self._scatter()
        return math.sqrt(2.0) * scatter_deg if len(self._samples) >= MIN_MOVE_SAMPLES else 0.0

    def _renew(self, image: np.ndarray, pose: ViewPose, time_s: float) -> None:
        """Add a reference in the present light where the one in use is worn, from images of the calibrated pose."""
        self._images.append((time_s, image))
        first = self._references[0]
        worn = first.is_worn(pose.share)
        still = self.report.condition.is_seen
        if not worn or not still or len(self._images) < REFERENCE_IMAGES or time_s - self._renewed_s < MIN_RENEWAL_S:
            return
        self._renewed_s = time_s
        shown = median([image for _, image in self._images])
        found = first.view.near(normalised(shown), self._last.after(_inverse(first.known.pose)))
        if found is None:
            return
        self._add_reference(self._masked(shown, found.without_zoom().after(first.known.pose)), first.view.camera)

    def _add_reference(self, known: KnownView, camera: Camera) -> None:
        """Use another reference first; drop the one that was not used for the longest time."""
        self._references = [_Reference(known, camera), *self._references][:MAX_REFERENCES]


def _scaled_lens(camera: Camera, shape: tuple[int, ...]) -> Camera | None:
    """Return a lens for images of `shape` (height, width); None if the shape is another than that of its images."""
    try:
        return camera.scaled_to(shape[1], shape[0])
    except UsageError:
        return None


def _inverse(pose: ViewPose) -> ViewPose:
    return ViewPose(pose.rotation.T, -pose.log_zoom, np.zeros((4, 4)))


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Return the correlation of two normalised images (H, W) in small; 0 where one shows nothing, as a black one."""
    small = [cv2.resize(image, COMPARED_SIZE, interpolation=cv2.INTER_AREA).astype(float) for image in (one, other)]
    first, second = (image - image.mean() for image in small)
    norm = math.sqrt(float((first**2).sum() * (second**2).sum()))
    return float((first * second).sum()) / norm if norm > 0 else 0.0

"""Perception pipeline of one image stream: images in, observations out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np

from autocalib_ros.config import GateOptions, Options, Polygons
from autocalib_ros.evidence.landmarks import Landmarks
from autocalib_ros.evidence.picture import Picture
from autocalib_ros.evidence.snapshot import Edges, Outlines, Segments, Track, TrackKind
from autocalib_ros.evidence.stillness import MIN_REPORTED_SWAY_PX, Stillness, ViewChange, drift_limit_px, sway_limit_px
from autocalib_ros.perception.background import Background, median
from autocalib_ros.perception.detector.detector import VehicleDetector
from autocalib_ros.perception.detector_tracks import DetectorTracks
from autocalib_ros.perception.drift_monitor import DriftLimits, DriftMonitor, ImagePose
from autocalib_ros.perception.frame_gate import LEVEL_SHIFT_THRESHOLD, FrameGate, FrameStatus
from autocalib_ros.perception.ignore_regions import IgnoreMask, black_out, require_polygons_inside, union
from autocalib_ros.perception.klt_tracker import PointTracker
from autocalib_ros.perception.landmark_matching import find_landmarks
from autocalib_ros.perception.line_segments import LineSegmentDetector
from autocalib_ros.perception.motion_mask import MotionMask, Region, exclude_pixels
from autocalib_ros.perception.picture_area import PictureArea
from autocalib_ros.perception.reductions import Reductions
from autocalib_ros.perception.repeats import RepeatDetector
from autocalib_ros.perception.silhouettes import outlines_of
from autocalib_ros.perception.still_view import warped
from autocalib_ros.perception.stripe_detector import StripeDetector
from autocalib_ros.perception.vehicle_search import MaskedFrame, VehicleSearch
from autocalib_ros.perception.view_watch import KnownView

MOTION_MASK_PERIOD = 2
"""Frames between updates of the motion mask: traffic needs no finer time step."""
GATE_WIDTH_PX = 320
"""Width at which frames are compared with the frame gate."""


OnVehicles = TypeVar('OnVehicles', Segments, Edges)


@dataclass(frozen=True)
class FrameObservations:
    """FrameObservations from one image, in pixels of the full image."""

    tracks: list[Track]
    segments: Segments | None
    edges: Edges | None
    outlines: Outlines | None = None
    view: int = 0
    """Number of the still view that they belong to; observations of different views are never mixed."""


@dataclass(frozen=True)
class _Scene:
    """What a still view of the camera shows besides its traffic."""

    background: Background
    lines: LineSegmentDetector
    stripes: StripeDetector
    picture_area: PictureArea


class Observer:
    """Processes one stream of images of one size; times are seconds since its first image.

    Vehicles are the regions of the motion mask or, with a detector, its moving boxes.
    """

    def __init__(self, options: Options, image_size: tuple[int, int], detector: VehicleDetector | None = None) -> None:
        self._options = options
        self._image_size = image_size
        self._reduction = max(1.0, image_size[0] / options.max_image_width)
        self.ignored = options.ignored_polygons
        """Polygons that are ignored, in pixels of the full image."""
        require_polygons_inside(self.ignored, image_size)
        self._ignored, self._excluded_by_options = self._masks()
        self._excluded = self._excluded_by_options
        self._motion = MotionMask(options.motion)
        self._detector_tracks = None if detector is None else DetectorTracks(detector, options.detector)
        self._tracker = PointTracker(options.tracking, self._excluded)
        self._drift_monitor = DriftMonitor(self._drift_limits(options.gate), self._ignored)
        self._scenes = {0: self._new_scene()}
        self._view = 0
        self._no_picture: np.ndarray | None = None
        """Mask of the tracked image where there is no picture, as far as is known."""
        self._vehicle_search = VehicleSearch()
        self._frame_gate = FrameGate(RepeatDetector(), LEVEL_SHIFT_THRESHOLD)
        self.repeated = 0
        """Number of images so far that repeat an earlier one."""
        self._slots = 0
        """Number of frames so far, with the lost ones and without repeats."""
        self._lost = 0
        """Images lost since the last one that was new."""
        self._vehicles = 0

    def observe(self, image: np.ndarray, time_s: float, lost: int = 0) -> FrameObservations:
        """Process a grey (H, W) or BGR (H, W, 3) uint8 image; repeated frames and closed shutters yield nothing.

        Images that were `lost` before it count for the intervals between detections: traffic went on meanwhile.
        """
        self._lost += lost
        image = black_out(image, self.ignored)
        grey = self._tracked_image(image)
        reductions = Reductions(grey)
        status = self._frame_gate.classify(self._compared_image(reductions, grey), time_s)
        if status is FrameStatus.REPEATED:
            return self._leave_out(status)
        pose = self._drift_monitor.update(grey, time_s, reductions)
        if pose.view != self._view:
            return self._change_view(pose.view)
        if status is FrameStatus.HIDDEN or not pose.is_usable:
            return FrameObservations([], None, None, view=self._view)
        if pose.is_compensated:
            image, grey = self._in_rest_position(image, grey, pose, time_s)
            reductions = Reductions(grey)
        if self._tracker.is_repeat(grey, time_s):
            return self._leave_out(status)
        ended = self._reset_appearance() if status is FrameStatus.LEVEL_SHIFT else []
        self._scene.background.update(image, time_s)
        was_known = self._scene.picture_area.is_known
        if self._scene.picture_area.update(self._scene.background) or was_known != self._scene.picture_area.is_known:
            self._exclude_no_picture()
        segments, edges = self._vehicle_search.go_on(self._tracker)
        tracks = [self._to_full_size(track) for track in (*ended, *self._tracker.follow_new(grey, time_s))]
        passed, self._slots, self._lost = self._slots, self._slots + 1 + self._lost, 0
        detect = _reaches_multiple(passed, self._slots, self._options.tracking.detect_every)
        if detect or _reaches_multiple(passed, self._slots, MOTION_MASK_PERIOD):
            self._motion.update(grey, time_s, reductions)
        if self._detector_tracks is not None:
            self._detector_tracks.follow(image, time_s, self._tracker, self._reduction)
        outlines = None
        if detect:
            frame = MaskedFrame(grey, time_s, *self._moving_regions(grey.shape))
            outlines = self._find_outlines(frame)
            edges = self._vehicle_search.begin(frame) or edges
        return FrameObservations(tracks, self._in_full_size(segments), self._in_full_size(edges), outlines, self._view)

    def follows(self, image: np.ndarray) -> bool:
        """Return whether the traffic in an image is one step further than in the last one, whatever its stamp.

        False without traffic, and for an image of another size.
        """
        if (image.shape[1], image.shape[0]) != self._image_size:
            return False
        return self._tracker.moved_one_step(self._tracked_image(black_out(image, self.ignored)))

    def change_gate(self, gate: GateOptions) -> None:
        """Take another limit of the drift, which may change while running."""
        self._drift_monitor.change_limits(self._drift_limits(gate))

    def ignore(self, polygons: Polygons) -> None:
        """Ignore other regions from the next image on, in pixels of the full image.

        Lines, bars and borders of the picture are looked for anew: those of the new regions are none.
        """
        self.ignored = polygons
        self._ignored, self._excluded_by_options = self._masks()
        self._scenes = {view: self._new_scene(scene.background) for view, scene in self._scenes.items()}
        self._exclude_no_picture()

    def _masks(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Return the masks of the tracked image of what is ignored, and of what is too near to it to be tracked."""
        ignored = IgnoreMask(self.ignored, self._image_size, self._tracked_size)
        return ignored.near(0), ignored.near(self._options.tracking.window_px)

    def _drift_limits(self, gate: GateOptions) -> DriftLimits:
        """Return what counts as standing still, in pixels of the tracked image."""
        width = self._image_size[0]
        limits = (drift_limit_px(width, gate), sway_limit_px(width, gate), MIN_REPORTED_SWAY_PX)
        return DriftLimits(*(limit / self._reduction for limit in limits))

    def _new_scene(self, background: Background | None = None) -> _Scene:
        return _Scene(
            background or Background(),
            LineSegmentDetector(self._excluded_by_options),
            StripeDetector(self._excluded_by_options),
            PictureArea(self._image_size, self._tracked_size, self.ignored),
        )

    @property
    def _scene(self) -> _Scene:
        return self._scenes[self._view]

    def _change_view(self, view: int) -> FrameObservations:
        """Begin with another view, or go on with an earlier one; return the tracks that end with the one before."""
        ended = [self._to_full_size(track) for track in self._reset_appearance()]
        before, self._view = self._view, view
        self._scenes = {number: self._scenes.get(number) or self._new_scene() for number in self._drift_monitor.views}
        self._exclude_no_picture()
        return FrameObservations(ended, None, None, view=before)

    def _in_rest_position(
        self, image: np.ndarray, grey: np.ndarray, pose: ImagePose, time_s: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Undo the sway of an image, in full size only if the background takes it, and of the tracked image."""
        if self._scene.background.is_due(time_s):
            image = warped(image, pose.motion.enlarged(self._reduction))
        return image, warped(grey, pose.motion)

    def _leave_out(self, status: FrameStatus) -> FrameObservations:
        """Count a repeated image, which shows nothing."""
        if status is not FrameStatus.REPEATED:  # only the tracker noticed
            self._frame_gate.revoke()
        self.repeated += 1
        self._tracker.skip_repeat()
        return FrameObservations([], None, None, view=self._view)

    def _exclude_no_picture(self) -> None:
        """Leave out what is no picture in all that follows: tracks, moving regions and corners of the background.

        In a view that has just begun that is what was none in the one before: text stays where it is as the camera
        turns, and its corners would hold the picture still.
        """
        if self._scene.picture_area.is_known:
            self._no_picture = self._scene.picture_area.mask
        mask = self._no_picture
        margin = 2 * self._options.tracking.window_px + 1
        near = None if mask is None else cv2.dilate(mask, np.ones((margin, margin), np.uint8))
        self._excluded = union(self._excluded_by_options, near)
        self._tracker.exclude(self._excluded)
        self._drift_monitor.exclude(union(self._ignored, mask))

    def _reset_appearance(self) -> list[Track]:
        """Reset all state that depends on earlier grey levels; return the tracks that end."""
        self._motion = MotionMask(self._options.motion)
        self._vehicle_search.restart()
        return self._tracker.finish_all()

    def _tracked_image(self, image: np.ndarray) -> np.ndarray:
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image.copy()
        if self._reduction > 1:
            grey = cv2.resize(grey, self._tracked_size, interpolation=cv2.INTER_AREA)
        return grey

    def _compared_image(self, reductions: Reductions, grey: np.ndarray) -> np.ndarray:
        """Return a grey image (H, W) in `GATE_WIDTH_PX`, which averages noise but keeps moving vehicles.

        Ignored pixels get the mean of the others, so that they affect no comparison.
        """
        ignored = self._ignored
        if ignored is not None and not ignored.all():
            reductions = Reductions(np.where(ignored > 0, np.uint8(grey[ignored == 0].mean()), grey))
        height, width = grey.shape
        columns = min(GATE_WIDTH_PX, width)
        return reductions.at((columns, max(1, height * columns // width)))

    @property
    def _tracked_size(self) -> tuple[int, int]:
        width, height = self._image_size
        return round(width / self._reduction), round(height / self._reduction)

    def _moving_regions(self, shape: tuple[int, int]) -> tuple[list[Region], np.ndarray, np.ndarray]:
        """Return the moving regions, the vehicle id of each (n,), and whether it is a detected person (n,)."""
        regions = exclude_pixels(self._motion.regions(), self._excluded)
        if self._detector_tracks is None:
            return regions, self._assign_vehicles(regions), np.zeros(len(regions), bool)
        regions, vehicles = self._detector_tracks.regions(regions, shape, self._excluded)
        return (
            regions,
            vehicles,
            np.array([self._detector_tracks.kind(one) is TrackKind.PERSON for one in vehicles], bool),
        )

    def _find_outlines(self, frame: MaskedFrame) -> Outlines | None:
        """Return the silhouettes of the regions; None with a detector, which classifies cyclists itself."""
        if self._detector_tracks is not None or not frame.regions:
            return None
        shape, dilation_px = frame.grey.shape, self._motion.dilation_px
        silhouettes = outlines_of(frame.regions, dilation_px, shape, self._reduction, self._excluded)
        return Outlines(frame.time_s, frame.vehicles, silhouettes)

    def _assign_vehicles(self, regions: list[Region]) -> np.ndarray:
        """Return the vehicle id (n,) of each region: the majority of the tracked points inside, or a new one."""
        points, vehicle_ids = self._tracker.positions()
        columns, rows = np.round(points).astype(int).T
        vehicles = np.zeros(len(regions), int)
        for index, region in enumerate(regions):
            height, width = region.mask.shape
            x, y = columns - region.x, rows - region.y
            near = np.flatnonzero((x >= 0) & (y >= 0) & (x < width) & (y < height))
            inside = vehicle_ids[near[region.mask[y[near], x[near]] > 0]]
            if len(inside):
                vehicles[index] = np.bincount(inside).argmax()
            else:
                self._vehicles += 1
                vehicles[index] = self._vehicles
        return vehicles

    def unfinished(self) -> list[Track]:
        """Return the tracks so far of the points still tracked."""
        return [self._to_full_size(track) for track in self._tracker.unfinished()]

    def followed(self, steps: int) -> np.ndarray:
        """Return the last positions of the tracked points, pixels (n, steps, 2), newest last."""
        return self._to_full_pixels(self._tracker.tails(steps))

    @property
    def drift_px(self) -> float:
        """Largest lasting displacement of the background of the present view, pixels of the full image."""
        return self._drift_monitor.drift_px * self._reduction

    @property
    def newest_change(self) -> ViewChange | None:
        """The newest change of the view, in pixels of the full image; None without one."""
        change = self._drift_monitor.newest_change
        return None if change is None else change.enlarged(self._reduction)

    @property
    def view(self) -> int:
        """Number of the present still view."""
        return self._view

    @property
    def views(self) -> dict[int, float]:
        """Numbers of the still views in memory, at most two, and the seconds that each was seen and still."""
        return {number: still_s for number, still_s in self._drift_monitor.views.items() if number in self._scenes}

    def stillness(self, view: int) -> tuple[float, Stillness]:
        """Return the drift of a view in memory in pixels of the full image, and how still the camera stood."""
        drift_px, stillness = self._drift_monitor.stillness(view)
        return drift_px * self._reduction, stillness.enlarged(self._reduction)

    def still_segments(self, view: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return line segments and bright bars of the background, in pixels of the full image.

        Segments are x0, y0, x1, y1, shape (n, 4); bars are as `Evidence.stripes_px`.
        """
        scene = self._scenes[self._view if view is None else view]
        if not _is_searched(scene):
            self._search(scene.lines, scene.stripes, scene.background, scene.picture_area.mask)
        return self._segments_and_bars(scene.lines, scene.stripes)

    def search_for_segments(self) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
        """Return a function that gives `still_segments` as they are now, for another thread."""
        scene = self._scene
        if _is_searched(scene):
            found = self._segments_and_bars(scene.lines, scene.stripes)
            return lambda: found
        background, mask = scene.background.copy(), scene.picture_area.mask
        lines, stripes = scene.lines.fresh(), scene.stripes.fresh()

        def search() -> tuple[np.ndarray, np.ndarray]:
            self._search(lines, stripes, background, mask)
            return self._segments_and_bars(lines, stripes)

        return search

    def _search(
        self,
        lines: LineSegmentDetector,
        stripes: StripeDetector,
        background: Background,
        no_picture: np.ndarray | None,
    ) -> None:
        """Find segments and bars of a background; uses nothing that later images change."""
        grey, samples = self._still_scene(background)
        lines.find(grey, background.times_s, no_picture, samples)
        stripes.find(grey, background.times_s)

    def _still_scene(self, background: Background) -> tuple[np.ndarray | None, list[np.ndarray]]:
        """Return a background as grey image and the samples of which it is the median; None without samples."""
        samples = background.grey_samples(self._tracked_size)
        return (median(samples) if samples else None), samples

    def _segments_and_bars(self, lines: LineSegmentDetector, stripes: StripeDetector) -> tuple[np.ndarray, np.ndarray]:
        bars = stripes.stripes_px
        return self._ends_in_full_size(lines.lines_px), np.hstack([self._ends_in_full_size(bars[:, :4]), bars[:, 4:]])

    def _in_full_size(self, found: OnVehicles | None) -> OnVehicles | None:
        """Return segments or edges in pixels of the full image."""
        return None if found is None else replace(found, ends_px=self._ends_in_full_size(found.ends_px))

    def _ends_in_full_size(self, ends_px: np.ndarray) -> np.ndarray:
        return self._to_full_pixels(ends_px.reshape(-1, 2)).reshape(-1, 4)

    def landmarks(self, view: int) -> Landmarks:
        """Return the landmarks of the background of a view in memory, pixels of the full image; none without one."""
        scene = self._scenes[view]
        samples = scene.background.grey_samples(self._tracked_size)
        if not samples:
            return Landmarks()
        excluded = union(self._excluded_by_options, scene.picture_area.mask)
        found = find_landmarks(median(samples), excluded)
        return Landmarks(self._to_full_pixels(found.points_px), found.descriptors)

    def known_view(self, view: int) -> KnownView | None:
        """Return a small image of a view in memory, in the pose of its evidence, for registration; None before one."""
        found = self._drift_monitor.image_of_view(view)
        return None if found is None else KnownView(*found)

    def leave_view(self) -> None:
        """Begin another still view with the next image."""
        self._drift_monitor.leave()

    def picture(self, view: int) -> Picture:
        """Return the picture inside the images of a view in memory, pixels of the full image."""
        return self._scenes[view].picture_area.picture

    def background(self, view: int | None = None) -> np.ndarray | None:
        """Return the background image, BGR uint8 (H, W, 3); None before the first image."""
        image = self._scenes[self._view if view is None else view].background.image()
        return None if image is None else black_out(image, self.ignored)  # JPEG ringing at the borders of the polygons

    def _to_full_size(self, track: Track) -> Track:
        kind = TrackKind.UNKNOWN if self._detector_tracks is None else self._detector_tracks.kind(track.vehicle)
        return Track(track.vehicle, track.times_s, self._to_full_pixels(track.points_px), kind)

    def _to_full_pixels(self, points_px: np.ndarray) -> np.ndarray:
        """Convert pixels (n, 2) of the tracked image to the full image; pixel centres are at integer coordinates."""
        return (points_px + 0.5) * self._reduction - 0.5 if self._reduction > 1 else points_px


def _reaches_multiple(before: int, now: int, period: int) -> bool:
    """Return whether one of the numbers from `before` to `now` - 1 is a multiple of the period."""
    return -(-now // period) > -(-before // period)


def _is_searched(scene: _Scene) -> bool:
    """Whether segments and bars of the present background of a scene are known."""
    times_s = scene.background.times_s
    return scene.lines.is_current(times_s) and scene.stripes.is_current(times_s)

"""Moves of the camera in a recording: found with a guessed lens while it is read, measured through the solved one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.lens.camera import Camera
from autocalib_ros.perception.view_registration import ViewPose, ViewReference, normalised
from autocalib_ros.perception.view_watch import KnownView, ViewWatch
from autocalib_ros.results.camera_move import CameraMove, MoveKind, kind_of_move

GUESSED_FOCAL_WIDTHS = 0.6
"""Focal length in image widths for which moves are looked for, 95 degrees across: the least move that is found is
wrong by what the lens is, a factor of two at most."""
FIRST_VIEW_S = 8.0
"""Time after which the view of a part is known, seconds: that of seven images of which the median is one."""
MAX_MOVES = 64
"""Most moves of a recording in memory; a camera in a hand moves all the time."""


@dataclass(frozen=True)
class _Seen:
    """A move as it was found, with the views before and after it; no view after is one that was not recognised."""

    move: CameraMove
    before: KnownView
    after: KnownView | None


class MoveLog:
    """Watches the images of a recording; times are seconds since its first image."""

    def __init__(self) -> None:
        self._watch = ViewWatch()
        self._seen: list[_Seen] = []
        self._first_ns: int | None = None
        self._part_ns = 0

    def add(self, stamp_ns: int, image: np.ndarray, calibrator: AutoCalibrator) -> None:
        """Take an image after the calibrator has; evidence of another view begins where the camera has moved."""
        if self._first_ns is None or stamp_ns < self._first_ns:
            self._first_ns = self._part_ns = stamp_ns
        time_s = (stamp_ns - self._first_ns) * 1e-9
        height, width = image.shape[:2]
        if self._watch.size != (width, height) or not self._watch.views:
            self._begin(stamp_ns, (width, height), calibrator)
            return
        if not self._watch.is_due(time_s):
            return
        report = self._watch.update(image, time_s)
        move = report.move
        if move is None or not (move.is_measured or move.kind is MoveKind.OTHER_VIEW):
            return
        before, after = self._watch.views[0], self._watch.newest_view(move.time_s)
        if len(self._seen) < MAX_MOVES:
            self._seen.append(_Seen(move, before, after if move.is_measured else None))
        calibrator.leave_view(self._first_ns + round(move.time_s * 1e9))
        if move.keeps_lens:
            self._watch.rebase(move)
        else:
            self._watch.end()
            self._part_ns = stamp_ns

    def _begin(self, stamp_ns: int, size: tuple[int, int], calibrator: AutoCalibrator) -> None:
        """Watch the view of the present part, once it is known."""
        if (stamp_ns - self._part_ns) * 1e-9 < FIRST_VIEW_S:
            return
        self._part_ns = stamp_ns  # for another try, where this view has too few outlines
        view = calibrator.known_view()
        if view is not None:
            self._watch.begin([view], Camera.equidistant(*size, GUESSED_FOCAL_WIDTHS * size[0]))

    def moves(self, camera: Camera | None) -> tuple[CameraMove, ...]:
        """Return the moves, measured through a lens; not measured without one, or where it is of another size."""
        return tuple(_measured(seen, camera) for seen in self._seen)


def _measured(seen: _Seen, camera: Camera | None) -> CameraMove:
    """Return a move as it is through a lens: the two views are registered to each other once more."""
    height, width = seen.before.image.shape
    unmeasured = replace(seen.move, pan_deg=0.0, tilt_deg=0.0, roll_deg=0.0, zoom=1.0, sigma_deg=None)
    if camera is None or seen.after is None or abs(width * camera.height - height * camera.width) > camera.width:
        return unmeasured
    reference = ViewReference(seen.before.image, camera.scaled_to(width, height), seen.before.ignored)
    pattern = normalised(seen.after.image)
    pose = reference.near(pattern, ViewPose.identity()) or reference.anywhere(pattern)
    if pose is None:
        return unmeasured
    if seen.move.kind is not MoveKind.ZOOM:
        pose = pose.without_zoom()
    pan, tilt, roll = (float(value) for value in np.degrees(pose.turn_rad))
    zoom = float(np.exp(pose.log_zoom))
    one, two, three = (float(value) for value in np.degrees(np.sqrt(np.diag(pose.covariance)[:3])))
    return CameraMove(
        kind_of_move(float(np.linalg.norm([pan, tilt, roll])), zoom),
        seen.move.time_s,
        pan,
        tilt,
        roll,
        zoom,
        (one, two, three),
    )

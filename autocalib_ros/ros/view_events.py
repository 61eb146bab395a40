"""What happened to the view of the camera, as log lines and as times for /diagnostics. Needs no ROS."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import datetime, timezone

from autocalib_ros.perception.view_watch import ViewCondition, ViewReport
from autocalib_ros.results.camera_move import CameraMove

MOVED_TOLD_S = 60.0
"""Real seconds for which a move is told as an error although the pose is mended: monitors ask once a minute or so."""
RECOVERED_TOLD_S = 10.0
"""Real seconds for which the end of a fault is told."""


class ViewEvents:
    """Remembers the newest events; `clock` returns real seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._was = ViewCondition.UNKNOWN
        self._lost = False
        self._recovered_at = self.mended_at = -MOVED_TOLD_S
        self.last_move: CameraMove | None = None
        """The newest move of the camera; None without one."""

    def told(self, report: ViewReport, stamp_ns: int, *, has_calibration: bool) -> tuple[str, bool]:
        """Take a report that changed; return a line for the log, '' for none, and whether it is good news."""
        was, self._was = self._was, report.condition
        if report.condition is ViewCondition.BLIND and report.fault is not None:
            self._lost = True
            return f'the picture says nothing since {clock_text(report.since_s)}: {report.fault.value}', False
        if report.condition is ViewCondition.MOVED and report.move is not None:
            self._lost = True
            self.last_move = report.move
            return f'the camera moved at {clock_text(report.move.time_s)}: {report}', False
        if report.condition.is_seen and self._lost:
            self._lost = False
            self._recovered_at = self._clock()
            held = 'the calibrated view is back' if has_calibration else 'the picture is back'
            return f'recovered at {clock_text(stamp_ns * 1e-9)}: {held}', True
        if report.condition is ViewCondition.UNKNOWN and was is ViewCondition.BLIND and not report.is_watched:
            self._lost = False
            self._recovered_at = self._clock()
            return f'recovered at {clock_text(stamp_ns * 1e-9)}: the picture is back', True
        return '', True

    def mended(self) -> None:
        """Note that the pose was mended by the newest move."""
        self._lost = False
        self.mended_at = self._clock()

    @property
    def moved_just_now(self) -> bool:
        """Whether the camera moved less than `MOVED_TOLD_S` ago, and the pose was mended."""
        return self._clock() - self.mended_at < MOVED_TOLD_S

    @property
    def recovered_just_now(self) -> bool:
        """Whether a fault ended less than `RECOVERED_TOLD_S` ago."""
        return self._clock() - self._recovered_at < RECOVERED_TOLD_S


def clock_text(stamp_s: float) -> str:
    """Return a stamp in seconds as the time of day (UTC), or as it is where that makes no sense."""
    if 1e8 < stamp_s < 1e11:
        return datetime.fromtimestamp(stamp_s, tz=timezone.utc).strftime('%Y-%m-%d %H:%M:%S UTC')
    return f'{stamp_s:.1f} s'

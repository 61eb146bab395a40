"""The log of the live node: what changed, with its numbers and what to do, and nothing twice. Needs no ROS."""

from __future__ import annotations

import traceback
from typing import Protocol

from autocalib_ros.calibrator import CalibrationProgress
from autocalib_ros.errors import AutocalibError
from autocalib_ros.perception.view_watch import ViewReport
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.ros.log_text import describe, describe_briefly, describe_progress
from autocalib_ros.ros.log_throttle import LogThrottle

PROGRESS_STEP = 10.0
"""Change of the progress in percent that is worth a line."""


class Logger(Protocol):
    """A logger of rclpy, which allows one severity for each place in the code."""

    def info(self, message: str) -> object:
        """Log a line."""

    def warning(self, message: str) -> object:
        """Log a warning."""

    def error(self, message: str) -> object:
        """Log an error."""


class NodeLog:
    """Writes lines of the node to a logger; `throttle` tells which are worth it."""

    def __init__(self, logger: Logger, throttle: LogThrottle | None = None) -> None:
        self._logger = logger
        self._throttle = throttle or LogThrottle()
        self._told_percent = 0.0
        self._told_grade = ''
        self._begun: dict[str, bool] = {}

    def tell(self, text: str, *, good: bool) -> None:
        """Log a line as information or warning; '' logs nothing."""
        if text and good:
            self._logger.info(text)
        elif text:
            self._logger.warning(text)

    def tell_state(self, topic: str, text: str, *, error: bool = True) -> None:
        """Log what lasts unless it says what the last line of its topic said."""
        if not self._throttle.is_due(topic, text):
            return
        if error:
            self._logger.error(text)
        else:
            self._logger.warning(text)

    def tell_outcome(self, topic: str, text: str, *, good: bool) -> None:
        """Log how something ended that is tried again and again, unless it ended like that before."""
        if self._throttle.is_due(topic, text, changed_s=0.0):
            self.tell(text, good=good)

    def tell_event(self, kind: str, text: str) -> bool:
        """Log what happened as a warning, unless it happens all the time; return whether it was logged."""
        more = self._throttle.event(kind)
        if more is not None:
            self._logger.warning(text + more)
        return more is not None

    def tell_begin(self, kind: str, text: str, cause: str = '') -> bool:
        """Log what begins, as `tell_event`, by its cause."""
        self._begun[kind] = self.tell_event(f'{kind} {cause}', text)
        return self._begun[kind]

    def tell_end(self, kind: str, text: str) -> None:
        """Log that it is over, where its beginning was logged; '' logs nothing."""
        self.tell(text if self._begun.get(kind, True) else '', good=True)

    def tell_fault(self, error: Exception) -> None:
        """Log a fault of the program with its traceback, for a bug report; one of the machine in a line."""
        whole = isinstance(error, AutocalibError)
        text = str(error) if whole else ''.join(traceback.format_exception(error)).rstrip()
        self.tell_state(f'fault {type(error).__name__}', text)

    def tell_refusal(self, refusal: Refusal) -> None:
        """Log why there is no solution."""
        self.tell_state(f'refusal {refusal.code}', describe(refusal), error=False)

    def tell_solution(self, result: Calibration, decision: str, *, good: bool) -> None:
        """Log what was decided about a new solution, and the solution: whole where its grade is another than before."""
        self._throttle.forget('refusal')
        if decision and (not good or self._throttle.is_due('decision', decision, changed_s=0.0)):
            self.tell(decision, good=good)
        if self._throttle.is_due('solution', f'grade {result.grade}', changed_s=0.0) or not good:
            self._logger.info(describe(result) if result.grade != self._told_grade else describe_briefly(result))
            self._told_grade = result.grade

    def tell_progress(self, progress: CalibrationProgress | None) -> None:
        """Log how far the evidence is, when it got further."""
        percent = 0.0 if progress is None else progress.percent
        if abs(percent - self._told_percent) >= PROGRESS_STEP:
            self._throttle.forget('progress')
        if self._throttle.is_due('progress', '' if progress is None else ', '.join(progress.missing)):
            self._told_percent = percent
            self._logger.info(describe_progress(progress))

    def tell_view(self, report: ViewReport, text: str, *, good: bool) -> bool:
        """Log what happened to the view; return whether what began was logged."""
        if good:
            self.tell_end('view', text)
        elif text:
            self.tell_begin('view', text, str(report.fault or (report.move and report.move.kind)))
        return self._begun.get('view', True)

    def start_over(self) -> None:
        """Tell the next calibration in full: that before was withdrawn."""
        self._told_grade = ''
        self._throttle.forget('solution')
        self._throttle.forget('decision')

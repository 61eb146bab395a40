"""Lines of the log: what happens again and again is told a few times, and a calibration whole where it is new."""

from dataclasses import replace

import pytest

from autocalib_ros.calibrator import CalibrationProgress
from autocalib_ros.perception.picture_faults import PictureFault
from autocalib_ros.perception.view_watch import ViewCondition, ViewReport
from autocalib_ros.ros.log_throttle import MAX_EVENTS
from autocalib_ros.ros.node_log import NodeLog
from stored_results import calibration


class Lines(list):
    """A logger that keeps its lines."""

    def info(self, message: str) -> None:
        self.append(message)

    warning = error = info


@pytest.fixture
def lines() -> Lines:
    return Lines()


def test_calibrations_of_one_grade_are_told_briefly_and_not_each(lines):
    log, found = NodeLog(lines), calibration()
    for _ in range(5):
        log.tell_solution(found, '', good=True)
    log.tell_solution(found, 'the traffic contradicts it', good=False)
    log.tell_solution(replace(found, grade='fair'), '', good=True)
    whole, contradiction, brief, other = lines
    assert 'assumptions' in whole and 'assumptions' in other and 'assumptions' not in brief
    assert contradiction == 'the traffic contradicts it' and 'focal length' in brief


def test_withdrawn_calibration_is_followed_by_a_whole_line(lines):
    log = NodeLog(lines)
    log.tell_solution(calibration(), '', good=True)
    log.start_over()
    log.tell_solution(calibration(), '', good=True)
    assert len(lines) == 2 and lines[0] == lines[1]


def test_end_of_a_fault_is_told_where_the_fault_was(lines):
    log = NodeLog(lines)
    frozen = ViewReport(ViewCondition.BLIND, fault=PictureFault.FROZEN)
    for number in range(3 * MAX_EVENTS):
        log.tell_view(frozen, f'frozen {number}', good=False)
        log.tell_view(ViewReport(ViewCondition.STILL), f'recovered {number}', good=True)
    assert lines == [f'{what} {number}' for number in range(MAX_EVENTS) for what in ('frozen', 'recovered')]


def test_progress_is_told_when_it_changed(lines):
    log = NodeLog(lines)

    def told(percent: float, *missing: str) -> bool:
        lines.clear()
        log.tell_progress(CalibrationProgress(percent, missing, f'about {percent} min more'))
        return bool(lines)

    assert told(3, '40 tracks')
    assert not told(3, '40 tracks') and not told(12, '31 tracks')
    assert told(14, '30 tracks') and not told(14, '30 tracks')


def test_what_begins_and_ends_all_the_time_is_told_in_pairs(lines):
    log = NodeLog(lines)
    for number in range(3 * MAX_EVENTS):
        log.tell_begin('size', f'withdrawn {number}')
        log.tell_end('size', f'again {number}')
    assert lines == [f'{what} {number}' for number in range(MAX_EVENTS) for what in ('withdrawn', 'again')]

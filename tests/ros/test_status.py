"""Content of /diagnostics for each state of the node."""

from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.calibrator import CalibrationProgress
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.perception.picture_faults import PictureFault
from autocalib_ros.perception.view_watch import ViewCondition, ViewReport
from autocalib_ros.results.calibration import Calibration, EvidenceSummary, StandardDeviations
from autocalib_ros.results.camera_move import CameraMove, MoveKind
from autocalib_ros.results.refusals import Reason
from autocalib_ros.results.statements import assumption
from autocalib_ros.ros.solver_activity import SolverActivity, SolverState
from autocalib_ros.ros.status import (
    ERROR,
    OK,
    RATE_WINDOW_S,
    WARN,
    Counts,
    NodeState,
    RateCounter,
    Situation,
    calibration_status,
    state_of,
    status,
)
from autocalib_ros.ros.view_events import ViewEvents
from autocalib_ros.ros.watchdog import NoImageDiagnosis

TILT_DEG = 30.0
COS, SIN = np.cos(np.radians(TILT_DEG)), np.sin(np.radians(TILT_DEG))
TILTED = np.array([[0.0, -SIN, COS], [-1.0, 0.0, 0.0], [0.0, -COS, -SIN]])
"""ground_from_camera of a camera that looks along the road, down by TILT_DEG."""
RESULT = Calibration(
    method='joint',
    grade='full',
    assumptions=(assumption('paper_roads'),),
    camera=Camera.equidistant(1280, 720, 512.346),
    ground=GroundPlane(TILTED, 8.0),
    ground_refusal=None,
    road_directions=np.zeros((0, 3)),
    stddev=StandardDeviations(focal_px=2.5, tilt_deg=0.125, roll_deg=0.25, height_m=0.1),
    paper=None,
    evidence=EvidenceSummary(
        image_size=(1280, 720), seconds=60.0, frames=900, tracks=80, segments=300, vehicles=40, coverage=0.4
    ),
    newest_stamp_ns=1_700_000_000_250_000_000,
)
WAITING = Situation(topic='/cam1/image', counts=Counts())
COLLECTING = replace(
    WAITING,
    counts=Counts(received=50, used=49, dropped=1),
    image_age_s=0.04,
    encoding='bgr8',
    progress=CalibrationProgress(42.4, ('17 of 40 tracks', 'another'), 'about 6 min more at this rate'),
    rates_hz=Counts(received=10.0, used=9.8, dropped=0.2),
)
CALIBRATED = replace(COLLECTING, result=RESULT, progress=CalibrationProgress(100.0, ()))


@pytest.mark.parametrize(
    ('situation', 'state', 'level'),
    [
        (WAITING, NodeState.WAITING_FOR_IMAGES, WARN),
        (replace(WAITING, counts=Counts(received=9, unreadable=9)), NodeState.WAITING_FOR_IMAGES, WARN),
        (COLLECTING, NodeState.COLLECTING, WARN),
        (CALIBRATED, NodeState.CALIBRATED, OK),
        (replace(CALIBRATED, restored=True), NodeState.RESTORED, WARN),
    ],
)
def test_state_and_its_level(situation, state, level):
    assert state_of(situation) is state
    current = status(situation)
    assert (current.level, current.message.startswith(state.value)) == (level, True)
    assert dict(current.values)['state'] == state.value


@pytest.mark.parametrize(
    ('changes', 'level', 'expected'),
    [
        ({'no_image': NoImageDiagnosis('no publisher', False)}, WARN, 'no publisher'),
        ({'no_image': NoImageDiagnosis('another type', True)}, ERROR, 'another type'),
        ({'unreadable': "image encoding 'x' is not supported"}, ERROR, "images cannot be used: image encoding 'x'"),
        ({'errors': ('the image size changed',)}, ERROR, 'the image size changed'),
        ({'warnings': ('two publishers',)}, WARN, 'two publishers'),
        (
            {'rates_hz': Counts(received=30.0, used=20.0, dropped=10.0)},
            WARN,
            '10.0 of 30.0 images per second are dropped',
        ),
        ({'rates_hz': Counts(received=30.0, late=30.0)}, WARN, 'time stamps of the images do not increase'),
    ],
)
def test_trouble_raises_the_level_of_a_calibrated_node_and_is_reported(changes, level, expected):
    trouble = status(replace(CALIBRATED, **changes))
    assert trouble.level == level
    assert trouble.message.startswith('CALIBRATED') and expected in trouble.message


def test_worst_trouble_is_reported_first():
    message = status(replace(CALIBRATED, warnings=('small',), errors=('great',))).message
    assert message.index('great') < message.index('small')


def test_stream_that_stops_brings_no_complaint_about_stamps():
    assert status(replace(CALIBRATED, rates_hz=Counts())).level == OK


def test_progress_is_reported_in_the_message_and_in_values():
    current = status(COLLECTING)
    assert '42 %: 17 of 40 tracks; another, about 6 min more' in current.message
    values = dict(current.values)
    assert (values['evidence_percent'], values['missing'], values['outlook']) == (
        '42',
        '17 of 40 tracks; another',
        'about 6 min more at this rate',
    )


def test_numbers_of_the_stream_are_reported():
    values = dict(status(COLLECTING).values)
    expected = {
        'image_topic': '/cam1/image',
        'encoding': 'bgr8',
        'image_age_s': '0.0',
        'received_hz': '10.0',
        'used_hz': '9.8',
        'received': '50',
        'used': '49',
        'dropped': '1',
        'unreadable': '0',
        'late': '0',
    }
    assert {name: values[name] for name in expected} == expected


def test_numbers_of_the_calibration_are_reported():
    values = dict(status(CALIBRATED).values)
    expected = {
        'grade': 'full',
        'focal_px': '512.35',
        'focal_sigma_px': '2.5',
        'tilt_deg': '30.00',
        'tilt_sigma_deg': '0.125',
        'roll_sigma_deg': '0.25',
        'height_m': '8.000',
        'height_sigma_m': '0.1',
        'assumptions': 'the two roads are perpendicular',
        'verification': '',
        'no_ground_plane': '',
        'newest_stamp_s': '1700000000.250',
    }
    assert {name: values[name] for name in expected} == expected


def test_lens_alone_gives_the_reason_there_is_no_plane():
    lens = replace(
        RESULT,
        grade='lens',
        ground=None,
        ground_refusal=Reason('no_height', 'no height given.', 'give it'),
        stddev=StandardDeviations(focal_px=2.5),
    )
    values = dict(status(replace(CALIBRATED, result=lens)).values)
    assert (values['no_ground_plane'], values['tilt_deg'], values['height_m']) == ('no height given.', '', '')


@pytest.mark.parametrize('situation', [WAITING, COLLECTING, CALIBRATED])
def test_every_state_has_the_same_keys_of_text(situation):
    values = status(situation).values
    assert [key for key, _ in values] == [key for key, _ in status(CALIBRATED).values]
    assert all(type(value) is str for _, value in values)


def test_rates_are_those_of_the_last_seconds():
    recent = RateCounter()
    assert recent.rates_hz(0.0, Counts()) is None
    for second in range(1, 61):
        count = 10 * second if second <= 30 else 300 + 2 * (second - 30)  # the camera slows down after 30 s
        rates = recent.rates_hz(float(second), Counts(received=count, used=count))
    assert rates.received == pytest.approx(2.0)
    assert rates.used == pytest.approx(2.0)


def test_rates_of_a_node_asked_seldom_still_cover_something():
    recent = RateCounter()
    recent.rates_hz(0.0, Counts())
    assert recent.rates_hz(4 * RATE_WINDOW_S, Counts(received=40)).received == pytest.approx(40 / (4 * RATE_WINDOW_S))


BUMP = CameraMove(MoveKind.BUMP, 1_700_000_100.0, 1.0, -0.5, 0.25, sigma_deg=(0.02, 0.02, 0.02))


@pytest.mark.parametrize(
    ('changes', 'state', 'level', 'pose'),
    [
        ({'view': ViewReport(ViewCondition.MOVED, move=BUMP), 'withheld': True}, NodeState.MOVED, ERROR, 'withheld'),
        ({'view': ViewReport(ViewCondition.MOVED, move=BUMP)}, NodeState.MOVED, ERROR, 'stale'),
        (
            {'view': ViewReport(ViewCondition.STILL), 'mended': True, 'moved_just_now': True},
            NodeState.MOVED,
            ERROR,
            'mended',
        ),
        ({'view': ViewReport(ViewCondition.STILL), 'mended': True}, NodeState.MENDED, WARN, 'mended'),
        ({'view': ViewReport(ViewCondition.BLIND, fault=PictureFault.BLACK)}, NodeState.BLIND, ERROR, 'stale'),
        ({'view': ViewReport(ViewCondition.UNKNOWN), 'withheld': True}, NodeState.BLIND, ERROR, 'withheld'),
        ({'view': ViewReport(ViewCondition.STILL), 'recovered_just_now': True}, NodeState.RECOVERED, OK, 'calibrated'),
        (
            {'view': ViewReport(ViewCondition.STILL), 'doubt': 'focal length differs'},
            NodeState.DEGRADED,
            WARN,
            'calibrated',
        ),
        ({'view': ViewReport(ViewCondition.STILL), 'restored': True}, NodeState.RESTORED, OK, 'calibrated'),
    ],
)
def test_what_happened_to_the_view_is_a_state(changes, state, level, pose):
    situation = replace(CALIBRATED, last_move=BUMP, **changes)
    shown = calibration_status(situation)
    assert (shown.level, dict(shown.values)['state'], dict(shown.values)['pose']) == (level, state.value, pose)
    assert status(situation).level == level
    assert dict(status(situation).values)['moved_pan_deg'] == '1.000'


def test_degrees_and_time_of_a_move_are_in_the_message():
    moved = replace(
        CALIBRATED, last_move=BUMP, view=ViewReport(ViewCondition.MOVED, 1_700_000_100.0, move=BUMP), withheld=True
    )
    message = status(moved).message
    assert 'pan +1.00 ± 0.02, tilt -0.50' in message
    assert '2023-11-14 22:15:00 UTC' in message
    assert dict(calibration_status(moved).values)['valid_until_s'] == '1700000100.000'


def test_events_are_told_once_and_recovery_after_them():
    now = [0.0]
    events = ViewEvents(lambda: now[0])
    assert events.told(ViewReport(ViewCondition.STILL), 0, has_calibration=True)[0] == ''
    text, good = events.told(ViewReport(ViewCondition.BLIND, fault=PictureFault.FROZEN), 0, has_calibration=True)
    assert 'frozen' in text and not good
    text, good = events.told(ViewReport(ViewCondition.STILL), 0, has_calibration=True)
    assert 'the calibrated view is back' in text and good and events.recovered_just_now
    now[0] += 100.0
    assert not events.recovered_just_now


def test_solver_is_seen_while_it_solves_and_after_it_failed():
    now = [0.0]
    activity = SolverActivity(lambda: now[0])
    assert activity.summary().state is SolverState.IDLE
    activity.begin()
    now[0] += 30.0
    activity.end()
    activity.begin()
    now[0] += 12.0
    solving = replace(COLLECTING, solver=activity.summary())
    assert 'solving for 12 s, usually 30 s' in status(solving).message
    activity.fail(TimeoutError('took longer than 900 s'), timed_out=True)
    failed = status(replace(CALIBRATED, solver=activity.summary()))
    assert failed.level == WARN
    assert 'TIMED_OUT: took longer than 900 s' in failed.message
    assert dict(failed.values)['result_age_s'] == '12'
    activity.begin()
    activity.end()
    assert status(replace(CALIBRATED, solver=activity.summary())).level == OK

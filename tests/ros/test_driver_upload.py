"""Upload of the calibration to the driver."""

import threading
from types import SimpleNamespace

import pytest
from sensor_msgs.srv import SetCameraInfo

from autocalib_ros.lens.camera_info import camera_info
from autocalib_ros.revalidation import CalibrationState
from autocalib_ros.ros import driver_upload
from bench import calibration, wait_for
from test_node import calibrated, publish_until

LOG_METHOD = 'autocalib_ros.ros.node_log.NodeLog.tell'


@pytest.fixture
def log_lines(monkeypatch) -> list[str]:
    """Return the log lines of the node."""
    lines: list[str] = []
    monkeypatch.setattr(LOG_METHOD, lambda self, text, *, good: lines.append(text))
    return lines


@pytest.fixture
def driver(bench):
    """Serve set_camera_info as a driver does; return the requests and its next answers."""

    state = SimpleNamespace(received=[], answers=[])
    state.received, state.answers = [], []

    def answer(request, response):
        state.received.append(request.camera_info)
        response.success, response.status_message = state.answers.pop(0) if state.answers else (True, '')
        return response

    bench.client.create_service(SetCameraInfo, '/set_camera_info', answer)
    return state


def test_calibration_is_sent_once(bench, driver, log_lines):
    node, publisher = calibrated(bench, upload_to_driver=True)
    wait_for(lambda: any('accepted the calibration' in line for line in log_lines), 'the line of the log')
    fields = camera_info(node.publication.published.result.camera)
    (sent,) = driver.received
    assert (list(sent.k), list(sent.d), sent.width) == (fields.k, fields.d, fields.width)
    before = node._worker.counters.used
    publish_until(publisher, lambda: node._worker.counters.used > before + 3, 'more images')
    assert not threading.Event().wait(2 * driver_upload.UPLOAD_POLL_S)
    assert len(driver.received) == 1


def test_newest_of_several_calibrations_is_sent_after_a_while(bench, driver, log_lines, monkeypatch):
    monkeypatch.setattr(driver_upload, 'UPLOAD_PERIOD_S', 1.0)
    focals = iter((300.0, 310.0, 320.0))
    calibrated(bench, lambda evidence, options, lens: calibration(evidence, next(focals)), upload_to_driver=True)
    assert bench.calibrate().success and bench.calibrate().success
    wait_for(lambda: driver.received and driver.received[-1].k[0] == 320.0, 'the newest')
    assert len(driver.received) <= 2


def test_nothing_is_sent_unless_asked_for(bench, driver):
    calibrated(bench)
    assert not threading.Event().wait(2 * driver_upload.UPLOAD_POLL_S)
    assert not driver.received


def test_restored_calibration_is_sent_only_when_the_traffic_confirms_it(bench, driver, log_lines, ros_home):
    node, publisher = calibrated(bench, camera_name='north')
    wait_for((ros_home / 'camera_info' / 'north.yaml').exists, 'the file')
    bench.stop(node)
    node = bench.start(
        lambda evidence, options, lens: calibration(evidence),
        camera_name='north',
        upload_to_driver=True,
        idle_solve_s=1000.0,
    )
    assert node.publication.state is CalibrationState.RESTORED
    publish_until(publisher, lambda: node._worker.counters.used, 'an image')
    assert not threading.Event().wait(2 * driver_upload.UPLOAD_POLL_S)
    assert not driver.received
    assert bench.calibrate().success
    wait_for(lambda: driver.received, 'the call')


def test_refusal_of_the_driver_is_reported(bench, driver, log_lines):
    driver.answers.append((False, 'read-only lens'))
    calibrated(bench, upload_to_driver=True)
    wait_for(
        lambda: any('rejected the calibration: read-only lens' in line for line in log_lines), 'the line of the log'
    )


def test_missing_driver_is_reported_and_found_when_it_comes(bench, log_lines, request):
    calibrated(bench, upload_to_driver=True)
    wait_for(
        lambda: any('no driver serves /set_camera_info: remap it' in line for line in log_lines), 'the line of the log'
    )
    driver = request.getfixturevalue('driver')
    wait_for(lambda: driver.received, 'the call')


def test_driver_that_does_not_answer_is_given_up(bench, log_lines, monkeypatch):
    monkeypatch.setattr(driver_upload, 'DRIVER_TIMEOUT_S', 0.5)
    monkeypatch.setattr('autocalib_ros.ros.driver_upload.DriverUpload._answered', lambda self, call: None)
    silent = bench.client.create_service(SetCameraInfo, '/set_camera_info', lambda request, response: response)
    assert silent
    _node, _ = calibrated(bench, upload_to_driver=True)
    wait_for(lambda: any('no answer from the driver within' in line for line in log_lines), 'the line of the log')
    wait_for(lambda: bench.calibrate().success, 'the node, which goes on')

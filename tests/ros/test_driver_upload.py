"""The calibration goes to the driver, where that is wanted."""

import threading

import pytest
from sensor_msgs.srv import SetCameraInfo

from autocalib_ros.lens.camera_info import camera_info
from autocalib_ros.revalidation import CalibrationState
from autocalib_ros.ros import driver_upload
from bench import calibration, wait_for
from test_node import calibrated, publish_until

TOLD = 'autocalib_ros.ros.autocalib_node.AutocalibNode._say'


@pytest.fixture
def told(monkeypatch) -> list[str]:
    """Return the lines that the node says."""
    lines: list[str] = []
    monkeypatch.setattr(TOLD, lambda self, text, *, good: lines.append(text))
    return lines


@pytest.fixture
def driver(bench):
    """Serve set_camera_info as a driver does; return what it was sent and its next answers."""

    class Driver:
        received: list = []
        answers: list = []

    state = Driver()
    state.received, state.answers = [], []

    def answer(request, response):
        state.received.append(request.camera_info)
        response.success, response.status_message = state.answers.pop(0) if state.answers else (True, '')
        return response

    bench.client.create_service(SetCameraInfo, '/set_camera_info', answer)
    return state


def test_calibration_is_sent_once(bench, driver, told):
    node, publisher = calibrated(bench, upload_to_driver=True)
    wait_for(lambda: any('took the calibration' in line for line in told), 'the line of the log')
    fields = camera_info(node.publication.published.result.camera)
    (sent,) = driver.received
    assert (list(sent.k), list(sent.d), sent.width) == (fields.k, fields.d, fields.width)
    before = node._worker.counters.used
    publish_until(publisher, lambda: node._worker.counters.used > before + 3, 'more images')
    assert not threading.Event().wait(2 * driver_upload.UPLOAD_POLL_S)
    assert len(driver.received) == 1


def test_newest_of_several_calibrations_is_sent_after_a_while(bench, driver, told, monkeypatch):
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


def test_restored_calibration_is_sent_only_when_the_traffic_confirms_it(bench, driver, told, ros_home):
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


def test_refusal_of_the_driver_is_told(bench, driver, told):
    driver.answers.append((False, 'read-only lens'))
    calibrated(bench, upload_to_driver=True)
    wait_for(lambda: any('refused the calibration: read-only lens' in line for line in told), 'the line of the log')


def test_missing_driver_is_told_and_found_when_it_comes(bench, told, request):
    calibrated(bench, upload_to_driver=True)
    wait_for(lambda: any('no driver serves /set_camera_info: remap it' in line for line in told), 'the line of the log')
    driver = request.getfixturevalue('driver')
    wait_for(lambda: driver.received, 'the call')


def test_driver_that_does_not_answer_is_given_up(bench, told, monkeypatch):
    monkeypatch.setattr(driver_upload, 'DRIVER_TIMEOUT_S', 0.5)
    monkeypatch.setattr('autocalib_ros.ros.driver_upload.DriverUpload._answered', lambda self, call: None)
    silent = bench.client.create_service(SetCameraInfo, '/set_camera_info', lambda request, response: response)
    assert silent
    node, _ = calibrated(bench, upload_to_driver=True)
    wait_for(lambda: any('did not answer within' in line for line in told), 'the line of the log')
    wait_for(lambda: bench.calibrate().success, 'the node, which goes on')

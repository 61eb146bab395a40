"""Response of the node to its image stream, driver and parameters, over DDS."""

from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, RegionOfInterest

from autocalib_ros.results.calibration import StandardDeviations
from autocalib_ros.ros import image_input
from autocalib_ros.ros.driver_info import check_size
from autocalib_ros.ros.messages import stamp_ns, time_message
from bench import SIZE, Bench, calibration, image, wait_for

START_NS = 1_700_000_000_000_000_000
FRAME_NS = 100_000_000
INFO = '/autocalib/camera_info'


@pytest.fixture
def statuses(bench: Bench) -> list:
    return bench.collect(DiagnosticArray, '/diagnostics')


def message(statuses: list) -> str:
    return statuses[-1].status[0].message if statuses else ''


def values(statuses: list) -> dict[str, str]:
    return {item.key: item.value for item in statuses[-1].status[0].values} if statuses else {}


def fed(bench: Bench, count: int = 3, **parameters):
    """Return a node that used `count` images, and the publisher of its images."""
    heights = parameters.pop('heights', [])

    def solve(evidence, options, lens):
        heights.append(options.camera_height)
        return calibration(evidence)

    node = bench.start(solve, idle_solve_s=0.3, **parameters)
    publisher = bench.connected(bench.publisher())
    counters = node._worker.counters
    for number in range(count):
        publisher.publish(image(START_NS + number * FRAME_NS))
        wait_for(lambda wanted=number + 1: counters.used >= wanted, 'an image')
    return node, publisher


def test_calibrated_node_reports_it_in_diagnostics(bench, statuses):
    fed(bench, camera_height=8.0)
    wait_for(lambda: values(statuses).get('state') == 'CALIBRATED', 'the calibration')
    assert (statuses[-1].status[0].level, statuses[-1].status[0].name) == (b'\x00', 'autocalib: calibration')
    assert (values(statuses)['grade'], values(statuses)['focal_px'], values(statuses)['focal_sigma_px']) == (
        'full',
        '300.00',
        '1',
    )
    assert stamp_ns(statuses[-1].header.stamp) > START_NS


@pytest.mark.parametrize(
    ('kind', 'reliability', 'parameters', 'words'),
    [
        (CompressedImage, ReliabilityPolicy.RELIABLE, {}, 'publishes /image as sensor_msgs/msg/CompressedImage'),
        (Image, ReliabilityPolicy.BEST_EFFORT, {'image_reliability': 'reliable'}, 'set image_reliability:=auto'),
    ],
    ids=['type', 'reliability'],
)
def test_stream_that_cannot_be_heard_is_reported_as_an_error(
    bench, statuses, capfd, monkeypatch, kind, reliability, parameters, words
):
    monkeypatch.setattr(image_input, 'NO_IMAGE_TIMEOUT_S', 0.3)
    bench.publisher(kind, reliability=reliability)
    bench.start(**parameters)
    wait_for(lambda: words in message(statuses), 'the reason')
    assert statuses[-1].status[0].level == b'\x02'
    assert words in capfd.readouterr().err


def test_image_that_cannot_be_decoded_is_an_error_until_one_can(bench, statuses):
    _node, publisher = fed(bench)
    publisher.publish(image(START_NS + 10 * FRAME_NS, encoding='no_such_encoding'))
    wait_for(lambda: "'no_such_encoding' is not supported" in message(statuses), 'the complaint')
    assert (statuses[-1].status[0].level, values(statuses)['unreadable']) == (b'\x02', '1')
    publisher.publish(image(START_NS + 11 * FRAME_NS))
    wait_for(lambda: 'no_such_encoding' not in message(statuses), 'the end of the complaint')


def test_size_that_changes_is_an_error_until_there_is_a_new_calibration(bench, statuses):
    node, publisher = fed(bench, camera_height=8.0)
    wait_for(lambda: node.publication.published, 'the calibration')
    node._worker.change(node.options, 1000.0)  # no solution for now
    for number in range(1, 7):  # a size counts when it has lasted for 3 s
        publisher.publish(image(START_NS + 10 * number * FRAME_NS, size=(160, 120)))
    wait_for(lambda: 'the present ones 160x120' in message(statuses), 'the error')
    assert (statuses[-1].status[0].level, values(statuses)['state']) == (b'\x02', 'COLLECTING')
    node._worker.change(node.options, 0.1)
    wait_for(lambda: values(statuses)['state'] == 'CALIBRATED', 'a calibration of the new size')
    assert statuses[-1].status[0].level == b'\x00'


def test_second_publisher_of_our_camera_info_is_reported(bench, statuses):
    bench.client.create_publisher(CameraInfo, INFO, QoSProfile(depth=1))
    bench.start()
    wait_for(lambda: f'/client also publishes {INFO}: remap one of the two' in message(statuses), 'the warning')
    assert statuses[-1].status[0].level == b'\x01'


def test_two_cameras_on_one_topic_are_reported(bench, statuses):
    bench.publisher(), bench.publisher()
    bench.start()
    wait_for(lambda: '2 publishers share /image' in message(statuses), 'the warning')


@pytest.mark.parametrize('wanted', [True, False])
def test_newest_message_of_the_driver_is_kept_where_that_is_wanted(bench, wanted):
    driver = bench.client.create_publisher(CameraInfo, 'camera_info_in', QoSProfile(depth=1))
    node = bench.start(use_driver_camera_info=wanted)
    if not wanted:
        assert (node._driver.newest, node._driver.check(SIZE), driver.get_subscription_count()) == (None, '', 0)
        return
    assert 'no CameraInfo on /camera_info_in' in node._driver.check(SIZE)
    bench.connected(driver)
    driver.publish(CameraInfo(width=2 * SIZE[0], height=2 * SIZE[1], binning_x=2, binning_y=2))
    wait_for(lambda: node._driver.newest, 'the message')
    assert (node._driver.newest.binning_x, node._driver.check(SIZE)) == (2, '')
    assert '320x240, these have 640x480' in node._driver.check((640, 480))


def test_binning_and_region_of_the_driver_are_published_where_they_are_of_these_images(bench):
    infos = bench.collect(CameraInfo, INFO)
    driver = bench.client.create_publisher(CameraInfo, 'camera_info_in', QoSProfile(depth=1))
    node, publisher = fed(bench, camera_height=8.0, use_driver_camera_info=True)
    bench.connected(driver)
    region = RegionOfInterest(x_offset=100, y_offset=50, width=2 * SIZE[0], height=2 * SIZE[1])
    readouts = (
        CameraInfo(width=1920, height=1080, binning_x=2, binning_y=2, roi=region),
        CameraInfo(width=700, height=480, roi=RegionOfInterest(x_offset=500, width=SIZE[0], height=SIZE[1])),
        CameraInfo(width=7, height=7),
    )
    wait_for(lambda: node.publication.published, 'the calibration')
    for number, driver_info in enumerate(readouts, 10):
        driver.publish(driver_info)
        wait_for(lambda width=driver_info.width: node._driver.newest and node._driver.newest.width == width, 'it')
        sent = image(START_NS + number * FRAME_NS)
        publisher.publish(sent)
        wait_for(lambda sent=sent: infos and infos[-1].header == sent.header, 'camera_info of the image')
        if driver_info.width == 1920:
            binned = infos[-1]
        else:
            assert (infos[-1].width, infos[-1].binning_x) == (SIZE[0], 0)
    assert (binned.width, binned.height, binned.binning_x, binned.roi) == (1920, 1080, 2, region)
    assert (infos[-1].width, infos[-1].binning_x) == (SIZE[0], 0)
    np.testing.assert_allclose((np.array(binned.k[:6:2]) - [0, 100, 0]) / 2, infos[-1].k[:6:2])


@pytest.mark.parametrize(
    ('info', 'fits'),
    [
        (CameraInfo(width=640, height=480), True),
        (CameraInfo(width=1280, height=960, binning_x=2, binning_y=2), True),
        (CameraInfo(width=1281, height=961, binning_x=2, binning_y=2), True),
        (CameraInfo(width=1920, height=1080, roi=RegionOfInterest(x_offset=9, width=640, height=480)), True),
        (CameraInfo(), True),  # a driver that knows no size
        (CameraInfo(width=1280, height=960), False),
        (CameraInfo(width=1000, height=720, roi=RegionOfInterest(x_offset=600, width=640, height=480)), False),
        (CameraInfo(width=640, height=480, binning_x=2, binning_y=2), False),
    ],
)
def test_size_of_the_drivers_message_is_compared_with_the_images(info, fits):
    assert (check_size(info, (640, 480)) == '') is fits


def test_camera_height_that_changes_is_solved_with_at_once(bench):
    heights = []
    node, _ = fed(bench, camera_height=8.0, heights=heights)
    wait_for(lambda: heights == [8.0], 'the first solution')
    assert node.set_parameters_atomically([Parameter('camera_height', value=9.0)]).successful
    wait_for(lambda: heights == [8.0, 9.0], 'a solution with the new height')


def test_pixel_outside_the_images_is_refused_once_their_size_is_known(bench):
    node, _ = fed(bench)
    refused = node.set_parameters_atomically(
        [
            Parameter('scale_from', value='distance'),
            Parameter('scale.distance_m', value=5.0),
            Parameter('scale.distance_px', value='10 10 900 10'),
        ]
    )
    assert not refused.successful and 'lies outside the images' in refused.reason


def test_recording_that_loops_restarts_the_evidence_and_keeps_the_calibration(bench):
    infos = bench.collect(CameraInfo, INFO)
    node, publisher = fed(bench, count=20, camera_height=8.0)
    wait_for(lambda: (now := node.publication.published) and now.result.evidence.frames == 20, 'the calibration')
    bench.listening(INFO)
    again = [image(START_NS), image(START_NS + FRAME_NS)]  # the second tells the loop from one odd stamp
    for sent in again:
        publisher.publish(sent)
    wait_for(lambda: [info.header for info in infos[-2:]] == [sent.header for sent in again], 'their camera_info')
    wait_for(lambda: node.publication.published.result.evidence.frames == 2, 'the evidence of the second time')


@pytest.mark.parametrize(
    ('focal_px', 'state', 'published_px'), [(305.0, 'VERIFIED', 300.0), (400.0, 'CALIBRATED', 400.0)]
)
def test_after_a_loop_a_more_precise_calibration_stays_unless_the_traffic_contradicts_it(
    bench, focal_px, state, published_px
):
    def solve(evidence, options, lens):
        if evidence.frames > 3:
            return calibration(evidence)
        return replace(calibration(evidence, focal_px), stddev=StandardDeviations(focal_px=9.0))

    node = bench.start(solve, idle_solve_s=0.3, camera_height=8.0)
    publisher, counters = bench.connected(bench.publisher()), node._worker.counters
    for number in range(20):
        publisher.publish(image(START_NS + number * FRAME_NS))
        wait_for(lambda wanted=number + 1: counters.used >= wanted, 'an image')
    wait_for(lambda: (now := node.publication.published) and now.result.evidence.frames == 20, 'the calibration')
    for number in range(2):
        publisher.publish(image(START_NS + number * FRAME_NS))
    wait_for(lambda: counters.used == 21 and node.publication.state.name == state, 'the first after the loop')
    wait_for(lambda: node.publication.published.result.camera.focal_px == published_px, 'the published calibration')


def test_images_twice_and_out_of_order_are_left_out_of_the_evidence_but_get_camera_info(bench, statuses):
    infos = bench.collect(CameraInfo, INFO)
    node, publisher = fed(bench, count=10, camera_height=8.0)
    wait_for(lambda: node.publication.published, 'the calibration')
    bench.listening(INFO)
    late = [image(START_NS + number * FRAME_NS) for number in (9, 5)]
    for sent in late:
        publisher.publish(sent)
    wait_for(lambda: [info.header for info in infos[-2:]] == [sent.header for sent in late], 'their camera_info')
    wait_for(lambda: values(statuses).get('late') == '2', 'the count')
    assert values(statuses)['used'] == '10'


def test_images_without_stamps_take_their_time_from_the_clock_of_the_recording(bench):
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    clock = bench.client.create_publisher(Clock, '/clock', latched)
    node = bench.start(lambda evidence, options, lens: calibration(evidence), use_sim_time=True, idle_solve_s=0.3)
    publisher = bench.connected(bench.publisher())
    counters = node._worker.counters
    for second in (5000, 5001, 5002, 20, 21):  # the clock steps back, as where a recording is played in a loop
        clock.publish(Clock(clock=time_message(second * 10**9)))
        wait_for(lambda now=second: node.get_clock().now().nanoseconds == now * 10**9, 'the clock')
        before = counters.used + counters.late
        publisher.publish(image(0))
        wait_for(lambda before=before: counters.used + counters.late == before + 1, 'an image')
    wait_for(lambda: (now := node.publication.published) and now.result.newest_stamp_ns == 21 * 10**9, 'the solution')
    assert node.publication.published.result.evidence.frames == 2

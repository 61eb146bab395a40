"""The example consumer as a real node, over DDS."""

import signal
import subprocess
import sys

import numpy as np
import pytest
from geometry_msgs.msg import Point32, Polygon, PolygonStamped, TransformStamped
from sensor_msgs.msg import CameraInfo, PointCloud2

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.ground import Ground
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import camera_info
from autocalib_ros.offline.synthetic.junction import pose
from autocalib_ros.ros import messages
from autocalib_ros.ros.ground_points_node import GroundPointsNode
from autocalib_ros.ros.qos import LATCHED
from bench import wait_for

pytestmark = pytest.mark.dds

CAMERA = Camera(1280, 720, 560.0, (630.0, 371.0), (0.015, 0.0, 0.0, 0.0))
PIXELS = [(640.0, 500.0, 0.0), (200.0, 10.0, 0.0), (900.0, 400.0, 1.5)]
"""The second lies above the horizon."""
STAMP_NS = 1_700_000_000_123_456_789


def lens_message() -> CameraInfo:
    return messages.camera_info_message(camera_info(CAMERA), messages.time_message(STAMP_NS - 5), 'cam')


def transform_message(height_m: float = 8.0, camera_frame: str = 'cam') -> TransformStamped:
    return messages.ground_transform_message(
        GroundPlane(pose(32.0, 1.0, 35.0).T, height_m), messages.time_message(STAMP_NS - 5), 'cam_ground', camera_frame
    )


def pixel_message(points=PIXELS, number: int = 0, frame: str = 'cam') -> PolygonStamped:
    stamp = messages.time_message(STAMP_NS + number)
    polygon = Polygon(points=[Point32(x=x, y=y, z=z) for x, y, z in points])
    return PolygonStamped(header=messages.header(stamp, frame), polygon=polygon)


def places(message: PointCloud2) -> np.ndarray:
    return np.frombuffer(message.data, '<f4').reshape(message.width, 3)


class Consumer:
    """The node with its publishers and received messages."""

    def __init__(self, bench):
        self._bench = bench
        self.node = GroundPointsNode(context=bench.context)
        bench.executor.add_node(self.node)
        self.info = bench.client.create_publisher(CameraInfo, 'camera_info', LATCHED)
        self.transform = bench.client.create_publisher(TransformStamped, 'ground_transform', LATCHED)
        self.pixels = bench.connected(bench.publisher(PolygonStamped, 'pixels'))
        self.clouds = bench.collect(PointCloud2, 'ground_points')
        bench.listening('ground_points')
        self._sent = 0

    def ask(self, points=PIXELS, frame: str = 'cam') -> int:
        """Send pixels and return their stamp."""
        self._sent += 1
        self.pixels.publish(pixel_message(points, self._sent, frame))
        return STAMP_NS + self._sent

    def answered(self) -> list[int]:
        return [messages.stamp_ns(found.header.stamp) for found in self.clouds]

    def answer(self, points=PIXELS) -> PointCloud2:
        """Send pixels until one message of them is answered, and return that answer."""
        sent: list[int] = []

        def found() -> list[PointCloud2]:
            sent.append(self.ask(points))
            return [cloud for cloud, stamp in zip(self.clouds, self.answered(), strict=True) if stamp in sent]

        return wait_for(found, 'points')[-1]

    def close(self):
        self._bench.halt()  # first: the node may be answering right now
        self.node.destroy_node()


@pytest.fixture
def consumer(bench):
    made = Consumer(bench)
    yield made
    made.close()


@pytest.fixture
def calibrated(consumer) -> Consumer:
    consumer.info.publish(lens_message())
    consumer.transform.publish(transform_message())
    return consumer


def test_points_are_those_of_ground_in_the_ground_frame_at_the_time_of_the_image(calibrated):
    found = calibrated.answer()
    pixels = np.array(PIXELS)
    expected = Ground.from_messages(lens_message(), transform_message()).points(pixels[:, :2], height_m=pixels[:, 2])
    assert found.header.frame_id == 'cam_ground'
    np.testing.assert_allclose(places(found), expected.points_m, rtol=1e-6)
    assert [field.name for field in found.fields] == ['x', 'y', 'z']
    assert (found.height, found.point_step, found.row_step) == (1, 12, 36)


def test_a_pixel_above_the_horizon_is_nan_in_its_place(calibrated):
    found = calibrated.answer()
    np.testing.assert_array_equal(np.isnan(places(found)).any(axis=1), [False, True, False])
    assert not found.is_dense
    assert calibrated.answer(PIXELS[:1]).is_dense


def test_without_calibration_nothing_is_said_and_then_it_is_found(consumer):
    for _ in range(3):
        consumer.ask()
    consumer.info.publish(lens_message())
    wait_for(lambda: consumer.node._info, 'the lens')
    consumer.ask()
    assert not consumer.clouds
    consumer.transform.publish(transform_message())
    assert consumer.answer().width == 3


def test_a_calibration_that_is_replaced_is_used(calibrated):
    first = places(calibrated.answer(PIXELS[:1]))
    calibrated.transform.publish(transform_message(height_m=12.0))
    wait_for(lambda: calibrated.node._transform.transform.translation.z == 12.0, 'the new transform')
    np.testing.assert_allclose(places(calibrated.answer(PIXELS[:1])), first * 1.5, rtol=1e-5)


def test_pixels_of_another_camera_are_left_out(calibrated, capfd):
    calibrated.answer()
    stamp = calibrated.ask(frame='other')
    calibrated.answer()
    assert stamp not in calibrated.answered()
    assert "pixels skipped: their frame is 'other', that of the calibration 'cam'" in capfd.readouterr().err


def test_a_transform_of_another_camera_gives_no_points(calibrated, capfd):
    calibrated.answer()
    calibrated.transform.publish(transform_message(camera_frame='other'))
    wait_for(lambda: calibrated.node._transform.child_frame_id == 'other', 'the transform of another camera')
    asked = pixel_message(number=10**6)
    calibrated.node._on_pixels(asked)  # here and now: what was sent before may still be on its way
    assert "but not the camera's frame 'cam'" in capfd.readouterr().err
    calibrated.transform.publish(transform_message())
    calibrated.answer()
    assert messages.stamp_ns(asked.header.stamp) not in calibrated.answered()


def test_no_pixels_are_answered_by_no_points(calibrated):
    found = calibrated.answer([])
    assert (found.width, len(found.data), found.header.frame_id) == (0, 0, 'cam_ground')


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_the_executable_ends_quietly_when_it_is_asked_to(bench, number):
    command = [sys.executable, '-m', 'autocalib_ros.ros.ground_points_node']
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            wait_for(lambda: bench.client.count_subscribers('pixels'), 'the node')
            process.send_signal(number)
            _, said = process.communicate(timeout=30)
        finally:
            process.kill()
    assert (process.returncode, said) == (0, '')

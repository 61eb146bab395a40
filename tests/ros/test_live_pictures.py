"""Pictures of a running node over DDS: drawn only while subscribed."""

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from autocalib_ros.calibrator import AutoCalibrator, CalibrationProgress
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.offline.synthetic.junction import pose
from autocalib_ros.pictures import live_overlay as live
from autocalib_ros.results.calibration import EvidenceSummary
from autocalib_ros.results.refusals import Reason
from autocalib_ros.revalidation import CalibrationState
from autocalib_ros.ros.live_pictures import VERIFIED_COLOUR, WAITING_COLOUR, LivePictures, caption_of, image_message
from autocalib_ros.ros.messages import header, stamp_ns, time_message, validated
from bench import PATIENCE_S, SIZE, calibration, image, refusal, wait_for

START_NS = 1_700_000_000_123_456_789
FRAME_NS = 100_000_001
TOPICS = ('debug_image', 'top_view', 'image_rect')
DRAWERS = (live.DebugPicture, live.TopPicture, live.RectifiedPicture)


class Stream:
    """A node that calibrates at once, and its images."""

    def __init__(self, bench, solve=None, **parameters):
        self.bench, self._sent = bench, 0
        solve = solve or (lambda evidence, options, lens: calibration(evidence))
        self.node = bench.start(
            solve,
            camera_height=8.0,
            idle_solve_s=1000.0,
            camera_name='north',
            **{'debug_rate_hz': 1000.0, **parameters},
        )
        self.publisher = bench.connected(bench.publisher())

    def send_until(self, condition, what: str):
        def step():
            self._sent += 1
            self.publisher.publish(image(START_NS + self._sent * FRAME_NS))
            return condition()

        return wait_for(step, what)

    def used(self, number: int) -> None:
        """Send so many more images, and wait until they are used."""
        wanted = self.node._worker.counters.used + number
        self.send_until(lambda: self.node._worker.counters.used >= wanted, f'{number} images')

    def calibrated(self) -> 'Stream':
        self.used(1)
        answer = self.bench.calibrate()
        assert answer.success, answer.message
        return self

    def look(self, topic: str, reliability=ReliabilityPolicy.RELIABLE) -> list:
        """Subscribe a picture and return the list that fills."""
        received: list = []
        self.bench.client.create_subscription(
            Image, f'/autocalib/{topic}', received.append, QoSProfile(depth=10, reliability=reliability)
        )
        publisher = getattr(self.node._pictures, f'_{topic}')
        wait_for(lambda: publisher.get_subscription_count() > 0, f'the subscription of {topic}')
        return received

    def seen(self, topic: str, **more) -> Image:
        received = self.look(topic, **more)
        return self.send_until(lambda: received, topic)[-1]


@pytest.fixture
def drawn(monkeypatch) -> list[str]:
    """Count pictures drawn, drawers made, and requests to the tracker."""
    calls: list[str] = []

    def counted(owner, name):
        original = getattr(owner, name)

        def call(*given, **named):
            calls.append(f'{owner.__name__}.{name}')
            return original(*given, **named)

        monkeypatch.setattr(owner, name, call)

    for owner in DRAWERS:
        counted(owner, '__init__')
        counted(owner, 'draw')
    counted(AutoCalibrator, 'followed')
    counted(LivePictures, '_show')
    return calls


def pixels(message: Image) -> np.ndarray:
    channels = {'mono8': 1, 'bgr8': 3}[message.encoding]
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, channels)


def test_without_subscribers_nothing_is_drawn(bench, drawn):
    stream = Stream(bench).calibrated()
    stream.used(20)
    assert drawn == []


@pytest.mark.parametrize('topic', TOPICS)
def test_only_what_is_looked_at_is_drawn(bench, drawn, topic):
    stream = Stream(bench).calibrated()
    stream.seen(topic)
    made = {call.partition('.')[0] for call in drawn} - {'LivePictures', 'AutoCalibrator'}
    assert made == {{'debug_image': 'DebugPicture', 'top_view': 'TopPicture', 'image_rect': 'RectifiedPicture'}[topic]}
    assert ('AutoCalibrator.followed' in drawn) == (topic == 'debug_image')


def test_drawing_ends_with_the_last_subscriber(bench, drawn):
    stream = Stream(bench).calibrated()
    stream.seen('debug_image')
    bench.client.destroy_subscription(
        next(iter(found for found in bench.client.subscriptions if found.topic_name.endswith('debug_image')))
    )
    wait_for(lambda: not stream.node._pictures._debug_image.get_subscription_count(), 'the end of the subscription')
    stream.used(1)
    wait_for(lambda: stream.node._pictures._pending is None, 'what was still to be drawn')
    stream.used(1)
    drawn.clear()
    stream.used(10)
    assert drawn == []


@pytest.mark.parametrize(
    ('topic', 'frame', 'encoding', 'reliability'),
    [
        ('debug_image', 'cam_optical', 'bgr8', ReliabilityPolicy.RELIABLE),
        ('image_rect', 'cam_optical', 'mono8', ReliabilityPolicy.BEST_EFFORT),
        ('top_view', 'north_ground', 'bgr8', ReliabilityPolicy.RELIABLE),
    ],
)
def test_pictures_bear_the_header_of_their_image(bench, topic, frame, encoding, reliability):
    stream = Stream(bench).calibrated()
    message = validated(stream.seen(topic, reliability=reliability))
    assert (stamp_ns(message.header.stamp) - START_NS) % FRAME_NS == 0
    assert (message.header.frame_id, message.encoding) == (frame, encoding)
    assert message.step * message.height == len(message.data)
    if topic != 'top_view':
        assert (message.width, message.height) == SIZE


def test_image_rect_goes_with_camera_info(bench):
    """A consumer that joins both by their stamps finds pairs, and P is that of the picture."""
    stream = Stream(bench, rectified_balance=0.5).calibrated()
    infos = bench.collect(CameraInfo, '/autocalib/camera_info')
    bench.listening('/autocalib/camera_info')
    pictures = stream.look('image_rect')
    stream.send_until(
        lambda: (
            {stamp_ns(info.header.stamp) for info in infos} & {stamp_ns(picture.header.stamp) for picture in pictures}
        ),
        'a pair',
    )
    published = stream.node.publication.published
    assert list(infos[-1].p) == published.fields.p
    expected = live.RectifiedPicture(published.result).draw(pixels(image(0))[..., 0])
    np.testing.assert_array_equal(pixels(pictures[-1])[..., 0], expected)


def test_before_the_calibration_the_debug_image_says_what_is_missing_and_no_other_picture_comes(bench):
    stream = Stream(bench)
    views = [stream.look(topic) for topic in ('top_view', 'image_rect')]
    message = stream.seen('debug_image')
    assert (pixels(message)[:20] != pixels(image(0))[:20]).any()
    stream.used(3)
    assert not any(views)


def test_a_lens_without_a_plane_gives_no_top_view(bench, drawn):
    stream = Stream(bench, lambda evidence, options, lens: calibration(evidence, height_m=None)).calibrated()
    received = stream.look('top_view')
    stream.seen('image_rect')
    assert not received and 'TopPicture.draw' not in drawn


def test_pictures_come_no_oftener_than_asked(bench):
    stream = Stream(bench, debug_rate_hz=1.0).calibrated()
    received = stream.look('debug_image')
    stream.send_until(lambda: len(received) >= 3, 'three pictures')
    assert stream.node._worker.counters.used > 20  # one image in 0.02 s, one picture in 1 s


def test_the_rate_may_change_while_the_node_runs(bench):
    stream = Stream(bench)
    stream.node.set_parameters([Parameter('debug_rate_hz', value=2.0)])
    assert stream.node._pictures.rate_hz == 2.0


def test_perception_and_executor_do_not_wait_for_a_picture(bench, monkeypatch):
    release, drawing = threading.Event(), threading.Event()

    def slow(self, *given):
        drawing.set()
        release.wait(PATIENCE_S)
        return given[0]

    monkeypatch.setattr(live.RectifiedPicture, 'draw', slow)
    stream = Stream(bench).calibrated()
    stream.look('image_rect')
    stream.send_until(drawing.is_set, 'drawing')
    stream.used(20)
    assert bench.calibrate().success
    release.set()


def test_a_fault_in_drawing_is_reported_and_the_next_picture_comes(bench, monkeypatch):
    faults = [ValueError('torn')]
    own = live.DebugPicture.draw
    reported: list[Exception] = []

    def draw(self, *given):
        if faults:
            raise faults.pop()
        return own(self, *given)

    monkeypatch.setattr(live.DebugPicture, 'draw', draw)
    stream = Stream(bench)
    stream.node._pictures._failed = reported.append
    stream.seen('debug_image')
    assert [str(error) for error in reported] == ['torn']


def test_an_ignored_region_is_black_in_pictures_of_the_image(bench):
    half = SIZE[0] // 2
    stream = Stream(bench, ignore_regions=f'-1 -1 {half} -1 {half} {SIZE[1]} -1 {SIZE[1]}').calibrated()
    rectified = pixels(stream.seen('image_rect'))
    assert not rectified[:, : half // 2].any()
    assert rectified[:, -half // 2 :].any()


def test_what_became_of_the_tracks_is_shown_until_the_next_solution_or_a_reset(bench):
    found = [calibration, refusal, calibration]
    stream = Stream(bench, lambda evidence, options, lens: found.pop(0)(evidence)).calibrated()
    pictures = stream.node._pictures
    first = pictures._labelled_tracks
    assert first is not None
    assert not bench.calibrate().success
    assert pictures._labelled_tracks is first
    assert bench.calibrate().success
    assert pictures._labelled_tracks is not None and pictures._labelled_tracks is not first
    bench.ask('reset')
    assert pictures._labelled_tracks is None


def test_a_picture_as_a_message_is_the_picture():
    picture = np.random.default_rng(0).integers(0, 255, (4, 6, 3), dtype=np.uint8)
    message = validated(image_message(picture[:, ::-1], header(time_message(5), 'cam')))
    assert (message.encoding, message.step, message.width, message.height) == ('bgr8', 18, 6, 4)
    np.testing.assert_array_equal(pixels(message), picture[:, ::-1])


PROGRESS = CalibrationProgress(
    42.0, ('17 of 40 tracks', 'traffic covers 9 % of the image'), 'about 6 min more at this rate'
)


def result(**more):
    """A calibration that looks 30 degrees down."""
    summary = EvidenceSummary(
        image_size=SIZE, seconds=60.0, frames=900, tracks=100, segments=0, vehicles=20, coverage=0.5
    )
    made = calibration(SimpleNamespace(image_size=SIZE, newest_stamp_ns=1, summary=lambda: summary), **more)
    return made if made.ground is None else replace(made, ground=GroundPlane(pose(30.0, 0.0, 0.0).T, 8.0))


def test_collecting_says_how_far_and_what_is_missing():
    caption = caption_of(CalibrationState.NONE, None, PROGRESS)
    assert (caption.title, caption.colour) == ('COLLECTING 42 %', WAITING_COLOUR)
    assert caption.text == '17 of 40 tracks; traffic covers 9 % of the image; about 6 min more at this rate'


def test_before_the_first_look_at_the_evidence_there_is_no_percentage():
    assert caption_of(CalibrationState.NONE, None, None).title == 'COLLECTING'


@pytest.mark.parametrize('state', [CalibrationState.CALIBRATED, CalibrationState.VERIFIED])
def test_calibrated_gives_grade_and_numbers(state):
    caption = caption_of(state, result(), PROGRESS)
    assert (caption.title, caption.colour) == ('CALIBRATED, grade full', VERIFIED_COLOUR)
    assert caption.text == 'focal length 300.00 px (sigma 1), tilt 30.00 deg, height 8 m'


def test_restored_is_not_yet_verified_and_says_what_the_traffic_still_lacks():
    caption = caption_of(CalibrationState.RESTORED, result(), PROGRESS)
    assert caption.title.startswith('RESTORED, not yet verified') and caption.colour == WAITING_COLOUR
    assert 'focal length 300.00 px' in caption.text and 'COLLECTING 42 %: 17 of 40 tracks' in caption.text


def test_a_lens_alone_gives_the_reason_there_is_no_plane():
    lens = replace(result(height_m=None), ground_refusal=Reason('one_direction', '3 of 10 tracks', 'wait'))
    assert 'no ground plane (one_direction): 3 of 10 tracks' in caption_of(CalibrationState.CALIBRATED, lens, None).text

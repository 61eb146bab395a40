"""A node in this process, with clients over DDS."""

import threading
import time
from dataclasses import replace

import cv2
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage

from autocalib_ros.errors import UsageError
from autocalib_ros.estimation.publish import with_requested_model
from autocalib_ros.evidence.stillness import ViewChange, ViewChangeKind
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import camera_info
from autocalib_ros.lens.camera_info_yaml import write_camera_info_yaml
from autocalib_ros.perception.picture_faults import PictureFault
from autocalib_ros.perception.view_watch import ViewCondition, ViewReport
from autocalib_ros.results.camera_move import CameraMove, MoveKind
from autocalib_ros.revalidation import CalibrationState
from autocalib_ros.ros.autocalib_node import AutocalibNode
from autocalib_ros.ros.messages import stamp_ns
from bench import PATIENCE_S, PIXELS, SIZE, Bench, calibration, image, refusal, wait_for

START_NS = 1_700_000_000_123_456_789
FRAME_NS = 100_000_001
INFO, GROUND = '/autocalib/camera_info', '/autocalib/ground_transform'


def instantly(evidence, options, lens):
    return calibration(evidence)


def lens_only(evidence, options, lens):
    return calibration(evidence, height_m=None)


def unit_scale(evidence, options, lens):
    return calibration(evidence, height_m=1.0, metric=False)


def publish_until(publisher, condition, what: str, make=image) -> int:
    """Publish images until something holds; return the stamp of the last."""
    number = 0

    def step():
        nonlocal number
        number += 1
        publisher.publish(make(START_NS + number * FRAME_NS))
        return condition()

    wait_for(step, what)
    return START_NS + number * FRAME_NS


def used(node) -> bool:
    return node._worker.counters.used > 0


def calibrated(bench: Bench, solve=instantly, make=image, publisher=None, **parameters):
    """Return a node that has calibrated from an image, and the publisher of its images."""
    node = bench.start(solve, camera_height=8.0, idle_solve_s=1000.0, **parameters)
    publisher = bench.connected(publisher or bench.publisher())
    publish_until(publisher, lambda: used(node), 'an image', make)
    answer = bench.calibrate()
    assert answer.success, answer.message
    return node, publisher


@pytest.mark.parametrize('reliability', [ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE])
def test_publisher_that_comes_late_is_found_and_matched(bench, reliability):
    node = bench.start(instantly)
    wait_for(lambda: bench.client.count_publishers(INFO) > 0, 'the node')
    publisher = bench.connected(bench.publisher(reliability=reliability))
    publish_until(publisher, lambda: used(node), 'an image')
    (subscriber,) = bench.client.get_subscriptions_info_by_topic('image')
    assert subscriber.qos_profile.reliability == reliability


def test_publisher_that_comes_back_with_another_reliability_is_matched(bench):
    node = bench.start(instantly)
    first = bench.connected(bench.publisher())
    publish_until(first, lambda: used(node), 'an image')
    bench.client.destroy_publisher(first)
    second = bench.publisher(reliability=ReliabilityPolicy.BEST_EFFORT)
    before = node._worker.counters.received
    publish_until(second, lambda: node._worker.counters.received > before, 'an image of the second publisher')


def test_each_image_gets_camera_info_with_exactly_its_header(bench):
    infos = bench.collect(CameraInfo, INFO)
    _, publisher = calibrated(bench)
    bench.listening(INFO)
    sent = image(START_NS + 10**12)
    publisher.publish(sent)
    wait_for(lambda: infos and infos[-1].header == sent.header, 'camera_info with the header of the image')
    assert (sent.header.frame_id, stamp_ns(sent.header.stamp)) == ('cam_optical', START_NS + 10**12)


def test_camera_info_holds_the_lens(bench):
    node, _ = calibrated(bench)
    infos = bench.collect(CameraInfo, INFO, latched=True)
    info = wait_for(lambda: infos, 'camera_info')[0]
    fields = camera_info(node.publication.published.result.camera)
    assert (info.width, info.height, info.distortion_model) == (*SIZE, 'equidistant')
    assert [list(info.k), list(info.d), list(info.r), list(info.p)] == [fields.k, fields.d, fields.r, fields.p]


def test_late_joiner_gets_both_latched_messages(bench):
    calibrated(bench, camera_name='north')
    infos, transforms = (
        bench.collect(kind, topic, latched=True) for kind, topic in ((CameraInfo, INFO), (TransformStamped, GROUND))
    )
    wait_for(lambda: infos and transforms, 'both messages')
    assert (transforms[0].header.frame_id, transforms[0].child_frame_id) == ('north_ground', 'cam_optical')
    assert transforms[0].transform.translation.z == 8.0
    assert infos[0].header.frame_id == 'cam_optical'


def test_camera_info_stays_silent_image_by_image_when_latched_only(bench):
    infos = bench.collect(CameraInfo, INFO)
    node, publisher = calibrated(bench, camera_info_mode='latched_only')
    bench.listening(INFO)
    before = node._worker.counters.received
    publish_until(publisher, lambda: node._worker.counters.received > before + 3, 'four images')
    assert bench.calibrate().success
    wait_for(lambda: infos, 'camera_info')
    assert len(infos) <= 2  # one for each solution, the first of which may have come before this subscriber


def test_images_services_and_parameters_do_not_wait_for_a_solution(bench):
    release, running = threading.Event(), threading.Event()

    def slow(evidence, options, lens):
        if running.is_set() or evidence.frames <= node_frames['first']:
            return calibration(evidence)
        running.set()
        release.wait(PATIENCE_S)
        return calibration(evidence, 400.0)

    node_frames = {'first': 10**9}
    infos = bench.collect(CameraInfo, INFO)
    node, publisher = calibrated(bench, slow)
    bench.listening(INFO)
    node_frames['first'] = 0
    answer = bench.ask_calibrate()
    assert running.wait(PATIENCE_S)
    infos.clear()
    began = time.monotonic()
    publish_until(publisher, lambda: len(infos) > 20, 'camera_info of twenty images')
    parameters = bench.client.create_client(GetParameters, '/autocalib/get_parameters')
    asked = parameters.call_async(GetParameters.Request(names=['camera_height']))
    wait_for(asked.done, 'a parameter')
    assert asked.result().values[0].double_value == 8.0
    assert time.monotonic() - began < 10.0  # twenty images and a parameter take a second or two, a wait takes forever
    assert not answer.done()
    release.set()
    wait_for(answer.done, 'the solution')
    assert node.publication.published.result.camera.focal_px == 400.0


def test_a_lens_without_plane_does_not_replace_one_with_its_plane(bench):
    found = [{'height_m': 8.0}, {'height_m': None, 'focal_px': 310.0}, {'height_m': 9.0, 'focal_px': 320.0}]

    def solve(evidence, options, lens):
        return calibration(evidence, **(found.pop(0) if len(found) > 1 else found[0]))

    _node, _ = calibrated(bench, solve)
    infos, transforms = (
        bench.collect(kind, topic, latched=True) for kind, topic in ((CameraInfo, INFO), (TransformStamped, GROUND))
    )
    wait_for(lambda: infos and transforms, 'lens and plane')
    assert 'focal length 310' in bench.calibrate().message  # the solution is reported, but not published
    assert bench.calibrate().success
    wait_for(lambda: infos[-1].k[0] == 320.0 and transforms[-1].transform.translation.z == 9.0, 'lens and plane anew')
    assert 310.0 not in [info.k[0] for info in infos]


def test_calibrate_answers_with_the_refusal(bench):
    node = bench.start(lambda evidence, options, lens: refusal(evidence))
    publish_until(bench.connected(bench.publisher()), lambda: used(node), 'an image')
    answer = bench.calibrate()
    assert not answer.success
    assert 'too_few_tracks' in answer.message and '12 tracks of the 40 needed.' in answer.message


def test_calibrate_before_the_first_image_reports_it(bench):
    bench.start(instantly)
    answer = bench.calibrate()
    assert (answer.success, answer.message) == (False, 'no image received yet on /image')


def test_refusal_keeps_the_calibration_before(bench):
    results = [calibration, refusal]
    node, publisher = calibrated(bench, lambda evidence, options, lens: results.pop(0)(evidence))
    infos = bench.collect(CameraInfo, INFO)
    bench.listening(INFO)
    assert not bench.calibrate().success
    publish_until(publisher, lambda: infos, 'camera_info after a refusal')
    assert node.publication.published.result.camera.focal_px == 300.0


def test_new_calibration_replaces_the_latched_one(bench):
    focals = [300.0, 310.0]
    calibrated(bench, lambda evidence, options, lens: calibration(evidence, focals.pop(0)))
    assert bench.calibrate().success
    infos = bench.collect(CameraInfo, INFO, latched=True)
    wait_for(lambda: infos, 'camera_info')
    assert infos[0].k[0] == 310.0


@pytest.mark.parametrize('solve', [lens_only, unit_scale])
def test_no_ground_transform_without_a_height(bench, solve):
    calibrated(bench, solve)
    infos = bench.collect(CameraInfo, INFO, latched=True)
    transforms = bench.collect(TransformStamped, GROUND, latched=True)
    wait_for(lambda: infos, 'camera_info')
    bench.listening(GROUND)
    assert not threading.Event().wait(0.5)  # a latched transform would have come with the camera_info
    assert not transforms


def test_unit_scale_is_published_when_it_is_allowed(bench):
    calibrated(bench, unit_scale, allow_unit_scale=True)
    transforms = bench.collect(TransformStamped, GROUND, latched=True)
    assert wait_for(lambda: transforms, 'the transform')[0].transform.translation.z == 1.0


def test_driver_without_stamp_and_frame_is_served(bench):
    infos = bench.collect(CameraInfo, INFO)
    node, publisher = calibrated(bench, make=lambda stamp: image(0, frame_id=''))
    bench.listening(INFO)
    publish_until(
        publisher,
        lambda: infos and not stamp_ns(infos[-1].header.stamp),
        'camera_info of an image',
        lambda stamp: image(0, frame_id=''),
    )
    assert infos[-1].header.frame_id == 'camera_optical_frame'
    assert node.publication.published.result.evidence.frames >= 1


def test_image_that_cannot_be_decoded_does_not_stop_the_stream(bench):
    node, publisher = calibrated(bench)
    publish_until(
        publisher,
        lambda: node._worker.counters.unreadable > 0,
        'an unreadable image',
        lambda stamp: image(stamp, encoding='no_such_encoding'),
    )
    before = node._worker.counters.used
    publish_until(publisher, lambda: node._worker.counters.used > before, 'a readable image')


def test_compressed_images_come_from_the_topic_beside_the_resolved_one(bench):
    def make(stamp: int) -> CompressedImage:
        message = CompressedImage(format='jpeg', data=cv2.imencode('.jpg', PIXELS)[1].tobytes())
        message.header = image(stamp).header
        return message

    publisher = bench.publisher(CompressedImage, '/image/compressed')
    infos = bench.collect(CameraInfo, INFO, latched=True)
    calibrated(bench, make=make, publisher=publisher, image_transport='compressed')
    assert (wait_for(lambda: infos, 'camera_info')[0].width, infos[0].height) == SIZE


def test_calibration_of_another_image_size_is_withdrawn(bench):
    node, publisher = calibrated(bench)
    infos = bench.collect(CameraInfo, INFO)
    bench.listening(INFO)
    publish_until(
        publisher,
        lambda: node.publication.published is None,
        'the withdrawal',
        lambda stamp: image(stamp, size=(160, 120)),
    )
    assert not infos
    # and published again with the first images of its own size that last
    publish_until(publisher, lambda: infos, 'the calibration again')
    assert node.publication.state is CalibrationState.RESTORED


def test_one_odd_image_costs_nothing(bench):
    node, publisher = calibrated(bench)
    before = node.publication.published
    publisher.publish(image(START_NS + 10**12, size=(1, 1)))
    wait_for(lambda: node._worker.counters.odd_size, 'the odd image')
    assert node.publication.published is before


def test_another_frame_is_told_and_published_after_some_images(bench):
    node, publisher = calibrated(bench)
    infos = bench.collect(CameraInfo, INFO)
    transforms = bench.collect(TransformStamped, GROUND)
    bench.listening(INFO)
    bench.listening(GROUND)
    publish_until(publisher, lambda: transforms, 'the transform', lambda stamp: image(stamp, frame_id='renamed'))
    assert 'renamed' in (transforms[-1].header.frame_id, transforms[-1].child_frame_id)
    wait_for(lambda: [info for info in infos if info.header.frame_id == 'renamed'], 'CameraInfo of the new frame')
    assert node.publication.published.image_frame == 'renamed'


def test_solution_is_tried_when_the_images_end(bench):
    node = bench.start(instantly, camera_height=8.0, idle_solve_s=0.5)
    publish_until(bench.connected(bench.publisher()), lambda: used(node), 'an image')
    wait_for(lambda: node.publication.published, 'a calibration that nobody asked for')


def test_known_lens_is_read_and_given_to_the_solver_in_the_size_of_the_images(bench, tmp_path):
    write_camera_info_yaml(tmp_path / 'lens.yaml', Camera.equidistant(2 * SIZE[0], 2 * SIZE[1], 512.0), 'cam')
    node, _ = calibrated(
        bench,
        lambda evidence, options, lens: replace(calibration(evidence), camera=lens),
        camera_info_file=str(tmp_path / 'lens.yaml'),
    )
    assert node.publication.published.result.camera == Camera.equidistant(*SIZE, 256.0)


def test_solver_gets_no_lens_unless_one_is_given(bench):
    lenses = []
    calibrated(bench, lambda evidence, options, lens: lenses.append(lens) or calibration(evidence))
    assert lenses and set(lenses) == {None}


def test_known_lens_in_a_distortion_model_that_cannot_say_it_is_wrong_usage(bench, tmp_path):
    write_camera_info_yaml(tmp_path / 'lens.yaml', Camera.equidistant(1280, 720, 500.0), 'cam')
    with pytest.raises(UsageError, match=r'plumb_bob would be off by up to .* Set distortion_model to rational'):
        bench.start(instantly, camera_info_file=str(tmp_path / 'lens.yaml'), distortion_model='plumb_bob')


def test_answer_of_calibrate_reports_the_error_of_a_fitted_distortion_model(bench):
    def solve(evidence, options, lens):
        return with_requested_model(calibration(evidence), options)

    node = bench.start(solve, camera_height=8.0, idle_solve_s=1000.0, distortion_model='rational_polynomial')
    publish_until(bench.connected(bench.publisher()), lambda: used(node), 'an image')
    infos = bench.collect(CameraInfo, INFO, latched=True)
    answer = bench.calibrate()
    assert answer.success
    assert 'camera_info rational_polynomial, error at most' in answer.message
    info = wait_for(lambda: infos, 'camera_info')[0]
    assert (info.distortion_model, len(info.d)) == ('rational_polynomial', 8)


def test_lens_that_the_asked_model_cannot_say_is_refused_and_nothing_is_published(bench):
    def solve(evidence, options, lens):
        return with_requested_model(calibration(evidence, 180.0), options)

    node = bench.start(solve, camera_height=8.0, idle_solve_s=1000.0, distortion_model='plumb_bob')
    publish_until(bench.connected(bench.publisher()), lambda: used(node), 'an image')
    answer = bench.calibrate()
    assert not answer.success
    assert answer.message.startswith('refused (distortion_model): plumb_bob would be off by up to')
    assert node.publication.published is None


def test_reliability_of_a_publisher_is_overridden_by_a_parameter(bench):
    node = AutocalibNode(
        context=bench.context,
        parameter_overrides=[
            Parameter('qos_overrides./autocalib/camera_info.publisher.reliability', value='best_effort')
        ],
    )
    bench.adopt(node)
    offered = [
        wait_for(lambda topic=topic: bench.client.get_publishers_info_by_topic(topic), topic)[0].qos_profile
        for topic in (INFO, GROUND)
    ]
    assert [profile.reliability for profile in offered] == [ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE]
    assert all(profile.durability is DurabilityPolicy.TRANSIENT_LOCAL for profile in offered)


ZOOM = CameraMove(MoveKind.ZOOM, 20.0, zoom=1.1, sigma_deg=(0.01, 0.01, 0.01))
BUMP = CameraMove(MoveKind.BUMP, 20.0, 1.0, 2.0, 0.0, sigma_deg=(0.01, 0.01, 0.01))


def test_calibration_is_withheld_after_a_zoom_and_published_again_when_that_is_undone(bench):
    node, publisher = calibrated(bench)
    infos = bench.collect(CameraInfo, INFO)
    bench.listening(INFO)
    node.view_changed(ViewReport(ViewCondition.MOVED, move=ZOOM), START_NS)
    publish_until(publisher, lambda: infos and not any(infos[-1].k), 'a CameraInfo that says not calibrated')
    assert not any(infos[-1].p) and (infos[-1].width, infos[-1].height) == SIZE
    answer = bench.ask('save')
    assert not answer.success and 'zoom' in answer.message
    late = bench.collect(TransformStamped, GROUND, latched=True)
    assert not late
    node.view_changed(ViewReport(ViewCondition.STILL), START_NS)
    publish_until(publisher, lambda: infos[-1].k[0] == 300.0, 'the calibration again')
    wait_for(lambda: late, 'the transform again')


def test_pose_is_mended_after_a_bump(bench):
    node, _ = calibrated(bench)
    transforms = bench.collect(TransformStamped, GROUND, latched=True)
    wait_for(lambda: transforms, 'the transform')
    before = node.publication.published.result
    now = node.view_changed(ViewReport(ViewCondition.MOVED, move=BUMP), START_NS)
    wait_for(lambda: len(transforms) > 1, 'the mended transform')
    assert transforms[-1].transform.rotation != transforms[0].transform.rotation
    assert node.publication.published.result is now
    assert (now.camera, now.grade, node.publication.state) == (before.camera, 'fair', CalibrationState.MENDED)


@pytest.mark.parametrize(('mode', 'withheld'), [('withhold', True), ('keep', False)])
def test_option_says_what_is_published_after_a_bump(bench, mode, withheld):
    node, _ = calibrated(bench, on_move=mode)
    before = node.publication.published
    assert node.view_changed(ViewReport(ViewCondition.MOVED, move=BUMP), START_NS) is None
    assert bool(node.publication.withheld) is withheld
    assert node.publication.published is before and node.publication.is_stale
    # whatever it says, the next solution takes the place of the stale one
    assert bench.calibrate().success
    assert not node.publication.withheld and node.publication.published is not before


def test_what_was_given_in_pixels_follows_the_camera(bench, tmp_path):
    """After a bump the map stays and lengths are measured where they are now; after a zoom neither is used."""
    points = tmp_path / 'points.csv'
    points.write_text('u_px,v_px,x_m,y_m\n100,180,0,0\n220,200,3,1\n')
    node, _ = calibrated(bench, control_points=str(points), scale__distances='100 180 220 180 8')
    places = bench.collect(TransformStamped, '/autocalib/map_transform', latched=True)
    wait_for(lambda: places, 'the place in the map')
    node.view_changed(ViewReport(ViewCondition.MOVED, move=BUMP), START_NS)
    wait_for(lambda: len(places) > 1, 'the place in the map after the bump')
    before, after = (message.transform.translation for message in places)
    assert (after.x, after.y) == pytest.approx((before.x, before.y), abs=1e-6)
    (length,) = node._worker.options.scale.known_distances
    assert length.metres == 8 and length.pixels[0] != (100, 180) and length.pixels[0] == pytest.approx((95, 169), abs=2)
    node.view_changed(ViewReport(ViewCondition.MOVED, move=ZOOM), START_NS)
    assert not node._worker.options.scale.known_distances

    def is_cleared():
        late = bench.collect(TransformStamped, '/autocalib/map_transform', latched=True)
        bench.listening('/autocalib/map_transform')
        time.sleep(0.2)
        return not late

    wait_for(is_cleared, 'the place in the map to be taken back')
    node.view_changed(ViewReport(ViewCondition.STILL), START_NS)
    assert node._worker.options.scale.known_distances == (length,)


def test_lengths_are_not_used_after_a_move_before_the_first_calibration(bench):
    node = bench.start(camera_height=8.0, idle_solve_s=1000.0, scale__distances='100 180 220 180 8')
    publish_until(bench.connected(bench.publisher()), lambda: used(node), 'an image')
    node.picture_moved(ViewChange(ViewChangeKind.TURN, 10.0, 12.0, 60.0), 1, START_NS)
    assert not node._worker.options.scale.known_distances
    node.picture_moved(ViewChange(ViewChangeKind.CUT, 20.0, 22.0), 0, START_NS)
    assert len(node._worker.options.scale.known_distances) == 1


def test_ignored_regions_follow_the_camera_and_stay(bench):
    node, _ = calibrated(bench, ignore_regions='60 60 120 60 120 110 60 110')
    node.view_changed(ViewReport(ViewCondition.MOVED, move=BUMP), START_NS)
    ignored = node._worker._ignored
    assert len(ignored) == 2 and ignored[:1] == node.options.ignored_polygons
    # to the left and up by what 1 and 2 degrees are at 300 px, and a little wider
    left, top = (min(point[axis] for point in ignored[1]) for axis in (0, 1))
    assert (left, top) == pytest.approx((60 - 5.2, 60 - 10.5), abs=5)
    assert node._pictures.ignored == ignored
    node.view_changed(ViewReport(ViewCondition.STILL), START_NS)
    assert len(node._worker._ignored) == 2  # the mended calibration is one of this view


def test_calibration_without_a_stored_view_is_published_again_after_a_black_picture(bench):
    node, _ = calibrated(bench)
    node.view_changed(ViewReport(ViewCondition.BLIND, 20.0, fault=PictureFault.BLACK), START_NS)
    assert node.publication.withheld
    node.view_changed(ViewReport(ViewCondition.UNKNOWN, 30.0, is_watched=True), START_NS)
    assert node.publication.withheld  # until the view is verified
    node.view_changed(ViewReport(ViewCondition.UNKNOWN, 30.0), START_NS)
    assert not node.publication.withheld  # which it cannot be


def test_solution_of_images_before_a_black_picture_is_withheld_until_the_picture_is_back(bench):
    node, publisher = calibrated(bench)
    before = node.publication.published
    infos = bench.collect(CameraInfo, INFO)
    bench.listening(INFO)
    node.view_changed(ViewReport(ViewCondition.BLIND, 20.0, fault=PictureFault.BLACK), START_NS)
    assert bench.calibrate().success
    assert node.publication.published is not before and node.publication.withheld
    infos.clear()
    publish_until(publisher, lambda: infos, 'a CameraInfo')
    assert not any(info.k[0] for info in infos)
    node.view_changed(ViewReport(ViewCondition.STILL), START_NS)
    publish_until(publisher, lambda: infos[-1].k[0] == 300.0, 'the calibration')


def test_status_tells_programs_that_the_picture_is_black(bench):
    node, _ = calibrated(bench)
    statuses = bench.collect(DiagnosticStatus, '/autocalib/status', latched=True)
    report = ViewReport(ViewCondition.BLIND, 20.0, fault=PictureFault.BLACK)
    node._worker.view = report
    node.view_changed(report, START_NS)

    def values() -> dict[str, str]:
        return {item.key: item.value for item in statuses[-1].values} if statuses else {}

    wait_for(lambda: values().get('state') == 'BLIND', 'state BLIND')
    assert (values()['pose'], values()['valid_until_s'], values()['fault']) == ('withheld', '20.000', 'black')
    assert statuses[-1].level == DiagnosticStatus.ERROR

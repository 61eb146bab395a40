"""Storing and restoring a calibration across nodes, and the services for it."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import CameraInfo

from autocalib_ros.lens.camera_info import camera_info
from autocalib_ros.lens.camera_info_yaml import read_camera_info
from autocalib_ros.results.store import Store, StoredCalibration, StoreState
from autocalib_ros.revalidation import CalibrationState
from autocalib_ros.ros.messages import stamp_ns
from bench import PATIENCE_S, SIZE, Bench, calibration, image, refusal, wait_for
from processes import running_fake_node
from test_node import GROUND, INFO, START_NS, calibrated, publish_until, used

NONE, RESTORED, VERIFIED, MENDED, DEGRADED, CALIBRATED = CalibrationState


def never(evidence, options, lens):
    return refusal(evidence)


def focal(focal_px: float, **more):
    """Return a solver that finds this focal length, ± 1 px."""
    return lambda evidence, options, lens: calibration(evidence, focal_px, **more)


@pytest.fixture
def store(ros_home) -> Store:
    return Store(ros_home / 'camera_info' / 'north.yaml')


@pytest.fixture
def evidence():
    from autocalib_ros.calibrator import AutoCalibrator
    from autocalib_ros.config import Options
    from bench import PIXELS

    calibrator = AutoCalibrator(Options())
    calibrator.add_image(START_NS, PIXELS)
    return calibrator.snapshot()


@pytest.fixture
def kept(store, evidence) -> StoredCalibration:
    """Return a calibration of an earlier run that lies in the store of the camera `north`."""
    result = calibration(evidence, 300.0)
    store.save(StoredCalibration(result, camera_info(result.camera), 'north', 'cam_optical'))
    return store.load().stored


def first_image(bench: Bench, node, make=image):
    publisher = bench.connected(bench.publisher())
    publish_until(publisher, lambda: used(node), 'an image', make)
    return publisher


def latched(bench: Bench) -> tuple[list, list]:
    """Return the lists that a late joiner's messages fill."""
    return (bench.collect(CameraInfo, INFO, latched=True), bench.collect(TransformStamped, GROUND, latched=True))


def nothing_latched(bench: Bench) -> bool:
    infos, transforms = latched(bench)
    bench.listening(INFO)
    bench.listening(GROUND)
    time.sleep(0.5)  # a latched message comes within milliseconds of the publisher's discovery
    return not infos and not transforms


def test_late_joiner_gets_the_restored_calibration_before_any_image(bench, kept):
    node = bench.start(never, camera_name='north')
    infos, transforms = latched(bench)
    wait_for(lambda: infos and transforms, 'both messages')
    fields = camera_info(kept.calibration.camera)
    assert [list(infos[0].k), list(infos[0].d), list(infos[0].p)] == [fields.k, fields.d, fields.p]
    assert (infos[0].header.frame_id, stamp_ns(infos[0].header.stamp)) == ('cam_optical', START_NS)
    assert (transforms[0].header.frame_id, transforms[0].transform.translation.z) == ('north_ground', 8.0)
    assert node.publication.state is RESTORED


def test_images_of_the_restored_calibration_get_camera_info(bench, kept):
    node = bench.start(never, camera_name='north')
    infos = bench.collect(CameraInfo, INFO)
    bench.listening(INFO)
    publisher = first_image(bench, node)
    sent = image(START_NS + 10**12)
    publisher.publish(sent)
    wait_for(lambda: infos and infos[-1].header == sent.header, 'camera_info with the header of the image')
    assert node.publication.state is RESTORED


def test_store_named_after_the_frame_is_found_with_the_first_image(bench, kept, ros_home):
    frames = Store(ros_home / 'camera_info' / 'cam_optical.yaml')
    frames.save(kept)
    node = bench.start(never)
    assert node.publication.state is NONE
    first_image(bench, node)
    wait_for(lambda: node.publication.state is RESTORED, 'the restored calibration')


@pytest.mark.parametrize(
    'make', [lambda stamp: image(stamp, size=(160, 120)), lambda stamp: image(stamp, frame_id='another_optical')]
)
def test_restored_calibration_of_another_size_or_frame_is_withdrawn(bench, kept, make):
    node = bench.start(never, camera_name='north')
    infos = bench.collect(CameraInfo, INFO)
    bench.listening(INFO)
    first_image(bench, node, make)
    wait_for(lambda: node.publication.state is NONE, 'the withdrawal')
    assert not [info for info in infos if info.header.frame_id == 'another_optical']
    assert not [info for info in infos if stamp_ns(info.header.stamp) != START_NS]  # the latched one alone
    wait_for(lambda: nothing_latched(bench), 'the end of the latched messages', 5.0)


def test_height_that_is_given_now_wins(bench, kept):
    bench.start(never, camera_name='north', camera_height=6.5)
    _, transforms = latched(bench)
    assert wait_for(lambda: transforms, 'the transform')[0].transform.translation.z == 6.5


def test_calibration_that_agrees_but_is_less_precise_verifies_the_restored_one(bench, kept, evidence):
    from dataclasses import replace

    def vague(evidence, options, lens):
        result = calibration(evidence, 302.0)
        return replace(
            result,
            stddev=replace(
                kept.calibration.stddev,
                focal_px=5.0,
                tilt_deg=9.0,
                roll_deg=9.0,
                principal_point_px=(1.0, 1.0),
                k1=0.1,
                k2=0.1,
            ),
        )

    sure = replace(
        kept.calibration,
        stddev=replace(
            kept.calibration.stddev, principal_point_px=(1.0, 1.0), k1=0.1, k2=0.1, tilt_deg=0.1, roll_deg=0.1
        ),
    )
    Store(Path(os.environ['ROS_HOME']) / 'camera_info' / 'north.yaml').save(replace(kept, calibration=sure))
    node, _ = calibrated(bench, vague, camera_name='north')
    assert (node.publication.state, node.publication.published.result.camera.focal_px) == (VERIFIED, 300.0)


def test_calibration_that_does_not_agree_replaces_the_restored_one(bench, kept, store):
    node, _ = calibrated(bench, focal(340.0), camera_name='north')
    assert (node.publication.state, node.publication.published.result.camera.focal_px) == (CALIBRATED, 340.0)
    infos, _ = latched(bench)
    assert wait_for(lambda: infos, 'camera_info')[0].k[0] == 340.0
    wait_for(lambda: store.load().stored.calibration.camera.focal_px == 340.0, 'the file')


def test_plane_of_a_restored_calibration_that_was_wrong_is_withdrawn_with_it(bench, kept):
    calibrated(bench, focal(340.0, height_m=None), camera_name='north')
    wait_for(lambda: not _transforms(bench), 'the end of the latched transform', 5.0)


def _transforms(bench: Bench) -> list:
    transforms = bench.collect(TransformStamped, GROUND, latched=True)
    bench.listening(GROUND)
    time.sleep(0.5)
    return transforms


def test_calibration_is_kept_where_the_url_says_and_restored_by_the_next_node(bench, ros_home):
    url = 'file://${ROS_HOME}/somewhere/${NAME}_lens.yaml'
    first, _ = calibrated(bench, focal(311.0), camera_name='north pole', camera_info_url=url)
    path = ros_home / 'somewhere' / 'north_pole_lens.yaml'
    wait_for(path.exists, 'the file')
    assert read_camera_info(path) == first.publication.published.result.camera
    published = first.publication.published.result
    bench.stop(first)
    second = bench.start(never, camera_name='north pole', camera_info_url=url, camera_height=8.0)
    assert second.publication.state is RESTORED
    again = second.publication.published.result
    assert (again.camera, again.ground.rotation.tolist()) == (published.camera, published.ground.rotation.tolist())


def test_without_autosave_only_the_service_writes(bench, store):
    node, _ = calibrated(bench, focal(311.0), camera_name='north', autosave=False)
    assert not store.path.exists()
    answer = bench.ask('save')
    assert answer.success and str(store.path) in answer.message and 'calibrated' in answer.message
    assert store.load().stored.calibration.camera.focal_px == 311.0
    assert node.publication.state is CALIBRATED


def test_restored_calibration_can_be_saved(bench, kept, store):
    bench.start(never, camera_name='north', camera_height=6.5)
    answer = bench.ask('save')
    assert answer.success and 'restored' in answer.message
    assert store.load().stored.calibration.ground.height_m == 6.5


def test_save_without_a_calibration_gives_the_reason(bench, store):
    bench.start(never, camera_name='north')
    answer = bench.ask('save')
    assert not answer.success and 'no calibration yet' in answer.message
    assert not store.path.exists()


def test_node_goes_on_where_nothing_can_be_written(bench, ros_home):
    (ros_home / 'camera_info').touch()
    node, publisher = calibrated(bench, camera_name='north')
    wait_for(lambda: node.store_writer.fault, 'the fault')
    answer = bench.ask('save')
    assert not answer.success and 'cannot write' in answer.message
    infos = bench.collect(CameraInfo, INFO)
    bench.listening(INFO)
    publish_until(publisher, lambda: infos, 'camera_info')


def test_node_starts_over_a_broken_file(bench, kept, store):
    text = 'image_width: ['  # tests of the store break it in other ways
    store.path.write_text(text)
    store.json_path.unlink()
    node, _ = calibrated(bench, camera_name='north')
    assert node.publication.state is CALIBRATED
    wait_for(lambda: 'not overwritten' in node.store_writer.fault, 'the report about the file')
    assert store.path.read_text() == text
    assert bench.ask('save').success
    assert store.path.with_name('north.yaml.orig').read_text() == text
    assert store.load().state is StoreState.INTACT


def test_reset_withdraws_what_is_published_and_leaves_what_is_stored(bench, store):
    node, publisher = calibrated(bench, focal(311.0), camera_name='north')
    wait_for(store.path.exists, 'the file')
    answer = bench.ask('reset')
    assert answer.success and 'calibrated calibration withdrawn' in answer.message
    assert node.publication.state is NONE
    wait_for(lambda: nothing_latched(bench), 'the end of the latched messages', 5.0)
    assert store.load().stored.calibration.camera.focal_px == 311.0
    publisher.publish(image(START_NS + 10**12))
    wait_for(lambda: bench.calibrate().success, 'a calibration after the reset')
    infos, transforms = latched(bench)
    wait_for(lambda: infos and transforms, 'both messages')
    assert node.publication.published.result.evidence.frames == 1


def test_solution_that_runs_during_a_reset_is_not_published(bench, store):
    running, release = threading.Event(), threading.Event()

    def slow(evidence, options, lens):
        running.set()
        release.wait(PATIENCE_S)
        return calibration(evidence)

    node = bench.start(slow, camera_name='north', idle_solve_s=1000.0)
    first_image(bench, node)
    answer = bench.asked('calibrate')
    assert running.wait(PATIENCE_S)
    assert bench.ask('reset').success
    wait_for(answer.done, 'the caller who is sent away')
    assert not answer.result().success and 'the evidence was reset meanwhile' in answer.result().message
    release.set()
    assert not bench.calibrate().success
    assert node.publication.state is NONE and not store.path.exists()


def test_killed_node_leaves_its_calibration_to_the_next_which_reports_that_it_is_not_verified(
    bench, tmp_path, ros_home
):
    store, publisher = Store(ros_home / 'camera_info' / 'cam1.yaml'), bench.publisher()
    info, ground = '/cam1/autocalib/camera_info', '/cam1/autocalib/ground_transform'
    with running_fake_node(tmp_path / 'first', 311.0) as first:
        bench.connected(publisher)
        publish_until(publisher, lambda: bench.client.count_publishers(info) > 0, 'the node')
        wait_for(lambda: bench.ask('calibrate', '/cam1/autocalib').success, 'a calibration')
        wait_for(store.path.exists, 'the file')
        first.send_signal(signal.SIGKILL)
        first.wait(PATIENCE_S)
    assert store.load().state is StoreState.INTACT
    with running_fake_node(tmp_path / 'second', 350.0) as second:
        infos = bench.collect(CameraInfo, info, latched=True)
        transforms = bench.collect(TransformStamped, ground, latched=True)
        wait_for(lambda: infos and transforms, 'what was restored, before any image')
        assert (infos[-1].k[0], (infos[-1].width, infos[-1].height)) == (311.0, SIZE)
        wait_for(lambda: 'not yet verified' in (tmp_path / 'second').read_text(), 'the line of the log')
        bench.connected(publisher)
        publish_until(
            publisher,
            lambda: stamp_ns(infos[-1].header.stamp) > START_NS + 10**10,
            'camera_info of an image',
            lambda stamp: image(stamp + 10**10),
        )
        assert infos[-1].k[0] == 311.0
        wait_for(lambda: bench.ask('calibrate', '/cam1/autocalib').success, 'a calibration')
        wait_for(lambda: infos[-1].k[0] == 350.0, 'the new calibration')
        wait_for(
            lambda: 'is inconsistent with current traffic' in (tmp_path / 'second').read_text(), 'the line of the log'
        )
        second.send_signal(signal.SIGINT)
        assert second.wait(PATIENCE_S) == 0, (tmp_path / 'second').read_text()
    assert store.load().stored.calibration.camera.focal_px == 350.0


def test_services_answer_while_a_solution_runs(bench, tmp_path, ros_home, kept):
    Store(ros_home / 'camera_info' / 'cam1.yaml').save(kept)
    with running_fake_node(tmp_path / 'log', 311.0, seconds=2.0 * PATIENCE_S, idle_solve_s=0.2):
        publisher, infos = bench.publisher(), bench.collect(CameraInfo, '/cam1/autocalib/camera_info')
        bench.connected(publisher)
        publish_until(publisher, lambda: len(infos) > 1, 'camera_info of images')
        wait_for(lambda: 'solving' in (tmp_path / 'log').read_text(), 'the solution')
        calibrate = bench.asked('calibrate', '/cam1/autocalib')
        assert bench.ask('save', '/cam1/autocalib').success
        assert not calibrate.done(), calibrate.result()
        assert bench.ask('reset', '/cam1/autocalib').success
        assert not bench.ask('save', '/cam1/autocalib').success
        wait_for(calibrate.done, 'the caller who is sent away')

"""Image streams as real cameras send them: a node and a camera in processes of their own, seen by /diagnostics."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray

from bench import Bench, wait_for
from processes import PROCESS_PATIENCE_S as PATIENCE_S
from processes import DiagnosticsLog, running_camera, running_node

pytestmark = pytest.mark.dds

RAW, COMPRESSED, LOSSY = {}, {'compressed': True}, {'reliable': False}


@pytest.fixture
def diagnostics(bench: Bench) -> DiagnosticsLog:
    seen = DiagnosticsLog()
    bench.client.create_subscription(DiagnosticArray, '/diagnostics', seen.append, 10)
    return seen


def test_camera_that_starts_late_and_changes_its_reliability_twice_is_heard(diagnostics, tmp_path):
    with running_node(tmp_path / 'log'):
        wait_for(lambda: diagnostics.newest().get('state') == 'WAITING_FOR_IMAGES', 'the node', PATIENCE_S)
        with running_camera('/camera/image', RAW, LOSSY, RAW, {'width': 160, 'height': 120}) as go_on:
            wait_for(lambda: diagnostics.used() > 3, 'images', PATIENCE_S)
            go_on()
            reliably = diagnostics.used()
            wait_for(lambda: diagnostics.used() > reliably + 10, 'images of best effort', PATIENCE_S)
            go_on()
            lossily = diagnostics.used()
            wait_for(lambda: diagnostics.used() > lossily + 10, 'reliable images', PATIENCE_S)
            newest, status = diagnostics.newest(), diagnostics[-1].status[0]
            go_on()
            wait_for(
                lambda: 'the image size changed at ' in (tmp_path / 'log').read_text(),
                'the news',
                PATIENCE_S,
            )
            before = diagnostics.used()
            wait_for(lambda: diagnostics.used() > before + 3, 'images of the other size', PATIENCE_S)
    subscriptions = [line for line in (tmp_path / 'log').read_text().splitlines() if 'subscribed to' in line]
    assert [line.rpartition(' ')[2] for line in subscriptions] == ['reliable)', 'best_effort)', 'reliable)']
    assert (newest['state'], newest['encoding'], newest['image_topic']) == ('COLLECTING', 'mono8', '/camera/image')
    assert float(newest['received_hz']) > 0
    assert (status.level, status.name, status.hardware_id) == (b'\x01', 'site/autocalib: calibration', 'site')


def test_compressed_images_are_heard(diagnostics, tmp_path):
    with (
        running_node(tmp_path / 'log', '-p', 'image_transport:=compressed'),
        running_camera('/camera/image/compressed', COMPRESSED),
    ):
        wait_for(lambda: diagnostics.used() > 3, 'images', PATIENCE_S)
    assert diagnostics.newest()['encoding'] == 'jpeg'

"""The files for RViz and Foxglove against nodes that run: topics, types, qualities of service, frames and names."""

import json
from pathlib import Path

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from autocalib_ros.ros.autocalib_node import AutocalibNode
from autocalib_ros.ros.ground_points_node import GroundPointsNode
from bench import wait_for

CONFIG = Path(__file__).parent.parent.parent / 'config'
TYPES = {
    'Image': 'sensor_msgs/msg/Image',
    'MarkerArray': 'visualization_msgs/msg/MarkerArray',
    'PointCloud2': 'sensor_msgs/msg/PointCloud2',
}


@pytest.fixture
def published(bench):
    """Return what the nodes of the camera cam1 publish: topics, each with its types."""
    bench.adopt(AutocalibNode(context=bench.context, cli_args=['--ros-args', '-r', '__ns:=/cam1']))
    points = GroundPointsNode(context=bench.context, cli_args=['--ros-args', '-r', '__ns:=/cam1/autocalib'])
    wait_for(lambda: bench.client.count_publishers('/cam1/autocalib/ground_points'), 'the nodes')
    yield dict(bench.client.get_topic_names_and_types())
    points.destroy_node()


def test_displays_of_rviz_match_their_publishers(bench, published):
    manager = yaml.safe_load((CONFIG / 'autocalib.rviz').read_text(encoding='utf-8'))['Visualization Manager']
    for display in manager['Displays']:
        if 'Topic' not in display:
            continue
        topic = display['Topic']
        assert published[topic['Value']] == [TYPES[display['Class'].partition('/')[2]]]
        (offer,) = (info.qos_profile for info in bench.client.get_publishers_info_by_topic(topic['Value']))
        assert topic['Reliability Policy'] == 'Best Effort' or offer.reliability == ReliabilityPolicy.RELIABLE
        assert topic['Durability Policy'] == 'Volatile' or offer.durability == DurabilityPolicy.TRANSIENT_LOCAL
    (node,) = bench.nodes
    assert manager['Global Options']['Fixed Frame'] == node._headers.ground_frame('any')


def test_panels_of_foxglove_name_what_is_published(bench, published):
    settings = json.loads((CONFIG / 'foxglove_layout.json').read_text(encoding='utf-8'))['configById']
    for name, panel in settings.items():
        kind = name.partition('!')[0]
        if kind == 'Image':
            assert published[panel['imageMode']['imageTopic']] == [TYPES['Image']]
        elif kind == '3D':
            assert {kind for topic in panel['topics'] for kind in published[topic]} == {
                TYPES['MarkerArray'],
                TYPES['PointCloud2'],
            }
            assert panel['followTf'] == bench.nodes[0]._headers.ground_frame('any')
        elif kind == 'RawMessages':
            assert panel['topicPath'] in published
        else:
            assert published[panel['topicToRender']] == ['diagnostic_msgs/msg/DiagnosticArray']


def test_the_details_that_foxglove_opens_are_those_of_this_camera(bench, published):
    settings = json.loads((CONFIG / 'foxglove_layout.json').read_text(encoding='utf-8'))['configById']
    (panel,) = (panel for name, panel in settings.items() if name.startswith('DiagnosticStatusPanel'))
    received = bench.collect(DiagnosticArray, '/diagnostics')
    (status,) = wait_for(lambda: received, 'diagnostics')[-1].status
    assert (panel['selectedName'], panel['selectedHardwareId']) == (status.name, status.hardware_id)

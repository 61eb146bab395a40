"""Why no image arrives: one line with fault and remedy."""

import pytest

from autocalib_ros.ros.watchdog import COMPRESSED, IMAGE, PublisherOffer, diagnose, other_transport_topic

RAW = PublisherOffer('/cam/driver', IMAGE, True)
LOSSY = PublisherOffer('/cam/driver', IMAGE, False)
PACKED = PublisherOffer('/cam/driver', COMPRESSED, True)
POINTS = PublisherOffer('/lidar', 'sensor_msgs/msg/PointCloud2', True)
T, C = '/cam/image', '/cam/image/compressed'


@pytest.mark.parametrize(
    ('topic', 'kind', 'offers', 'other_offers', 'reliable', 'expected', 'persistent'),
    [
        (T, IMAGE, [], [], True, 'no publisher on /cam/image: start the camera, or remap', False),
        (T, IMAGE, [], [PACKED], True, '/cam/image/compressed: set image_transport:=compressed', True),
        (C, COMPRESSED, [], [RAW], True, 'publishes /cam/image: set image_transport:=raw', True),
        (C + '/compressed', COMPRESSED, [], [PACKED], True, 'remap without it: -r image:=/cam/image', True),
        (C, IMAGE, [PACKED], [], True, 'set image_transport:=compressed, and remap -r image:=/cam/image', True),
        (T, IMAGE, [PACKED], [], True, 'republish it on /cam/image/compressed', True),
        (C, COMPRESSED, [RAW], [], True, 'set image_transport:=raw, and remap -r image:=/cam/image/compressed', True),
        (
            T,
            IMAGE,
            [POINTS],
            [],
            True,
            'as sensor_msgs/msg/PointCloud2, but this node subscribes to sensor_msgs/msg/Image',
            True,
        ),
        (T, IMAGE, [LOSSY], [], True, 'requests reliable: set image_reliability:=auto', True),
        (T, IMAGE, [LOSSY, RAW], [], True, 'no image arrives: is the camera running?', False),
        (T, IMAGE, [LOSSY], [], False, 'best effort loses large images', False),
        (T, IMAGE, [RAW], [], False, 'is the camera running?', False),
    ],
)
def test_fault_is_named_with_its_remedy(topic, kind, offers, other_offers, reliable, expected, persistent):
    diagnosis = diagnose(topic, kind, offers, requests_reliable=reliable, other_offers=other_offers)
    assert expected in diagnosis.text
    assert '\n' not in diagnosis.text
    assert diagnosis.persistent == persistent


@pytest.mark.parametrize(('topic', 'kind', 'other_offers'), [(T, IMAGE, C), (C, COMPRESSED, T)])
def test_topic_of_the_other_transport(topic, kind, other_offers):
    assert other_transport_topic(topic, kind) == other_offers

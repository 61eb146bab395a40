"""Diagnosis of a missing image stream from what the publishers of the topic offer. Needs no ROS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

IMAGE, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
TRANSPORT = {IMAGE: 'raw', COMPRESSED: 'compressed'}
SUFFIX = '/compressed'


@dataclass(frozen=True)
class PublisherOffer:
    """One publisher: name of its node, message type, and whether its QoS is reliable."""

    node: str
    type_name: str
    reliable: bool


@dataclass(frozen=True)
class NoImageDiagnosis:
    """Why no image arrives; `persistent` if only a change of configuration helps."""

    text: str
    persistent: bool


def diagnose(
    topic: str,
    type_name: str,
    offers: Sequence[PublisherOffer],
    *,
    requests_reliable: bool,
    other_offers: Sequence[PublisherOffer] = (),
) -> NoImageDiagnosis:
    """Return why no image of type `type_name` arrives on `topic`.

    `other_offers` are the publishers on the topic of the other transport, see `other_transport_topic`.
    """
    if not offers:
        return _no_publisher(topic, type_name, other_offers)
    matching = [offer for offer in offers if offer.type_name == type_name]
    if not matching:
        return _wrong_type(topic, type_name, offers)
    if requests_reliable and not any(offer.reliable for offer in matching):
        return NoImageDiagnosis(
            f'incompatible QoS: {_names(matching)} publishes {topic} as best effort, this node requests reliable: '
            'set image_reliability:=auto',
            True,
        )
    lossy = '' if any(offer.reliable for offer in matching) else '; best effort loses large images'
    return NoImageDiagnosis(
        f'{_names(matching)} publishes {topic}, but no image arrives: is the camera running?{lossy}', False
    )


def other_transport_topic(topic: str, type_name: str) -> str:
    """Return the topic of the same camera in the other transport, raw or compressed."""
    return topic.removesuffix(SUFFIX) if type_name == COMPRESSED else topic + SUFFIX


def _no_publisher(topic: str, type_name: str, other_offers: Sequence[PublisherOffer]) -> NoImageDiagnosis:
    other = other_transport_topic(topic, type_name)
    sent = {offer.type_name for offer in other_offers}
    if type_name == COMPRESSED and COMPRESSED in sent:
        return NoImageDiagnosis(
            f"no publisher on {topic}, but {other} carries compressed images: '{SUFFIX}' is appended here, "
            f'so remap without it: -r image:={other.removesuffix(SUFFIX)}',
            True,
        )
    transport = {IMAGE: 'compressed', COMPRESSED: 'raw'}[type_name]
    if any(TRANSPORT.get(name) == transport for name in sent):
        return NoImageDiagnosis(
            f'no publisher on {topic}, but {_names(other_offers)} publishes {other}: set image_transport:={transport}',
            True,
        )
    return NoImageDiagnosis(
        f'no publisher on {topic}: start the camera, or remap with -r image:=/your/image_topic', False
    )


def _wrong_type(topic: str, type_name: str, offers: Sequence[PublisherOffer]) -> NoImageDiagnosis:
    sent = sorted({offer.type_name for offer in offers})
    what = f'{_names(offers)} publishes {topic} as {", ".join(sent)}, but this node subscribes to {type_name}'
    if type_name == IMAGE and sent == [COMPRESSED]:
        base = topic.removesuffix(SUFFIX)
        advice = (
            f'set image_transport:=compressed, and remap -r image:={base}'
            if base != topic
            else (f'republish it on {topic}{SUFFIX} and set image_transport:=compressed')
        )
    elif type_name == COMPRESSED and sent == [IMAGE]:
        advice = f'set image_transport:=raw, and remap -r image:={topic}'
    else:
        advice = 'remap with -r image:=/your/image_topic'
    return NoImageDiagnosis(f'{what}: {advice}', True)


def _names(offers: Sequence[PublisherOffer]) -> str:
    return ', '.join(sorted({offer.node for offer in offers}))

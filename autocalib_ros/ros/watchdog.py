"""Why no image arrives, in one line, from what the publishers of the image topic offer. Needs no ROS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

IMAGE, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
TRANSPORT = {IMAGE: 'raw', COMPRESSED: 'compressed'}
SUFFIX = '/compressed'


@dataclass(frozen=True)
class PublisherOffer:
    """What one publisher offers: the name of its node, the type of its messages, reliable or best effort."""

    node: str
    type_name: str
    reliable: bool


@dataclass(frozen=True)
class NoImageDiagnosis:
    """Why no image arrives; `lasting` when waiting alone does not mend it."""

    words: str
    lasting: bool


def diagnose(
    topic: str,
    type_name: str,
    offers: Sequence[PublisherOffer],
    *,
    asks_reliable: bool,
    other_offers: Sequence[PublisherOffer] = (),
) -> NoImageDiagnosis:
    """Say why no image arrives on `topic`, whose messages should be `type_name`.

    `other_offers` is what is offered on the topic of the other transport, see `other_transport_topic`.
    """
    if not offers:
        return _no_publisher(topic, type_name, other_offers)
    matching = [offer for offer in offers if offer.type_name == type_name]
    if not matching:
        return _wrong_type(topic, type_name, offers)
    if asks_reliable and not any(offer.reliable for offer in matching):
        return NoImageDiagnosis(
            f'{_names(matching)} publishes {topic} as best effort, and this node asks for reliable '
            '(incompatible QoS): set image_reliability:=auto',
            True,
        )
    lossy = '' if any(offer.reliable for offer in matching) else '; best effort loses large images, see the README'
    return NoImageDiagnosis(
        f'{_names(matching)} publishes {topic}, and nothing arrives: is the camera running?{lossy}', False
    )


def other_transport_topic(topic: str, type_name: str) -> str:
    """Return where the same camera publishes by the other transport: beside raw images the compressed ones."""
    return topic.removesuffix(SUFFIX) if type_name == COMPRESSED else topic + SUFFIX


def _no_publisher(topic: str, type_name: str, other_offers: Sequence[PublisherOffer]) -> NoImageDiagnosis:
    other = other_transport_topic(topic, type_name)
    sent = {offer.type_name for offer in other_offers}
    if type_name == COMPRESSED and COMPRESSED in sent:
        return NoImageDiagnosis(
            f"nobody publishes {topic}, but {other} holds compressed images: '{SUFFIX}' is added here, "
            f'so remap without it, -r image:={other.removesuffix(SUFFIX)}',
            True,
        )
    transport = {IMAGE: 'compressed', COMPRESSED: 'raw'}[type_name]
    if any(TRANSPORT.get(name) == transport for name in sent):
        return NoImageDiagnosis(
            f'nobody publishes {topic}, but {_names(other_offers)} publishes {other}: set image_transport:={transport}',
            True,
        )
    return NoImageDiagnosis(
        f'nobody publishes {topic}: start the camera, or remap with -r image:=/your/image_topic', False
    )


def _wrong_type(topic: str, type_name: str, offers: Sequence[PublisherOffer]) -> NoImageDiagnosis:
    sent = sorted({offer.type_name for offer in offers})
    what = f'{_names(offers)} publishes {topic} as {", ".join(sent)}, and this node takes {type_name}'
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

"""Repeated images, as recorders and network cameras make them, and what codecs make of the repeats.

A fault takes the number of images of a recording and a random generator, and returns which image each image of the
stream shows. The stream can have more images per second than the recording.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

JPEG_QUALITIES = (85, 70, 55)
"""Qualities at which images in a row are encoded, so that a repeat differs by up to ten levels as in recordings."""
MACROBLOCK_PX = 16
SKIPPED_LEVELS, COARSE_LEVELS = 2.5, 8.0
"""Mean change, grey levels, below which a codec sends no macroblock (twice the noise of a camera by day), and above
which it sends it coarsely: what is still off is refined by the next image.
"""
COARSE_QUALITY = 30
FREEZE_IMAGES, FREEZE_PERIOD = 15, 150
"""Images of a freeze, and images from one freeze to the next: half a second in five at 30 Hz."""

Order = Callable[[int, np.random.Generator], np.ndarray]
"""Returns the index of the image that each image of the stream shows, increasing or equal, shape (m,)."""
Codec = Callable[[np.ndarray, int], np.ndarray]
"""Encodes and decodes the next image of one stream; the number is that of the image that it shows."""


@dataclass(frozen=True)
class RepeatFault:
    """Which images a stream repeats, and through which codec it comes."""

    order: Order
    rate: float = 1.0
    """Images per second of the stream, in those of the recording."""
    codec: str = ''
    """A key of `CODECS`."""


def every_image(count: int, random: np.random.Generator) -> np.ndarray:
    """Show each image once."""
    return np.arange(count)


def recorded(shown: int, of: int) -> Order:
    """Return the order of a recorder that takes `of` images while the camera takes `shown`."""
    return lambda count, random: np.arange(count * of // shown) * shown // of


def in_bursts(count: int, random: np.random.Generator) -> np.ndarray:
    """Show three new images in a row, then the last three times more, as a network camera does that is recorded."""
    place = np.arange(2 * count) % 6
    return np.minimum(np.arange(2 * count) // 6 * 3 + np.minimum(place, 2), count - 1)


def at_random(count: int, random: np.random.Generator) -> np.ndarray:
    """Show a third of the images once, a third twice and a third three times."""
    order = np.repeat(np.arange(count), random.permutation(np.arange(count) % 3 + 1))
    return order[: 2 * count]


def replaced(every: int) -> Order:
    """Return the order in which each image of number `every` is lost and the one before shown instead."""

    def order(count: int, random: np.random.Generator) -> np.ndarray:
        numbers = np.arange(count)
        return numbers - (numbers % every == every - 1)

    return order


def frozen(count: int, random: np.random.Generator) -> np.ndarray:
    """Freeze for `FREEZE_IMAGES` images, again and again."""
    numbers = np.arange(count)
    return numbers - np.maximum(numbers % FREEZE_PERIOD - (FREEZE_PERIOD - FREEZE_IMAGES), 0)


def jpeg() -> Codec:
    """Return a codec that encodes each image anew, at another quality than the one before.

    The quality at which an image is shown first is the same in every stream, repeats or not: so repeats alone make
    the difference.
    """
    shown, repeats = -1, 0

    def code(image: np.ndarray, number: int) -> np.ndarray:
        nonlocal shown, repeats
        shown, repeats = number, repeats + 1 if number == shown else 0
        return _through_jpeg(image, JPEG_QUALITIES[(number + repeats) % len(JPEG_QUALITIES)])

    return code


def skipping() -> Codec:
    """Return a codec that sends only the macroblocks that change, and refines them in the next image."""
    sent: np.ndarray | None = None

    def code(image: np.ndarray, number: int) -> np.ndarray:
        nonlocal sent
        decoded = _through_jpeg(image, JPEG_QUALITIES[0])
        if sent is not None:
            levels = _macroblock_changes(sent, image)
            coarse, skipped = levels > COARSE_LEVELS, levels < SKIPPED_LEVELS
            decoded[coarse] = _through_jpeg(image, COARSE_QUALITY)[coarse]
            decoded[skipped] = sent[skipped]
        sent = decoded
        return decoded.copy()

    return code


CODECS: dict[str, Callable[[], Codec]] = {'': lambda: _unchanged, 'jpeg': jpeg, 'skipping': skipping}
"""Makers of codecs by name; '' changes nothing."""
REPEAT_FAULTS: dict[str, RepeatFault] = {
    'repeated_25_in_30': RepeatFault(recorded(25, 30), 30 / 25),
    'repeated_15_in_30': RepeatFault(recorded(15, 30), 30 / 15),
    'repeated_in_bursts': RepeatFault(in_bursts, 2.0),
    'repeated_at_random': RepeatFault(at_random, 2.0),
    'repeated_25_in_30_jpeg': RepeatFault(recorded(25, 30), 30 / 25, 'jpeg'),
    'repeated_15_in_30_jpeg': RepeatFault(recorded(15, 30), 30 / 15, 'jpeg'),
    'repeated_in_bursts_jpeg': RepeatFault(in_bursts, 2.0, 'jpeg'),
    'repeated_25_in_30_skipping': RepeatFault(recorded(25, 30), 30 / 25, 'skipping'),
    'repeated_15_in_30_skipping': RepeatFault(recorded(15, 30), 30 / 15, 'skipping'),
    'replaced_1_in_6_jpeg': RepeatFault(replaced(6), 1.0, 'jpeg'),
    'replaced_1_in_2_jpeg': RepeatFault(replaced(2), 1.0, 'jpeg'),
    'frozen_jpeg': RepeatFault(frozen, 1.0, 'jpeg'),
}
"""Faults by name."""


def _unchanged(image: np.ndarray, number: int) -> np.ndarray:
    return image


def _macroblock_changes(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the mean change of the macroblock of each pixel, grey levels (H, W)."""
    height, width = before.shape[:2]
    change = cv2.absdiff(before, after).reshape(height, width, -1).mean(axis=2, dtype=np.float32)
    blocks = (-(-width // MACROBLOCK_PX), -(-height // MACROBLOCK_PX))
    levels = cv2.resize(change, blocks, interpolation=cv2.INTER_AREA)
    return cv2.resize(levels, (width, height), interpolation=cv2.INTER_NEAREST)


def _through_jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    data = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE if image.ndim == 2 else cv2.IMREAD_COLOR))

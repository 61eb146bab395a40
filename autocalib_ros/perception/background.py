"""Background image: the temporal median of a few images far apart in time, in which traffic cancels out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

MAX_SAMPLES = 17
"""Images in memory; bounds memory and the cost of the median. Nine are left when every second one is dropped: where
vehicles queue for a third of the time they cover most of five images in one place of five, most of nine in one of
seven, most of 17 in one of thirteen, and edges there change with the images that happen to be in it."""
FIRST_INTERVAL_S = 1.0
"""First sampling interval, seconds: in less a vehicle nearby covers much of the same pixels again."""
EARLY_INTERVAL_S = 0.5
"""Sampling interval until there are `MIN_SAMPLES` at `FIRST_INTERVAL_S`, seconds: a background after two seconds, which
the better one replaces."""
MAX_INTERVAL_S = 300.0
"""Longest sampling interval: images older than `MAX_SAMPLES` of these show other light, dirt and road paint."""
SAMPLE_TOLERANCE_S = 0.01
"""An image this much before a multiple of the interval is at it, seconds: cameras of even rates have an image at each
whole second, and neither rounding nor what is left of jitter decides between it and the next. Less than a frame."""
MIN_SAMPLES = 5
"""The median of fewer images still shows passing vehicles. Judgement."""

BAND_BYTES = 1 << 19
"""Size of the bands of rows of all images that are sorted at once: they fit into the cache of a core."""

STRIP_BYTES = 1 << 20
"""Size of the strips in which samples are encoded: the median takes one strip of each, 17 MB at most, where whole
images of 3840x2160 would need 423 MB."""
STRIP_ROWS = 16
"""Strips are whole blocks of the JPEG, 16 rows where colours have half the resolution."""
REDUCED_WIDTH_PX = 960
"""Largest width of the copies that are kept as they are, halved until they fit: letters can still be read, and borders
are found to one of their pixels. 17 of them take 26 MB at most, what decoding them again would."""


@dataclass(frozen=True)
class _StoredSample:
    """One image: encoded, and reduced."""

    time_s: float
    strips: tuple[np.ndarray, ...]
    """JPEG of the strips of rows, from top to bottom."""
    reduced: np.ndarray
    """Grey or BGR uint8, at most `REDUCED_WIDTH_PX` wide."""

    def grey(self, size: tuple[int, int]) -> np.ndarray:
        """Return the image in grey, uint8 (height, width) of a `size` (width, height) that it is reduced to."""
        image = np.concatenate([_decoded(strip, cv2.IMREAD_GRAYSCALE) for strip in self.strips])
        return image if image.shape == size[::-1] else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


class Background:
    """Bounded set of JPEG samples, the first at or after each multiple of the sampling interval.

    At multiples, lost or late images change one sample and not all later ones. When there are too many, the interval
    doubles, and those between its multiples are dropped. Once the interval has reached `MAX_INTERVAL_S`, the oldest
    sample is dropped instead.
    """

    def __init__(self) -> None:
        self._regular: list[_StoredSample] = []
        self._early: list[_StoredSample] = []
        self._interval_s = FIRST_INTERVAL_S
        self._next_s = self._next_early_s = 0.0

    def copy(self) -> Background:
        """Return the same samples, for another thread; an encoded sample is never changed."""
        other = Background()
        other._regular, other._early = list(self._regular), list(self._early)
        return other

    def update(self, image: np.ndarray, time_s: float) -> None:
        """Add a grey or BGR uint8 image if the sampling interval has passed."""
        if not self.is_due(time_s):
            return
        sample = _StoredSample(time_s, _encoded(image), _halved(image))
        if time_s >= self._next_s - SAMPLE_TOLERANCE_S:
            self._regular.append(sample)
            while len(self._regular) > MAX_SAMPLES:
                self._thin()
            self._next_s = self._interval_s * (_multiple(time_s, self._interval_s) + 1)
            self._early = self._early if self._is_early else []
        else:
            self._early.append(sample)
        self._next_early_s = EARLY_INTERVAL_S * (_multiple(time_s, EARLY_INTERVAL_S) + 1)

    @property
    def _is_early(self) -> bool:
        return len(self._regular) < MIN_SAMPLES

    @property
    def _samples(self) -> list[_StoredSample]:
        return sorted([*self._regular, *self._early], key=lambda sample: sample.time_s)

    def _thin(self) -> None:
        if 2 * self._interval_s > MAX_INTERVAL_S:
            self._regular = self._regular[1:]
            return
        self._interval_s *= 2
        first_of = {_multiple(sample.time_s, self._interval_s): sample for sample in self._regular[::-1]}
        self._regular = list(first_of.values())[::-1]

    def is_due(self, time_s: float) -> bool:
        """Whether an image of this time would be added."""
        next_s = min(self._next_s, self._next_early_s) if self._is_early else self._next_s
        return time_s >= next_s - SAMPLE_TOLERANCE_S

    @property
    def times_s(self) -> tuple[float, ...]:
        """Times of the images that the background is computed from."""
        return tuple(sample.time_s for sample in self._samples)

    def image(self) -> np.ndarray | None:
        """Return the median image, BGR uint8 (H, W, 3); None before the first image."""
        samples = self._samples
        if not samples:
            return None
        strips = zip(*(sample.strips for sample in samples), strict=True)
        return np.concatenate([median([_decoded(part, cv2.IMREAD_COLOR) for part in strip]) for strip in strips])

    def grey_samples(self, size: tuple[int, int]) -> list[np.ndarray]:
        """Return the images in grey, uint8 (height, width) of a `size` (width, height) that they are reduced to.

        Oldest first; none while there are fewer than `MIN_SAMPLES`.
        """
        samples = self._samples
        return [sample.grey(size) for sample in samples] if len(samples) >= MIN_SAMPLES else []

    def reduced_samples(self) -> list[np.ndarray]:
        """Return the images, BGR uint8 (h, w, 3), oldest first, at most `REDUCED_WIDTH_PX` wide."""
        reduced = [sample.reduced for sample in self._samples]
        return [image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) for image in reduced]


def _encoded(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """Encode the strips of an image (H, W) or (H, W, 3)."""
    rows = max(1, STRIP_BYTES // (3 * image.shape[1] * STRIP_ROWS)) * STRIP_ROWS
    strips = (np.ascontiguousarray(image[top : top + rows]) for top in range(0, len(image), rows))
    return tuple(cv2.imencode('.jpg', strip, [cv2.IMWRITE_JPEG_QUALITY, 92])[1] for strip in strips)


def _decoded(strip: np.ndarray, flags: int) -> np.ndarray:
    return np.asarray(cv2.imdecode(strip, flags))


def _halved(image: np.ndarray) -> np.ndarray:
    """Return a copy of an image, halved until it is at most `REDUCED_WIDTH_PX` wide."""
    factor = 1
    while image.shape[1] > REDUCED_WIDTH_PX * factor:
        factor *= 2
    if factor == 1:
        return image.copy()
    size = (max(1, round(image.shape[1] / factor)), max(1, round(image.shape[0] / factor)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _multiple(time_s: float, interval_s: float) -> int:
    """Return the number of the last multiple of an interval."""
    return math.floor((time_s + SAMPLE_TOLERANCE_S) / interval_s)


def median(images: list[np.ndarray]) -> np.ndarray:
    """Return the pixelwise median of images of one shape; the upper median of an even number."""
    rows = max(1, BAND_BYTES * len(images[0]) // max(1, len(images) * images[0].nbytes))
    bands = [[image[first : first + rows] for image in images] for first in range(0, len(images[0]), rows)]
    return np.concatenate([_median_of_band(band) for band in bands])


def _median_of_band(images: list[np.ndarray]) -> np.ndarray:
    """Sort images by odd-even transposition (Knuth, TAOCP vol. 3, 5.2.2) and return the middle one.

    Each exchange is one OpenCV minimum and maximum of whole images.
    """
    for turn in range(len(images)):
        for low in range(turn % 2, len(images) - 1, 2):
            one, other = images[low], images[low + 1]
            images[low], images[low + 1] = cv2.min(one, other), cv2.max(one, other)
    return images[len(images) // 2]

"""Background image: the temporal median of a few images far apart in time, in which traffic cancels out."""

from __future__ import annotations

import math

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

REDUCED_FLAGS = (
    cv2.IMREAD_COLOR,
    cv2.IMREAD_REDUCED_COLOR_2,
    cv2.IMREAD_REDUCED_COLOR_4,
    cv2.IMREAD_REDUCED_COLOR_8,
)
"""Decoding of a JPEG in whole, half, quarter and eighth size, each cheaper than the one before."""


class Background:
    """Bounded set of JPEG samples, the first at or after each multiple of the sampling interval.

    At multiples, lost or late images change one sample and not all later ones. When there are too many, the interval
    doubles, and those between its multiples are dropped. Once the interval has reached `MAX_INTERVAL_S`, the oldest
    sample is dropped instead.
    """

    def __init__(self) -> None:
        self._regular: list[tuple[float, np.ndarray]] = []
        self._early: list[tuple[float, np.ndarray]] = []
        self._interval_s = FIRST_INTERVAL_S
        self._next_s = self._next_early_s = 0.0
        self._width = 0

    def copy(self) -> Background:
        """Return the same samples, for another thread; an encoded sample is never changed."""
        other = Background()
        other._regular, other._early, other._width = list(self._regular), list(self._early), self._width
        return other

    def update(self, image: np.ndarray, time_s: float) -> None:
        """Add a grey or BGR uint8 image if the sampling interval has passed."""
        if not self.is_due(time_s):
            return
        ok, encoded = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 92])
        self._width = image.shape[1]
        if time_s >= self._next_s - SAMPLE_TOLERANCE_S:
            self._regular += [(time_s, encoded)] if ok else []
            while len(self._regular) > MAX_SAMPLES:
                self._thin()
            self._next_s = self._interval_s * (_multiple(time_s, self._interval_s) + 1)
            self._early = self._early if self._is_early else []
        else:
            self._early += [(time_s, encoded)] if ok else []
        self._next_early_s = EARLY_INTERVAL_S * (_multiple(time_s, EARLY_INTERVAL_S) + 1)

    @property
    def _is_early(self) -> bool:
        return len(self._regular) < MIN_SAMPLES

    @property
    def _samples(self) -> list[tuple[float, np.ndarray]]:
        return sorted([*self._regular, *self._early], key=lambda sample: sample[0])

    def _thin(self) -> None:
        if 2 * self._interval_s > MAX_INTERVAL_S:
            self._regular = self._regular[1:]
            return
        self._interval_s *= 2
        first_of = {_multiple(time_s, self._interval_s): (time_s, data) for time_s, data in self._regular[::-1]}
        self._regular = list(first_of.values())[::-1]

    def is_due(self, time_s: float) -> bool:
        """Whether an image of this time would be added."""
        next_s = min(self._next_s, self._next_early_s) if self._is_early else self._next_s
        return time_s >= next_s - SAMPLE_TOLERANCE_S

    @property
    def times_s(self) -> tuple[float, ...]:
        """Times of the images that the background is computed from."""
        return tuple(time_s for time_s, _ in self._samples)

    def image(self) -> np.ndarray | None:
        """Return the median image, BGR uint8 (H, W, 3); None before the first image."""
        return self._median(cv2.IMREAD_COLOR) if self._samples else None

    def grey(self) -> np.ndarray | None:
        """Return the median image in grey, uint8 (H, W); None while there are fewer than `MIN_SAMPLES`."""
        return median(samples) if (samples := self.grey_samples()) else None

    def grey_samples(self) -> list[np.ndarray]:
        """Return the images in grey, uint8 (H, W), oldest first; none while there are fewer than `MIN_SAMPLES`."""
        return self._decoded(cv2.IMREAD_GRAYSCALE) if len(self._samples) >= MIN_SAMPLES else []

    def samples(self, max_width: int) -> list[np.ndarray]:
        """Return the images, BGR uint8 (h, w, 3), oldest first, halved until they are at most `max_width` wide."""
        halvings = 0
        while self._width > max_width << halvings and halvings + 1 < len(REDUCED_FLAGS):
            halvings += 1
        return self._decoded(REDUCED_FLAGS[halvings])

    def _median(self, flags: int) -> np.ndarray:
        return median(self._decoded(flags))

    def _decoded(self, flags: int) -> list[np.ndarray]:
        images = [cv2.imdecode(encoded, flags) for _, encoded in self._samples]
        return [image for image in images if image is not None]


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

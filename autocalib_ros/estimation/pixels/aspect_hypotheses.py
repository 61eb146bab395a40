"""Hypotheses about the shape of the pixels, from the size of the images.

Sensors have square pixels; recorders, encoders and analogue standards squeeze their pictures. The shape of the picture
as it was taken, 4:3 or 16:9, over the shape of the image gives the pixel aspect that a squeeze would have caused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

SQUEEZED_SHAPES = {'4:3': 4 / 3, '16:9': 16 / 9}
"""Shapes of the pictures that are squeezed into images of other shapes: of television, and of recorders and network
cameras, which are made after it."""
SENSOR_SHAPES = (1.0, 5 / 4, 4 / 3, 3 / 2, 16 / 10, 16 / 9, 17 / 9)
"""Width over height of images as sensors give them, with square pixels."""
ROUNDING_PX = 1.0
"""Codecs need sides of even length: a side of a size that is not squeezed may be wrong by one pixel."""
MACROBLOCK_PX = 16
"""Side of a macroblock, in which encoders count: a side is squeezed or cropped to the next multiple of it, and nothing
tells which."""
TELEVISION_LINES = (576, 480, 288, 240, 144, 120)
TELEVISION_COLUMNS = (960, 720, 704, 544, 528, 480, 360, 352, 176)
"""Lines and columns of digitised analogue video (ITU-R BT.601, and 960H), whole and reduced: its pixels are never
square."""
TELEVISION_SIGMA = float(np.log(720 / 704))
"""Standard deviation of the log aspect of such pixels: the standards disagree by this."""
RECORDER_SQUEEZES = (2.0, 3 / 2, 4 / 3, 1 / 2)
"""Pixel aspects with which recorders store pictures of sensors: half of the columns (1080N), two thirds (DVCPRO HD),
three quarters (HDV), half of the lines (2CIF)."""
UNUSUAL_RMS = 0.04
"""Standard deviation of the log aspect of images whose size is that of a sensor: one in eight is squeezed, by 12 %."""
MIN_SQUEEZE = 0.002
"""Smallest squeeze, in log aspect, that is one: less moves a point at the border of an image by about one pixel."""


@dataclass(frozen=True)
class AspectHypotheses:
    """What the size of an image lets expect of its pixels."""

    size: tuple[int, int]
    others: dict[str, float]
    """Pixel aspects besides the expected one, by the shape of the picture that would have been squeezed; without those
    that are nearly the expected one."""
    near_sigma: float
    """Standard deviation of the log aspect of the expected pixels: the squeeze from the nearest shape of sensors, where
    an encoder may have rounded the size; 0 where it has not."""
    others_sigma: float
    """The same of the other pixels: the standards of television leave open whether 704 or 720 columns show the
    picture."""
    doubtful: bool
    """Whether images of this size are usually squeezed, so that the expected pixels have to be shown."""
    expected: float = 1.0
    """Pixel aspect that is taken unless the traffic contradicts it."""

    @classmethod
    def of(cls, size: tuple[int, int]) -> AspectHypotheses:
        """Return the hypotheses for images of a size (width, height)."""
        width, height = size
        aspects = {name: shape * height / width for name, shape in SQUEEZED_SHAPES.items()}
        television = width in TELEVISION_COLUMNS and height in TELEVISION_LINES
        native = not television and any(_is_shape(size, width / height / shape) for shape in SENSOR_SHAPES)
        near_sigma = 0.0 if native or television else _rounded_squeeze(size)
        recorder = not (native or near_sigma) and any(
            abs(np.log(aspects[name] / squeeze)) * min(size) <= MACROBLOCK_PX
            for squeeze in RECORDER_SQUEEZES
            for name in SQUEEZED_SHAPES
        )
        others = {name: aspect for name, aspect in aspects.items() if not _is_near(size, aspect, 1.0, near_sigma)}
        others_sigma = TELEVISION_SIGMA if television else near_sigma
        return cls(size, others, near_sigma, others_sigma, television or recorder)

    @property
    def unmeasured_sigma(self) -> float:
        """Standard deviation of the log aspect where nothing measures it: over what images of the size usually are."""
        if not self.doubtful:
            return 0.0 if self.near_sigma else UNUSUAL_RMS
        logs = np.log(np.array([self.expected, *self.others.values()]) / self.expected)
        return float(np.sqrt(np.mean(logs**2) + self.others_sigma**2))

    def expecting(self, aspect: float) -> AspectHypotheses:
        """Return the hypotheses for a recording that states a pixel aspect: that one is expected, not 1."""
        others = {
            name: other
            for name, other in {**self.others, 'square pixels': 1.0}.items()
            if not _is_near(self.size, other, aspect, self.others_sigma)
        }
        return replace(self, others=others, near_sigma=0.0, doubtful=False, expected=aspect)


def _is_near(size: tuple[int, int], aspect: float, expected: float, sigma: float) -> bool:
    """Whether a pixel aspect is nearly the expected one, whose log has a standard deviation."""
    return abs(np.log(aspect / expected)) <= sigma + MIN_SQUEEZE or _is_shape(size, aspect / expected)


def _is_shape(size: tuple[int, int], excess: float) -> bool:
    """Whether an image of a size has a shape, of which its own is `excess` times, but for `ROUNDING_PX` in a side."""
    return abs(np.log(excess)) * min(size) < ROUNDING_PX * 1.5


def _rounded_squeeze(size: tuple[int, int]) -> float:
    """Return the log aspect of the nearest shape of sensors, 0 if no side comes to it within a macroblock."""
    width, height = size
    nearest = min((abs(float(np.log(shape * height / width))) for shape in SENSOR_SHAPES), default=np.inf)
    return nearest if nearest * min(size) <= MACROBLOCK_PX and nearest > MIN_SQUEEZE else 0.0

"""The picture inside the images: what the lens lights, without bars around it and without the corners of a fisheye."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

PICTURE_SHAPES = (1.0, 11 / 9, 5 / 4, 4 / 3, 22 / 15, 3 / 2, 16 / 10, 16 / 9, 17 / 9)
"""Long over short side of whole pictures: square fisheye modes, CIF, SXGA, VGA and its multiples, SIF, 3:2 sensors,
16:10, HD, DCI."""
SHAPE_TOLERANCE = 0.01
"""Relative deviation of a whole picture from its shape: a border is found to one pixel on each side, and encoders
round sides to two pixels: 4 px of a side of 400 px."""
EQUAL_BARS_PX = 2.0
"""Largest difference between two opposite bars that centre a picture, pixels of the full image: each of the two borders
is found to one pixel."""


@dataclass(frozen=True)
class Picture:
    """Where the picture lies in the images, in pixels of the full image; borders lie half a pixel outside of centres.

    A rectangle of x0, y0, x1, y1 covers the columns x0 to x1 - 1 and the rows y0 to y1 - 1; a whole image of
    640x360 is (0, 0, 640, 360).
    """

    image_size: tuple[int, int]
    """Width and height of the images."""
    rectangle: tuple[float, float, float, float]
    circle: tuple[float, float, float] | None = None
    """Image circle of a fisheye: x and y of its centre, where (0, 0) is the corner of the image, and its radius."""

    @classmethod
    def whole(cls, image_size: tuple[int, int]) -> Picture:
        """Return the picture that fills images of this size."""
        return cls(image_size, (0.0, 0.0, float(image_size[0]), float(image_size[1])))

    def __post_init__(self) -> None:
        width, height = self.image_size
        x0, y0, x1, y1 = self.rectangle
        numbers = (*self.rectangle, *(self.circle or ()))
        inside = 0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height
        if not np.isfinite(numbers).all() or not inside or (self.circle is not None and self.circle[2] <= 0):
            raise ValueError(f'a picture of {self.rectangle}, circle {self.circle}, in images of {width}x{height}')

    @property
    def fills_image(self) -> bool:
        """Whether the picture is the whole image."""
        return self == Picture.whole(self.image_size)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the rectangle."""
        x0, y0, x1, y1 = self.rectangle
        return x1 - x0, y1 - y0

    @property
    def centre_px(self) -> tuple[float, float]:
        """Centre of the circle or of the rectangle, in pixels where (0, 0) is the centre of the top-left pixel."""
        if self.circle is not None:
            return self.circle[0] - 0.5, self.circle[1] - 0.5
        x0, y0, x1, y1 = self.rectangle
        return (x0 + x1 - 1) / 2, (y0 + y1 - 1) / 2

    @property
    def bars(self) -> tuple[float, float, float, float]:
        """Widths of the bars left, above, right and below."""
        (x0, y0, x1, y1), (width, height) = self.rectangle, self.image_size
        return x0, y0, width - x1, height - y1

    @property
    def is_covered(self) -> bool:
        """Whether bars on one side look as if they cover a part of the picture, as a data strip does.

        The image has the shape of a sensor, and what is seen of it has not.
        """
        if self.circle is not None or self._uneven_bars == (0.0, 0.0):
            return False
        return _missing(*self.size) != (0.0, 0.0) and _missing(*self.image_size) == (0.0, 0.0)

    @property
    def lens_centre_px(self) -> tuple[float, float]:
        """Most probable centre of the lens: that of the picture, or of the image where bars cover the picture."""
        return Picture.whole(self.image_size).centre_px if self.is_covered else self.centre_px

    @property
    def centre_sigma_px(self) -> tuple[float, float]:
        """Standard deviation x and y of the centre of the lens from `lens_centre_px` where the picture looks cut, or 0.

        Bars on one side stand beside the picture, or cover a part of it; then it is as large as the image. The centres
        of both lie half of the bars apart: that is the standard deviation. A picture of another shape than sensors
        have, without such bars, was cut out of one: by an unknown share on either side of what it lacks to the nearest
        such shape (uniform). A picture of the shape of a sensor is whole, and so is the image circle of a fisheye.
        """
        if self.circle is not None:
            return 0.0, 0.0
        missing = _missing(*self.size)
        if missing == (0.0, 0.0):
            return missing
        if self._uneven_bars != (0.0, 0.0):
            return self._uneven_bars[0] / 2, self._uneven_bars[1] / 2
        return missing[0] / math.sqrt(12.0), missing[1] / math.sqrt(12.0)

    @property
    def _uneven_bars(self) -> tuple[float, float]:
        """Difference between the bars on opposite sides, across and down; 0 if they centre the picture."""
        left, above, right, below = self.bars
        across, down = abs(left - right), abs(above - below)
        return (across, down) if max(across, down) > EQUAL_BARS_PX else (0.0, 0.0)

    @property
    def looks_cut(self) -> bool:
        """Whether a part of the picture may be hidden, so that the lens need not look at its centre."""
        return any(self.centre_sigma_px)

    def scaled(self, across: float, down: float, image_size: tuple[int, int]) -> Picture:
        """Return the picture in images of another size, scaled by two factors; a circle gets their geometric mean."""
        x0, y0, x1, y1 = self.rectangle
        width, height = image_size
        circle = None
        if self.circle is not None:
            x, y, radius = self.circle
            circle = (x * across, y * down, radius * math.sqrt(across * down))
        box = (x0 * across, y0 * down, min(x1 * across, float(width)), min(y1 * down, float(height)))
        return Picture(image_size, box, circle)

    def in_images_of(self, image_size: tuple[int, int]) -> Picture:
        """Return the picture in the same images scaled to another size."""
        width, height = image_size
        return self.scaled(width / self.image_size[0], height / self.image_size[1], image_size)

    @property
    def numbers(self) -> np.ndarray:
        """The rectangle and the circle as one array (7,), nan without a circle, for files."""
        return np.array([*self.rectangle, *(self.circle or (np.nan,) * 3)])

    @classmethod
    def of_numbers(cls, image_size: tuple[int, int], numbers: np.ndarray) -> Picture:
        """Return the picture with these `numbers`; ValueError if they are none."""
        if numbers.shape != (7,):
            raise ValueError(f'a picture is seven numbers, got an array {numbers.shape}')
        x0, y0, x1, y1, x, y, radius = (float(number) for number in numbers)
        return cls(image_size, (x0, y0, x1, y1), None if np.isnan(radius) else (x, y, radius))

    def __str__(self) -> str:
        (width, height), (x0, y0, *_) = self.size, self.rectangle
        of_images = f'in images of {self.image_size[0]}x{self.image_size[1]}'
        if self.circle is not None:
            x, y = self.centre_px
            return f'a circle of radius {self.circle[2]:.0f} px about ({x:.0f}, {y:.0f}) {of_images}'
        return f'{width:.0f}x{height:.0f} at ({x0:.0f}, {y0:.0f}) {of_images}'

    @property
    def description(self) -> str:
        """The picture in a sentence, with the bars around it and what they may hide."""
        left, above, right, below = self.bars
        beside = [('columns on the left', left), ('rows above', above), ('columns on the right', right)]
        beside.append(('rows below', below))
        bars = [f'{depth:.0f} {where}' for where, depth in beside if depth > 0 and self.circle is None]
        text = f'The picture is {self}' + (f': {", ".join(bars)} are no picture' if bars else '')
        if not self.looks_cut:
            return f'{text}.'
        across, down = self.centre_sigma_px
        sigma = ' and '.join(f'{sigma:.0f} px {way}' for way, sigma in (('across', across), ('down', down)) if sigma)
        whose = 'images, of which the bars cover a part' if self.is_covered else 'picture'
        return f'{text}. It looks cut: the lens is taken to look at the centre of the {whose}, within {sigma}.'


def _missing(width: float, height: float) -> tuple[float, float]:
    """Return the columns and rows that a picture lacks to the smallest sensor shape around it; 0 if it has one."""
    upright = height > width
    long, short = max(width, height), min(width, height)
    if any(abs(long / short / shape - 1) <= SHAPE_TOLERANCE for shape in PICTURE_SHAPES):
        return 0.0, 0.0
    around = [(max(long, short * shape), max(short, long / shape)) for shape in PICTURE_SHAPES]
    whole_long, whole_short = min(around, key=lambda sides: sides[0] * sides[1])
    missing = (whole_long - long, whole_short - short)
    return (missing[1], missing[0]) if upright else missing

"""Drawing primitives for textures: noise, polygons, lines, discs, text."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from autocalib_ros.offline.simulate.palette import Colour

_FIXED_POINT_BITS = 4  # fractional bits of OpenCV drawing coordinates


def filled_image(height: int, width: int, colour: Colour) -> np.ndarray:
    """Return an opaque BGRA image (h, w, 4) of one colour."""
    image = np.empty((max(height, 2), max(width, 2), 4), np.uint8)
    image[:] = (*colour, 255)
    return image


def octave_noise(
    height: int, width: int, octaves: Iterable[tuple[float, float]], rng: np.random.Generator
) -> np.ndarray:
    """Return smooth noise (h, w) float32, the sum of octaves (size in texels, standard deviation)."""
    total = np.zeros((height, width), np.float32)
    for size, stddev in octaves:
        rows, columns = max(2, int(height / size) + 2), max(2, int(width / size) + 2)
        coarse = rng.standard_normal((rows, columns), np.float32) * np.float32(stddev)
        if size > 1:
            full = (int(columns * size), int(rows * size))
            total += cv2.resize(coarse, full, interpolation=cv2.INTER_CUBIC)[:height, :width]
        else:
            total += coarse[:height, :width]
    return total


def add_noise(image: np.ndarray, noise: np.ndarray) -> None:
    """Add noise (h, w) in grey levels to the colours of an image (h, w, 3 or 4), in place."""
    rough = image[..., :3].astype(np.float32) + noise[..., None]
    image[..., :3] = np.clip(rough, 0, 255).astype(np.uint8)


def polygon(image: np.ndarray, points: np.ndarray, colour: tuple[int, ...]) -> None:
    """Fill a polygon (n, 2) in texels; (0, 0) is the corner of the image."""
    fixed = np.round((np.asarray(points, float) - 0.5) * (1 << _FIXED_POINT_BITS)).astype(np.int32)
    cv2.fillPoly(image, [fixed], colour, cv2.LINE_AA, _FIXED_POINT_BITS)


def line(
    image: np.ndarray,
    start: tuple[float, float],
    end: tuple[float, float],
    colour: tuple[int, ...],
    width: int = 1,
) -> None:
    """Draw a line between two points in texels."""
    ends = [tuple(round((c - 0.5) * (1 << _FIXED_POINT_BITS)) for c in p) for p in (start, end)]
    cv2.line(image, ends[0], ends[1], colour, width, cv2.LINE_AA, _FIXED_POINT_BITS)


def disc(image: np.ndarray, centre: tuple[float, float], radius: float, colour: tuple[int, ...]) -> None:
    """Fill a circle in texels."""
    x, y = (round((c - 0.5) * (1 << _FIXED_POINT_BITS)) for c in centre)
    radius_fixed = round(radius * (1 << _FIXED_POINT_BITS))
    cv2.circle(image, (x, y), radius_fixed, colour, -1, cv2.LINE_AA, _FIXED_POINT_BITS)


def draw_text(image: np.ndarray, text: str, box: tuple[float, float, float, float], colour: Colour) -> None:
    """Draw text as large as fits into a box (x0, y0, x1, y1) in texels."""
    x0, y0, x1, y1 = box
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 1.0, 2)
    scale = min((x1 - x0) / width, (y1 - y0) / height)
    if scale * height < 5:
        return
    position = (round((x0 + x1 - scale * width) / 2), round((y0 + y1 + scale * height) / 2))
    thickness = max(1, round(3 * scale))
    cv2.putText(image, text, position, cv2.FONT_HERSHEY_DUPLEX, scale, (*colour, 255), thickness, cv2.LINE_AA)


def mix_colours(a: Colour, b: Colour, part: float) -> Colour:
    """Interpolate linearly between two colours: a at part 0, b at part 1."""
    blue, green, red = (round(x + part * (y - x)) for x, y in zip(a, b, strict=True))
    return (blue, green, red)

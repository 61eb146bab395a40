"""Drawing primitives with OpenCV: lines, text and overlays that are drawn once and composited with each image.

Pictures are BGR uint8; colours are HTML hex strings. Paths are in pixels with pixel centres at integer coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from autocalib_ros.util.plain_text import in_ascii

INK, PAPER, GREY = '#1c2733', '#ffffff', '#9aa5ae'
ROAD_COLOURS = ('#0077bb', '#ee7733', '#009988', '#cc3377', '#ddaa33')
"""One per road direction; distinguishable with all common forms of colour blindness (Paul Tol, vibrant)."""
FONT = cv2.FONT_HERSHEY_SIMPLEX
TEXT_HEIGHT_FRACTION = 0.032
MIN_TEXT_HEIGHT_PX, MAX_TEXT_HEIGHT_PX = 13.0, 34.0
"""Height of a line of text, fraction of the height of the picture, and its limits for legibility and size."""
FONT_HEIGHT_PX = 30.0
"""Line height of the OpenCV font at scale 1, from the top of an l to the bottom of a g."""
STROKE_FRACTION = 0.055
"""Stroke width of letters, fraction of the line height."""
CAPTION_FRACTION = 0.4
"""Largest fraction of the height of a picture that the caption takes."""
PANEL_OPACITY = 0.9
LINE_FRACTION = 0.002
"""Width of a line, fraction of the height of the picture."""
FRACTION_BITS = 4
"""OpenCV draws with fixed-point coordinates in units of 1/16 px."""
MAX_COORDINATE_PX = 30000
"""Limit of coordinates: larger ones overflow the fixed-point format."""


def bgr(colour: str) -> tuple[int, int, int]:
    """Return a colour such as '#0077bb' as a BGR triple."""
    return int(colour[5:7], 16), int(colour[3:5], 16), int(colour[1:3], 16)


def text_height_px(height: int) -> float:
    """Return the text line height for a picture of this height, pixels."""
    return min(max(TEXT_HEIGHT_FRACTION * height, MIN_TEXT_HEIGHT_PX), MAX_TEXT_HEIGHT_PX)


def line_px(height: int) -> int:
    """Return the line width for a picture of this height, pixels."""
    return max(1, round(LINE_FRACTION * height))


def draw_paths(picture: np.ndarray, paths: Sequence[np.ndarray] | np.ndarray, colour: str | int, width_px: int) -> None:
    """Draw anti-aliased polylines, each (n, 2); the colour is an intensity if the picture is a mask."""
    if not len(paths):
        return
    steps = list(_fixed_point(paths)) if isinstance(paths, np.ndarray) else [_fixed_point(path) for path in paths]
    cv2.polylines(
        picture, steps, False, bgr(colour) if isinstance(colour, str) else colour, width_px, cv2.LINE_AA, FRACTION_BITS
    )


def draw_dots(picture: np.ndarray, points_px: np.ndarray, colour: str, width_px: int) -> None:
    """Draw a dot at each of the points (n, 2)."""
    draw_paths(picture, np.repeat(points_px[:, None], 2, axis=1), colour, width_px)


def _fixed_point(path: np.ndarray) -> np.ndarray:
    near = np.clip(path, -MAX_COORDINATE_PX, MAX_COORDINATE_PX)
    return np.round(near * (1 << FRACTION_BITS)).astype(np.int32)


def text_size(text: str, text_height: float) -> tuple[int, int]:
    """Return the width and the line height of a text in pixels."""
    (width, _), _ = cv2.getTextSize(in_ascii(text), FONT, text_height / FONT_HEIGHT_PX, stroke_px(text_height))
    return width, round(text_height)


def stroke_px(text_height: float) -> int:
    """Return the stroke width of letters in pixels."""
    return max(1, round(STROKE_FRACTION * text_height))


def draw_text(picture: np.ndarray, text: str, left: float, top: float, text_height: float, colour: str) -> None:
    """Draw one line of text with its upper left corner at (left, top); the OpenCV font has ASCII only."""
    cv2.putText(
        picture,
        in_ascii(text),
        (round(left), round(top + 0.75 * text_height)),
        FONT,
        text_height / FONT_HEIGHT_PX,
        bgr(colour),
        stroke_px(text_height),
        cv2.LINE_AA,
    )


def wrap_text(text: str, text_height: float, width_px: float, most: int) -> list[str]:
    """Wrap a text into at most `most` lines of a width; the rest is replaced by '...'."""
    lines: list[str] = []
    line = ''
    for word in text.split():
        longer = f'{line} {word}'.strip()
        if line and text_size(longer, text_height)[0] > width_px:
            lines.append(line)
            longer = word
        line = longer
    lines.append(line)
    if len(lines) > most:
        lines = [*lines[: most - 1], f'{lines[most - 1]} ...']
    return [truncate_text(line, text_height, width_px) for line in lines]


def truncate_text(line: str, text_height: float, width_px: float) -> str:
    """Return a line truncated to a width, with '...'."""
    if text_size(line, text_height)[0] <= width_px:
        return line
    while line and text_size(f'{line} ...', text_height)[0] > width_px:
        line = line[:-1]
    return f'{line} ...'


class Overlay:
    """Semi-transparent drawing for images of one size: drawn once, composited with each image."""

    def __init__(self, height: int, width: int) -> None:
        self._ink = np.zeros((height, width, 3), np.uint8)
        self._clear = np.full((height, width, 3), 255, np.uint8)
        """Transparency, 0 to 255 in each channel."""

    def add_paths(self, paths: Sequence[np.ndarray], colour: str, width_px: int, opacity: float = 1.0) -> None:
        """Add polylines, each (n, 2)."""
        mask = np.zeros(self._ink.shape[:2], np.uint8)
        draw_paths(mask, paths, 255, width_px)
        self._cover(mask, np.array(bgr(colour), np.uint8), opacity)

    def add_box(self, left: int, top: int, right: int, bottom: int, colour: str, opacity: float) -> None:
        """Add a filled rectangle; right and bottom are exclusive."""
        mask = np.zeros(self._ink.shape[:2], np.uint8)
        mask[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = 255
        self._cover(mask, np.array(bgr(colour), np.uint8), opacity)

    def add_text(self, text: str, left: float, top: float, text_height: float, colour: str) -> None:
        """Add one line of text."""
        written = np.zeros_like(self._ink)
        draw_text(written, text, left, top, text_height, PAPER)
        self._cover(written[..., 0], np.array(bgr(colour), np.uint8), 1.0)

    def _cover(self, mask: np.ndarray, colour: np.ndarray, opacity: float) -> None:
        rows, columns = np.nonzero(mask)
        share = (opacity / 255) * mask[rows, columns, None]
        self._ink[rows, columns] = np.round(self._ink[rows, columns] * (1 - share) + colour * share)
        self._clear[rows, columns] = np.round(self._clear[rows, columns] * (1 - share))

    def composite(self, image: np.ndarray) -> np.ndarray:
        """Return a grey or BGR image of this size with the overlay composited."""
        colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
        picture = cv2.multiply(colour, self._clear, scale=1 / 255)
        return cv2.add(picture, self._ink, picture)


@dataclass(frozen=True)
class Caption:
    """Caption of a picture."""

    title: str
    text: str = ''
    colour: str = PAPER
    """Of the title."""


def caption_panel(caption: Caption, height: int, width: int) -> np.ndarray:
    """Return the caption as a BGR panel for the upper left corner of a picture of this size, as small as possible."""
    text_height = text_height_px(height)
    margin, leading = round(0.5 * text_height), round(1.15 * text_height)
    room = width - 2 * margin
    most = max(1, int((CAPTION_FRACTION * height - 2 * margin) / leading) - 1)
    text = wrap_text(caption.text, text_height, room, most) if caption.text else []
    lines = [truncate_text(caption.title, text_height, room), *text]
    widest = max(text_size(line, text_height)[0] for line in lines)
    panel = np.empty((2 * margin + leading * len(lines), min(widest + 2 * margin, width), 3), np.uint8)
    panel[:] = bgr(INK)
    for number, line in enumerate(lines):
        draw_text(panel, line, margin, margin + number * leading, text_height, PAPER if number else caption.colour)
    return panel[:height]


def draw_panel(picture: np.ndarray, panel: np.ndarray) -> None:
    """Blend a panel over the upper left corner of a picture, in place."""
    rows, columns = panel.shape[:2]
    corner = picture[:rows, :columns]
    cv2.addWeighted(panel, PANEL_OPACITY, corner, 1 - PANEL_OPACITY, 0, corner)


class RemapTable:
    """Remapping of the images of one camera, in the fixed-point format that OpenCV processes fastest."""

    def __init__(self, sources: np.ndarray, empty_grey: int) -> None:
        """Take the source pixel in the image of each pixel of the view, float32 (rows, columns, 2)."""
        self._maps = cv2.convertMaps(sources, None, cv2.CV_16SC2)  # type: ignore[call-overload]  # the stub lacks None
        self._empty = (empty_grey,) * 3
        self._view: np.ndarray | None = None

    def of(self, image: np.ndarray) -> np.ndarray:
        """Return the view of an image, grey or BGR like the image; the next call overwrites it.

        Allocating a new view would add a third to the cost.
        """
        shape = (*self._maps[0].shape[:2], *image.shape[2:])
        if self._view is None or self._view.shape != shape:
            self._view = np.empty(shape, np.uint8)
        return cv2.remap(image, self._maps[0], self._maps[1], cv2.INTER_LINEAR, dst=self._view, borderValue=self._empty)

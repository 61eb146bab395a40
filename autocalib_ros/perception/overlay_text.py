"""Text burnt into the images: names of cameras, dates, running clocks, captions of logos.

A line of text is told from the scene by its geometry. Its strokes begin and end at the same two pixel rows over the
whole line, above and below them are none; it has several strokes over the height of a letter, and about as many strokes
across as upright ones. Windows and fences have few strokes or upright ones alone, crosswalks and trees begin at other
rows in other columns. Sensor noise tells nothing behind a codec: compressed letters scatter as the scene does.
Digits that change are strokes in every image, so that a running clock is found with the text before it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

STROKE_LEVELS = 40
"""Least step between two pixels at the edge of a stroke, levels of any colour: a letter that can be read on any
background has 100 or more, which a codec or a reduction to half the size spreads over two pixels."""
HEIGHTS_PX = (6, 7, 8, 9, 10, 12, 14, 16, 18, 21, 24)
"""Heights of capital letters sought, pixels: 6 is the least that can be read; a factor of 1.17 between them moves the
upper row by less than a quarter of the height."""
WINDOW_HEIGHTS = 3
"""Width of the window that is judged, letter heights: four or five letters."""
MIN_HEIGHTS_FOUND, MIN_WINDOWS = 2, 3
"""Least number of letter heights, and of windows, that find a line: free rows above and below letters let them fit
several; what fits one height at one place is chance."""
OUTSIDE_WEIGHT = 2.0
"""Weight of the strokes just above and below the line against those inside."""
MIN_STROKES = 1.9
"""Least edges of strokes over one letter height along a row, less `OUTSIDE_WEIGHT` times those outside: letters are 0.6
heights wide and have two to four upright edges, spaces have none."""
MIN_CONTRAST_SUM = 150.0
"""Least sum of the steps over one letter height along a row, levels, less `OUTSIDE_WEIGHT` times those outside: two
strokes with both edges of 40 levels."""
MIN_BAND_SHARE = 0.6
"""Least share of upright strokes in each third of the height, relative to the whole: letters have them in all three."""
ACROSS_RATIO = (0.45, 1.2)
"""Range of the ratio of strokes across in the inner half of the height to upright ones: bars and windows have fewer,
foliage and level edges more."""
GROWN_STROKES, GROWN_OUTSIDE = 0.9, 0.5
"""Least edges of strokes, and largest share of those outside, of half a letter height that continues a line."""
WORD_STROKES, WORD_OUTSIDE = 0.7, 0.4
"""The same, for a word of `WORD_HEIGHTS` beyond a gap; the strokes relative to those of the line, as one font has them:
a clock behind a date, whose digits change, or a word before a restless background."""
WORD_HEIGHTS = 2
"""Width of such a word, letter heights: three letters."""
JOINED_GAP_HEIGHTS = 6
"""Largest gap between words of one line, letter heights: white letters over a white sky are not seen."""
FRAME_LEVELS, FRAME_SHARE = 15, 0.8
"""Least step at a side of a box behind text, levels of any colour, and share of the side that has it: a box that makes
letters legible stands out by more, except where the scene behind has its colour."""
FRAME_HEIGHTS_BESIDE, FRAME_HEIGHTS_ABOVE = 6, 2
"""Where the sides of such a box are sought, letter heights beside, and above and below the text."""
MARGIN_HEIGHTS = 0.5
"""Margin of the boxes, letter heights: descenders, shadows and the frame of a caption."""


@dataclass(frozen=True)
class TextBox:
    """Box of a line of text, pixels: columns x0 to x1 - 1 and rows y0 to y1 - 1, without margin."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def height(self) -> int:
        """Height of the letters."""
        return self.y1 - self.y0


@dataclass(frozen=True)
class _Strokes:
    """Integral images of edges of strokes, averaged over the samples; `PADDING` rows without strokes on each side."""

    upright: np.ndarray
    steps: np.ndarray
    across: np.ndarray


PADDING = 3
"""Rows beyond the image border: text may touch it."""


def find_text(samples: list[np.ndarray]) -> list[TextBox]:
    """Return the lines of text in BGR images (H, W, 3) of one view taken at different times."""
    strokes = _strokes(samples)
    height, width = samples[0].shape[:2]
    windows = [box for found in _windows(strokes, height, width) for box in found]
    lines = _joined([_grown(line, strokes, width) for line in _lines(windows, height, width)])
    if not lines:
        return []
    mean = np.asarray(np.mean(np.stack(samples), axis=0, dtype=np.float32))
    return [_framed(line, mean) for line in lines]


def _strokes(samples: list[np.ndarray]) -> _Strokes:
    """Find the edges of strokes: steps of at least `STROKE_LEVELS` that are the largest of their neighbours."""
    height, width = samples[0].shape[:2]
    upright, steps, across = (np.zeros((height, width), np.float32) for _ in range(3))
    for image in samples:
        step_x, step_y = _steps(image, 1), _steps(image, 0)
        cv2.accumulate(_peaks(step_x, np.ones((1, 3), np.uint8)), upright)
        cv2.accumulate(_peaks(step_y, np.ones((3, 1), np.uint8)), across)
        cv2.accumulate(step_x, steps)
    return _Strokes(*(_integral(part / len(samples)) for part in (upright, steps, across)))


def _steps(image: np.ndarray, axis: int) -> np.ndarray:
    """Return the largest step over the colours to the pixel before along an axis, uint8 (H, W)."""
    later, earlier = (image[:, 1:], image[:, :-1]) if axis == 1 else (image[1:], image[:-1])
    blue, green, red = cv2.split(cv2.absdiff(later, earlier))
    step = cv2.max(cv2.max(blue, green), red)
    return cv2.copyMakeBorder(step, 1 - axis, 0, axis, 0, cv2.BORDER_CONSTANT, value=0)


def _peaks(step: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    return ((step >= STROKE_LEVELS) & (step == cv2.dilate(step, neighbours))).astype(np.uint8)


def _integral(strokes: np.ndarray) -> np.ndarray:
    return cv2.integral(cv2.copyMakeBorder(strokes, PADDING, PADDING, 0, 0, cv2.BORDER_CONSTANT, value=0))


def _windows(strokes: _Strokes, rows: int, columns: int) -> Iterator[list[TextBox]]:
    """Yield the windows of each letter height that hold text."""
    for height in HEIGHTS_PX:
        width = WINDOW_HEIGHTS * height
        if width > columns or height + 2 > rows:
            return
        columns_of = np.arange(0, columns - width + 1, max(2, height // 4))
        rows_of = np.arange(-1, rows - height + 2)
        dense = height * _mean(strokes.upright, columns_of, rows_of[:, None], width, height) >= MIN_STROKES
        y, x = (positions[index] for positions, index in zip((rows_of, columns_of), np.nonzero(dense), strict=True))
        found = _is_text(strokes, x, y, width, height)
        yield [
            TextBox(left, top, left + width, top + height)
            for left, top in zip(x[found].tolist(), y[found].tolist(), strict=True)
        ]


def _is_text(strokes: _Strokes, x: np.ndarray, y: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the mask (n,) of the windows with upper left corners x and y (n,) that hold text."""
    third, quarter = height // 3, height // 4
    inside = _mean(strokes.upright, x, y, width, height)
    outside = _mean_outside(strokes.upright, x, y, width, height)
    bands = (
        _mean(strokes.upright, x, y, width, third),
        _mean(strokes.upright, x, y + third, width, height - 2 * third),
        _mean(strokes.upright, x, y + height - third, width, third),
    )
    across = _mean(strokes.across, x, y + quarter, width, height - 2 * quarter)
    steps, steps_outside = _mean(strokes.steps, x, y, width, height), _mean_outside(strokes.steps, x, y, width, height)
    return np.asarray(
        (height * (inside - OUTSIDE_WEIGHT * outside) >= MIN_STROKES)
        & (height * (steps - OUTSIDE_WEIGHT * steps_outside) >= MIN_CONTRAST_SUM)
        & (np.min(bands, axis=0) >= MIN_BAND_SHARE * inside)
        & (across >= ACROSS_RATIO[0] * inside)
        & (across <= ACROSS_RATIO[1] * inside)
    )


def _mean(table: np.ndarray, x: np.ndarray, y: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the means over windows with their upper left corners at columns x and rows y, of their common shape."""
    top, bottom = y + PADDING, y + height + PADDING
    total = table[bottom, x + width] - table[top, x + width] - table[bottom, x] + table[top, x]
    return np.asarray(total / (height * width))


def _mean_outside(table: np.ndarray, x: np.ndarray, y: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the larger of the means over the rows above and below windows, one row away, which edges are soft over."""
    return np.maximum(_mean(table, x, y - 2, width, 1), _mean(table, x, y + height + 1, width, 1))


def _lines(windows: list[TextBox], rows: int, columns: int) -> list[TextBox]:
    """Return the lines that overlapping windows make; a single chance window makes none."""
    covered = np.zeros((rows, columns), np.uint8)
    for box in windows:
        covered[max(box.y0, 0) : box.y1, box.x0 : box.x1] = 1
    count, labels, stats, _ = cv2.connectedComponentsWithStats(covered)
    members: list[list[TextBox]] = [[] for _ in range(count)]
    for box in windows:
        members[labels[(max(box.y0, 0) + min(box.y1, rows)) // 2, (box.x0 + box.x1) // 2]].append(box)
    lines = []
    for (x0, _, width, _, _), inside in zip(stats, members, strict=True):
        if len({box.height for box in inside}) < MIN_HEIGHTS_FOUND or len(inside) < MIN_WINDOWS:
            continue
        y0, y1 = min(box.y0 for box in inside), max(box.y1 for box in inside)
        lines.append(TextBox(int(x0), max(y0, 0), int(x0 + width), min(y1, rows)))
    return lines


def _grown(line: TextBox, strokes: _Strokes, columns: int) -> TextBox:
    """Return the line, continued to both sides by strokes of its rows that follow at once or by words beyond a gap."""
    height, x0, x1 = line.height, line.x0, line.x1
    density, _ = _inside_and_outside(strokes, x0, line.y0, x1 - x0, height)
    step, word = max(2, height // 2), WORD_HEIGHTS * height

    def follows(start: int) -> bool:
        inside, outside = _inside_and_outside(strokes, start, line.y0, step, height)
        return height * inside >= GROWN_STROKES and outside <= GROWN_OUTSIDE * inside

    def is_word(start: int) -> bool:
        if not 0 <= start <= columns - word:
            return False
        inside, outside = _inside_and_outside(strokes, start, line.y0, word, height)
        return inside >= WORD_STROKES * density and outside <= WORD_OUTSIDE * inside

    gaps = range(0, JOINED_GAP_HEIGHTS * height, step)
    grows = True
    while grows:
        before = x0, x1
        while x0 >= step and follows(x0 - step):
            x0 -= step
        while x1 <= columns - step and follows(x1):
            x1 += step
        x0 = next((x0 - gap - word for gap in gaps if is_word(x0 - gap - word)), x0)
        x1 = next((x1 + gap + word for gap in gaps if is_word(x1 + gap)), x1)
        grows = (x0, x1) != before
    return TextBox(x0, line.y0, x1, line.y1)


def _inside_and_outside(strokes: _Strokes, x: int, y: int, width: int, height: int) -> tuple[float, float]:
    """Return the upright strokes in one window, and the more of those above and below it."""
    at = np.array([x]), np.array([y])
    return float(_mean(strokes.upright, *at, width, height)[0]), float(
        _mean_outside(strokes.upright, *at, width, height)[0]
    )


def _joined(lines: list[TextBox]) -> list[TextBox]:
    """Join boxes of the same rows with less than `JOINED_GAP_HEIGHTS` between them: words of one line."""
    joined: list[TextBox] = []
    for line in sorted(lines, key=lambda box: box.x0):
        for index, other in enumerate(joined):
            height = max(line.height, other.height)
            if (
                abs(line.y0 + line.y1 - other.y0 - other.y1) < height
                and height < 2 * min(line.height, other.height)
                and line.x0 - other.x1 < JOINED_GAP_HEIGHTS * height
            ):
                joined[index] = TextBox(
                    other.x0, min(line.y0, other.y0), max(line.x1, other.x1), max(line.y1, other.y1)
                )
                break
        else:
            joined.append(line)
    return joined


def _framed(line: TextBox, mean: np.ndarray) -> TextBox:
    """Return the line with the box that it stands in, if that has four straight sides in the mean image (H, W, 3)."""
    height = line.height
    beside, above = FRAME_HEIGHTS_BESIDE * height, FRAME_HEIGHTS_ABOVE * height
    inside = height  # windows reach beyond the text by less than this
    x0 = _outermost(mean[line.y0 : line.y1], line.x0 - beside, line.x0 + inside, first=True)
    x1 = _outermost(mean[line.y0 : line.y1], line.x1 - inside, line.x1 + beside, first=False)
    columns = mean[:, line.x0 + inside : line.x1 - inside].swapaxes(0, 1)
    y0 = _outermost(columns, line.y0 - above, line.y0 + height // 2, first=True)
    y1 = _outermost(columns, line.y1 - height // 2, line.y1 + above, first=False)
    if x0 is None or x1 is None or y0 is None or y1 is None:
        return line
    return TextBox(min(x0, line.x0), min(y0, line.y0), max(x1, line.x1), max(y1, line.y1))


def _outermost(part: np.ndarray, low: int, high: int, *, first: bool) -> int | None:
    """Return the first or last step from `low` up to `high` along the second axis of a part (n, m, 3) of an image.

    All but a few of its rows have the step; the border of the image is one. None if there is no step.
    """
    length = part.shape[1]
    if first and low <= 0:
        return 0
    if not first and high >= length:
        return length
    steps = np.abs(np.diff(part[:, max(low, 1) - 1 : high + 1], axis=1)).max(axis=2) >= FRAME_LEVELS
    found = np.flatnonzero(steps.mean(axis=0) >= FRAME_SHARE) if steps.size else np.zeros(0, int)
    return None if not len(found) else int(max(low, 1) + found[0 if first else -1])

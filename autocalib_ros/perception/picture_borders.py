"""Bars around the picture and the image circle of a fisheye, found in images of one view at different times.

A border is constant in time and along the side of the image, and ends in one sharp step along a line parallel to that
side or along a circle. Night sky, a dark road and overexposed clouds are constant too, but no such line ends them: they
end at roofs, trees and lamps, at other rows in other columns, or without a step.
"""

from __future__ import annotations

import cv2
import numpy as np

STEP_LEVELS = 6.0
"""Deviation from the colour of a border, grey levels, that is picture: compression leaves the constant colour within 2
to 3 levels, the JPEG of the background samples within 2 more."""
SIDE_BINS = 32
"""Parts along a side of the image, in each of which the step is sought: 20 columns of 640 average noise and ringing."""
BIN_QUANTILE = 1 / 3
"""Quantile of the deviations in a bin: letters on a data strip cover less than the other two thirds of it."""
MIN_STEP_BINS = 8
"""Bins in which the picture must begin at the same row; the others may show a dark scene, whose step is too small."""
TEXT_BINS = 10
"""Most bins of a dark strip in which text stands close to the picture; all others must then show the step, because
lamps in a night sky stand above roofs as well."""
MIN_QUARTERS = 3
"""Quarters of the side that must hold such bins: a border runs along the full side, a single roof does not."""
MAX_BLACK_LEVEL = 40.0
"""Grey level of the brightest dark border: bars, unlit pixels and video black (16). A brighter strip could be sky above
a level horizon and must end in all bins at the same row."""
MIN_STRIP_SHARE = 2 / 3
"""Share of the pixels of a strip that have its colour; the others are text on it."""
MIN_SHARPNESS = 0.6
"""Share of the step, over the two rows about it, in the contrast to three rows further in: a step that the codec
blurred keeps it; an unsharp hood before the lens, or light that fades, does not."""
MIN_STRIP_PX = 2
"""Shallowest strip, pixels: resized images have one dim row or column at a side, which moves no centre."""
MAX_STRIP = 0.45
"""Deepest strip, fraction of the image: the picture keeps at least a tenth between two of them."""
MAX_STRIPS = 3
"""Strips of different colours one beside the other on one side: a frame around a data strip around a bar."""

MAX_RIM_POINTS = 240
"""Rows and columns that are searched for the rim of the circle: a point each 3 px of a rim in 640 columns."""
RIM_TOLERANCE = 0.006
"""Largest deviation of a rim point from the circle, fraction of the radius: lens barrels are round to a part in
thousands; pixels and compression add `MIN_RIM_TOLERANCE_PX`."""
MIN_RIM_TOLERANCE_PX = 1.5
MIN_RIM_SHARE = 0.5
"""Share of the rim points on the circle; dark scene inside and text outside hide the others."""
MIN_RIM_ARCS = 9
"""Of 36 arcs of 10 degrees, those that must hold points on the circle: a quarter of it fixes the centre to 0.1 r."""
MIN_CUT_CORNERS = 3
"""Corners of the image that lie outside of the circle: light pools at night and hoods leave other shapes."""
MAX_LIT_OUTSIDE = 0.05
"""Share of the pixels outside of the circle that may be lit: a line of text in the corners."""
CIRCLE_TRIALS = 400
"""Random triples of rim points: with half of them right, 1 in 8 triples is."""


def darkest_and_deviation(samples: np.ndarray, colour: float) -> np.ndarray:
    """Return the second largest deviation of grey samples (n, H, W) from a colour, float32 (H, W).

    A border stays constant when lamps pass; the largest is left out where there are three samples or more, because one
    image in a few is torn.
    """
    first = second = np.zeros(samples.shape[1:], np.float32)
    for sample in samples:
        deviation = np.abs(sample.astype(np.float32) - np.float32(colour))
        second, first = np.maximum(second, np.minimum(first, deviation)), np.maximum(first, deviation)
    return np.asarray(first if len(samples) < 3 else second)


def find_rectangle(samples: np.ndarray) -> tuple[int, int, int, int]:
    """Return the rectangle x0, y0, x1, y1 of the picture in grey samples (n, H, W), uint8; x1 and y1 are exclusive."""
    height, width = samples.shape[1:]
    x0, y0, x1, y1 = 0, 0, width, height
    y0 += _strips(samples)
    y1 -= _strips(samples[:, ::-1])
    rows = samples[:, y0:y1].swapaxes(1, 2)
    x0 += _strips(rows)
    x1 -= _strips(rows[:, ::-1])
    if (x0, x1) != (0, width) and (y0, y1) == (0, height):  # data strips that end at the bars left and right
        columns = samples[:, :, x0:x1]
        y0 += _strips(columns)
        y1 -= _strips(columns[:, ::-1])
    return x0, y0, x1, y1


def _strips(samples: np.ndarray) -> int:
    """Return the depth of the strips at the top of samples (n, depth, along)."""
    depth = 0
    for _ in range(MAX_STRIPS):
        found = _strip(samples[:, depth:])
        if not found or depth + found > MAX_STRIP * samples.shape[1]:
            break
        depth += found
    return depth


def _strip(samples: np.ndarray) -> int:
    """Return the depth of one strip of constant colour at the top of samples (n, depth, along); 0 if there is none."""
    limit = min(int(MAX_STRIP * samples.shape[1]) + 6, samples.shape[1])
    along = samples.shape[2]
    if limit < 10 or along < 2 * SIDE_BINS:
        return 0
    samples = samples[:, :limit]
    colour = float(np.median(samples[:, 0]))
    if np.mean(darkest_and_deviation(samples[:, :1], colour) <= STEP_LEVELS) < MIN_STRIP_SHARE:
        return 0
    deviation = darkest_and_deviation(samples, colour)
    columns = along // SIDE_BINS
    bins = deviation[:, : columns * SIDE_BINS].reshape(limit, SIDE_BINS, columns)
    profile = np.quantile(bins, BIN_QUANTILE, axis=2)
    constant = np.cumsum((deviation <= STEP_LEVELS).mean(axis=1)) / np.arange(1, limit + 1)
    for depth in range(limit - 5, MIN_STRIP_PX - 1, -1):
        if constant[depth - 1] >= MIN_STRIP_SHARE:
            steps = _steps_at(profile, depth, colour)
            if steps is not None:
                return _refined(profile[:, steps], depth)
    return 0


def _steps_at(profile: np.ndarray, depth: int, colour: float) -> np.ndarray | None:
    """Return the bins (SIDE_BINS,) in which a strip ends near row `depth` of the deviations (rows, SIDE_BINS).

    None if it does not. A strip ends nowhere before: there all bins are constant, but for those with text.
    """
    before, after, inside = profile[max(depth - 2, 0)], profile[depth + 1], profile[depth + 4]
    outside = (profile[max(depth - 2, 0) : max(depth - 1, 1)] <= STEP_LEVELS).all(axis=0)
    steps = outside & (after - before > STEP_LEVELS) & (profile[depth] - before > 0.5 * (after - before))
    text = SIDE_BINS - np.count_nonzero(outside)
    needed = SIDE_BINS - text if text or colour > MAX_BLACK_LEVEL else MIN_STEP_BINS
    quarters = len(np.unique(np.flatnonzero(steps) * 4 // SIDE_BINS))
    if text > TEXT_BINS or steps.sum() < needed or quarters < MIN_QUARTERS:
        return None
    contrast = np.maximum(inside, after)[steps] - before[steps]
    return steps if np.median((after - before)[steps] / contrast) >= MIN_SHARPNESS else None


def _refined(profile: np.ndarray, depth: int) -> int:
    """Return the depth at which the deviations (rows, bins) of the bins with a step pass half of it, in the median."""
    near = profile[max(depth - 3, 0) : depth + 2]
    half = 0.5 * (near[0] + near[-1])
    return max(depth - 3, 0) + int(np.median((near > half).argmax(axis=0)))


def find_circle(samples: np.ndarray) -> tuple[float, float, float] | None:
    """Return the image circle of a fisheye in grey samples (n, H, W): x and y of the centre, and the radius, pixels.

    (0, 0) is the centre of the top-left pixel. None if the corners are not dark or no circle bounds them.
    """
    height, width = samples.shape[1:]
    side = max(3, min(width, height) // 60)
    corners = [samples[:, rows, columns] for rows in _ends(side) for columns in _ends(side)]
    levels = np.array([np.median(corner) for corner in corners])
    colour = float(np.sort(levels)[1])
    if colour > MAX_BLACK_LEVEL or (np.abs(levels - colour) <= STEP_LEVELS).sum() < MIN_CUT_CORNERS:
        return None
    deviation = cv2.medianBlur(darkest_and_deviation(samples, colour), 3)
    lit = deviation > STEP_LEVELS
    points = _rim_points(lit)
    found = None if len(points) < MIN_RIM_ARCS else _fitted_circle(points)
    if found is None:
        return None
    return found if _bounds_picture(found, points, lit) else None


def _ends(side: int) -> tuple[slice, slice]:
    return slice(0, side), slice(-side, None)


def _rim_points(lit: np.ndarray) -> np.ndarray:
    """Return the first lit pixels (n, 2) of rows and columns from each side; those at the image border are left out."""
    points = []
    for mask, flip in ((lit, False), (lit.T, True)):
        lines = np.unique(np.linspace(0, len(mask) - 1, min(MAX_RIM_POINTS, len(mask))).astype(int))
        for reverse in (False, True):
            part = mask[lines, ::-1] if reverse else mask[lines]
            run = part[:, :-2] & part[:, 1:-1] & part[:, 2:]
            first = run.argmax(axis=1)
            good = run.any(axis=1) & (first > 1)
            along = (mask.shape[1] - 1 - first if reverse else first)[good]
            pair = np.column_stack([along, lines[good]]).astype(float)
            points.append(pair[:, ::-1] if flip else pair)
    return np.concatenate(points)


def _fitted_circle(points: np.ndarray) -> tuple[float, float, float] | None:
    """Return the circle through most of the points (n, 2), refined by least squares on those."""
    generator = np.random.default_rng(0)
    best, most = None, 0
    for triple in generator.integers(0, len(points), (CIRCLE_TRIALS, 3)):
        circle = _least_squares_circle(points[triple])
        if circle is None:
            continue
        count = int(_on_circle(points, circle).sum())
        if count > most:
            best, most = circle, count
    for _ in range(3):
        refined = None if best is None else _least_squares_circle(points[_on_circle(points, best)])
        best = best if refined is None else refined
    return best


def _least_squares_circle(points: np.ndarray) -> tuple[float, float, float] | None:
    """Return the algebraic least squares circle of points (n, 2); None if they are too few or lie on a line."""
    if len(points) < 3:
        return None
    shift = points.mean(axis=0)
    x, y = (points - shift).T
    solution, _, rank, _ = np.linalg.lstsq(np.column_stack([x, y, np.ones(len(x))]), x * x + y * y, rcond=None)
    if rank < 3:
        return None
    cx, cy = solution[:2] / 2
    return float(cx + shift[0]), float(cy + shift[1]), float(np.sqrt(max(solution[2] + cx * cx + cy * cy, 1e-9)))


def _on_circle(points: np.ndarray, circle: tuple[float, float, float]) -> np.ndarray:
    """Return the mask (n,) of points (n, 2) within the tolerance of a circle."""
    x, y, radius = circle
    tolerance = max(MIN_RIM_TOLERANCE_PX, RIM_TOLERANCE * radius)
    return np.abs(np.hypot(points[:, 0] - x, points[:, 1] - y) - radius) <= tolerance


def _bounds_picture(circle: tuple[float, float, float], points: np.ndarray, lit: np.ndarray) -> bool:
    """Whether a circle leaves the corners out, has enough of the rim on it, and darkness outside."""
    (x, y, radius), (height, width) = circle, lit.shape
    corners = np.array([(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)], float)
    away = np.hypot(corners[:, 0] - x, corners[:, 1] - y)
    if (away > 1.02 * radius).sum() < MIN_CUT_CORNERS or not (0 < x < width and 0 < y < height):
        return False
    near = _on_circle(points, circle)
    angles = np.degrees(np.arctan2(points[near, 1] - y, points[near, 0] - x))
    arcs = np.unique((angles // 10).astype(int))
    if near.mean() < MIN_RIM_SHARE or len(arcs) < MIN_RIM_ARCS or len(np.unique(angles // 90)) < MIN_CUT_CORNERS:
        return False
    rows, columns = np.mgrid[:height, :width]
    outside = np.hypot(columns - x, rows - y) > radius + 2 * max(MIN_RIM_TOLERANCE_PX, RIM_TOLERANCE * radius)
    return bool(lit[outside].mean() <= MAX_LIT_OUTSIDE)

"""What is painted on a made-up junction, and what stands beside it, as straight lines in the image of its camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.offline.synthetic.drives import LANE_M
from autocalib_ros.offline.synthetic.junction import Junction

ROAD_M = 2 * LANE_M
"""Half of a road is two lanes wide."""
REACH_M = 27.0
"""Lines end so far from the middle of the junction."""
DASH_M, GAP_M, WIDTH_M = 3.0, 3.0, 0.15
STRIPES_M, STOP_M = (8.5, 11.5), 13.0
"""The stripes of a crosswalk, and the stop line before it, are so far from the middle."""
STRIPE_M = 0.5
LEAST_PX = 25.6
"""Shorter lines are not looked for."""


@dataclass(frozen=True)
class Paint:
    """What there is of lines, and how badly they are painted and seen."""

    angles_deg: tuple[float, ...] = (0.0, 90.0)
    """Directions of the roads."""
    across: bool = True
    """Whether there are stop lines."""
    askew_deg: float = 0.2
    """Standard deviation of painted lines about their direction, those of one crosswalk alike."""
    lean_deg: float = 0.5
    """Standard deviation of posts from the upright."""
    noise_px: float = 0.3
    """Standard deviation of the ends' coordinates."""


def painted_lines(junction: Junction, generator: np.random.Generator, paint: Paint = Paint()) -> np.ndarray:
    """Return lines on the road, x0, y0, x1, y1 in pixels (n, 4): chords of what the lens bends."""
    pieces = [piece for angle in paint.angles_deg for piece in _road(junction, np.radians(angle), generator, paint)]
    return _seen(junction, np.array(pieces), generator, paint)


def post_lines(junction: Junction, generator: np.random.Generator, count: int, paint: Paint = Paint()) -> np.ndarray:
    """Return so many posts beside the road, or as many of them as are seen, shape (n, 4)."""
    return _seen(junction, np.array([_post(junction, generator, paint) for _ in range(count)]), generator, paint)


def random_lines(junction: Junction, generator: np.random.Generator, count: int) -> np.ndarray:
    """Return lines (count, 4) of any place and direction."""
    middle, length = generator.uniform(0, junction.image_size, (count, 2)), generator.uniform(LEAST_PX, 120, count)
    heading = generator.uniform(0, np.pi, count)
    half = 0.5 * length[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    return np.concatenate([middle - half, middle + half], axis=1)


def _seen(junction: Junction, ends_m: np.ndarray, generator: np.random.Generator, paint: Paint) -> np.ndarray:
    """Project ends (n, 2, 3); keep the lines whose ends both are in the image, and that are long enough there."""
    pixels, valid = junction.camera.project((ends_m - [0.0, 0.0, junction.height_m]) @ junction.camera_from_ground.T)
    seen = (valid & (pixels >= 0).all(axis=2) & (pixels < junction.image_size).all(axis=2)).all(axis=1)
    lines = pixels[seen] + generator.normal(0.0, paint.noise_px, (seen.sum(), 2, 2))
    return lines[np.hypot(*(lines[:, 1] - lines[:, 0]).T) > LEAST_PX].reshape(-1, 4)


def _road(junction: Junction, angle: float, generator: np.random.Generator, paint: Paint) -> list[np.ndarray]:
    """Ends (2, 3) of what is painted on one road."""
    pieces = []
    for side in (-1.0, 1.0):
        for lane in (-ROAD_M, -LANE_M, 0.0, LANE_M, ROAD_M):
            for begin in np.arange(STOP_M + 0.5, REACH_M, DASH_M + GAP_M):
                pieces += _edges([side * begin, lane], [side * (begin + DASH_M), lane], 0.0, generator, paint)
        askew = generator.normal(0.0, np.radians(paint.askew_deg))
        for place in np.arange(-ROAD_M + STRIPE_M, ROAD_M, 2 * STRIPE_M):
            pieces += _edges(
                [side * STRIPES_M[0], place], [side * STRIPES_M[1], place], askew, generator, paint, STRIPE_M
            )
        if paint.across:
            for lane in (0.0, LANE_M):
                pieces += _edges(
                    [side * STOP_M, side * lane], [side * STOP_M, side * (lane + LANE_M)], 0.0, generator, paint, 0.4
                )
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return [np.column_stack([piece @ turn + junction.centre_m, np.zeros(2)]) for piece in pieces]


def _edges(
    begin: list[float],
    end: list[float],
    askew: float,
    generator: np.random.Generator,
    paint: Paint,
    width_m: float = WIDTH_M,
) -> list[np.ndarray]:
    """Both edges (2, 2) of a painted line."""
    begin, end = np.array(begin), np.array(end)
    along = end - begin
    askew = askew + generator.normal(0.0, np.radians(paint.askew_deg)) * (askew == 0)
    along = along + askew * np.array([-along[1], along[0]])
    aside = 0.5 * width_m * np.array([-along[1], along[0]]) / np.hypot(*along)
    return [np.stack([begin + way * aside, begin + along + way * aside]) for way in (-1.0, 1.0)]


def _post(junction: Junction, generator: np.random.Generator, paint: Paint) -> np.ndarray:
    """Ends (2, 3) of a post beside the road."""
    angle = np.radians(generator.choice(paint.angles_deg))
    along, aside = generator.uniform(-20, 20), generator.choice([-1.0, 1.0]) * (ROAD_M + 0.5)
    x = np.cos(angle) * along - np.sin(angle) * aside + junction.centre_m[0]
    y = np.sin(angle) * along + np.cos(angle) * aside + junction.centre_m[1]
    lean = 3.0 * np.tan(np.radians(generator.normal(0.0, paint.lean_deg, 2)))
    return np.array([[x, y, 0.2], [x + lean[0], y + lean[1], 3.0]])

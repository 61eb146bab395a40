"""The ground as a picture from above: asphalt, markings, kerbs, pavements, grass."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from . import paint
from .network import CROSSING_WIDTH_M, Network, Road
from .palette import Palette

PAVEMENT_M = 3.2
KERB_M = 0.25
CORNER_RADIUS_M = 6.5
_COARSE_M = 0.25


@dataclass(frozen=True)
class GroundMap:
    """A picture of the square |x|, |y| <= half_m from above; row 0 is at y = +half_m.

    levels: BGR pictures, each half as fine as the one before; texel_m: texel of the first.
    """

    levels: tuple[np.ndarray, ...]
    half_m: float
    texel_m: float


def paint_ground(
    network: Network, palette: Palette, half_m: float, texel_m: float, seed: int
) -> GroundMap:
    """Paint the ground around the origin."""
    size = round(2 * half_m / texel_m)
    texel_m = 2 * half_m / size
    rng = np.random.default_rng([seed, 3])
    edge = cv2.resize(_edge_distance(network, half_m), (size, size))
    picture = _surfaces(edge, palette, texel_m, rng)
    view = _View(picture, half_m, texel_m)
    _paint_wear(view, network, palette, edge, rng)
    marks = np.zeros((size, size), np.uint8)
    _paint_markings(_View(marks, half_m, texel_m), network)
    _blend(picture, marks, palette, texel_m, rng)
    levels = [picture]
    while levels[-1].shape[0] > 64:
        half = tuple(n // 2 for n in levels[-1].shape[:2])
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return GroundMap(tuple(levels), half_m, texel_m)


def edge_distance(network: Network, xy: np.ndarray) -> np.ndarray:
    """Return how far points (..., 2) lie outside the asphalt, in metres; negative on it."""
    sides = [
        np.abs(xy[..., 1] * road.axis[0] - xy[..., 0] * road.axis[1]) - road.half_width_m
        for road in network.roads
    ]
    if len(sides) == 1:
        return sides[0]
    # The union of both strips, its corners filled with arcs.
    radius = CORNER_RADIUS_M
    corner = np.hypot(*(np.maximum(radius - side, 0.0) for side in sides))
    return np.maximum(np.minimum(*sides), radius) - corner


def _edge_distance(network: Network, half_m: float) -> np.ndarray:
    """Return the distance field (n, n) of the asphalt on a coarse grid."""
    size = round(2 * half_m / max(_COARSE_M, half_m / 500))
    line = ((np.arange(size) + 0.5) / size * 2 - 1) * half_m
    return edge_distance(network, np.stack(np.meshgrid(line, -line), -1)).astype(np.float32)


def _surfaces(
    edge: np.ndarray, palette: Palette, texel_m: float, rng: np.random.Generator
) -> np.ndarray:
    """Colour grass, pavement, kerb and asphalt by the distance from the kerb, each with grain."""
    size = edge.shape[0]
    picture = np.empty((size, size, 3), np.uint8)
    picture[:] = palette.grass
    picture[edge < PAVEMENT_M] = palette.pavement
    picture[edge < KERB_M] = palette.kerb
    picture[edge < 0] = palette.asphalt
    slabs = ((np.arange(size) * texel_m) % 1.2) < 0.05
    joints = (slabs[:, None] | slabs[None, :]) & (edge > KERB_M) & (edge < PAVEMENT_M)
    picture[joints] = paint.mixed(palette.pavement, palette.asphalt, 0.5)
    cv2.GaussianBlur(picture, (3, 3), 0, dst=picture)  # no steps along slanting edges
    contrast = palette.texture * np.where(edge < 0, 1.0, np.where(edge < PAVEMENT_M, 0.7, 2.0))
    octaves = [(m / texel_m, s) for m, s in ((0.05, 5.0), (0.25, 3.0), (1.0, 3.0), (6.0, 4.0))]
    noise = paint.grain(size, size, [(max(o, 1.0), s) for o, s in octaves], rng)
    paint.roughen(picture, noise * contrast.astype(np.float32))
    return picture


class _View:
    """Draws in metres on a picture of the ground."""

    def __init__(self, picture: np.ndarray, half_m: float, texel_m: float) -> None:
        self.picture, self.half_m, self.texel_m = picture, half_m, texel_m

    def texels(self, xy: np.ndarray) -> np.ndarray:
        """Return texel coordinates (n, 2) of ground points (n, 2)."""
        return np.stack([xy[:, 0] + self.half_m, self.half_m - xy[:, 1]], 1) / self.texel_m

    def polygon(self, xy: np.ndarray, colour: tuple[int, ...]) -> None:
        """Fill a polygon of ground points (n, 2)."""
        paint.polygon(self.picture, self.texels(np.asarray(xy, float)), colour)

    def strip(self, road: Road, along: tuple[float, float], aside: tuple[float, float],
              colour: tuple[int, ...]) -> None:
        """Fill a rectangle given along a road and to the left of its axis."""
        corners = [(along[0], aside[0]), (along[1], aside[0]), (along[1], aside[1]),
                   (along[0], aside[1])]
        self.polygon(np.array([on_road(road, *c) for c in corners]), colour)


def on_road(road: Road, along: float, aside: float) -> np.ndarray:
    """Return the ground point (2,) at a distance along a road and to the left of its axis."""
    axis = road.axis
    return along * axis + aside * np.array([-axis[1], axis[0]])


def _paint_wear(
    view: _View, network: Network, palette: Palette, edge: np.ndarray, rng: np.random.Generator
) -> None:
    """Add patches, cracks and manhole covers to the asphalt."""
    dark = paint.mixed(palette.asphalt, palette.trim, 0.3)
    reach = min(view.half_m, 60.0)
    for road in network.roads:
        for _ in range(10):
            along = rng.uniform(-reach, reach)
            aside = rng.uniform(-1, 0.7) * road.half_width_m
            length, width = rng.uniform(1.5, 6.0), rng.uniform(0.5, 1.6)
            colour = paint.mixed(palette.asphalt, dark, rng.uniform(-0.4, 0.7))
            view.strip(road, (along, along + length), (aside, aside + width), colour)
        for _ in range(8):
            centre = on_road(road, rng.uniform(-reach, reach), rng.uniform(-1, 1) * 6.0)
            circle = np.linspace(0, 2 * np.pi, 24)
            view.polygon(centre + 0.32 * np.stack([np.cos(circle), np.sin(circle)], 1), dark)
    for _ in range(14):
        _crack(view, edge, dark, reach, rng)


def _crack(view: _View, edge: np.ndarray, colour: tuple[int, ...], reach: float,
           rng: np.random.Generator) -> None:
    point, heading = rng.uniform(-reach, reach, 2), rng.uniform(0, 2 * np.pi)
    for _ in range(25):
        heading += rng.normal(0, 0.35)
        after = point + 0.4 * np.array([np.cos(heading), np.sin(heading)])
        (x0, y0), (x1, y1) = view.texels(np.stack([point, after]))
        column, row = int(x1), int(y1)
        if not (0 <= row < edge.shape[0] and 0 <= column < edge.shape[1]) or edge[row, column] > 0:
            return
        paint.line(view.picture, (x0, y0), (x1, y1), colour, 1)
        point = after


def _paint_markings(view: _View, network: Network) -> None:
    """Draw lane lines, stop lines and zebra crossings as a mask."""
    white = (255,)
    begin = network.stop_m if network.stop_m is not None else 0.0
    far = min(view.half_m, 300.0)
    for road in network.roads:
        for sign in (1, -1):
            for aside, kind in road.lane_edges_m:
                _paint_line(view, road, sign, (begin, far), aside, kind)
        if network.stop_m is None:
            continue
        near = network.stop_m - 2.0 - CROSSING_WIDTH_M
        half = road.half_width_m
        for sign in (1, -1):
            # Traffic drives on the right: the lanes that arrive on this arm are on its left.
            inner, outer = 0.2 * half, 0.98 * half
            stop = (sign * network.stop_m, sign * (network.stop_m + 0.45))
            view.strip(road, stop, (sign * -inner, sign * outer), white)
            for aside in np.arange(-half + 0.4, half - 0.6, 1.0):
                span = (sign * near, sign * (near + CROSSING_WIDTH_M))
                view.strip(road, span, (aside, aside + 0.5), white)


def _paint_line(view: _View, road: Road, sign: int, span: tuple[float, float], aside: float,
                kind: str) -> None:
    white = (255,)
    if kind == 'dash':
        for along in np.arange(span[0], span[1], 6.0):
            dash = (sign * along, sign * (along + 3.0))
            view.strip(road, dash, (aside - 0.07, aside + 0.07), white)
        return
    inward = 0.3 if kind == 'edge' else 0.0
    aside -= np.sign(aside) * inward
    view.strip(road, (sign * span[0], sign * span[1]), (aside - 0.06, aside + 0.06), white)


def _blend(picture: np.ndarray, marks: np.ndarray, palette: Palette, texel_m: float,
           rng: np.random.Generator) -> None:
    """Lay worn paint over the picture, in place."""
    octaves = ((max(0.06 / texel_m, 1), 0.12), (max(0.4 / texel_m, 1), 0.10))
    wear = np.clip(0.85 + paint.grain(marks.shape[0], marks.shape[1], octaves, rng), 0.3, 1.0)
    rows, columns = np.nonzero(marks)
    part = (marks[rows, columns] / 255.0 * wear[rows, columns])[:, None]
    under = picture[rows, columns].astype(np.float32)
    picture[rows, columns] = (under + part * (np.array(palette.marking) - under)).astype(np.uint8)

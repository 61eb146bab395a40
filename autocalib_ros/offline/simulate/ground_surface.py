"""The ground as a picture from above: asphalt, markings, kerbs, pavements, grass."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial, reduce

import cv2
import numpy as np

from autocalib_ros.offline.simulate import paint
from autocalib_ros.offline.simulate.network import CROSSING_WIDTH_M, Network, Road, Roundabout
from autocalib_ros.offline.simulate.palette import Palette

PAVEMENT_WIDTH_M = 3.2
KERB_WIDTH_M = 0.25
VERGE_WIDTH_M = 0.8
_DISTANCE_GRID_M = 0.25
_CURVE_STEP_M = 0.7  # strips of bends are drawn as polygons with so long sides


@dataclass(frozen=True)
class GroundMap:
    """A picture of the square |x|, |y| <= half_m from above; row 0 is at y = +half_m.

    levels: BGR pictures, each half as fine as the one before; texel_m: texel of the first.
    """

    levels: tuple[np.ndarray, ...]
    half_m: float
    texel_m: float


def paint_ground(network: Network, palette: Palette, half_m: float, texel_m: float, seed: int) -> GroundMap:
    """Paint the ground around the origin."""
    size = round(2 * half_m / texel_m)
    texel_m = 2 * half_m / size
    rng = np.random.default_rng([seed, 3])
    edge = cv2.resize(_edge_distance_grid(network, half_m), (size, size))
    picture = _paint_surfaces(edge, palette, texel_m, network.rural, rng)
    view = _MapPainter(picture, half_m, texel_m)
    _paint_wear(view, network, palette, edge, rng)
    marks = np.zeros((size, size), np.uint8)
    _paint_markings(_MapPainter(marks, half_m, texel_m), network)
    _blend_markings(picture, marks, palette, texel_m, rng)
    levels = [picture]
    while levels[-1].shape[0] > 64:
        half = tuple(n // 2 for n in levels[-1].shape[:2])
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return GroundMap(tuple(levels), half_m, texel_m)


def edge_distance(network: Network, xy: np.ndarray) -> np.ndarray:
    """Return how far points (..., 2) lie outside the asphalt, in metres; negative on it."""
    shapes = [road.edge_distance(xy) for road in network.roads]
    ring = network.roundabout
    if ring is None:
        return reduce(partial(_round_union, radius_m=network.corner_radius_m), shapes)
    reach = np.hypot(xy[..., 0], xy[..., 1])
    shapes.append(reach - ring.outer_m)
    whole = reduce(partial(_round_union, radius_m=network.corner_radius_m), shapes)
    return np.maximum(whole, ring.island_m - reach)


def _round_union(a: np.ndarray, b: np.ndarray, radius_m: float) -> np.ndarray:
    """Return the edge distance of the union of two shapes, its corners filled with arcs."""
    corner = np.hypot(np.maximum(radius_m - a, 0.0), np.maximum(radius_m - b, 0.0))
    return np.maximum(np.minimum(a, b), radius_m) - corner


def _edge_distance_grid(network: Network, half_m: float) -> np.ndarray:
    """Return the distance field (n, n) of the asphalt on a coarse grid."""
    size = round(2 * half_m / max(_DISTANCE_GRID_M, half_m / 500))
    line = ((np.arange(size) + 0.5) / size * 2 - 1) * half_m
    return edge_distance(network, np.stack(np.meshgrid(line, -line), -1)).astype(np.float32)


def _paint_surfaces(
    edge: np.ndarray, palette: Palette, texel_m: float, rural: bool, rng: np.random.Generator
) -> np.ndarray:
    """Colour grass, pavement, kerb and asphalt by the distance from the edge, each with grain."""
    pavement_m, kerb_m = (VERGE_WIDTH_M, 0.0) if rural else (PAVEMENT_WIDTH_M, KERB_WIDTH_M)
    size = edge.shape[0]
    picture = np.empty((size, size, 3), np.uint8)
    picture[:] = palette.grass
    picture[edge < pavement_m] = palette.pavement
    picture[edge < kerb_m] = palette.kerb
    picture[edge < 0] = palette.asphalt
    slabs = ((np.arange(size) * texel_m) % 1.2) < 0.05
    joints = (slabs[:, None] | slabs[None, :]) & (edge > kerb_m) & (edge < pavement_m)
    picture[joints & (not rural)] = paint.mix_colours(palette.pavement, palette.asphalt, 0.5)
    cv2.GaussianBlur(picture, (3, 3), 0, dst=picture)  # no steps along slanting edges
    contrast = palette.texture * np.where(edge < 0, 1.0, np.where(edge < pavement_m, 0.7, 2.0))
    octaves = [(m / texel_m, s) for m, s in ((0.05, 5.0), (0.25, 3.0), (1.0, 3.0), (6.0, 4.0))]
    noise = paint.octave_noise(size, size, [(max(o, 1.0), s) for o, s in octaves], rng)
    paint.add_noise(picture, noise * contrast.astype(np.float32))
    return picture


class _MapPainter:
    """Draws in metres on a picture of the ground."""

    def __init__(self, picture: np.ndarray, half_m: float, texel_m: float) -> None:
        self.picture, self.half_m, self.texel_m = picture, half_m, texel_m

    def texels(self, xy: np.ndarray) -> np.ndarray:
        """Return texel coordinates (n, 2) of ground points (n, 2)."""
        return np.stack([xy[:, 0] + self.half_m, self.half_m - xy[:, 1]], 1) / self.texel_m

    def polygon(self, xy: np.ndarray, colour: tuple[int, ...]) -> None:
        """Fill a polygon of ground points (n, 2)."""
        paint.polygon(self.picture, self.texels(np.asarray(xy, float)), colour)

    def strip(
        self, road: Road, along: tuple[float, float], aside: tuple[float, float], colour: tuple[int, ...]
    ) -> None:
        """Fill a strip given along a road and to the left of its axis."""
        pieces = 1 if road.straight else max(1, round(abs(along[1] - along[0]) / _CURVE_STEP_M))
        way = np.linspace(*along, pieces + 1)
        self.polygon(np.concatenate([road.at(way, aside[0]), road.at(way[::-1], aside[1])]), colour)

    def ring(self, radii: tuple[float, float], colour: tuple[int, ...]) -> None:
        """Fill a ring about the origin."""
        angle = np.linspace(0.0, 2 * np.pi, round(2 * np.pi * radii[1] / _CURVE_STEP_M))
        arc = np.stack([np.cos(angle), np.sin(angle)], 1)
        self.polygon(np.concatenate([radii[0] * arc, radii[1] * arc[::-1]]), colour)


def _paint_wear(
    view: _MapPainter, network: Network, palette: Palette, edge: np.ndarray, rng: np.random.Generator
) -> None:
    """Add patches, cracks and manhole covers to the asphalt."""
    dark = paint.mix_colours(palette.asphalt, palette.trim, 0.3)
    reach = min(view.half_m, 60.0)
    for road in network.roads:
        for _ in range(10):
            along = rng.uniform(-reach, reach)
            aside = rng.uniform(-1, 0.7) * road.half_width_m
            length, width = rng.uniform(1.5, 6.0), rng.uniform(0.5, 1.6)
            colour = paint.mix_colours(palette.asphalt, dark, rng.uniform(-0.4, 0.7))
            if _on_asphalt(network, road.at(np.linspace(along, along + length, 5), aside)):
                view.strip(road, (along, along + length), (aside, aside + width), colour)
        for _ in range(8):
            centre = road.at(rng.uniform(-reach, reach), rng.uniform(-1, 1) * 0.75 * road.half_width_m)
            circle = np.linspace(0, 2 * np.pi, 24)
            rim = centre + 0.32 * np.stack([np.cos(circle), np.sin(circle)], 1)
            if _on_asphalt(network, rim):
                view.polygon(rim, dark)
    for _ in range(14):
        _paint_crack(view, edge, dark, reach, rng)


def _on_asphalt(network: Network, xy: np.ndarray) -> bool:
    return bool((edge_distance(network, xy) <= 0).all())


def _paint_crack(
    view: _MapPainter, edge: np.ndarray, colour: tuple[int, ...], reach: float, rng: np.random.Generator
) -> None:
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


def _paint_markings(view: _MapPainter, network: Network) -> None:
    """Draw lane lines, stop lines and zebra crossings as a mask."""
    begin = network.stop_m if network.stop_m is not None else 0.0
    far = min(view.half_m, 300.0)
    for road in network.roads:
        for sign in (1, -1):
            if not road.reaches(sign * begin):
                continue
            for aside, kind in road.lane_edges_m:
                start = network.clear_m if kind == 'edge' else begin
                _paint_line(view, road, sign, (start, far), aside, kind)
            if network.stop_m is not None:
                _paint_crossing(view, road, sign, network)
    if network.roundabout is not None:
        _paint_island_line(view, network.roundabout)


def _paint_crossing(view: _MapPainter, road: Road, sign: int, network: Network) -> None:
    """Draw a stop line, or a give-way line of short dashes, and a zebra crossing across one arm."""
    white = (255,)
    half, stop_m, near = road.half_width_m, network.stop_m, network.crossing_m
    # Traffic drives on the right: the lanes that arrive on this arm are on its left.
    inner, outer = (0.0 if network.roundabout else -0.2 * half), 0.98 * half
    marks = [(inner, outer)]
    if network.roundabout:
        marks = [(aside, aside + 0.5) for aside in np.arange(inner + 0.3, outer - 0.4, 0.9)]
    for mark in marks:
        view.strip(road, (sign * stop_m, sign * (stop_m + 0.45)), (sign * mark[0], sign * mark[1]), white)
    for aside in np.arange(-half + 0.4, half - 0.6, 1.0):
        span = (sign * near, sign * (near + CROSSING_WIDTH_M))
        view.strip(road, span, (aside, aside + 0.5), white)


def _paint_island_line(view: _MapPainter, ring: Roundabout) -> None:
    """Draw the line round the island."""
    view.ring((ring.island_m + 0.3, ring.island_m + 0.45), (255,))


def _paint_line(view: _MapPainter, road: Road, sign: int, span: tuple[float, float], aside: float, kind: str) -> None:
    white = (255,)
    if kind == 'dash':
        for along in np.arange(span[0], span[1], 6.0):
            dash = (sign * along, sign * (along + 3.0))
            view.strip(road, dash, (aside - 0.07, aside + 0.07), white)
        return
    inward = 0.3 if kind == 'edge' else 0.0
    aside -= np.sign(aside) * inward
    view.strip(road, (sign * span[0], sign * span[1]), (aside - 0.06, aside + 0.06), white)


def _blend_markings(
    picture: np.ndarray, marks: np.ndarray, palette: Palette, texel_m: float, rng: np.random.Generator
) -> None:
    """Lay worn paint over the picture, in place."""
    octaves = ((max(0.06 / texel_m, 1), 0.12), (max(0.4 / texel_m, 1), 0.10))
    wear = np.clip(0.85 + paint.octave_noise(marks.shape[0], marks.shape[1], octaves, rng), 0.3, 1.0)
    rows, columns = np.nonzero(marks)
    part = (marks[rows, columns] / 255.0 * wear[rows, columns])[:, None]
    under = picture[rows, columns].astype(np.float32)
    picture[rows, columns] = (under + part * (np.array(palette.marking) - under)).astype(np.uint8)

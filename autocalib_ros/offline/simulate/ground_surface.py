"""Ground texture from above: asphalt, markings, kerbs, pavements, grass."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial, reduce

import cv2
import numpy as np

from autocalib_ros.offline.simulate import paint
from autocalib_ros.offline.simulate.network import CROSSING_WIDTH_M, Network, Road, Roundabout, StopLines
from autocalib_ros.offline.simulate.palette import Palette

PAVEMENT_WIDTH_M = 3.2
KERB_WIDTH_M = 0.25
VERGE_WIDTH_M = 0.8
_DISTANCE_GRID_M = 0.25
_CURVE_STEP_M = 0.7  # side length of the polygons that approximate curved strips


@dataclass(frozen=True)
class GroundMap:
    """Texture of the square |x|, |y| <= half_m from above; row 0 is at y = +half_m.

    levels: mipmap of BGR images, each half as fine as the one before.  texel_m: texel size of the first.
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
    image = _paint_surfaces(edge, palette, texel_m, network.rural, rng)
    painter = _MapPainter(image, half_m, texel_m)
    _paint_wear(painter, network, palette, edge, rng)
    marks = np.zeros((size, size), np.uint8)
    _paint_markings(_MapPainter(marks, half_m, texel_m), network)
    _blend_markings(image, marks, palette, texel_m, rng)
    levels = [image]
    while levels[-1].shape[0] > 64:
        half = tuple(n // 2 for n in levels[-1].shape[:2])
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return GroundMap(tuple(levels), half_m, texel_m)


def edge_distance(network: Network, xy: np.ndarray) -> np.ndarray:
    """Return the signed distance of points (..., 2) to the edge of the asphalt in metres, negative on it."""
    shapes = [road.edge_distance(xy) for road in network.roads]
    ring = network.roundabout
    if ring is None:
        return reduce(partial(_round_union, radius_m=network.corner_radius_m), shapes)
    reach = np.hypot(xy[..., 0], xy[..., 1])
    shapes.append(reach - ring.outer_m)
    whole = reduce(partial(_round_union, radius_m=network.corner_radius_m), shapes)
    return np.maximum(whole, ring.island_m - reach)


def _round_union(a: np.ndarray, b: np.ndarray, radius_m: float) -> np.ndarray:
    """Return the signed distance of the union of two shapes with rounded inner corners."""
    corner = np.hypot(np.maximum(radius_m - a, 0.0), np.maximum(radius_m - b, 0.0))
    return np.maximum(np.minimum(a, b), radius_m) - corner


def _edge_distance_grid(network: Network, half_m: float) -> np.ndarray:
    """Return the signed distance field (n, n) of the asphalt on a coarse grid."""
    size = round(2 * half_m / max(_DISTANCE_GRID_M, half_m / 500))
    line = ((np.arange(size) + 0.5) / size * 2 - 1) * half_m
    return edge_distance(network, np.stack(np.meshgrid(line, -line), -1)).astype(np.float32)


def _paint_surfaces(
    edge: np.ndarray, palette: Palette, texel_m: float, rural: bool, rng: np.random.Generator
) -> np.ndarray:
    """Colour grass, pavement, kerb and asphalt by signed edge distance, each with its own noise."""
    pavement_m, kerb_m = (VERGE_WIDTH_M, 0.0) if rural else (PAVEMENT_WIDTH_M, KERB_WIDTH_M)
    size = edge.shape[0]
    image = np.empty((size, size, 3), np.uint8)
    image[:] = palette.grass
    image[edge < pavement_m] = palette.pavement
    image[edge < kerb_m] = palette.kerb
    image[edge < 0] = palette.asphalt
    slabs = ((np.arange(size) * texel_m) % 1.2) < 0.05
    joints = (slabs[:, None] | slabs[None, :]) & (edge > kerb_m) & (edge < pavement_m)
    image[joints & (not rural)] = paint.mix_colours(palette.pavement, palette.asphalt, 0.5)
    cv2.GaussianBlur(image, (3, 3), 0, dst=image)  # anti-alias slanting edges
    contrast = palette.texture * np.where(edge < 0, 1.0, np.where(edge < pavement_m, 0.7, 2.0))
    octaves = [(m / texel_m, s) for m, s in ((0.05, 5.0), (0.25, 3.0), (1.0, 3.0), (6.0, 4.0))]
    noise = paint.octave_noise(size, size, [(max(o, 1.0), s) for o, s in octaves], rng)
    paint.add_noise(image, noise * contrast.astype(np.float32))
    return image


class _MapPainter:
    """Draws shapes given in metres on a ground texture."""

    def __init__(self, image: np.ndarray, half_m: float, texel_m: float) -> None:
        self.image, self.half_m, self.texel_m = image, half_m, texel_m

    def texels(self, xy: np.ndarray) -> np.ndarray:
        """Return texel coordinates (n, 2) of ground points (n, 2)."""
        return np.stack([xy[:, 0] + self.half_m, self.half_m - xy[:, 1]], 1) / self.texel_m

    def polygon(self, xy: np.ndarray, colour: tuple[int, ...]) -> None:
        """Fill a polygon of ground points (n, 2)."""
        paint.polygon(self.image, self.texels(np.asarray(xy, float)), colour)

    def strip(
        self, road: Road, along: tuple[float, float], lateral: tuple[float, float], colour: tuple[int, ...]
    ) -> None:
        """Fill a strip given by ranges along a road and to the left of its axis."""
        pieces = 1 if road.straight else max(1, round(abs(along[1] - along[0]) / _CURVE_STEP_M))
        stations = np.linspace(*along, pieces + 1)
        self.polygon(np.concatenate([road.at(stations, lateral[0]), road.at(stations[::-1], lateral[1])]), colour)

    def ring(self, radii: tuple[float, float], colour: tuple[int, ...]) -> None:
        """Fill an annulus about the origin."""
        angle = np.linspace(0.0, 2 * np.pi, round(2 * np.pi * radii[1] / _CURVE_STEP_M))
        arc = np.stack([np.cos(angle), np.sin(angle)], 1)
        self.polygon(np.concatenate([radii[0] * arc, radii[1] * arc[::-1]]), colour)


def _paint_wear(
    painter: _MapPainter, network: Network, palette: Palette, edge: np.ndarray, rng: np.random.Generator
) -> None:
    """Add patches, cracks and manhole covers to the asphalt."""
    dark = paint.mix_colours(palette.asphalt, palette.trim, 0.3)
    reach = min(painter.half_m, 60.0)
    for road in network.roads:
        for _ in range(10):
            along = rng.uniform(-reach, reach)
            lateral = rng.uniform(-1, 0.7) * road.half_width_m
            length, width = rng.uniform(1.5, 6.0), rng.uniform(0.5, 1.6)
            colour = paint.mix_colours(palette.asphalt, dark, rng.uniform(-0.4, 0.7))
            if _on_asphalt(network, road.at(np.linspace(along, along + length, 5), lateral)):
                painter.strip(road, (along, along + length), (lateral, lateral + width), colour)
        for _ in range(8):
            centre = road.at(rng.uniform(-reach, reach), rng.uniform(-1, 1) * 0.75 * road.half_width_m)
            circle = np.linspace(0, 2 * np.pi, 24)
            rim = centre + 0.32 * np.stack([np.cos(circle), np.sin(circle)], 1)
            if _on_asphalt(network, rim):
                painter.polygon(rim, dark)
    for _ in range(14):
        _paint_crack(painter, edge, dark, reach, rng)


def _on_asphalt(network: Network, xy: np.ndarray) -> bool:
    return bool((edge_distance(network, xy) <= 0).all())


def _paint_crack(
    painter: _MapPainter, edge: np.ndarray, colour: tuple[int, ...], reach: float, rng: np.random.Generator
) -> None:
    point, heading = rng.uniform(-reach, reach, 2), rng.uniform(0, 2 * np.pi)
    for _ in range(25):
        heading += rng.normal(0, 0.35)
        after = point + 0.4 * np.array([np.cos(heading), np.sin(heading)])
        (x0, y0), (x1, y1) = painter.texels(np.stack([point, after]))
        column, row = int(x1), int(y1)
        if not (0 <= row < edge.shape[0] and 0 <= column < edge.shape[1]) or edge[row, column] > 0:
            return
        paint.line(painter.image, (x0, y0), (x1, y1), colour, 1)
        point = after


def _paint_markings(painter: _MapPainter, network: Network) -> None:
    """Draw lane markings, stop lines and zebra crossings into a mask."""
    lines = network.stop_lines
    begin, clear = (0.0, 0.0) if lines is None else (lines.stop_m, lines.clear_m)
    far = min(painter.half_m, 300.0)
    for road in network.roads:
        for sign in (1, -1):
            if not road.reaches(sign * begin):
                continue
            for lateral, kind in road.lane_edges_m:
                start = clear if kind == 'edge' else begin
                _paint_line(painter, road, sign, (start, far), lateral, kind)
            if lines is not None:
                _paint_crossing(painter, road, sign, lines, give_way=network.roundabout is not None)
    if network.roundabout is not None:
        _paint_island_line(painter, network.roundabout)


def _paint_crossing(painter: _MapPainter, road: Road, sign: int, lines: StopLines, *, give_way: bool) -> None:
    """Draw the stop line (a dashed one to give way) and the zebra crossing of one arm."""
    white = (255,)
    half, stop_m, near = road.half_width_m, lines.stop_m, lines.crossing_m
    # Right-hand traffic: the entry lanes of an arm are on the left of its outward direction.
    inner, outer = (0.0 if give_way else -0.2 * half), 0.98 * half
    marks = [(inner, outer)]
    if give_way:
        marks = [(lateral, lateral + 0.5) for lateral in np.arange(inner + 0.3, outer - 0.4, 0.9)]
    for mark in marks:
        painter.strip(road, (sign * stop_m, sign * (stop_m + 0.45)), (sign * mark[0], sign * mark[1]), white)
    for lateral in np.arange(-half + 0.4, half - 0.6, 1.0):
        span = (sign * near, sign * (near + CROSSING_WIDTH_M))
        painter.strip(road, span, (lateral, lateral + 0.5), white)


def _paint_island_line(painter: _MapPainter, ring: Roundabout) -> None:
    """Draw the edge marking round the island."""
    painter.ring((ring.island_m + 0.3, ring.island_m + 0.45), (255,))


def _paint_line(
    painter: _MapPainter, road: Road, sign: int, span: tuple[float, float], lateral: float, kind: str
) -> None:
    white = (255,)
    if kind == 'dash':
        for along in np.arange(span[0], span[1], 6.0):
            dash = (sign * along, sign * (along + 3.0))
            painter.strip(road, dash, (lateral - 0.07, lateral + 0.07), white)
        return
    inward = 0.3 if kind == 'edge' else 0.0
    lateral -= np.sign(lateral) * inward
    painter.strip(road, (sign * span[0], sign * span[1]), (lateral - 0.06, lateral + 0.06), white)


def _blend_markings(
    image: np.ndarray, marks: np.ndarray, palette: Palette, texel_m: float, rng: np.random.Generator
) -> None:
    """Blend worn markings into the texture, in place."""
    octaves = ((max(0.06 / texel_m, 1), 0.12), (max(0.4 / texel_m, 1), 0.10))
    wear = np.clip(0.85 + paint.octave_noise(marks.shape[0], marks.shape[1], octaves, rng), 0.3, 1.0)
    rows, columns = np.nonzero(marks)
    part = (marks[rows, columns] / 255.0 * wear[rows, columns])[:, None]
    under = image[rows, columns].astype(np.float32)
    image[rows, columns] = (under + part * (np.array(palette.marking) - under)).astype(np.uint8)

"""Static objects beside the road: buildings, trees, poles, barriers."""

from __future__ import annotations

import math

import numpy as np

from autocalib_ros.offline.simulate import paint
from autocalib_ros.offline.simulate.faces import Faces, Texture, concatenate_faces
from autocalib_ros.offline.simulate.ground_surface import PAVEMENT_WIDTH_M, edge_distance
from autocalib_ros.offline.simulate.network import Network, Road
from autocalib_ros.offline.simulate.palette import Palette

_SCENERY_TEXELS_PER_M = 24
_PANEL_M = 6.0  # width of a wall panel
_LAMP_POSITIONS_M = np.arange(-105.0, 106.0, 30.0)  # along a road
_BARRIER_HEIGHT_M = 0.8
_BARRIER_REACH_M = 300.0
_BARRIER_PANEL_M = 6.0


def build_scenery(network: Network, viewpoint: np.ndarray, palette: Palette, seed: int) -> Faces:
    """Return all static objects; viewpoint (2,) is the ground point below the camera, which is kept clear."""
    rng = np.random.default_rng([seed, 4])
    parts: list[Faces] = []
    crowns = [foliage_texture(palette, rng) for _ in range(6)]
    for road in network.roads:
        for side in (1, -1):
            if not network.rural:
                parts += _buildings(road, side, network, viewpoint, palette, rng)
            parts += _trees(road, side, network, viewpoint, palette, crowns, rng)
            parts += _poles(road, side, network, viewpoint, palette)
    parts += _barriers(network, palette)
    return concatenate_faces(parts)


def _is_unobstructed(
    network: Network, viewpoint: np.ndarray, points: np.ndarray, kerb_m: float, camera_m: float
) -> bool:
    """Whether points (n, 2) are clear of the roads, the camera and its view of the centre."""
    if edge_distance(network, points).min() < kerb_m:
        return False
    offset = points - viewpoint
    if np.hypot(*offset.T).min() < camera_m:
        return False
    towards = -viewpoint / max(float(np.hypot(*viewpoint)), 1e-6)
    along, lateral = offset @ towards, np.abs(offset @ np.array([-towards[1], towards[0]]))
    return not bool(((along > 0) & (along < np.hypot(*viewpoint)) & (lateral < 12.0)).any())


def _buildings(
    road: Road, side: int, network: Network, viewpoint: np.ndarray, palette: Palette, rng: np.random.Generator
) -> list[Faces]:
    parts = []
    for along in np.arange(-110.0, 111.0, 24.0):
        length, depth = rng.uniform(14, 22), rng.uniform(10, 14)
        height = float(rng.choice([6.4, 9.6, 12.8]))
        wall = palette.walls[int(rng.integers(len(palette.walls)))]
        lateral = side * (road.half_width_m + PAVEMENT_WIDTH_M + rng.uniform(3.0, 6.0) + depth / 2)
        centre = road.at(along, lateral)
        box = _rectangle(centre, road.heading(along), length, depth)
        if _is_unobstructed(network, viewpoint, _perimeter_points(box), PAVEMENT_WIDTH_M + 1.0, 20.0):
            parts.append(_building(box, height, wall, palette, rng))
    return parts


def _rectangle(centre: np.ndarray, heading: float, length: float, depth: float) -> np.ndarray:
    """Return the four corners (4, 2) of a rectangle, counter-clockwise."""
    axis = np.array([math.cos(heading), math.sin(heading)]) * length / 2
    normal = np.array([-math.sin(heading), math.cos(heading)]) * depth / 2
    return np.array([centre - axis - normal, centre + axis - normal, centre + axis + normal, centre - axis + normal])


def _perimeter_points(ring: np.ndarray) -> np.ndarray:
    """Return points along the sides of a rectangle (4, 2)."""
    following = np.roll(ring, -1, axis=0)
    return np.concatenate([ring + f * (following - ring) for f in (0, 0.25, 0.5, 0.75)])


def _building(
    ring: np.ndarray, height: float, wall: tuple[int, int, int], palette: Palette, rng: np.random.Generator
) -> Faces:
    """Return a building with panelled walls and a flat roof."""
    corners, textures = [], []
    panel = _wall_texture(height, wall, palette, rng)
    for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        count = max(1, round(float(np.hypot(*(end - start))) / _PANEL_M))
        step = (end - start) / count
        for i in range(count):
            corners.append([(*(start + i * step), height), (*step, 0), (0, 0, -height)])
            textures.append(panel)
    roof = paint.filled_image(32, 32, paint.mix_colours(wall, palette.asphalt, 0.5))
    corners.append([(*ring[3], height), (*(ring[2] - ring[3]), 0), (*(ring[0] - ring[3]), 0)])
    textures.append(Texture(roof))
    return Faces(np.array(corners, float), tuple(textures))


def _wall_texture(height: float, wall: tuple[int, int, int], palette: Palette, rng: np.random.Generator) -> Texture:
    """Paint a wall panel with two windows per storey."""
    rows, columns = round(height * _SCENERY_TEXELS_PER_M), round(_PANEL_M * _SCENERY_TEXELS_PER_M)
    image = paint.filled_image(rows, columns, wall)
    octaves = [(s, 5.0 * palette.texture) for s in (1.5, 5.0, 20.0)]
    paint.add_noise(image, paint.octave_noise(rows, columns, octaves, rng))
    storey = 3.2 * _SCENERY_TEXELS_PER_M
    for top in np.arange(0.8 * _SCENERY_TEXELS_PER_M, rows - storey / 2, storey):
        for left in (0.12, 0.60):
            x0, x1 = left * columns, (left + 0.27) * columns
            y0, y1 = top, top + 1.5 * _SCENERY_TEXELS_PER_M
            glass = paint.mix_colours(palette.window, palette.sky_low, float(rng.uniform(0, 0.5)))
            box = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
            frame = box + [(-2, -2), (2, -2), (2, 2), (-2, 2)]
            paint.polygon(image, frame, (*palette.kerb, 255))
            paint.polygon(image, box, (*glass, 255))
            paint.line(image, ((x0 + x1) / 2, y0), ((x0 + x1) / 2, y1), (*palette.kerb, 255), 2)
    return Texture(image)


def billboard(
    position: np.ndarray, viewpoint: np.ndarray, width: float, low: float, high: float
) -> list[tuple[float, ...]]:
    """Return a billboard: an upright rectangle that faces the camera."""
    away = position - viewpoint
    across = np.array([away[1], -away[0]]) / max(float(np.hypot(*away)), 1e-6) * width
    return [(*(position - across / 2), high), (*across, 0.0), (0.0, 0.0, low - high)]


def _trees(
    road: Road,
    side: int,
    network: Network,
    viewpoint: np.ndarray,
    palette: Palette,
    crowns: list[Texture],
    rng: np.random.Generator,
) -> list[Faces]:
    parts = []
    for along in np.arange(-100.0, 101.0, 11.0):
        lateral = side * (road.half_width_m + PAVEMENT_WIDTH_M + rng.uniform(0.5, 2.0))
        position = road.at(along + rng.uniform(-3, 3), lateral)
        height = rng.uniform(4.5, 8.0)
        if not road.reaches(along) or not _is_unobstructed(
            network, viewpoint, position[None], PAVEMENT_WIDTH_M - 0.2, 14.0
        ):
            continue
        width = 0.7 * height
        corners = [
            billboard(position, viewpoint, 0.25, 0.0, 0.5 * height),
            billboard(position, viewpoint, width, 0.3 * height, height),
        ]
        trunk = Texture(paint.filled_image(32, 4, palette.trunk))
        parts.append(Faces(np.array(corners), (trunk, crowns[int(rng.integers(len(crowns)))])))
    return parts


def foliage_texture(palette: Palette, rng: np.random.Generator) -> Texture:
    """Paint foliage: overlapping discs, lit from above."""
    size = 128
    image = paint.filled_image(size, size, palette.foliage)
    alpha = np.zeros((size, size), np.uint8)
    for _ in range(160):
        angle, radius = rng.uniform(0, 2 * np.pi), 0.40 * np.sqrt(rng.uniform())
        x, y = 0.5 + radius * np.cos(angle), 0.5 + radius * np.sin(angle)
        light = (0.45 - y) + rng.normal(0, 0.15)
        other = palette.sky_low if light > 0 else palette.trim
        colour = paint.mix_colours(palette.foliage, other, min(0.5, abs(light) * 0.5))
        centre, spread = (x * size, y * size), rng.uniform(0.04, 0.10) * size
        paint.disc(image, centre, spread, (*colour, 255))
        paint.disc(alpha, centre, spread, (255,))
    image[..., 3] = alpha
    return Texture(image)


def _poles(road: Road, side: int, network: Network, viewpoint: np.ndarray, palette: Palette) -> list[Faces]:
    """Return street lamps along the road and signal posts at the stop lines."""
    metal = Texture(paint.filled_image(32, 4, palette.pole))
    head = paint.filled_image(48, 16, palette.trim)
    for i, colour in enumerate(((40, 40, 200), (40, 160, 200), (80, 180, 60))):
        paint.disc(head, (8.0, 8.0 + 16 * i), 5.0, (*paint.mix_colours(palette.trim, colour, 0.4), 255))
    plans = [(along, 0.6, 0.14, 8.0) for along in _LAMP_POSITIONS_M]
    if network.phases and network.stop_lines is not None:
        plans += [(side * network.stop_lines.stop_m, 0.5, 0.16, 4.2)]
    parts = []
    for along, kerb, width, height in plans:
        position = road.at(along, side * (road.half_width_m + kerb))
        if not road.reaches(along):
            continue
        if edge_distance(network, position) < 0.2 or np.hypot(*(position - viewpoint)) < 9.0:
            continue
        corners, textures = [billboard(position, viewpoint, width, 0.0, height)], [metal]
        if height < 5.0:
            corners.append(billboard(position, viewpoint, 0.36, height - 1.0, height + 0.1))
            textures.append(Texture(head))
        parts.append(Faces(np.array(corners), tuple(textures)))
    return parts


def _barriers(network: Network, palette: Palette) -> list[Faces]:
    """Return concrete crash barriers along the first road."""
    concrete = Texture(paint.filled_image(16, 16, palette.kerb))
    parts = []
    for lateral in network.barriers_m:
        for along in np.arange(-_BARRIER_REACH_M, _BARRIER_REACH_M, _BARRIER_PANEL_M):
            a, b = network.roads[0].at(np.array([along, along + _BARRIER_PANEL_M]), lateral)
            left = (b - a)[::-1] * (-1, 1) / _BARRIER_PANEL_M * 0.15
            step = (*(b - a), 0.0)
            faces = [
                [(*(a + side * left), _BARRIER_HEIGHT_M), step, (0.0, 0.0, -_BARRIER_HEIGHT_M)] for side in (1, -1)
            ]
            faces.append([(*(a + left), _BARRIER_HEIGHT_M), step, (*(-2 * left), 0.0)])
            parts.append(Faces(np.array(faces), (concrete,) * 3))
    return parts


def street_lamp_positions(network: Network) -> list[tuple[float, float]]:
    """Return the ground points (x, y) under the street lamps."""
    positions = []
    for road in network.roads:
        for side in (1, -1):
            for along in filter(road.reaches, _LAMP_POSITIONS_M):
                x, y = road.at(along, side * (road.half_width_m - 1.5)).tolist()
                positions.append((x, y))
    return positions

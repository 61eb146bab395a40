"""Moving objects beside the road that are not traffic: trees and flags in the wind, scanned LED signs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autocalib_ros.offline.simulate import paint
from autocalib_ros.offline.simulate.faces import Faces, Texture
from autocalib_ros.offline.simulate.ground_surface import PAVEMENT_WIDTH_M, edge_distance
from autocalib_ros.offline.simulate.lens import CameraPose, KannalaBrandtLens
from autocalib_ros.offline.simulate.network import Network
from autocalib_ros.offline.simulate.palette import Colour, Palette
from autocalib_ros.offline.simulate.scenery import billboard, foliage_texture

TREE_COUNT, FLAG_COUNT, SIGN_COUNT = 5, 3, 2
"""Objects of each kind, at most: fewer where the view has no room. Judgement."""
_GUST_PERIOD_S = 9.0
"""Period of the wind strength in seconds. Judgement."""
_BRANCH_COUNT = 7
_STRIP_COUNT = 10
_NEAR_BRANCH_M, _NEAR_FOLIAGE_SIZE_M = 4.0, 1.1
"""Distance of a branch that hangs into the image, and size of its foliage."""
_FLAG_SIZE_M = (3.0, 2.0)
"""Width and height of a flag."""
_FLAG_WAVELENGTH_M, _FLAG_WAVE_MPS = 1.3, 2.5
"""Wavelength and speed of the wave along a flag."""
_SIGN_SIZE_M = (1.6, 1.2)
"""Width and height of a sign."""
_SIGN_STEPS = 12
"""Textures of one beat period."""
_SIGN_BEAT_HZ = 1.3
"""Beat frequency of the row scan of a sign with the frame rate."""


def wind_strength(time_s: float) -> float:
    """Return the wind strength at a time, 0.4 to 1."""
    return 0.7 + 0.3 * math.sin(2 * math.pi * time_s / _GUST_PERIOD_S) * math.cos(
        2 * math.pi * time_s / (2.3 * _GUST_PERIOD_S)
    )


def roadside_positions(
    network: Network,
    pose: CameraPose,
    lens: KannalaBrandtLens,
    size: tuple[int, int],
    beyond_m: float,
    rng: np.random.Generator,
    count: int,
) -> list[np.ndarray]:
    """Draw random visible positions (2,) beside the road, `beyond_m` to `beyond_m` + 3 m from the asphalt."""
    positions: list[np.ndarray] = []
    for _ in range(4000):
        reach, angle = rng.uniform(9.0, 40.0), rng.uniform(0, 2 * np.pi)
        position = pose.position_m[:2] + reach * np.array([math.cos(angle), math.sin(angle)])
        if len(positions) == count:
            break
        distance_m = float(edge_distance(network, position))
        pixel, valid = lens.project(pose.to_camera(np.array([*position, 1.5])))
        visible = bool(valid) and bool(((pixel > 20) & (pixel < np.array(size) - 20)).all())
        if (
            visible
            and beyond_m < distance_m < beyond_m + 3.0
            and all(math.dist(position, other) > 4.0 for other in positions)
        ):
            positions.append(position)
    return positions


@dataclass(frozen=True)
class Tree:
    """A trunk and branches with foliage; each branch swings about its pivot at its own frequency."""

    branches: np.ndarray
    """Corners (n, 3, 3) at rest."""
    pivots_m: np.ndarray
    """Centres of rotation (n, 3)."""
    swings_rad: np.ndarray
    rates_hz: np.ndarray
    phases: np.ndarray
    textures: tuple[Texture, ...]

    def at(self, time_s: float) -> Faces:
        """Return the faces at a time."""
        wave = np.sin(2 * np.pi * self.rates_hz * time_s + self.phases)
        angles = self.swings_rad * wind_strength(time_s) * (0.4 + 0.6 * wave)
        return Faces(
            np.stack([_rotated_in_plane(*row) for row in zip(self.branches, self.pivots_m, angles, strict=True)]),
            self.textures,
        )


def _rotated_in_plane(corners: np.ndarray, pivot: np.ndarray, angle: float) -> np.ndarray:
    """Rotate a face (3, 3) in its own plane about a pivot (3,)."""
    axis = np.cross(corners[1], corners[2])
    axis /= np.linalg.norm(axis)
    c, s = math.cos(angle), math.sin(angle)

    def turned(vector: np.ndarray) -> np.ndarray:
        return vector * c + np.cross(axis, vector) * s + axis * (axis @ vector) * (1 - c)

    return np.stack([pivot + turned(corners[0] - pivot), turned(corners[1]), turned(corners[2])])


def make_tree(position: np.ndarray, viewer: np.ndarray, palette: Palette, rng: np.random.Generator) -> Tree:
    """Return a tree at a position (2,) that faces the viewer (2,)."""
    height = rng.uniform(4.5, 7.5)
    towards = (viewer - position) / max(float(np.hypot(*(viewer - position))), 1e-6)
    corners = [billboard(position, viewer, 0.25, 0.0, 0.5 * height)]
    pivots, swings, rates = [(*position, 0.0)], [0.004], [0.4]
    for i in range(_BRANCH_COUNT):
        lateral = rng.uniform(-0.25, 0.25) * height * np.array([-towards[1], towards[0]])
        centre = position + lateral + 0.05 * (i + 1) * towards
        low = rng.uniform(0.3, 0.65) * height
        corners.append(billboard(centre, viewer, 0.36 * height, low, low + 0.36 * height))
        pivots.append((*position, 0.3 * height))
        swings.append(rng.uniform(0.02, 0.07))
        rates.append(rng.uniform(0.35, 1.4))
    textures = (
        Texture(paint.filled_image(32, 4, palette.trunk)),
        *(foliage_texture(palette, rng) for _ in range(_BRANCH_COUNT)),
    )
    return Tree(
        np.array(corners, float),
        np.array(pivots),
        np.array(swings),
        np.array(rates),
        rng.uniform(0, 2 * np.pi, len(swings)),
        textures,
    )


def near_branch(
    pose: CameraPose, lens: KannalaBrandtLens, size: tuple[int, int], palette: Palette, rng: np.random.Generator
) -> Tree:
    """Return the foliage of a branch close to the camera that hangs into an upper corner of the image."""
    viewer = pose.position_m[:2]
    column = rng.choice([0.12, 0.88]) * size[0]
    corners, pivots = [], []
    for _ in range(_BRANCH_COUNT):
        pixel = np.array([column + rng.normal(0, 0.04) * size[0], rng.uniform(0.05, 0.25) * size[1]])
        ray = pose.world_from_camera @ lens.bearings(pixel)
        x, y, z = pose.position_m + _NEAR_BRANCH_M * rng.uniform(0.9, 1.1) * ray
        low = z - _NEAR_FOLIAGE_SIZE_M / 2
        corners.append(billboard(np.array([x, y]), viewer, _NEAR_FOLIAGE_SIZE_M, low, low + _NEAR_FOLIAGE_SIZE_M))
        pivots.append((x, y, z + 1.5))
    return Tree(
        np.array(corners, float),
        np.array(pivots),
        rng.uniform(0.08, 0.2, _BRANCH_COUNT),
        rng.uniform(0.3, 0.9, _BRANCH_COUNT),
        rng.uniform(0, 2 * np.pi, _BRANCH_COUNT),
        tuple(foliage_texture(palette, rng) for _ in range(_BRANCH_COUNT)),
    )


@dataclass(frozen=True)
class Flag:
    """A flag on a pole: vertical strips with waves that travel away from the pole."""

    position: np.ndarray
    heading: float
    top_m: float
    phase: float
    strips: tuple[Texture, ...]
    pole: Texture

    def at(self, time_s: float, viewer: np.ndarray) -> Faces:
        """Return the faces at a time, with the strips turned to show the viewer (2,) their front."""
        width, height = _FLAG_SIZE_M
        step = width / _STRIP_COUNT
        foot = self.position.copy()
        corners = [billboard(self.position, viewer, 0.09, 0.0, self.top_m + 0.1)]
        for i in range(_STRIP_COUNT):
            along = (i + 0.5) * step
            wave = (
                2 * np.pi * (along - _FLAG_WAVE_MPS * wind_strength(time_s) * time_s) / _FLAG_WAVELENGTH_M + self.phase
            )
            heading = self.heading + 0.7 * min(1.0, along) * math.cos(wave)
            direction = step * np.array([math.cos(heading), math.sin(heading)])
            facing = direction[0] * (foot - viewer)[1] - direction[1] * (foot - viewer)[0] > 0
            origin, edge = (foot, direction) if facing else (foot + direction, -direction)
            corners.append([(*origin, self.top_m), (*edge, 0.0), (0.0, 0.0, -height)])
            foot = foot + direction
        return Faces(np.array(corners, float), (self.pole, *self.strips))


def make_flag(position: np.ndarray, viewer: np.ndarray, palette: Palette, rng: np.random.Generator) -> Flag:
    """Return a flag at a position (2,) that blows across the line of sight."""
    away = position - viewer
    heading = math.atan2(away[1], away[0]) + rng.choice([-1, 1]) * rng.uniform(0.9, 1.6)
    rows, columns = 64, 10
    strips = []
    stripes: list[Colour] = []
    for _ in range(3):
        blue, green, red = rng.integers(20, 235, 3).tolist()
        stripes.append((blue, green, red))
    emblem = rng.integers(0, _STRIP_COUNT)
    for i in range(_STRIP_COUNT):
        image = paint.filled_image(rows, columns, stripes[0])
        for band, colour in enumerate(stripes):
            image[band * rows // 3 : (band + 1) * rows // 3, :, :3] = colour
        if abs(i - emblem) < 2:
            image[20:44, :, :3] = (230, 230, 230) if i % 2 else (30, 30, 30)
        strips.append(Texture(image))
    return Flag(
        position,
        heading,
        rng.uniform(4.0, 6.0),
        rng.uniform(0, 2 * np.pi),
        tuple(strips),
        Texture(paint.filled_image(32, 4, palette.pole)),
    )


@dataclass(frozen=True)
class LedSign:
    """A row-scanned LED sign: sampled at the frame rate, dark bands drift over it."""

    corners: np.ndarray
    textures: tuple[Texture, ...]
    """One for each step of the beat period."""
    phase: float

    def at(self, time_s: float) -> Faces:
        """Return the faces at a time."""
        step = int((time_s * _SIGN_BEAT_HZ + self.phase) % 1.0 * _SIGN_STEPS)
        return Faces(self.corners, (self.textures[step],))


def make_sign(position: np.ndarray, viewer: np.ndarray, rng: np.random.Generator) -> LedSign:
    """Return a sign at a position (2,) that faces the viewer (2,)."""
    rows, columns = 48, 64
    text = np.zeros((rows, columns, 4), np.uint8)
    paint.draw_text(text, f'{rng.integers(3, 9)}0', (6.0, 6.0, columns - 6.0, rows - 6.0), (60, 190, 255))
    board = paint.filled_image(rows, columns, (18, 18, 18))
    lit, textures = text[..., :3].max(-1) > 60, []
    for step in range(_SIGN_STEPS):
        band = 0.5 + 0.5 * np.cos(2 * np.pi * (np.arange(rows)[:, None] / rows * 1.5 - step / _SIGN_STEPS))
        image = board.copy()
        light = (0.15 + 0.85 * band)[..., None] * np.array((60, 190, 255))
        image[..., :3] = np.where(lit[..., None], light, image[..., :3]).astype(np.uint8)
        textures.append(Texture(image))
    low = rng.uniform(2.5, 4.0)
    corners = np.array([billboard(position, viewer, _SIGN_SIZE_M[0], low, low + _SIGN_SIZE_M[1])], float)
    return LedSign(corners, tuple(textures), float(rng.uniform()))


class MovingScenery:
    """All moving objects beside the road of one recording."""

    def __init__(
        self,
        troubles: frozenset[str],
        network: Network,
        pose: CameraPose,
        lens: KannalaBrandtLens,
        size: tuple[int, int],
        palette: Palette,
        seed: int,
    ) -> None:
        rng = np.random.default_rng([seed, 10])
        self._viewer = viewer = pose.position_m[:2]

        def positions(name: str, beyond_m: float, count: int) -> list[np.ndarray]:
            drawn = roadside_positions(network, pose, lens, size, beyond_m, rng, count)
            return drawn if name in troubles else []

        self._trees = [
            make_tree(position, viewer, palette, rng) for position in positions('trees', PAVEMENT_WIDTH_M, TREE_COUNT)
        ]
        if 'trees' in troubles:
            self._trees.append(near_branch(pose, lens, size, palette, rng))
        self._flags = [make_flag(position, viewer, palette, rng) for position in positions('flags', 1.0, FLAG_COUNT)]
        self._signs = [make_sign(position, viewer, rng) for position in positions('leds', 0.5, SIGN_COUNT)]

    def at(self, time_s: float) -> list[Faces]:
        """Return the faces of each object at a time."""
        return [
            *(tree.at(time_s) for tree in self._trees),
            *(flag.at(time_s, self._viewer) for flag in self._flags),
            *(sign.at(time_s) for sign in self._signs),
        ]

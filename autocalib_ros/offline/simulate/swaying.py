"""What moves beside the road and is no traffic: trees and flags in the wind, LED signs that are scanned."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autocalib_ros.offline.simulate import paint
from autocalib_ros.offline.simulate.faces import Faces, Texture
from autocalib_ros.offline.simulate.ground_surface import PAVEMENT_WIDTH_M, edge_distance
from autocalib_ros.offline.simulate.lens import CameraPose, KannalaBrandtLens
from autocalib_ros.offline.simulate.network import Network
from autocalib_ros.offline.simulate.palette import Palette
from autocalib_ros.offline.simulate.scenery import billboard, foliage_texture

TREE_COUNT, FLAG_COUNT, SIGN_COUNT = 5, 3, 2
_GUST_PERIOD_S = 9.0
"""Wind comes and goes with this period."""
_BRANCH_COUNT = 7
_STRIP_COUNT = 10
_NEAR_BRANCH_M, _NEAR_FOLIAGE_SIZE_M = 4.0, 1.1
"""How far before the camera a bough hangs into the picture, and how large its leaves are together."""
_FLAG_SIZE_M = (3.0, 2.0)
_FLAG_WAVELENGTH_M, _FLAG_WAVE_MPS = 1.3, 2.5
"""Length and speed of the wave that runs out along a flag."""
_SIGN_SIZE_M = (1.6, 1.2)
_SIGN_STEPS = 12
_SIGN_BEAT_HZ = 1.3
"""What is left of the frequency of the rows of a sign when it is looked at with the camera's."""


def wind_strength(time_s: float) -> float:
    """Return the strength of the wind at a time, 0.4 to 1."""
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
    """Draw places (2,) beside the road that the camera sees, at `beyond_m` from the asphalt and up to 3 m more."""
    places: list[np.ndarray] = []
    for _ in range(4000):
        reach, angle = rng.uniform(9.0, 40.0), rng.uniform(0, 2 * np.pi)
        place = pose.position_m[:2] + reach * np.array([math.cos(angle), math.sin(angle)])
        if len(places) == count:
            break
        off = float(edge_distance(network, place))
        pixel, valid = lens.project(pose.to_camera(np.array([*place, 1.5])))
        seen = bool(valid) and bool(((pixel > 20) & (pixel < np.array(size) - 20)).all())
        if seen and beyond_m < off < beyond_m + 3.0 and all(math.dist(place, other) > 4.0 for other in places):
            places.append(place)
    return places


@dataclass(frozen=True)
class Tree:
    """A trunk and branches with leaves; each branch swings about the foot in its own time."""

    branches: np.ndarray
    """Corners (n, 3, 3) at rest."""
    pivots_m: np.ndarray
    """(n, 3): about which each swings."""
    swings_rad: np.ndarray
    rates_hz: np.ndarray
    phases: np.ndarray
    textures: tuple[Texture, ...]

    def at(self, time_s: float) -> Faces:
        """Return its faces at a time."""
        wave = np.sin(2 * np.pi * self.rates_hz * time_s + self.phases)
        angles = self.swings_rad * wind_strength(time_s) * (0.4 + 0.6 * wave)
        return Faces(
            np.stack([_rotated_in_plane(*row) for row in zip(self.branches, self.pivots_m, angles, strict=True)]),
            self.textures,
        )


def _rotated_in_plane(corners: np.ndarray, pivot: np.ndarray, angle: float) -> np.ndarray:
    """Turn a face (3, 3) within its own plane about a point (3,) of that plane."""
    axis = np.cross(corners[1], corners[2])
    axis /= np.linalg.norm(axis)
    c, s = math.cos(angle), math.sin(angle)

    def turned(vector: np.ndarray) -> np.ndarray:
        return vector * c + np.cross(axis, vector) * s + axis * (axis @ vector) * (1 - c)

    return np.stack([pivot + turned(corners[0] - pivot), turned(corners[1]), turned(corners[2])])


def tree(place: np.ndarray, viewer: np.ndarray, palette: Palette, rng: np.random.Generator) -> Tree:
    """Return a tree at a place (2,) that faces the viewer (2,)."""
    height = rng.uniform(4.5, 7.5)
    towards = (viewer - place) / max(float(np.hypot(*(viewer - place))), 1e-6)
    corners = [billboard(place, viewer, 0.25, 0.0, 0.5 * height)]
    pivots, swings, rates = [(*place, 0.0)], [0.004], [0.4]
    for i in range(_BRANCH_COUNT):
        aside = rng.uniform(-0.25, 0.25) * height * np.array([-towards[1], towards[0]])
        centre = place + aside + 0.05 * (i + 1) * towards
        low = rng.uniform(0.3, 0.65) * height
        corners.append(billboard(centre, viewer, 0.36 * height, low, low + 0.36 * height))
        pivots.append((*place, 0.3 * height))
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
    """Return leaves on the end of a bough, close before the camera, that hang into an upper corner of the picture."""
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
    """A cloth on a pole: strips that waves run along, away from the pole."""

    place: np.ndarray
    heading: float
    top_m: float
    phase: float
    strips: tuple[Texture, ...]
    pole: Texture

    def at(self, time_s: float, viewer: np.ndarray) -> Faces:
        """Return its faces at a time, strips turned so that the viewer (2,) sees their front."""
        width, height = _FLAG_SIZE_M
        step = width / _STRIP_COUNT
        foot = self.place.copy()
        corners = [billboard(self.place, viewer, 0.09, 0.0, self.top_m + 0.1)]
        for i in range(_STRIP_COUNT):
            along = (i + 0.5) * step
            wave = (
                2 * np.pi * (along - _FLAG_WAVE_MPS * wind_strength(time_s) * time_s) / _FLAG_WAVELENGTH_M + self.phase
            )
            heading = self.heading + 0.7 * min(1.0, along) * math.cos(wave)
            way = step * np.array([math.cos(heading), math.sin(heading)])
            facing = way[0] * (foot - viewer)[1] - way[1] * (foot - viewer)[0] > 0
            origin, edge = (foot, way) if facing else (foot + way, -way)
            corners.append([(*origin, self.top_m), (*edge, 0.0), (0.0, 0.0, -height)])
            foot = foot + way
        return Faces(np.array(corners, float), (self.pole, *self.strips))


def flag(place: np.ndarray, viewer: np.ndarray, palette: Palette, rng: np.random.Generator) -> Flag:
    """Return a flag at a place (2,) that blows across the line of sight."""
    away = place - viewer
    heading = math.atan2(away[1], away[0]) + rng.choice([-1, 1]) * rng.uniform(0.9, 1.6)
    rows, columns = 64, 10
    strips = []
    stripes = [tuple(int(c) for c in rng.integers(20, 235, 3)) for _ in range(3)]
    emblem = rng.integers(0, _STRIP_COUNT)
    for i in range(_STRIP_COUNT):
        picture = paint.filled_image(rows, columns, stripes[0])
        for band, colour in enumerate(stripes):
            picture[band * rows // 3 : (band + 1) * rows // 3, :, :3] = colour
        if abs(i - emblem) < 2:
            picture[20:44, :, :3] = (230, 230, 230) if i % 2 else (30, 30, 30)
        strips.append(Texture(picture))
    return Flag(
        place,
        heading,
        rng.uniform(4.0, 6.0),
        rng.uniform(0, 2 * np.pi),
        tuple(strips),
        Texture(paint.filled_image(32, 4, palette.pole)),
    )


@dataclass(frozen=True)
class LedSign:
    """A message sign whose rows of LEDs light in turn: seen at the camera's rate, dark bands creep over it."""

    corners: np.ndarray
    textures: tuple[Texture, ...]
    phase: float

    def at(self, time_s: float) -> Faces:
        """Return its faces at a time."""
        step = int((time_s * _SIGN_BEAT_HZ + self.phase) % 1.0 * _SIGN_STEPS)
        return Faces(self.corners, (self.textures[step],))


def sign(place: np.ndarray, viewer: np.ndarray, rng: np.random.Generator) -> LedSign:
    """Return a sign at a place (2,), turned to the viewer (2,)."""
    rows, columns = 48, 64
    text = np.zeros((rows, columns, 4), np.uint8)
    paint.draw_text(text, f'{rng.integers(3, 9)}0', (6.0, 6.0, columns - 6.0, rows - 6.0), (60, 190, 255))
    board = paint.filled_image(rows, columns, (18, 18, 18))
    lit, textures = text[..., :3].max(-1) > 60, []
    for step in range(_SIGN_STEPS):
        band = 0.5 + 0.5 * np.cos(2 * np.pi * (np.arange(rows)[:, None] / rows * 1.5 - step / _SIGN_STEPS))
        picture = board.copy()
        light = (0.15 + 0.85 * band)[..., None] * np.array((60, 190, 255))
        picture[..., :3] = np.where(lit[..., None], light, picture[..., :3]).astype(np.uint8)
        textures.append(Texture(picture))
    low = rng.uniform(2.5, 4.0)
    corners = np.array([billboard(place, viewer, _SIGN_SIZE_M[0], low, low + _SIGN_SIZE_M[1])], float)
    return LedSign(corners, tuple(textures), float(rng.uniform()))


class MovingScenery:
    """All that sways and blinks beside the road of one recording."""

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

        def places(name: str, beyond_m: float, count: int) -> list[np.ndarray]:
            drawn = roadside_positions(network, pose, lens, size, beyond_m, rng, count)
            return drawn if name in troubles else []

        self._trees = [tree(place, viewer, palette, rng) for place in places('trees', PAVEMENT_WIDTH_M, TREE_COUNT)]
        if 'trees' in troubles:
            self._trees.append(near_branch(pose, lens, size, palette, rng))
        self._flags = [flag(place, viewer, palette, rng) for place in places('flags', 1.0, FLAG_COUNT)]
        self._signs = [sign(place, viewer, rng) for place in places('leds', 0.5, SIGN_COUNT)]

    def at(self, time_s: float) -> list[Faces]:
        """Return the faces of each of them at a time."""
        return [
            *(tree.at(time_s) for tree in self._trees),
            *(flag.at(time_s, self._viewer) for flag in self._flags),
            *(sign.at(time_s) for sign in self._signs),
        ]

"""Lights at night: beams on the road, pools of light under street lamps, glow of head and tail lamps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from autocalib_ros.offline.simulate.faces import SAMPLES_PER_PIXEL, Canvas, Faces, Texture
from autocalib_ros.offline.simulate.lens import CameraPose
from autocalib_ros.offline.simulate.paint import mix_colours
from autocalib_ros.offline.simulate.sensor import add_glow
from autocalib_ros.offline.simulate.shapes import SHAPES
from autocalib_ros.offline.simulate.vehicle_models import Vehicle, VehicleState

_HEAD_LAMP_COLOUR = (215, 240, 255)
_TAIL_LAMP_COLOUR = (40, 30, 230)
_BEAM_SIZE_M = (16.0, 6.0)  # length and width on the road
LAMP_HEIGHT_M = 0.7


@lru_cache(maxsize=16)
def beam_faces(kind: str) -> Faces:
    """Return the head-lamp beam on the road ahead of a vehicle, to be drawn as a gain."""
    length, width = _BEAM_SIZE_M
    start = SHAPES[kind].length_m / 2
    # Texture x runs along the beam, y across it.
    x, y = np.linspace(0, 1, 96)[None], np.linspace(-1, 1, 48)[:, None]
    spread = 0.25 + 0.5 * x
    light = np.exp(-((y / spread) ** 2)) * np.clip(x * 12, 0, 1) * (1 - x) ** 1.3
    return _gain_faces(light, [(start, width / 2, 0.02), (length, 0, 0), (0, -width, 0)])


@lru_cache(maxsize=1)
def light_pool() -> Faces:
    """Return the pool of light under a street lamp, to be drawn as a gain."""
    line = np.linspace(-1, 1, 64)
    light = np.exp(-3.5 * (line[None] ** 2 + line[:, None] ** 2))
    return _gain_faces(0.6 * light, [(-10, 10, 0.01), (20, 0, 0), (0, -20, 0)])


def _gain_faces(light: np.ndarray, corners: list[tuple[float, float, float]]) -> Faces:
    image = np.full((*light.shape, 4), 255, np.uint8)
    image[..., :3] = (100 + 155 * np.clip(light, 0, 1))[..., None]
    return Faces(np.array([corners], float), (Texture(image),))


@dataclass(frozen=True)
class Lamp:
    """A vehicle lamp: position (3,), horizontal direction (2,) of its light, colour and size."""

    position_m: np.ndarray
    direction: np.ndarray
    colour: tuple[int, int, int]
    size_m: float


def vehicle_lamps(vehicle: Vehicle, state: VehicleState) -> Iterator[Lamp]:
    """Yield the head and tail lamps of a vehicle."""
    shape = vehicle.shape
    ahead = np.array([np.cos(state.heading), np.sin(state.heading)])
    left = np.array([-ahead[1], ahead[0]])
    for end, colour, size in ((1, _HEAD_LAMP_COLOUR, 0.24), (-1, _TAIL_LAMP_COLOUR, 0.13)):
        for side in (0.36, -0.36):
            xy = np.array([state.x, state.y]) + ahead * end * (shape.length_m / 2 + 0.05)
            yield Lamp(np.array([*(xy + left * side * shape.width_m), LAMP_HEIGHT_M]), ahead * end, colour, size)


def add_lamps(
    image: np.ndarray,
    canvas: Canvas,
    pose: CameraPose,
    vehicles: list[tuple[Vehicle, VehicleState]],
) -> None:
    """Add the glow of all visible lamps that face the camera, in place."""
    for vehicle, state in vehicles:
        for lamp in vehicle_lamps(vehicle, state):
            _add_lamp(image, canvas, pose, lamp)


def _add_lamp(image: np.ndarray, canvas: Canvas, pose: CameraPose, lamp: Lamp) -> None:
    to_camera = pose.position_m - lamp.position_m
    distance = float(np.linalg.norm(to_camera))
    turned = float(lamp.direction @ to_camera[:2]) / distance
    pixel, valid = canvas.lens.project(pose.to_camera(lamp.position_m))
    column, row = (round(c) for c in pixel)
    if turned < 0.05 or not valid:
        return
    if not (0 <= row < image.shape[0] and 0 <= column < image.shape[1]):
        return
    if canvas.distance[row * SAMPLES_PER_PIXEL, column * SAMPLES_PER_PIXEL] < distance - 0.5:
        return
    # A lamp is brightest along its axis and fades to the side; distant ones stay visible.
    radius = max(1.2, lamp.size_m * canvas.lens.focal_px / distance * (0.6 + 1.4 * turned**2))
    strength = min(1.0, 0.35 + turned)
    add_glow(image, pixel, radius, mix_colours((0, 0, 0), lamp.colour, strength))

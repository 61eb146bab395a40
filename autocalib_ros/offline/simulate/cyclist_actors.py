"""Cyclists along the kerb or on the pavement: as narrow as pedestrians, as fast as turning cars."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from autocalib_ros.offline.simulate import paint
from autocalib_ros.offline.simulate.clothing import FigureSizes, figure_images
from autocalib_ros.offline.simulate.faces import Faces, Texture
from autocalib_ros.offline.simulate.network import Network, Road
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.palette import palette_for

_ROUTE_HALF_LENGTH_M = 45.0  # routes end at this distance from the centre of the network
_FROM_KERB_M = 0.6
_BICYCLE_LENGTH_M, _BICYCLE_HEIGHT_M = 1.75, 1.0
_WHEEL_RADIUS_M = 0.34
_TEXELS_PER_M = 60
_RIDER_SIZES = FigureSizes(leg=(44, 10), trunk=(36, 26), arm=(32, 7), head=(17, 13))


class CyclistState(NamedTuple):
    """Position in metres, heading and pedal phase in radians."""

    x: float
    y: float
    heading: float
    pedal_phase: float


@dataclass(frozen=True)
class Cyclist:
    """A cyclist who rides along a road periodically."""

    road: Road
    lateral_m: float
    """To the left of the road's axis."""
    forward: bool
    """Along the axis or against it."""
    speed_mps: float
    first_s: float
    clothes: int

    def state(self, time_s: float) -> CyclistState:
        """Return the state at a time."""
        distance = (time_s - self.first_s) * self.speed_mps % (2 * _ROUTE_HALF_LENGTH_M)
        along = distance - _ROUTE_HALF_LENGTH_M if self.forward else _ROUTE_HALF_LENGTH_M - distance
        x, y = self.road.at(along, self.lateral_m + 0.06 * math.sin(distance / 1.3)).tolist()
        heading = self.road.heading(along) + (0.0 if self.forward else math.pi)
        return CyclistState(x, y, heading, distance * 2 * math.pi / 4.5)


def spawn_cyclists(network: Network, options: SimulationOptions) -> tuple[Cyclist, ...]:
    """Return the cyclists of a recording; none on rural roads and at roundabouts."""
    if options.empty or network.rural or network.roundabout is not None:
        return ()
    rng = np.random.default_rng([options.seed, 12])
    return tuple(_cyclist(network, rng) for _ in range(options.cyclists))


def _cyclist(network: Network, rng: np.random.Generator) -> Cyclist:
    road = network.roads[int(rng.integers(len(network.roads)))]
    forward = bool(rng.integers(2))
    right = road.half_width_m + (-_FROM_KERB_M if rng.integers(2) else rng.uniform(0.8, 1.6))
    return Cyclist(
        road,
        -right if forward else right,
        forward,
        float(rng.uniform(4.0, 7.0)),
        -float(rng.uniform(0.0, 30.0)),
        int(rng.integers(15)),
    )


def cyclist_faces(cyclist: Cyclist, state: CyclistState, viewer_xy: np.ndarray, thermal: bool) -> Faces:
    """Return a flat bicycle, visible from both sides, and billboards of its rider facing the viewer (2,)."""
    x, y, heading, phase = state
    ride = np.array([math.cos(heading), math.sin(heading)])
    left = np.array([-ride[1], ride[0]])
    to_viewer = math.atan2(viewer_xy[1] - y, viewer_xy[0] - x)
    across = np.array([-math.sin(to_viewer), math.cos(to_viewer)])
    centre = np.array([x, y])
    front, rear = centre + ride * _BICYCLE_LENGTH_M / 2, centre - ride * _BICYCLE_LENGTH_M / 2
    corners = [
        [(*start, _BICYCLE_HEIGHT_M), (*(end - start), 0.0), (0.0, 0.0, -_BICYCLE_HEIGHT_M)]
        for start, end in ((front, rear), (rear, front))
    ]
    swing = 0.17 * math.sin(phase)
    for ahead_low, lateral_low, low, ahead_high, lateral_high, high, width in (
        (0.05 + swing, 0.1, 0.2 + 0.1 * math.cos(phase), -0.15, 0.1, 0.98, 0.17),
        (0.05 - swing, -0.1, 0.2 - 0.1 * math.cos(phase), -0.15, -0.1, 0.98, 0.17),
        (-0.15, 0.0, 0.9, 0.12, 0.0, 1.48, 0.44),
        (0.48, 0.25, 0.95, 0.12, 0.2, 1.42, 0.11),
        (0.48, -0.25, 0.95, 0.12, -0.2, 1.42, 0.11),
        (0.17, 0.0, 1.46, 0.2, 0.0, 1.74, 0.21),
    ):
        top = centre + ride * ahead_high + left * lateral_high - across * width / 2
        foot = centre + ride * ahead_low + left * lateral_low - across * width / 2
        corners.append([(*top, high), (*(across * width), 0.0), (*(foot - top), low - high)])
    return Faces(np.array(corners), _textures(cyclist.clothes, thermal))


@lru_cache(maxsize=32)
def _textures(clothes: int, thermal: bool) -> tuple[Texture, ...]:
    palette = palette_for(thermal)
    images = figure_images(clothes, _RIDER_SIZES, palette, np.random.default_rng([clothes, 6]))
    bicycle = Texture(_bicycle(palette.tyre, palette.bodies[clothes % len(palette.bodies)]))
    return bicycle, bicycle, *(Texture(image) for image in images)


def _bicycle(tyre: tuple[int, int, int], frame: tuple[int, int, int]) -> np.ndarray:
    """Paint two wheels and the frame; alpha is the silhouette."""
    height, width = round(_BICYCLE_HEIGHT_M * _TEXELS_PER_M), round(_BICYCLE_LENGTH_M * _TEXELS_PER_M)
    image = paint.filled_image(height, width, tyre)
    alpha = np.zeros((height, width), np.uint8)
    hub = height - _WHEEL_RADIUS_M * _TEXELS_PER_M
    wheels = [(_WHEEL_RADIUS_M * _TEXELS_PER_M, hub), (width - _WHEEL_RADIUS_M * _TEXELS_PER_M, hub)]
    for wheel in wheels:
        paint.disc(alpha, wheel, _WHEEL_RADIUS_M * _TEXELS_PER_M, (255,))
        paint.disc(alpha, wheel, (_WHEEL_RADIUS_M - 0.06) * _TEXELS_PER_M, (70,))
    saddle, bar, pedals = (0.62 * width, 0.1 * height), (0.27 * width, 0.08 * height), (0.5 * width, hub)
    for start, end in (
        (wheels[0], bar),
        (wheels[1], saddle),
        (bar, pedals),
        (saddle, pedals),
        (saddle, bar),
        (pedals, wheels[1]),
    ):
        paint.line(alpha, start, end, (255,), 4)
        paint.line(image, start, end, (*frame, 255), 4)
    image[..., 3] = alpha
    return image

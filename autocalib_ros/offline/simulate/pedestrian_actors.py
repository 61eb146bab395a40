"""Pedestrians: small, slow, with lateral sway and swinging legs; hard for a tracker."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from autocalib_ros.offline.simulate import paint
from autocalib_ros.offline.simulate.clothing import FigureSizes, figure_images
from autocalib_ros.offline.simulate.faces import Faces, Texture
from autocalib_ros.offline.simulate.network import CROSSING_WIDTH_M, Network, Road, StopLines
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.palette import palette_for

_WALK_RANGE_M = 45.0
_STRIDE_M = 1.4
_PEDESTRIAN_SIZES = FigureSizes(leg=(40, 10), trunk=(36, 24), arm=(32, 8), head=(14, 12))


class PedestrianState(NamedTuple):
    """Position in metres and gait phase in radians."""

    x: float
    y: float
    gait_phase: float


@dataclass(frozen=True)
class Pedestrian:
    """A pedestrian who walks along a line, periodically (period_s) or once."""

    start: tuple[float, float]
    heading: float
    length_m: float
    speed_mps: float
    first_s: float
    period_s: float | None
    height_m: float
    clothes: int

    def state(self, time_s: float) -> PedestrianState | None:
        """Return the state at a time, or None while absent."""
        elapsed = time_s - self.first_s
        if self.period_s is not None:
            elapsed %= self.period_s
        along = elapsed * self.speed_mps
        if not 0.0 <= along <= self.length_m:
            return None
        phase = 2 * math.pi * along / _STRIDE_M
        lateral = 0.04 * math.sin(phase) + 0.25 * math.sin(along / 4.0 + self.height_m * 50)
        c, s = math.cos(self.heading), math.sin(self.heading)
        return PedestrianState(self.start[0] + along * c - lateral * s, self.start[1] + along * s + lateral * c, phase)


def spawn_pedestrians(
    network: Network, green_phases: tuple[tuple[str, float, float], ...], options: SimulationOptions
) -> tuple[Pedestrian, ...]:
    """Return the pedestrians of a recording: on the pavements and on the zebra crossings."""
    if options.empty or not options.pedestrians or network.rural:
        return ()
    rng = np.random.default_rng([options.seed, 2])
    walking = [_pavement_pedestrian(network, rng) for _ in range(options.pedestrians)]
    crossing = [
        _crossing_pedestrian(network, network.stop_lines, name, start, rng)
        for name, start, _ in green_phases
        if network.stop_lines is not None and name.startswith('main') and start > -20.0
        for _ in range(max(1, options.pedestrians // 4))
    ]
    return tuple(walking + crossing)


def pedestrian_faces(pedestrian: Pedestrian, state: PedestrianState, viewer_xy: np.ndarray, thermal: bool) -> Faces:
    """Return billboards facing the viewer (2,): legs, trunk, arms, head."""
    x, y, phase = state
    to_viewer = math.atan2(viewer_xy[1] - y, viewer_xy[0] - x)
    across = np.array([-math.sin(to_viewer), math.cos(to_viewer)])
    walk = np.array([math.cos(pedestrian.heading), math.sin(pedestrian.heading)])
    # Steps along the line of sight hardly swing in the image.
    swing = 0.25 * float(walk @ across) + 0.04
    height = pedestrian.height_m
    lift = 0.02 * abs(math.sin(phase))
    limbs = [
        (swing * math.sin(phase), 0.0, 0.0, 0.48, 0.17),
        (-swing * math.sin(phase), 0.0, 0.0, 0.48, 0.17),
        (0.0, 0.0, 0.45, 0.86, 0.44),
        (-0.7 * swing * math.sin(phase), 0.26, 0.47, 0.82, 0.12),
        (0.7 * swing * math.sin(phase), -0.26, 0.47, 0.82, 0.12),
        (0.0, 0.0, 0.85, 1.0, 0.20),
    ]
    corners = []
    for i, (sway, lateral, low, high, width) in enumerate(limbs):
        top = np.array([x, y]) + across * (lateral - width / 2)
        foot = across * sway
        nearer = 0.03 * i * np.array([math.cos(to_viewer), math.sin(to_viewer)])
        corners.append(
            [
                (*(top + nearer), high * height + lift),
                (*(across * width), 0.0),
                (*foot, -(high - low) * height),
            ]
        )
    return Faces(np.array(corners), _textures(pedestrian.clothes, thermal))


@lru_cache(maxsize=64)
def _textures(clothes: int, thermal: bool) -> tuple[Texture, ...]:
    images = figure_images(clothes, _PEDESTRIAN_SIZES, palette_for(thermal), np.random.default_rng([clothes, 5]))
    alpha = np.zeros(_PEDESTRIAN_SIZES.head, np.uint8)
    paint.disc(alpha, (6.0, 7.0), 6.0, (255,))
    images[-1][..., 3] = alpha
    return tuple(Texture(image) for image in images)


def _arm(road: Road, rng: np.random.Generator) -> float:
    """Draw the sign of an existing arm of a road."""
    arm = float(rng.choice([-1.0, 1.0]))
    return arm if road.reaches(arm * _WALK_RANGE_M) else -arm


def _pavement_pedestrian(network: Network, rng: np.random.Generator) -> Pedestrian:
    """Draw a pedestrian who walks a pavement from end to end, again and again."""
    road = network.roads[int(rng.integers(len(network.roads)))]
    side = float(rng.choice([-1.0, 1.0]))
    offset = side * (road.half_width_m + rng.uniform(0.8, 2.6))
    forward = bool(rng.integers(2))
    # At a junction pedestrians stay on one arm, between the crossing and the end of the view.
    near, arm = -_WALK_RANGE_M, 1.0
    if network.stop_lines is not None:
        near, arm = network.stop_lines.clear_m + 1.0, _arm(road, rng)
    ends = sorted((arm * near, arm * _WALK_RANGE_M))
    begin = ends[0] if forward else ends[1]
    length = ends[1] - ends[0]
    speed = float(rng.uniform(1.0, 1.6))
    return Pedestrian(
        tuple(road.at(begin, offset).tolist()),
        road.heading(begin) + (0 if forward else math.pi),
        length,
        speed,
        -float(rng.uniform(0, length / speed)),
        length / speed,
        float(rng.uniform(1.55, 1.9)),
        int(rng.integers(15)),
    )


def _crossing_pedestrian(
    network: Network, stop_lines: StopLines, green: str, start_s: float, rng: np.random.Generator
) -> Pedestrian:
    """Draw a pedestrian who crosses the road without the green phase."""
    other = 1 - int(green[-1])
    road = network.roads[other]
    arm = _arm(road, rng)
    side = float(rng.choice([-1.0, 1.0]))
    centre = stop_lines.crossing_m + CROSSING_WIDTH_M / 2
    along = arm * (centre + rng.uniform(-1.2, 1.2))
    across = side * (road.half_width_m + 0.5)
    heading = road.heading(along) + (-side) * math.pi / 2
    return Pedestrian(
        tuple(road.at(along, across).tolist()),
        heading,
        2 * road.half_width_m + 1.0,
        float(rng.uniform(1.3, 1.7)),
        start_s + float(rng.uniform(0.0, 2.0)),
        None,
        float(rng.uniform(1.55, 1.9)),
        int(rng.integers(15)),
    )

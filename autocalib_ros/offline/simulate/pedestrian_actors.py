"""Pedestrians: small, slow, swaying, with swinging legs; a nuisance to every tracker."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from autocalib_ros.offline.simulate import paint
from autocalib_ros.offline.simulate.faces import Faces, Texture
from autocalib_ros.offline.simulate.network import CROSSING_WIDTH_M, Network, Road
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.palette import palette_for

_WALK_RANGE_M = 45.0


@dataclass(frozen=True)
class Pedestrian:
    """Somebody who walks along a line, again and again (period_s) or within a time span."""

    start: tuple[float, float]
    heading: float
    length_m: float
    speed_mps: float
    first_s: float
    period_s: float | None
    height_m: float
    clothes: int

    def place(self, time_s: float) -> tuple[float, float, float] | None:
        """Return (x, y, phase of the step in radians), or None while not there."""
        elapsed = time_s - self.first_s
        if self.period_s is not None:
            elapsed %= self.period_s
        way = elapsed * self.speed_mps
        if not 0.0 <= way <= self.length_m:
            return None
        step = 2 * math.pi * way / 1.4
        aside = 0.04 * math.sin(step) + 0.25 * math.sin(way / 4.0 + self.height_m * 50)
        c, s = math.cos(self.heading), math.sin(self.heading)
        return self.start[0] + way * c - aside * s, self.start[1] + way * s + aside * c, step


def spawn_pedestrians(
    network: Network, green_phases: tuple[tuple[str, float, float], ...], options: SimulationOptions
) -> tuple[Pedestrian, ...]:
    """Return the people of a recording: walkers on the pavements, and some who cross."""
    if options.empty or not options.pedestrians or network.rural:
        return ()
    rng = np.random.default_rng([options.seed, 2])
    walkers = [_walker(network, rng) for _ in range(options.pedestrians)]
    crossing = [
        _crosser(network, name, start, rng)
        for name, start, _ in green_phases
        if name.startswith('main') and start > -20.0
        for _ in range(max(1, options.pedestrians // 4))
    ]
    return tuple(walkers + crossing)


def figure_faces(person: Pedestrian, place: tuple[float, float, float], viewer_xy: np.ndarray, thermal: bool) -> Faces:
    """Return upright rectangles that face the viewer (2,): legs, trunk, arms, head."""
    x, y, step = place
    to_viewer = math.atan2(viewer_xy[1] - y, viewer_xy[0] - x)
    across = np.array([-math.sin(to_viewer), math.cos(to_viewer)])
    walk = np.array([math.cos(person.heading), math.sin(person.heading)])
    # Steps along the line of sight hardly swing in the picture.
    swing = 0.25 * float(walk @ across) + 0.04
    height = person.height_m
    lift = 0.02 * abs(math.sin(step))
    limbs = [
        (swing * math.sin(step), 0.0, 0.0, 0.48, 0.17),
        (-swing * math.sin(step), 0.0, 0.0, 0.48, 0.17),
        (0.0, 0.0, 0.45, 0.86, 0.44),
        (-0.7 * swing * math.sin(step), 0.26, 0.47, 0.82, 0.12),
        (0.7 * swing * math.sin(step), -0.26, 0.47, 0.82, 0.12),
        (0.0, 0.0, 0.85, 1.0, 0.20),
    ]
    corners = []
    for i, (sway, aside, low, high, width) in enumerate(limbs):
        top = np.array([x, y]) + across * (aside - width / 2)
        foot = across * sway
        nearer = 0.03 * i * np.array([math.cos(to_viewer), math.sin(to_viewer)])
        corners.append(
            [
                (*(top + nearer), high * height + lift),
                (*(across * width), 0.0),
                (*foot, -(high - low) * height),
            ]
        )
    return Faces(np.array(corners), _textures(person.clothes, thermal))


@lru_cache(maxsize=64)
def _textures(clothes: int, thermal: bool) -> tuple[Texture, ...]:
    palette = palette_for(thermal)
    rng = np.random.default_rng([clothes, 5])
    coat = palette.clothes[clothes % len(palette.clothes)]
    legs = palette.clothes[(clothes * 3 + 1) % len(palette.clothes)]
    pictures = []
    for colour, size in (
        (legs, (40, 10)),
        (paint.mix_colours(legs, palette.trim, 0.3), (40, 10)),
        (coat, (36, 24)),
        (coat, (32, 8)),
        (coat, (32, 8)),
        (palette.skin, (14, 12)),
    ):
        picture = paint.filled_image(*size, colour)
        octaves = ((2.0, 6.0 * palette.texture), (8.0, 8.0 * palette.texture))
        paint.add_noise(picture, paint.octave_noise(*size, octaves, rng))
        pictures.append(picture)
    alpha = np.zeros((14, 12), np.uint8)
    paint.disc(alpha, (6.0, 7.0), 6.0, (255,))
    pictures[-1][..., 3] = alpha
    return tuple(Texture(p) for p in pictures)


def _arm(road: Road, rng: np.random.Generator) -> float:
    """Return the sign of an arm of a road that is there."""
    arm = float(rng.choice([-1.0, 1.0]))
    return arm if road.reaches(arm * _WALK_RANGE_M) else -arm


def _walker(network: Network, rng: np.random.Generator) -> Pedestrian:
    """Somebody on a pavement, from one end of the view to the other and back at the start."""
    road = network.roads[int(rng.integers(len(network.roads)))]
    side = float(rng.choice([-1.0, 1.0]))
    offset = side * (road.half_width_m + rng.uniform(0.8, 2.6))
    forward = bool(rng.integers(2))
    # Round a junction people stay on one arm: between the crossing and the end of the view.
    near = -_WALK_RANGE_M
    if network.stop_m:
        near = network.clear_m + 1.0
    arm = _arm(road, rng) if network.stop_m else 1.0
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


def _crosser(network: Network, green: str, start_s: float, rng: np.random.Generator) -> Pedestrian:
    """Somebody who crosses the road that is not the one with green."""
    other = 1 - int(green[-1])
    road = network.roads[other]
    arm = _arm(road, rng)
    side = float(rng.choice([-1.0, 1.0]))
    centre = network.crossing_m + CROSSING_WIDTH_M / 2
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

"""Disturbances of synthetic evidence: gross outliers, tracks on no road, a swaying camera."""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.lens.camera import Camera

SWAY_STEP_S = 0.5
SWAY_DURATION_S = 3000.0
"""Length of the simulated sway; synthetic recordings are shorter."""
DRIFT_QUANTILES = (0.05, 0.95)
"""Quantiles of the background offsets whose span is the drift of synthetic evidence."""

Sway = Callable[[np.ndarray], np.ndarray]
"""Rotations (n, 3, 3) of the camera about its mean pose at times (n,) in seconds."""


def corrupt_track(points: np.ndarray, size: tuple[int, int], generator: np.random.Generator) -> np.ndarray:
    """Turn a track (n, 2) into a gross outlier: a jump to another object, or an unrelated curve."""
    if generator.uniform() < 0.5:
        jumped = points.copy()
        jumped[generator.integers(2, len(points) - 2) :] += generator.uniform(40, 200) * _any_direction(generator)
        return reflect_into_image(jumped, size)
    return random_curve(len(points), size, generator)


def random_curve(count: int, size: tuple[int, int], generator: np.random.Generator) -> np.ndarray:
    """Return `count` points (n, 2) on a random arc in the image, radius 100 to 600 px."""
    bend = generator.choice([-1.0, 1.0]) / generator.uniform(100, 600)
    along = np.linspace(0.0, generator.uniform(80, 500), count)
    heading = generator.uniform(0, 2 * np.pi) + bend * along
    steps = np.gradient(along)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    return reflect_into_image(generator.uniform((0, 0), size) + np.cumsum(steps, axis=0), size)


def random_walk(count: int, size: tuple[int, int], generator: np.random.Generator) -> np.ndarray:
    """Return `count` points (n, 2) of a random walk, such as rain, leaves or a lost tracker give."""
    steps = generator.normal(scale=generator.uniform(2.0, 8.0), size=(count, 2))
    return reflect_into_image(generator.uniform((0, 0), size) + np.cumsum(steps, axis=0), size)


def noisy_line(count: int, size: tuple[int, int], generator: np.random.Generator) -> np.ndarray:
    """Return `count` points (n, 2) along a random, almost straight line in the image."""
    way = _any_direction(generator)
    along = np.linspace(0.0, generator.uniform(60, 500), count)
    sideways = np.cumsum(generator.normal(scale=generator.uniform(0.2, 1.5), size=count))
    line = along[:, None] * way + sideways[:, None] * np.array([-way[1], way[0]])
    return reflect_into_image(generator.uniform((0, 0), size) + line, size)


def reflect_into_image(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Reflect points (n, 2) at the image borders until they lie inside."""
    last = np.array(size) - 1.0
    turned = np.mod(points, 2 * last)
    return np.minimum(turned, 2 * last - turned)


def random_sway(generator: np.random.Generator) -> Sway:
    """Draw a sway of 0.5 to 3 degrees over 1 to 10 s.

    The sum of an oscillation about one axis and an Ornstein-Uhlenbeck process about all three.
    """
    amplitude = np.radians(0.5 * 6.0 ** generator.uniform())
    period, memory = generator.uniform(1.0, 10.0, 2)
    axis, phase = generator.normal(size=3), generator.uniform(0, 2 * np.pi)
    axis /= np.linalg.norm(axis)
    keep = np.exp(-SWAY_STEP_S / memory)
    pushes = generator.normal(
        scale=0.5 * amplitude * np.sqrt(1 - keep**2), size=(int(SWAY_DURATION_S / SWAY_STEP_S), 3)
    )
    walk = np.array(list(accumulate(pushes, lambda before, push: push + keep * before)))
    ticks = SWAY_STEP_S * np.arange(len(walk))

    def sway(times_s: np.ndarray) -> np.ndarray:
        swing = amplitude * np.sin(2 * np.pi * times_s / period + phase)[:, None] * axis
        drifted = np.column_stack([np.interp(times_s, ticks, column) for column in walk.T])
        return Rotation.from_rotvec(swing + drifted).as_matrix()

    return sway


def background_drift_px(camera: Camera, sway: Sway, seconds: float) -> float:
    """Return the drift in pixels of evidence from a camera that sways for `seconds` and is not compensated."""
    corners = np.stack(
        np.meshgrid(np.linspace(0.1, 0.9, 8) * camera.width, np.linspace(0.1, 0.9, 5) * camera.height), axis=-1
    ).reshape(-1, 2)
    bearings, _ = camera.unproject(corners)
    moved, _ = camera.project(bearings @ sway(np.arange(0.0, seconds, 0.5)).transpose(0, 2, 1))
    offsets = np.median(moved - moved[0], axis=1)
    return float(np.hypot(*np.diff(np.quantile(offsets, DRIFT_QUANTILES, axis=0), axis=0)[0]))


def _any_direction(generator: np.random.Generator) -> np.ndarray:
    angle = generator.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])

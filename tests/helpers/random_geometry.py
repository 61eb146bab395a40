"""Hypothesis strategies for lenses and poses, and the settings that make property tests reproducible."""

from __future__ import annotations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import pose

SIZE = (1280, 720)


def reproducible(examples: int) -> settings:
    """Return settings with the same examples in every run, and no deadline: test machines are busy."""
    return settings(max_examples=examples, derandomize=True, deadline=None, database=None)


def between(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers of a closed interval."""
    return st.floats(low, high, allow_nan=False)


def lenses() -> st.SearchStrategy[Camera]:
    """Lenses about the families of `lens_prior`, between the equidistant and the distortion-free one and beyond."""
    return st.builds(
        lambda focal, x, y, k: Camera(*SIZE, focal, (639.5 + x, 359.5 + y), k),
        between(350.0, 1500.0),
        between(-60.0, 60.0),
        between(-40.0, 40.0),
        st.tuples(between(-0.08, 0.34), between(-0.02, 0.14), between(-0.005, 0.05), between(-0.001, 0.02)),
    )


def poses() -> st.SearchStrategy[np.ndarray]:
    """camera_from_ground (3, 3) of roadside cameras: the road is in view, at any heading."""
    return st.builds(pose, between(10.0, 60.0), between(-8.0, 8.0), between(-180.0, 180.0))


def ground_planes() -> st.SearchStrategy[GroundPlane]:
    """Planes in metres below roadside cameras."""
    return st.builds(lambda rotation, height: GroundPlane(rotation.T, height), poses(), between(2.0, 40.0))


def image_pixels(seed: int, count: int = 200) -> np.ndarray:
    """Return pixels (count, 2) all over the image, its corners among them."""
    width, height = SIZE
    corners = np.array([(0.0, 0.0), (width - 1.0, 0.0), (0.0, height - 1.0), (width - 1.0, height - 1.0)])
    inside = np.random.default_rng(seed).uniform((0, 0), (width - 1, height - 1), (count - len(corners), 2))
    return np.concatenate([corners, inside])

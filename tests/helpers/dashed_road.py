"""Dashes of lane lines on a synthetic road, as a camera sees them."""

import numpy as np

from autocalib_ros.offline.synthetic.junction import Junction

LINES_M = (-3.5, 0.0, 3.5)
"""Places of the dashed lines, to the left of the road's middle."""
PERIOD_M, DASH_M = 12.0, 3.0


def dashes(
    junction: Junction,
    generator: np.random.Generator,
    *,
    period_m: float = PERIOD_M,
    lines_m: tuple[float, ...] = LINES_M,
    dash_m: float = DASH_M,
    noise_px: float = 0.4,
) -> np.ndarray:
    """Return the dashes (n, 5) of a road along the first axis of the ground that are seen, as `Evidence.stripes_px`."""
    starts = np.arange(-60.0, 120.0, period_m)
    ends = np.array([[[x, y], [x + dash_m, y]] for y in lines_m for x in starts + generator.uniform(0, period_m)])
    return bars_seen(junction, ends, generator, noise_px)


def bars_seen(
    junction: Junction, ends_m: np.ndarray, generator: np.random.Generator, noise_px: float = 0.4
) -> np.ndarray:
    """Return bars with ends (n, 2, 2) on the ground as they are seen, (m, 5): those inside the image."""
    ground = np.concatenate([ends_m, np.full((*ends_m.shape[:-1], 1), -junction.height_m)], axis=-1)
    in_camera = ground.reshape(-1, 3) @ junction.camera_from_ground.T
    pixels, valid = junction.camera.project(in_camera)
    valid &= in_camera[:, 2] > 0
    pixels = np.where(valid[:, None], pixels + generator.normal(0.0, noise_px, pixels.shape), -1.0).reshape(-1, 4)
    inside = (pixels >= 0).all(axis=1) & (pixels <= np.tile(np.subtract(junction.image_size, 1), 2)).all(axis=1)
    long = np.hypot(*(pixels[:, 2:] - pixels[:, :2]).T) > 6.0
    return np.column_stack([pixels, np.full(len(pixels), 60.0)])[inside & long]

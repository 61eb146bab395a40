"""The static scene without traffic, rendered once per camera pose."""

from __future__ import annotations

import cv2
import numpy as np

from autocalib_ros.offline.simulate.faces import SAMPLES_PER_PIXEL, Canvas, Faces
from autocalib_ros.offline.simulate.ground_surface import GroundMap
from autocalib_ros.offline.simulate.lens import CameraPose
from autocalib_ros.offline.simulate.palette import Palette

_HAZE_LENGTH_M = 260.0  # attenuation length


def draw_backdrop(
    canvas: Canvas,
    pose: CameraPose,
    grounds: tuple[GroundMap, ...],
    scenery: Faces,
    palette: Palette,
) -> None:
    """Draw sky, ground (coarse maps first) and scenery into an empty canvas."""
    rays = cv2.transform(canvas.bearings(), pose.world_from_camera)
    _draw_sky(canvas, rays, palette)
    height = float(pose.position_m[2])
    down = rays[..., 2] < -1e-3
    distance = np.where(down, -height / np.minimum(rays[..., 2], -1e-3), np.inf)
    canvas.distance[:] = distance
    positions = rays[..., :2] * np.where(down, distance, 0)[..., None]
    positions += pose.position_m[:2].astype(np.float32)
    for ground in grounds:
        _draw_ground(canvas, positions, distance, height, ground)
    _add_haze(canvas, palette)
    canvas.draw(canvas.project_faces([scenery], pose)[0])


def _draw_sky(canvas: Canvas, rays: np.ndarray, palette: Palette) -> None:
    up = np.clip(rays[..., 2] / 0.5, 0.0, 1.0)[..., None]
    low, high = np.array(palette.sky_low, np.float32), np.array(palette.sky_high, np.float32)
    canvas.colour[..., :3] = (low + up * (high - low)).astype(np.uint8)
    canvas.colour[..., 3] = 255


def _draw_ground(canvas: Canvas, positions: np.ndarray, distance: np.ndarray, height: float, ground: GroundMap) -> None:
    """Colour the samples on a ground map, each from its mipmap level."""
    inside = np.isfinite(distance) & (np.abs(positions) < ground.half_m).all(-1)
    # Footprint of a sample: geometric mean of its width and its length along the line of sight.
    angle = 1.0 / (canvas.lens.focal_px * SAMPLES_PER_PIXEL)
    footprint = angle * distance * np.sqrt(np.maximum(distance / height, 1.0))
    wanted = np.log2(np.maximum(footprint / ground.texel_m, 1e-6))
    wanted = np.where(inside, wanted, 0.0)
    level = np.clip(np.round(wanted), 0, len(ground.levels) - 1).astype(np.int8)
    for i in np.unique(level[inside]):
        here = inside & (level == i)
        image = ground.levels[i]
        scale = image.shape[0] / (2 * ground.half_m)
        rows, columns = np.nonzero(here)
        part = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
        x = (positions[part][..., 0] + ground.half_m) * scale - 0.5
        y = (ground.half_m - positions[part][..., 1]) * scale - 0.5
        sampled = cv2.remap(
            image,
            x.astype(np.float32),
            y.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        canvas.colour[part][..., :3][here[part]] = sampled[here[part]]


def _add_haze(canvas: Canvas, palette: Palette) -> None:
    far = np.isfinite(canvas.distance)
    part = (1 - np.exp(-canvas.distance[far] / _HAZE_LENGTH_M))[:, None]
    colour = canvas.colour[far][:, :3].astype(np.float32)
    colour += part * (np.array(palette.sky_low, np.float32) - colour)
    canvas.colour[far, :3] = colour.astype(np.uint8)

"""Motion of the simulated camera beyond shake and bump: sway in the wind, a slow drift, a zoom; and dusk.

They are applied to the finished picture, before the noise, by a turn about the camera centre through the true lens.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from autocalib_ros.offline.simulate.lens import KannalaBrandtLens, rotation_from_vector
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.sensor import NIGHT_GAIN

_SWAY_AXIS = np.array([0.5, 0.8, 0.33])
"""Axis about which a mast sways: pan most, since the arm twists."""
_DRIFT_AXIS = np.array([0.9, 0.3, -0.3])
"""Axis of a slow drift: the camera nods as its screw gives way."""
_SWAY_GUST_PERIOD_S = 23.0
"""Period of the strength of the wind."""
MOTION_GRID = (80, 45)
"""Columns and rows at which the turned picture is computed; between them places are interpolated, to
0.01 px."""


class CameraMotion:
    """The motion and the light of one recording."""

    def __init__(self, options: SimulationOptions) -> None:
        self._options, self._lens = options, options.lens
        self.is_active = bool(options.sway_deg or options.drift_deg or options.zoom_at_s is not None)

    def rotation(self, time_s: float) -> np.ndarray:
        """Return the rotation (3, 3) of the camera against its pose at rest: a turn in its own frame."""
        options = self._options
        gust = 0.5 + 0.5 * math.sin(2 * math.pi * time_s / _SWAY_GUST_PERIOD_S)
        sway = options.sway_deg * gust * math.sin(2 * math.pi * options.sway_rate_hz * time_s)
        drift = options.drift_deg * time_s / options.duration_s
        axes = [axis / np.linalg.norm(axis) for axis in (_SWAY_AXIS, _DRIFT_AXIS)]
        return rotation_from_vector(np.radians(sway * axes[0] + drift * axes[1]))

    def zoom(self, time_s: float) -> float:
        """Return the focal length over that at the beginning."""
        at_s = self._options.zoom_at_s
        return 1.0 if at_s is None or time_s < at_s else self._options.zoom

    def moved(self, image: np.ndarray, time_s: float) -> np.ndarray:
        """Return a picture (h, w) or (h, w, 3) as the moved camera sees it; what it did not show is mirrored."""
        if not self.is_active:
            return image
        height, width = image.shape[:2]
        grid = np.stack(
            np.meshgrid(np.linspace(0, width - 1, MOTION_GRID[0]), np.linspace(0, height - 1, MOTION_GRID[1])), axis=-1
        )
        now = KannalaBrandtLens(self._lens.focal_px * self.zoom(time_s), self._lens.k, self._lens.centre_px)
        places, _ = self._lens.project(now.bearings(grid) @ self.rotation(time_s).T)
        return resampled(image, places)

    def lit(self, image: np.ndarray, time_s: float) -> np.ndarray:
        """Return a picture in the light of its time: with option dusk night falls from the beginning to the end."""
        if not self._options.dusk:
            return image
        share = time_s / self._options.duration_s
        return cv2.convertScaleAbs(image, alpha=NIGHT_GAIN**share)


def resampled(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return a picture (h, w) or (h, w, 3) taken from places (rows, columns, 2) of it, interpolated between them."""
    (height, width), (rows, columns) = image.shape[:2], places.shape[:2]
    across = np.linspace(0, columns - 1, width, dtype=np.float32)
    down = np.linspace(0, rows - 1, height, dtype=np.float32)
    fine = cv2.remap(places.astype(np.float32), *np.meshgrid(across, down), cv2.INTER_LINEAR)
    return cv2.remap(image, fine[..., 0], fine[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)

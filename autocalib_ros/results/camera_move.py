"""How a camera that was calibrated has turned or zoomed since, in degrees through its lens."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from autocalib_ros.geometry.small_matrices import rotation_matrix


class MoveKind(str, Enum):
    """What happened to the view of a calibrated camera."""

    BUMP = 'bump'
    """A small turn: the lens and most of the view are those of before."""
    REAIM = 're-aim'
    """A turn by more than `MAX_BUMP_DEG`."""
    ZOOM = 'zoom'
    """Another focal length: the lens of the calibration does not hold any more."""
    OTHER_VIEW = 'other view'
    """Nothing of the view of before was found: another camera, another direction, a test card."""


MAX_BUMP_DEG = 5.0
"""Largest turn that is called a bump. A word only: both are mended alike."""
TINY_RAD = 1e-9
"""Angle below which sine and angle are the same to the last digit."""
MIN_MOVE_ZOOM = 1.01
"""Least zoom factor of a zoom: focal lengths are known to 1 % or so, and lenses that focus anew change by less."""


@dataclass(frozen=True)
class CameraMove:
    """One lasting move. The camera turned right by `pan_deg`, down by `tilt_deg`, clockwise by `roll_deg`.

    The three are the components of one rotation vector, so that their order does not matter.
    """

    kind: MoveKind
    time_s: float
    """When the view of before was seen last, on the clock of the one who tells."""
    pan_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    zoom: float = 1.0
    """Focal length now over that before."""
    sigma_deg: tuple[float, float, float] | None = None
    """Standard deviations of pan, tilt and roll by the registration; None if nothing was measured."""
    parallax_deg: float = 0.0
    """Angle by which what is near turned otherwise than what is far, where that is significant: the camera was shifted
    as well, by this angle times the distance of what is near."""

    @property
    def rotation(self) -> np.ndarray:
        """Directions in the camera now from those in the camera before, shape (3, 3)."""
        return rotation_from_turn(np.radians([self.pan_deg, self.tilt_deg, self.roll_deg]))

    @property
    def is_measured(self) -> bool:
        """Whether the picture says by how much the camera moved."""
        return self.sigma_deg is not None

    @property
    def keeps_lens(self) -> bool:
        """Whether the lens of before still holds, so that the measured turn mends the pose."""
        return self.kind in (MoveKind.BUMP, MoveKind.REAIM) and self.is_measured

    def __str__(self) -> str:
        if self.sigma_deg is None:
            return f'{self.kind.value}: nothing of the earlier view was found'
        turn = ', '.join(
            f'{name} {value:+.2f} ± {sigma:.2f}'
            for name, value, sigma in zip(
                ('pan', 'tilt', 'roll'), (self.pan_deg, self.tilt_deg, self.roll_deg), self.sigma_deg, strict=True
            )
        )
        zoom = f', zoom {self.zoom:.3f}' if self.kind is MoveKind.ZOOM else ''
        shifted = f', and shifted: the near part turned by {self.parallax_deg:.2f} more' if self.parallax_deg else ''
        return f'{self.kind.value}: {turn} degrees{zoom}{shifted}'


def rotation_from_turn(turn_rad: np.ndarray) -> np.ndarray:
    """Return now_from_before (3, 3) of a camera that turned right, down and clockwise by radians (3,)."""
    # axes of the camera: x right, y down, z forward; a turn of the camera moves what it sees the other way
    pan, tilt, roll = turn_rad
    return rotation_matrix(np.array([tilt, -pan, -roll]))


def turn_of_rotation(now_from_before: np.ndarray) -> np.ndarray:
    """Return pan, tilt and roll in radians (3,) of a rotation now_from_before (3, 3) by less than 180 degrees."""
    r = now_from_before
    across = 0.5 * np.array([r[2, 0] - r[0, 2], r[2, 1] - r[1, 2], r[0, 1] - r[1, 0]])
    sine, cosine = float(np.linalg.norm(across)), 0.5 * (float(np.trace(r)) - 1.0)
    return across if sine < TINY_RAD else across * (math.atan2(sine, cosine) / sine)


def rotation_angle_deg(rotation: np.ndarray) -> float:
    """Return the angle in degrees of a rotation (3, 3) by less than 180 degrees."""
    return float(np.degrees(np.linalg.norm(turn_of_rotation(rotation))))


def kind_of_move(angle_deg: float, zoom: float) -> MoveKind:
    """Return what a turn and a zoom factor are called."""
    if max(zoom, 1.0 / zoom) > MIN_MOVE_ZOOM:
        return MoveKind.ZOOM
    return MoveKind.BUMP if angle_deg <= MAX_BUMP_DEG else MoveKind.REAIM

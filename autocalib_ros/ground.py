"""Pixels to points on the road and back, for trackers: from the node's two messages or from calibration.json.

    ground = Ground.from_messages(camera_info, ground_transform)
    found = ground.points(pixels)       # pixels (n, 2) -> found.points_m (n, 3), found.valid (n,)
    pixels, valid = ground.pixels(found.points_m)

Pixel (0, 0) is the centre of the top-left pixel of the images as they are delivered, neither rectified nor scaled.
The ground frame is z up with the road at z = 0, metres. Nothing here needs ROS: a message is any object with the
attributes of one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.errors import InputError
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info_lens import CameraInfoLens, message_field
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.calibration_json import calibration_from_json, read_json

MIN_HORIZON_DISTANCE_PX = 1.0
"""A pixel nearer than this to the horizon, or to where the plane asked for vanishes, is on it: the next one shows no
ground at all, so that nothing is known of its distance."""
DIFFERENCE_STEP_PX = 1e-3
PERTURBATION_SIGMAS = 0.01
"""How far lens and pose are moved to see what depends on them: where everything is still linear."""
QUATERNION_TOLERANCE = 1e-3
"""A quaternion farther from unit length is not one."""


@dataclass(frozen=True, kw_only=True)
class GroundPoints:
    """Where pixels meet the ground, in the order of the pixels."""

    points_m: np.ndarray
    """In the ground frame, shape (n, 3); nan where not valid."""
    valid: np.ndarray
    """False at and above the horizon, and where the lens images nothing; shape (n,)."""
    covariance_m2: np.ndarray | None
    """Of x and y, by the calibration, shape (n, 2, 2); None where it does not tell. It moves all points together, in
    every image alike, so that no filter averages it out."""
    noise_m2: np.ndarray | None
    """Of x and y, by the noise of the pixels, shape (n, 2, 2), for filters; None where that was not given."""

    @property
    def sigma_m(self) -> np.ndarray | None:
        """One sigma of a point's place by all that is known, metres, (n,); None where the calibration does not tell."""
        if self.covariance_m2 is None:
            return None
        whole = self.covariance_m2 if self.noise_m2 is None else self.covariance_m2 + self.noise_m2
        return np.sqrt(np.trace(whole, axis1=1, axis2=2))


@dataclass(frozen=True, kw_only=True)
class Ground:
    """A lens over a plane."""

    lens: Camera | CameraInfoLens
    rotation: np.ndarray
    """ground_from_camera, shape (3, 3)."""
    camera_m: np.ndarray
    """The camera in the ground frame, shape (3,)."""
    ground_frame: str = ''
    camera_frame: str = ''
    covariance: np.ndarray | None = None
    """Of `calibration.COVARIANCE_PARAMETERS`, shape (10, 10); None where it is not known."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.camera_m).all() and np.isfinite(self.rotation).all() and self.camera_m[2] > 0):
            raise InputError(
                f'the camera is {self.camera_m[2]:g} m above the plane z = 0 of the ground, expected more'
                ' than 0: give the transform to the ground frame, whose z axis points up'
            )

    @classmethod
    def from_messages(
        cls, camera_info: Any, ground_transform: Any, *, camera_frame: str = '', rectified: bool = False
    ) -> Ground:
        """Build from a CameraInfo and a TransformStamped between its frame and the ground, either of them the parent.

        `camera_frame` is the frame of the pose where that is not the one of the CameraInfo; `rectified` is for
        pixels of image_proc's image_rect. There is no covariance in messages. Raises InputError.
        """
        camera = (camera_frame or camera_info.header.frame_id).lstrip('/')
        parent, child = ground_transform.header.frame_id.lstrip('/'), ground_transform.child_frame_id.lstrip('/')
        if (parent == camera) == (child == camera):
            raise InputError(
                f"the transform joins '{parent}' and '{child}', and one of the two should be the camera's"
                f" frame '{camera}': take the ground transform of this camera, or say camera_frame"
            )
        rotation, translation = _parse_transform(ground_transform.transform)
        if parent == camera:
            rotation, translation = rotation.T, -rotation.T @ translation
        try:
            lens = CameraInfoLens.of(camera_info, rectified=rectified)
        except InputError as error:
            raise InputError(f'camera_info: {error}') from error
        if rectified:
            rotation = rotation @ np.array([float(value) for value in message_field(camera_info, 'r')]).reshape(3, 3).T
        return cls(
            lens=lens,
            rotation=rotation,
            camera_m=translation,
            camera_frame=camera,
            ground_frame=child if parent == camera else parent,
        )

    @classmethod
    def from_file(cls, path: Path | str) -> Ground:
        """Build from a saved calibration.json, with its covariance; InputError where it holds no ground plane."""
        path = Path(path).expanduser()
        document = read_json(path)
        try:
            return cls.from_document(document)
        except InputError as error:
            raise InputError(f'{path}: {error}') from error

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Ground:
        """Build from the document of calibration.json."""
        return cls.of(calibration_from_json(document))

    @classmethod
    def of(cls, result: Calibration) -> Ground:
        """Build from a calibration; InputError where it holds no ground plane in metres."""
        ground, refusal = result.ground, result.ground_refusal
        if ground is None:
            why = f' ({refusal.code}: {refusal.message}); {refusal.remedy}' if refusal else ''
            raise InputError(f'it holds no ground plane{why}')
        if not ground.metric:
            raise InputError("its plane is in units of the camera's height, not in metres: calibrate with the height")
        return cls(
            lens=result.camera, rotation=ground.rotation, camera_m=ground.translation_m, covariance=result.covariance
        )

    def points(
        self, pixels: np.ndarray, *, height_m: float | np.ndarray = 0.0, pixel_sigma_px: float = 0.0
    ) -> GroundPoints:
        """Return where pixels (n, 2) meet the road, or the plane `height_m` above it: a number, or one each, (n,).

        `pixel_sigma_px` is one sigma of the pixels themselves in x and in y, for `noise_m2`.
        """
        pixels = np.asarray(pixels, float).reshape(-1, 2)
        numbers = np.isfinite(pixels).all(axis=1)
        pixels = np.where(numbers[:, None], pixels, 0.0)
        near = pixels + DIFFERENCE_STEP_PX * np.array(
            [[[0, 0]], [[1, 0]], [[0, 1]]]
        )  # (3, n, 2): the pixel, right, below
        bearings, seen = self.lens.unproject(near.reshape(-1, 2))
        rays = bearings.reshape(3, -1, 3) @ self.rotation.T
        with np.errstate(all='ignore'):  # what is not valid may be anything, and is left out
            reach = (height_m - self.camera_m[2]) / rays[..., 2]
            slope = np.hypot(*(rays[1:, :, 2] - rays[0, :, 2])) / DIFFERENCE_STEP_PX
            valid = numbers & seen.reshape(3, -1).all(axis=0) & (reach[0] > 0)
            valid &= np.abs(rays[0, :, 2]) > MIN_HORIZON_DISTANCE_PX * slope
            places = np.where(valid[:, None], reach[..., None] * rays + self.camera_m, np.nan)
        points = np.column_stack([places[0, :, :2], np.where(valid, height_m, np.nan)])
        by_pixel = (places[1:, :, :2] - places[0, :, :2]) * (pixel_sigma_px / DIFFERENCE_STEP_PX)
        noise = _outer_product_sum(by_pixel) if pixel_sigma_px > 0 else None
        return GroundPoints(
            points_m=points,
            valid=valid,
            covariance_m2=self._calibration_covariance(pixels, height_m, valid),
            noise_m2=noise,
        )

    def pixels(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (n, 2), nan where there are none, of points (n, 3) in the ground frame; and where valid (n,).

        Points (n, 2) are on the road. A pixel may lie outside the image.
        """
        points = np.asarray(points_m, float)
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        bearings = (points - self.camera_m) @ self.rotation  # the row form of R^T (X - t)
        there = np.isfinite(bearings).all(axis=1) & bearings.any(axis=1)
        pixels, valid = self.lens.project(np.where(there[:, None], bearings, [0.0, 0.0, 1.0]))
        return np.where((there & valid)[:, None], pixels, np.nan), there & valid

    @cached_property
    def perturbations(self) -> list[tuple[Camera, np.ndarray, np.ndarray]] | None:
        """Lens, pose and place of the camera on both sides of this one along each axis of the covariance.

        Each is `PERTURBATION_SIGMAS` away; None where the covariance is not known.
        """
        if self.covariance is None or not isinstance(self.lens, Camera):
            return None
        # each row and column by its own sigma: their units have nothing to do with each other
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        axes = (scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))).T[values > 1e-12]
        return [self._perturbed(sign * PERTURBATION_SIGMAS * axis) for axis in axes for sign in (1.0, -1.0)]

    def _perturbed(self, step: np.ndarray) -> tuple[Camera, np.ndarray, np.ndarray]:
        """Lens, ground_from_camera and place of the camera at a step (10,) of `calibration.COVARIANCE_PARAMETERS`.

        The ground frame stays below where the optical axis points to: its heading is chosen, not measured.
        """
        (cx, cy), (k1, k2, k3, k4) = self.lens.principal_point_px, self.lens.k
        lens = replace(
            self.lens,
            focal_px=self.lens.focal_px + step[0],
            principal_point_px=(cx + step[1], cy + step[2]),
            k=(k1 + step[3], k2 + step[4], k3 + step[5], k4 + step[6]),
        )
        normal = self.rotation[2]
        tilt, roll = np.arcsin(np.clip(-normal[2], -1, 1)), np.arctan2(-normal[0], -normal[1])
        tilt, roll = tilt + np.radians(step[7]), roll + np.radians(step[8])
        up = -np.array([np.cos(tilt) * np.sin(roll), np.cos(tilt) * np.cos(roll), np.sin(tilt)])
        in_road = self.rotation @ _ground_axes(normal)
        return lens, in_road @ _ground_axes(up).T, self.camera_m + [0.0, 0.0, step[9]]

    def _calibration_covariance(
        self, pixels: np.ndarray, height_m: float | np.ndarray, valid: np.ndarray
    ) -> np.ndarray | None:
        """Covariance (n, 2, 2) of the places of pixels that the calibration leaves, nan where they are not valid."""
        moved = self.perturbations
        if moved is None:
            return None
        with np.errstate(all='ignore'):  # what is not valid may be anything, and is left out
            places = [
                ((height_m - camera_m[2]) / rays[:, 2])[:, None] * rays[:, :2]
                for lens, rotation, camera_m in moved
                for rays in [lens.unproject(pixels)[0] @ rotation.T]
            ]
            sides = np.reshape(places, (len(places) // 2, 2, len(pixels), 2))
            spread = _outer_product_sum((sides[:, 0] - sides[:, 1]) / (2 * PERTURBATION_SIGMAS))
        spread[~valid] = np.nan
        return spread


def _outer_product_sum(moves: np.ndarray) -> np.ndarray:
    """Covariance (n, 2, 2) of what independent causes of one sigma each move by `moves` (causes, n, 2)."""
    return np.einsum('ani,anj->nij', moves, moves)


def _ground_axes(normal: np.ndarray) -> np.ndarray:
    """Columns (3, 3), camera frame: where the optical axis points to on the ground, to the left of it, and up."""
    ahead = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    return np.column_stack([ahead, np.cross(normal, ahead), normal])


def _parse_transform(transform: Any) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and translation (3,) of an object with the attributes of geometry_msgs/Transform."""
    turn, shift = transform.rotation, transform.translation
    quaternion = np.array([float(turn.x), float(turn.y), float(turn.z), float(turn.w)])
    if not abs(np.linalg.norm(quaternion) - 1.0) < QUATERNION_TOLERANCE:
        raise InputError(
            f'the rotation of the transform has the length {np.linalg.norm(quaternion):.6g}, expected 1:'
            ' it is no rotation, so its sender is at fault'
        )
    return Rotation.from_quat(quaternion).as_matrix(), np.array([float(shift.x), float(shift.y), float(shift.z)])

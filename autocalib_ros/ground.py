"""Pixels to points on the road and back, from calibration.json or from the node's two messages.

    ground = Ground.from_messages(camera_info, ground_transform)
    found = ground.points(pixels)       # pixels (n, 2) -> found.points_m (n, 3), found.valid (n,)
    pixels, valid = ground.pixels(found.points_m)

Pixel (0, 0) is the centre of the top-left pixel of the images as delivered, neither rectified nor scaled. Ground frame:
z up, the road at z = 0, metres. Nothing here needs ROS: a message is any object with the attributes of one.
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
from autocalib_ros.results.calibration_json import calibration_from_json, read_json_object

MIN_HORIZON_DISTANCE_PX = 1.0
"""Minimum distance in pixels from the horizon of the requested plane: closer pixels are invalid, since the next one
shows no ground at all and their distance is unknown."""
DIFFERENCE_STEP_PX = 1e-3
"""Step in pixels of numerical derivatives."""
PERTURBATION_SIGMAS = 0.01
"""Step of lens and pose, in standard deviations, of numerical derivatives: small enough to be linear."""
QUATERNION_TOLERANCE = 1e-3
"""Maximum deviation of a quaternion from unit length."""


@dataclass(frozen=True, kw_only=True)
class GroundPoints:
    """Ground points of pixels, in the order of the pixels."""

    points_m: np.ndarray
    """Points in the ground frame, shape (n, 3); nan where invalid."""
    valid: np.ndarray
    """False at and above the horizon, and where the lens has no bearing; shape (n,)."""
    covariance_m2: np.ndarray | None
    """Covariance of x and y due to the calibration, shape (n, 2, 2); None if unknown. The error is systematic: it
    moves all points in all images together, so no filter averages it out."""
    noise_m2: np.ndarray | None
    """Covariance of x and y due to pixel noise, shape (n, 2, 2), for filters; None without `pixel_sigma_px`."""

    @property
    def sigma_m(self) -> np.ndarray | None:
        """Standard deviation of the positions in metres, shape (n,); None if the calibration has no covariance."""
        if self.covariance_m2 is None:
            return None
        whole = self.covariance_m2 if self.noise_m2 is None else self.covariance_m2 + self.noise_m2
        return np.sqrt(np.trace(whole, axis1=1, axis2=2))


@dataclass(frozen=True, kw_only=True)
class Ground:
    """A lens above a ground plane."""

    lens: Camera | CameraInfoLens
    rotation: np.ndarray
    """ground_from_camera, shape (3, 3)."""
    camera_m: np.ndarray
    """Camera position in the ground frame, shape (3,)."""
    ground_frame: str = ''
    camera_frame: str = ''
    covariance: np.ndarray | None = None
    """Covariance of `calibration.COVARIANCE_PARAMETERS`, shape (10, 10); None if unknown."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.camera_m).all() and np.isfinite(self.rotation).all() and self.camera_m[2] > 0):
            raise InputError(
                f'the camera is {self.camera_m[2]:g} m above the ground plane z = 0, expected more'
                ' than 0: give the transform to the ground frame, whose z axis points up'
            )

    @classmethod
    def from_messages(
        cls, camera_info: Any, ground_transform: Any, *, camera_frame: str = '', rectified: bool = False
    ) -> Ground:
        """Return the ground of a CameraInfo and a TransformStamped between camera and ground, either as the parent.

        `camera_frame` is the frame of the pose if it differs from that of the CameraInfo. `rectified` is for pixels
        of image_proc's image_rect. Messages carry no covariance. InputError if they are invalid or do not match.
        """
        camera = (camera_frame or camera_info.header.frame_id).lstrip('/')
        parent, child = ground_transform.header.frame_id.lstrip('/'), ground_transform.child_frame_id.lstrip('/')
        if (parent == camera) == (child == camera):
            raise InputError(
                f"the transform joins '{parent}' and '{child}', but not the camera's frame '{camera}':"
                ' give the ground transform of this camera, or camera_frame'
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
        """Return the ground of a calibration.json, with its covariance; InputError if it has no ground plane."""
        path = Path(path).expanduser()
        document = read_json_object(path)
        try:
            return cls.from_document(document)
        except InputError as error:
            raise InputError(f'{path}: {error}') from error

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Ground:
        """Return the ground of the document of a calibration.json."""
        return cls.of(calibration_from_json(document))

    @classmethod
    def of(cls, result: Calibration) -> Ground:
        """Return the ground of a calibration; InputError if it has no ground plane in metres."""
        ground, refusal = result.ground, result.ground_refusal
        if ground is None:
            why = f' ({refusal.code}: {refusal.message}); {refusal.remedy}' if refusal else ''
            raise InputError(f'it has no ground plane{why}')
        if not ground.metric:
            raise InputError(
                "its plane is in units of the camera's height, not in metres: give the height to calibrate"
            )
        return cls(
            lens=result.camera, rotation=ground.rotation, camera_m=ground.translation_m, covariance=result.covariance
        )

    def points(
        self, pixels: np.ndarray, *, height_m: float | np.ndarray = 0.0, pixel_sigma_px: float = 0.0
    ) -> GroundPoints:
        """Return where pixels (n, 2) meet the road, or the plane `height_m` above it: one number, or one each, (n,).

        `pixel_sigma_px` is the standard deviation of the pixels in x and in y, for `noise_m2`.
        """
        pixels = np.asarray(pixels, float).reshape(-1, 2)
        numbers = np.isfinite(pixels).all(axis=1)
        pixels = np.where(numbers[:, None], pixels, 0.0)
        steps = np.array([[[0, 0]], [[1, 0]], [[0, 1]]])  # the pixel, to the right, below: (3, n, 2)
        near = pixels + DIFFERENCE_STEP_PX * steps
        bearings, seen = self.lens.unproject(near.reshape(-1, 2))
        rays = bearings.reshape(3, -1, 3) @ self.rotation.T
        with np.errstate(all='ignore'):  # invalid pixels may give anything, and are masked
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
        """Return pixels (n, 2) of points (n, 3) in the ground frame, nan where invalid, and which are valid (n,).

        Points (n, 2) are on the road. A valid pixel may lie outside the image.
        """
        points = np.asarray(points_m, float)
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        bearings = (points - self.camera_m) @ self.rotation  # row form of R^T (X - t)
        there = np.isfinite(bearings).all(axis=1) & bearings.any(axis=1)
        pixels, valid = self.lens.project(np.where(there[:, None], bearings, [0.0, 0.0, 1.0]))
        return np.where((there & valid)[:, None], pixels, np.nan), there & valid

    @cached_property
    def perturbations(self) -> list[tuple[Camera, np.ndarray, np.ndarray]] | None:
        """Lens, pose and camera position moved to both sides along each principal axis of the covariance.

        The steps are `PERTURBATION_SIGMAS`. None if the covariance is unknown.
        """
        if self.covariance is None or not isinstance(self.lens, Camera):
            return None
        # scaled by the standard deviations, since the parameters have different units
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        axes = (scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))).T[values > 1e-12]
        return [self._perturbed(sign * PERTURBATION_SIGMAS * axis) for axis in axes for sign in (1.0, -1.0)]

    def _perturbed(self, step: np.ndarray) -> tuple[Camera, np.ndarray, np.ndarray]:
        """Return lens, ground_from_camera and camera position after a step (10,) of `COVARIANCE_PARAMETERS`.

        The ground frame keeps its x axis relative to the optical axis: its heading is a convention, not an estimate.
        """
        if not isinstance(self.lens, Camera):
            raise TypeError('only a Camera has a covariance')
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
        return lens, in_road @ _ground_axes(up).T, self.camera_m + np.array([0.0, 0.0, step[9]])

    def _calibration_covariance(
        self, pixels: np.ndarray, height_m: float | np.ndarray, valid: np.ndarray
    ) -> np.ndarray | None:
        """Return the covariance (n, 2, 2) of ground points due to the calibration, nan where invalid."""
        moved = self.perturbations
        if moved is None:
            return None
        with np.errstate(all='ignore'):  # invalid pixels may give anything, and are masked
            places = [
                points_from_foot(lens, rotation, camera_m, pixels, height_m) for lens, rotation, camera_m in moved
            ]
            sides = np.reshape(places, (len(places) // 2, 2, len(pixels), 2))
            spread = _outer_product_sum((sides[:, 0] - sides[:, 1]) / (2 * PERTURBATION_SIGMAS))
        spread[~valid] = np.nan
        return spread


def points_from_foot(
    lens: Camera, rotation: np.ndarray, camera_m: np.ndarray, pixels: np.ndarray, height_m: float | np.ndarray = 0.0
) -> np.ndarray:
    """Return where the rays of pixels (n, 2) are at a height over the road, from the foot of the camera, (n, 2)."""
    rays = lens.unproject(pixels)[0] @ rotation.T
    return np.asarray(((height_m - camera_m[2]) / rays[:, 2])[:, None] * rays[:, :2])


def _outer_product_sum(moves: np.ndarray) -> np.ndarray:
    """Return the covariance (n, 2, 2) of independent causes that each move points by `moves` (causes, n, 2)."""
    return np.einsum('ani,anj->nij', moves, moves)


def _ground_axes(normal: np.ndarray) -> np.ndarray:
    """Return forward, left and up of the ground as columns (3, 3) in the camera frame; forward is the optical axis."""
    ahead = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    return np.column_stack([ahead, np.cross(normal, ahead), normal])


def _parse_transform(transform: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (3, 3) and translation (3,) of an object with the attributes of geometry_msgs/Transform."""
    turn, shift = transform.rotation, transform.translation
    quaternion = np.array([float(turn.x), float(turn.y), float(turn.z), float(turn.w)])
    if not abs(np.linalg.norm(quaternion) - 1.0) < QUATERNION_TOLERANCE:
        raise InputError(
            f'the rotation of the transform has the length {np.linalg.norm(quaternion):.6g}, expected 1:'
            ' its sender publishes no unit quaternion'
        )
    return Rotation.from_quat(quaternion).as_matrix(), np.array([float(shift.x), float(shift.y), float(shift.z)])

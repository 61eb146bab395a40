"""The results as values, and their files."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import CameraInfo, camera_info
from autocalib_ros.util.files import write_atomically

JSON_VERSION = 1
GROUND_DISTANCES_M = (10.0, 20.0, 40.0)
"""Distances from the camera's foot at which the accuracy on the road is told."""
COVARIANCE_OF = ('focal_px', 'principal_point_x_px', 'principal_point_y_px', 'k1', 'k2', 'k3', 'k4', 'tilt_deg',
                 'roll_deg', 'height_m')
"""Rows and columns of the covariance."""


@dataclass(frozen=True, kw_only=True)
class EvidenceSummary:
    """What a result rests on."""

    image_size: tuple[int, int]
    seconds: float
    frames: int
    tracks: int
    segments: int
    vehicles: int
    coverage: float
    people: int = 0
    """Of those that moved, who walks, not counted in `vehicles`: as far as a detector, or else lens and plane tell."""


@dataclass(frozen=True)
class Transform:
    """Takes coordinates in the frame `child` to coordinates in the frame `parent`; metres, unit quaternion (4,)."""

    parent: str
    child: str
    translation_m: np.ndarray
    rotation_xyzw: np.ndarray


@dataclass(frozen=True)
class GroundPlane:
    """The pose of the camera over the road: a point in the camera optical frame goes to the ground frame.

    Ground frame: origin at the camera's foot point on the road, z up, x along the dominant traffic
    direction, y left. `rotation` is ground_from_camera, shape (3, 3); `height_m` is in metres, or 1 when
    `metric` is false: then all lengths are in units of the camera's height.
    """

    rotation: np.ndarray
    height_m: float
    metric: bool = True

    @property
    def translation_m(self) -> np.ndarray:
        """The camera in the ground frame, shape (3,)."""
        return np.array([0.0, 0.0, self.height_m])

    @property
    def rotation_xyzw(self) -> np.ndarray:
        """The rotation as a unit quaternion x, y, z, w with w >= 0, shape (4,)."""
        return quaternion_xyzw(self.rotation)

    @property
    def normal_in_camera(self) -> np.ndarray:
        """Unit vector up from the road in the camera optical frame, shape (3,)."""
        return self.rotation[2]

    def transform(self, ground_frame: str, camera_frame: str, tf_parent: str) -> Transform:
        """Return the pose with the 'ground' or the 'camera' as the parent: the same pose, told from either end."""
        if tf_parent == 'ground':
            return Transform(ground_frame, camera_frame, self.translation_m, self.rotation_xyzw)
        back = self.rotation.T
        return Transform(camera_frame, ground_frame, -back @ self.translation_m, quaternion_xyzw(back))


@dataclass(frozen=True, kw_only=True)
class StandardDeviations:
    """One sigma of what is published; None where it is not estimated."""

    focal_px: float | None = None
    principal_point_px: tuple[float, float] | None = None
    k1: float | None = None
    tilt_deg: float | None = None
    roll_deg: float | None = None
    height_m: float | None = None
    k2: float | None = None
    ground_point_m: tuple[float | None, ...] = ()
    """Of where a pixel meets the road straight ahead, `GROUND_DISTANCES_M` away; None outside the image."""


@dataclass(frozen=True, kw_only=True)
class PaperReport:
    """Quantities of the published method, reported whichever method gave the result."""

    focal_px: float
    polynomial_k: tuple[float, float, float]
    straightness_px2: tuple[float, float]
    """Mean squared line-fit error per track before and after undistortion (the paper's table 2)."""
    focal_from_vanishing_points_px: float | None = None
    """The paper's f_new."""
    translation_m: tuple[float, float, float] | None = None
    """The paper's t = (0, 0, H / |r33|), whose origin is where the optical axis meets the road."""


@dataclass(frozen=True)
class Residuals:
    """How far what a solution rests on lies from where the solution has it, in observed pixels."""

    points_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    """Observed pixels, shape (n, 2)."""
    distance_px: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    """From the path along a road, or from the place on a vehicle that turns, shape (n,)."""
    roads: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int8))
    """Index of the road direction, -1 for a vehicle that turns, shape (n,)."""


@dataclass(frozen=True, kw_only=True)
class Figures:
    """What a report draws; not part of a result's identity and not written to calibration.json."""

    focal_sweep_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """Trial focal length and its error, shape (n, 2)."""
    track_labels: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """For each track of the evidence: -1 not used, -2 rejected, else the index of its road direction."""
    orientation_histogram: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """Orientation in degrees and the number of segments, shape (n, 2)."""
    orientation_peaks_deg: tuple[float, ...] = ()
    paper_tracks: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """Indices of the tracks that the published method keeps."""
    residuals: Residuals = field(default_factory=Residuals)
    """Of the robust method; none for the published one."""


@dataclass(frozen=True)
class Reason:
    """Why something is not given: a code for programs, numbers in words, and what to do."""

    code: str
    message: str
    remedy: str


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """No calibration, and why. It is false, so that `if result:` asks whether there is a calibration."""

    code: str
    message: str
    remedy: str
    method: str
    evidence: EvidenceSummary
    figures: Figures = field(default_factory=Figures, compare=False, repr=False)

    def __bool__(self) -> bool:
        return False

    @classmethod
    def because(cls, reason: Reason, method: str, evidence: EvidenceSummary, figures: Figures) -> Refusal:
        """Make a refusal of a reason."""
        return cls(code=reason.code, message=reason.message, remedy=reason.remedy, method=method, evidence=evidence,
                   figures=figures)


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A lens, and the ground plane where the evidence and the height give one."""

    method: str
    grade: str
    """'full': lens and metric ground plane; 'assumed': the same, where the plane rests on an assumption that was
    allowed; 'unit_scale': the plane in units of the height; 'lens': no plane."""
    assumptions: tuple[str, ...]
    """What was taken for granted, in words."""
    checks: tuple[str, ...] = ()
    """What was measured or cross-checked, in words."""
    camera: Camera
    ground: GroundPlane | None
    ground_refusal: Reason | None
    """Why there is no ground plane, where there is none."""
    road_directions: np.ndarray
    """Unit vectors in the camera optical frame, shape (n, 3)."""
    stddev: StandardDeviations
    covariance: np.ndarray | None = field(default=None, compare=False, repr=False)
    """Of `COVARIANCE_OF`, shape (10, 10), where there is a ground plane in metres and it is estimated."""
    paper: PaperReport | None
    evidence: EvidenceSummary
    newest_stamp_ns: int
    """Stamp of the newest image that the result rests on."""
    distortion_model: str = 'auto'
    rectified_balance: float = 0.0
    figures: Figures = field(default_factory=Figures, compare=False, repr=False)

    @cached_property
    def camera_info(self) -> CameraInfo:
        """The lens as ROS knows it; ModelMisfit where the distortion model cannot say it."""
        return camera_info(self.camera, self.distortion_model, self.rectified_balance)


def quaternion_xyzw(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion x, y, z, w (w >= 0) of a rotation matrix (3, 3)."""
    quaternion = Rotation.from_matrix(rotation).as_quat()
    return quaternion if quaternion[3] >= 0 else -quaternion


def to_json(result: Calibration | Refusal, *, accepted_at_s: float | None = None) -> dict[str, Any]:
    """Return the document of calibration.json, version 1."""
    evidence = result.evidence
    document: dict[str, Any] = {
        'version': JSON_VERSION, 'state': 'calibrated' if result else 'refused', 'grade': None,
        'method': result.method, 'assumptions': [], 'checks': [], 'refusal': None,
        'image_size': list(evidence.image_size),
        'camera': None, 'camera_info': None, 'ground_from_camera': None, 'road_directions_in_camera': [],
        'stddev': None, 'covariance': None, 'paper': None, 'newest_stamp_ns': None,
        'evidence': {'seconds': evidence.seconds, 'frames': evidence.frames, 'tracks': evidence.tracks,
                     'segments': evidence.segments, 'vehicles': evidence.vehicles,
                     'people': evidence.people, 'coverage': evidence.coverage, 'accepted_at_s': accepted_at_s}}
    if isinstance(result, Refusal):
        document['refusal'] = _refusal_json(result)
    else:
        document.update(_calibration_json(result))
    return document


def _refusal_json(refusal: Refusal | Reason) -> dict[str, str]:
    return {'code': refusal.code, 'message': refusal.message, 'remedy': refusal.remedy}


def _calibration_json(result: Calibration) -> dict[str, Any]:
    camera, info, sigma = result.camera, result.camera_info, result.stddev
    return {
        'grade': result.grade, 'assumptions': list(result.assumptions), 'checks': list(result.checks),
        'refusal': _refusal_json(result.ground_refusal) if result.ground_refusal else None,
        'camera': {'model': 'kannala_brandt', 'focal_px': camera.focal_px,
                   'principal_point_px': list(camera.principal_point_px), 'k': list(camera.k)},
        'camera_info': {'distortion_model': info.distortion_model, 'k': info.k, 'd': info.d, 'r': info.r,
                        'p': info.p},
        'ground_from_camera': None if result.ground is None else {
            'translation_m': result.ground.translation_m.tolist(),
            'rotation_xyzw': result.ground.rotation_xyzw.tolist(),
            'rotation': np.asarray(result.ground.rotation).tolist()},
        'newest_stamp_ns': result.newest_stamp_ns,
        'road_directions_in_camera': np.asarray(result.road_directions).tolist(),
        'stddev': {'focal_px': sigma.focal_px,
                   'principal_point_px': None if sigma.principal_point_px is None else list(sigma.principal_point_px),
                   'k1': sigma.k1, 'tilt_deg': sigma.tilt_deg, 'roll_deg': sigma.roll_deg,
                   'height_m': sigma.height_m, 'k2': sigma.k2,
                   'ground_point_m': {f'{distance:g}': value for distance, value in zip(
                       GROUND_DISTANCES_M, sigma.ground_point_m, strict=False)}},
        'covariance': None if result.covariance is None else {
            'of': list(COVARIANCE_OF), 'matrix': result.covariance.tolist()},
        'paper': None if result.paper is None else {
            'focal_px': result.paper.focal_px, 'polynomial_k': list(result.paper.polynomial_k),
            'straightness_px2': dict(zip(('before', 'after'), result.paper.straightness_px2, strict=True)),
            'focal_from_vanishing_points_px': result.paper.focal_from_vanishing_points_px,
            'translation_m': None if result.paper.translation_m is None else list(result.paper.translation_m)}}


def calibration_json(result: Calibration | Refusal, *, accepted_at_s: float | None = None) -> str:
    """Return the text of calibration.json in full precision."""
    return json.dumps(to_json(result, accepted_at_s=accepted_at_s), indent=1, allow_nan=False)


def write_calibration_json(path: Path, result: Calibration | Refusal, *, accepted_at_s: float | None = None) -> None:
    """Write calibration.json, atomically."""
    write_atomically(path, calibration_json(result, accepted_at_s=accepted_at_s) + '\n')

"""The results as values, and their files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import CameraInfo, camera_info
from autocalib_ros.results.refusals import Reason
from autocalib_ros.results.statements import Statement, Value

GROUND_DISTANCES_M = (10.0, 20.0, 40.0)
"""Distances from the camera's foot at which the accuracy on the road is told."""
COVARIANCE_PARAMETERS = (
    'focal_px',
    'principal_point_x_px',
    'principal_point_y_px',
    'k1',
    'k2',
    'k3',
    'k4',
    'tilt_deg',
    'roll_deg',
    'height_m',
)
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


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """No calibration, and why. It is false, so that `if result:` asks whether there is a calibration."""

    code: str
    """One of `refusals.REFUSALS`."""
    message: str
    remedy: str
    method: str
    evidence: EvidenceSummary
    values: Mapping[str, Value] = field(default_factory=dict, compare=False)
    """The numbers of the message and the limit that they missed."""
    figures: Figures = field(default_factory=Figures, compare=False, repr=False)

    def __bool__(self) -> bool:
        return False

    @classmethod
    def from_reason(cls, reason: Reason, method: str, evidence: EvidenceSummary, figures: Figures) -> Refusal:
        """Return the refusal for a reason."""
        return cls(
            code=reason.code,
            message=reason.message,
            remedy=reason.remedy,
            values=reason.values,
            method=method,
            evidence=evidence,
            figures=figures,
        )


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A lens, and the ground plane where the evidence and the height give one."""

    method: str
    grade: str
    """'full': lens and metric ground plane; 'assumed': the same, where the plane rests on an assumption that was
    allowed; 'unit_scale': the plane in units of the height; 'lens': no plane."""
    assumptions: tuple[Statement, ...]
    """What was assumed, of `statements.ASSUMPTIONS`."""
    checks: tuple[Statement, ...] = ()
    """What was measured or cross-checked, of `statements.CHECKS`."""
    camera: Camera
    ground: GroundPlane | None
    ground_refusal: Reason | None
    """Why there is no ground plane, where there is none."""
    road_directions: np.ndarray
    """Unit vectors in the camera optical frame, shape (n, 3)."""
    stddev: StandardDeviations
    covariance: np.ndarray | None = field(default=None, compare=False, repr=False)
    """Of `COVARIANCE_PARAMETERS`, shape (10, 10), where there is a ground plane in metres and it is estimated."""
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

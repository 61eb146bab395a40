"""Results as values: a calibration or a refusal, with its evidence, uncertainty and figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import CameraInfo, camera_info
from autocalib_ros.results.grades import GroundSigma, HelpfulMeasure
from autocalib_ros.results.refusals import Reason
from autocalib_ros.results.statements import Statement, Value
from autocalib_ros.results.verification_table import VerificationRow

GRADED_DISTANCE_M = 20.0
"""Distance from the camera's foot point at which the certainty of lengths is graded."""
GROUND_DISTANCES_M = (10.0, 20.0, 40.0)
"""Distances from the camera's foot point at which the sigma of a road point is given."""
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
    """Size of the evidence behind a result."""

    image_size: tuple[int, int]
    seconds: float
    frames: int
    tracks: int
    segments: int
    vehicles: int
    coverage: float
    people: int = 0
    """Pedestrians and cyclists, not counted in `vehicles`: classified by a detector, or by size and speed."""


@dataclass(frozen=True, kw_only=True)
class StandardDeviations:
    """One standard deviation of each published number; None if it is not estimated."""

    focal_px: float | None = None
    principal_point_px: tuple[float, float] | None = None
    k1: float | None = None
    tilt_deg: float | None = None
    roll_deg: float | None = None
    height_m: float | None = None
    k2: float | None = None
    ground_point_m: tuple[float | None, ...] = ()
    """Of the road point of a pixel straight ahead, at each of `GROUND_DISTANCES_M`; None outside the image."""
    ground: GroundSigma | None = None
    """Of short lengths on the road about `GRADED_DISTANCE_M` ahead, relative; it decides the grade."""


@dataclass(frozen=True, kw_only=True)
class PaperReport:
    """Quantities of the published method (Jain & Saunier 2020), reported with the result of either method."""

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
    """Residuals of a solution in observed pixels."""

    points_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    """Observed pixels, shape (n, 2)."""
    distance_px: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    """Distance from the path along a road, or from the position on a turning vehicle, shape (n,)."""
    roads: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int8))
    """Index of the road direction, -1 for a turning vehicle, shape (n,)."""


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Data of the report's figures; not compared, and not written to calibration.json."""

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
    """Of method joint; empty for the published method."""


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
    candidate: Calibration | None = field(default=None, compare=False, repr=False)
    """What was found but is too uncertain to be accepted."""
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
    """A lens, and the ground plane if evidence and scale give one."""

    method: str
    grade: str
    """One of `grades.GRADES`. Of a metric plane by its `GroundSigma`; at most 'fair' if it rests on an assumption or a
    check contradicts it. 'unit_scale': the plane in units of the camera height; 'lens': no plane."""
    assumptions: tuple[Statement, ...]
    """What was assumed: kinds of `statements.ASSUMPTIONS`."""
    checks: tuple[Statement, ...] = ()
    """What was measured or cross-checked: kinds of `statements.CHECKS`."""
    verification: tuple[VerificationRow, ...] = ()
    """The verification table: each check with its value and limit. Empty for method paper, which has none."""
    camera: Camera
    ground: GroundPlane | None
    ground_refusal: Reason | None
    """Why there is no ground plane; None if there is one."""
    road_directions: np.ndarray
    """Unit vectors in the camera optical frame, shape (n, 3)."""
    stddev: StandardDeviations
    helpful: HelpfulMeasure | None = field(default=None, compare=False)
    """The one further measure that would help most; None if there is none, or grade full without it."""
    covariance: np.ndarray | None = field(default=None, compare=False, repr=False)
    """Of `COVARIANCE_PARAMETERS`, shape (10, 10); None without a metric ground plane or an estimate."""
    paper: PaperReport | None
    evidence: EvidenceSummary
    newest_stamp_ns: int
    """Stamp of the newest image in the evidence."""
    distortion_model: str = 'auto'
    rectified_balance: float = 0.0
    figures: Figures = field(default_factory=Figures, compare=False, repr=False)

    @property
    def candidate(self) -> Calibration:
        """The calibration itself: what a refusal holds if it is too uncertain to be accepted."""
        return self

    @cached_property
    def camera_info(self) -> CameraInfo:
        """The lens as CameraInfo; raises ModelMisfit if the distortion model cannot represent it."""
        return camera_info(self.camera, self.distortion_model, self.rectified_balance)

"""Calibrations with every field set, and a folder to store them in."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import camera_info
from autocalib_ros.results.calibration import (
    COVARIANCE_PARAMETERS,
    Calibration,
    EvidenceSummary,
    PaperReport,
    StandardDeviations,
)
from autocalib_ros.results.statements import assumption, check
from autocalib_ros.results.store import StoredCalibration
from autocalib_ros.results.verification_table import verified

SIZE = (640, 360)
LOOKS_ALONG = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""ground_from_camera of a level camera that looks along the road."""


def calibration(
    focal_px: float = 300.0,
    *,
    tilt_deg: float = 12.3,
    roll_deg: float = 0.7,
    height_m: float = 8.1,
    sigmas: float = 1.0,
    number: int = 0,
) -> Calibration:
    """Return a calibration whose stated deviations are `sigmas` times 1 px, 0.2 degrees and 0.05 m."""
    pitched = LOOKS_ALONG @ Rotation.from_euler('xz', [-tilt_deg, roll_deg], degrees=True).as_matrix()
    camera = Camera(*SIZE, focal_px, (319.1 + 1 / 3, 179.7), (0.01 + 1e-17, -0.002, 1e-9, 0.0))
    return Calibration(
        method='joint',
        grade='full',
        assumptions=(
            assumption('paper_roads'),
            assumption('scale_height', given_m=8.1, given_sigma_m=0.0),
        ),
        checks=(check('halves', focal=0.004, normal_deg=0.2),),
        verification=(verified('halves_focal', 0.004, 0.03), verified('lane_markings', 0.1 + 0.2, 0.5)),
        camera=camera,
        ground=GroundPlane(pitched, height_m),
        ground_refusal=None,
        road_directions=pitched[:, :2].T.copy(),
        stddev=StandardDeviations(
            focal_px=sigmas,
            principal_point_px=(2.1 * sigmas, 1.9 * sigmas),
            k1=0.004 * sigmas,
            k2=0.001 * sigmas,
            tilt_deg=0.2 * sigmas,
            roll_deg=0.21 * sigmas,
            height_m=0.05 * sigmas,
            ground_point_m=(0.11, 0.3, None),
        ),
        paper=PaperReport(
            focal_px=288.8,
            polynomial_k=(0.1, 0.2, 0.3),
            straightness_px2=(1.5, 0.4),
            focal_from_vanishing_points_px=None,
            translation_m=(0.0, 0.0, 38.0),
        ),
        evidence=EvidenceSummary(
            image_size=SIZE, seconds=61.7, frames=number, tracks=300, segments=4000, vehicles=70, coverage=0.61
        ),
        newest_stamp_ns=1_700_000_000_123_456_789,
        covariance=sigmas**2 * np.cov(np.random.default_rng(number).normal(size=(len(COVARIANCE_PARAMETERS), 40))),
    )


def lens_only(result: Calibration) -> Calibration:
    return replace(
        result,
        grade='lens',
        ground=None,
        covariance=None,
        stddev=replace(result.stddev, tilt_deg=None, roll_deg=None, height_m=None, ground_point_m=()),
    )


def stored(result: Calibration) -> StoredCalibration:
    return StoredCalibration(result, camera_info(result.camera), 'north', 'cam_optical')


@contextmanager
def quick_folder() -> Iterator[Path]:
    """Yield a folder in memory if possible: on a busy disk each save waits for other data."""
    memory = Path('/dev/shm')
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as folder:
        yield Path(folder)

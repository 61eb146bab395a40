"""A camera over a road that the tests of pictures share."""

import numpy as np
import pytest

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import Calibration, EvidenceSummary, StandardDeviations


def looking_down(dip_deg: float) -> GroundPlane:
    """A camera 8 m up that looks down along x."""
    dip = np.radians(dip_deg)
    ahead = np.array([np.cos(dip), 0.0, -np.sin(dip)])
    right = np.array([0.0, -1.0, 0.0])
    return GroundPlane(np.column_stack([right, np.cross(ahead, right), ahead]), 8.0)


def calibration(camera: Camera, ground: GroundPlane | None, **more) -> Calibration:
    evidence = EvidenceSummary(
        image_size=(camera.width, camera.height),
        seconds=60.0,
        frames=900,
        tracks=100,
        segments=0,
        vehicles=20,
        coverage=0.5,
    )
    return Calibration(
        method='joint',
        grade='lens' if ground is None else 'full',
        assumptions=(),
        camera=camera,
        ground=ground,
        ground_refusal=None,
        road_directions=np.zeros((0, 3)),
        stddev=StandardDeviations(focal_px=1.0),
        paper=None,
        evidence=evidence,
        newest_stamp_ns=1,
        **more,
    )


@pytest.fixture(name='calibration')
def fixture_calibration():
    """Return the function that makes a calibration of a lens and a plane."""
    return calibration


@pytest.fixture(name='looking_down')
def fixture_looking_down():
    """Return the function that makes a plane of a dip."""
    return looking_down


@pytest.fixture
def camera() -> Camera:
    return Camera(640, 480, 300.0, (322.0, 236.0), (0.01, 0.0, 0.0, 0.0))


@pytest.fixture
def ground() -> GroundPlane:
    return looking_down(30.0)


@pytest.fixture
def calibrated(camera, ground) -> Calibration:
    return calibration(camera, ground)


@pytest.fixture
def lens_only(camera) -> Calibration:
    return calibration(camera, None)

"""Views are read as they were written, for their own calibration only; a damaged file is refused."""

from __future__ import annotations

import stat
from pathlib import Path

import numpy as np
import pytest

from autocalib_ros.errors import InputError
from autocalib_ros.perception.view_file import read_views, write_views
from autocalib_ros.perception.view_registration import ViewPose
from autocalib_ros.perception.view_watch import KnownView
from autocalib_ros.results.camera_move import rotation_from_turn

IMAGE = np.random.default_rng(0).integers(0, 255, (36, 64), np.uint8)
TURNED = ViewPose(rotation_from_turn(np.array([0.01, 0.0, 0.02])), 0.0, 1e-8 * np.eye(4))
VIEWS = (KnownView(IMAGE, None, TURNED), KnownView(IMAGE[::-1].copy(), (IMAGE > 200).astype(np.uint8)))


def test_views_are_read_as_they_were_written(quick_path: Path) -> None:
    path = quick_path / 'cam.view.npz'
    write_views(path, 'this', VIEWS)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600  # nobody else reads pictures of the street
    for kept, read in zip(VIEWS, read_views(path, 'this'), strict=True):
        np.testing.assert_array_equal(read.image, kept.image)
        np.testing.assert_array_equal(read.pose.rotation, kept.pose.rotation)
        assert (read.ignored is None) == (kept.ignored is None)


def test_views_of_another_calibration_are_not_used(quick_path: Path) -> None:
    path = quick_path / 'cam.view.npz'
    assert read_views(path, 'this') == ()
    write_views(path, 'this', VIEWS)
    assert read_views(path, 'that') == ()


def test_damaged_file_is_refused(quick_path: Path) -> None:
    path = quick_path / 'cam.view.npz'
    path.write_bytes(b'PK\x03\x04 torn')
    with pytest.raises(InputError, match='cannot be read'):
        read_views(path, 'this')
    np.savez(path, belongs_to='this', images=IMAGE, ignored=IMAGE, rotations=np.eye(3), covariances=np.eye(4))
    with pytest.raises(InputError, match='no file of views'):
        read_views(path, 'this')

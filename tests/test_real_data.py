"""Rendered scenes with exact truth and real clips, where the machine has them."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from autocalib_ros.calibration import Calibration, Refusal
from autocalib_ros.config import Options
from autocalib_ros.offline.replay import replay
from autocalib_ros.offline.sources import open_source

DATA = Path(os.environ.get('AUTOCALIB_TEST_DATA', '')) / 'data'
pytestmark = [pytest.mark.slow, pytest.mark.skipif(
    'AUTOCALIB_TEST_DATA' not in os.environ or not DATA.is_dir(),
    reason='AUTOCALIB_TEST_DATA does not name a folder with recorded clips')]


def result_of(clip: Path, height_m: float, duration_s: float | None = None) -> Calibration | Refusal:
    return replay(open_source(clip, duration_s=duration_s), Options(camera_height=height_m)).result


def test_a_rendered_junction_is_calibrated_within_three_per_cent_and_one_degree() -> None:
    scene = DATA / 'scenes' / 'S2'
    truth = json.loads((scene / 'truth.json').read_text())
    result = result_of(scene / 'video.mp4', truth['camera']['height'])
    assert isinstance(result, Calibration) and result.ground is not None
    assert result.camera.focal_px == pytest.approx(truth['lens']['f'], rel=0.03)
    normal = np.array(truth['camera']['R_world_from_camera'])[2]
    assert np.degrees(np.arccos(result.ground.normal_in_camera @ normal)) < 1.0


def test_a_hand_held_camera_is_refused() -> None:
    result = result_of(DATA / 'real' / 'NEG_shaky_1280x720' / 'traffic.mp4', 8.0)
    assert isinstance(result, Refusal) and result.code == 'camera_moving'


@pytest.mark.parametrize('clip', ['highway_curve_640x360_11s/highway.mp4',
                                  'jamcam_a13_352x288/625_201709211326.mp4',
                                  'otvision_dresden/Testvideo_Cars-Truck_FR20_2020-01-01_00-00-00.mp4'])
def test_real_clips_that_say_too_little_are_refused_with_a_remedy(clip: str) -> None:
    result = result_of(DATA / 'real' / clip, 8.0)
    assert isinstance(result, Refusal)
    assert result.message and result.remedy

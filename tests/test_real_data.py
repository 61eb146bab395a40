"""Rendered scenes with exact truth and real clips, where the machine has them."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from autocalib_ros.config import DetectorOptions, Options
from autocalib_ros.evidence.snapshot import TrackKind
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.replay_recording import replay
from autocalib_ros.perception.detector.detector import open_detector
from autocalib_ros.results.calibration import Calibration, Refusal

DATA = Path(os.environ.get('AUTOCALIB_TEST_DATA', '')) / 'data'
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        'AUTOCALIB_TEST_DATA' not in os.environ or not DATA.is_dir(),
        reason='AUTOCALIB_TEST_DATA does not name a folder with recorded clips',
    ),
]


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


@pytest.mark.parametrize(
    'clip',
    [
        'highway_curve_640x360_11s/highway.mp4',
        'jamcam_a13_352x288/625_201709211326.mp4',
        'otvision_dresden/Testvideo_Cars-Truck_FR20_2020-01-01_00-00-00.mp4',
    ],
)
def test_real_clips_that_say_too_little_are_refused_with_a_remedy(clip: str) -> None:
    result = result_of(DATA / 'real' / clip, 8.0)
    assert isinstance(result, Refusal)
    assert result.message and result.remedy


@pytest.mark.parametrize(('model', 'least_found'), [('yolox_nano_dyn', 0.4), ('yolox_nano', 0.2)])
def test_a_real_detector_finds_vehicles_where_they_are(model: str, least_found: float) -> None:
    pytest.importorskip('onnxruntime', reason='onnxruntime is not installed')
    detector = open_detector(DetectorOptions(model=str(DATA.parent / 'models' / f'{model}.onnx')))
    assert detector is not None and detector.layout == 'yolox'
    true, found, aside = 0, 0, []
    for frame, places in zip(*frames_and_places('S7', (150, 300, 450, 600, 750, 900)), strict=True):
        detections = detector.detect(frame)
        left, top, right, bottom = detections.edges_px[~detections.people].T
        u, v = places.T[..., None]
        inside = (u > left) & (u < right) & (v > top) & (v < bottom)
        true, found = true + len(places), found + int(inside.any(axis=1).sum())
        aside += (np.abs(u - 0.5 * (left + right)) / (right - left))[inside].tolist()
    assert found >= least_found * true
    assert np.median(aside) < 0.12  # of its width, between a vehicle's footprint and the middle of its box


def frames_and_places(scene: str, numbers: tuple[int, ...]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Frames of a scene, and the pixels (n, 2) of the vehicles' footprints in each."""
    truth = json.loads((DATA / 'scenes' / scene / 'truth.json').read_text())
    wanted = {number: round(number / truth['fps'], 2) for number in numbers}
    frames = [
        frame.image
        for number, frame in enumerate(
            open_source(DATA / 'scenes' / scene / 'video.mp4', duration_s=max(wanted.values()) + 0.01).frames()
        )
        if number in wanted
    ]
    rows = np.concatenate([np.array(track['rows']) for track in truth['vehicles']['tracks']])
    return frames, [rows[np.abs(rows[:, 0] - time_s) < 0.01, 5:7] for time_s in wanted.values()]


def test_evidence_by_a_real_detector_tells_people_from_vehicles() -> None:
    pytest.importorskip('onnxruntime', reason='onnxruntime is not installed')
    options = DetectorOptions(model=str(DATA.parent / 'models' / 'yolox_nano_dyn.onnx'))
    evidence = replay(
        open_source(DATA / 'scenes' / 'S1' / 'video.mp4', duration_s=20.0),
        Options(camera_height=8.0, first_solve_s=1e5, detector=options),
    ).evidence
    way = np.array(
        [np.hypot(*(track.points_px[-1] - track.points_px[0])) / np.ptp(track.times_s) for track in evidence.tracks()]
    )
    people = evidence.track_kinds == TrackKind.PERSON
    assert people.sum() > 5 and (evidence.track_kinds == TrackKind.VEHICLE).sum() > 50
    # pixels a second; who walks is slower than who drives, over the same places
    assert np.median(way[people]) < 0.6 * np.median(way[~people])

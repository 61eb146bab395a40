"""Rendered scenes with exact truth and real clips, where the machine has them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recorded_clips import DATA, needs_recorded_clips

from autocalib_ros.config import DetectorOptions, Options
from autocalib_ros.evidence.snapshot import TrackKind
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.recordings.sources import Frame
from autocalib_ros.offline.replay_recording import replay
from autocalib_ros.perception.background import Background
from autocalib_ros.perception.detector.detector import open_detector
from autocalib_ros.perception.picture_area import PictureArea
from autocalib_ros.results.calibration import Calibration, Refusal

pytestmark = [pytest.mark.slow, needs_recorded_clips]


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


@pytest.mark.parametrize('clip', ['NEG_shaky_1280x720', 'NEG_drone_960x540', 'NEG_handheld_1280x720'])
def test_a_camera_in_a_hand_or_in_the_air_is_refused(clip: str) -> None:
    result = result_of(DATA / 'real' / clip / 'traffic.mp4', 8.0)
    assert isinstance(result, Refusal) and result.code == 'camera_moving'
    assert 'moves all the time' in result.message


class Swaying:
    """A `Source` whose images sway by 2 px about their place, as on a mast in wind."""

    def __init__(self, clip: Path, duration_s: float) -> None:
        self._source = open_source(clip, duration_s=duration_s)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def frames(self) -> Iterator[Frame]:
        for frame in self._source.frames():
            time_s = frame.stamp_ns * 1e-9
            shift = np.array([[1.0, 0, 2 * np.sin(4.4 * time_s)], [0, 1.0, 0.8 * np.sin(2.7 * time_s)]])
            size = frame.image.shape[1::-1]
            image = cv2.warpAffine(frame.image, shift, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            yield replace(frame, image=image)


def test_a_camera_that_sways_by_two_pixels_is_calibrated() -> None:
    scene = DATA / 'scenes' / 'S1'
    truth = json.loads((scene / 'truth.json').read_text())
    options = Options(camera_height=truth['camera']['height'], first_solve_s=1e5)
    result = replay(Swaying(scene / 'video.mp4', 45.0), options).result
    assert isinstance(result, Calibration) and result.ground is not None
    assert 'sway' in [check.kind for check in result.checks]
    sigma_px = result.stddev.focal_px
    assert abs(result.camera.focal_px - truth['lens']['f']) < 3 * sigma_px < 0.03 * truth['lens']['f']
    normal = np.array(truth['camera']['R_world_from_camera'])[2]
    assert np.degrees(np.arccos(result.ground.normal_in_camera @ normal)) < 0.5


@pytest.mark.parametrize(
    'clip',
    [
        'highway_curve_640x360_11s/highway.mp4',
        'otvision_dresden/Testvideo_Cars-Truck_FR20_2020-01-01_00-00-00.mp4',
    ],
)
def test_real_clips_that_say_too_little_are_refused_with_a_remedy(clip: str) -> None:
    result = result_of(DATA / 'real' / clip, 8.0)
    assert isinstance(result, Refusal)
    assert result.message and result.remedy


def test_a_real_road_along_the_view_gets_standard_deviations_that_cover_it() -> None:
    """By the paint the focal length is 452 to 492 px, and nothing but what is usual tells it."""
    clip = DATA / 'real' / 'jamcam_a13_352x288' / '625_201709211326.mp4'
    found = result_of(clip, 12.6).candidate
    assert found is not None and found.grade in ('coarse', 'assumed')
    sigma = found.stddev.focal_px / found.camera.focal_px
    assert sigma > 0.1 and abs(np.log(found.camera.focal_px / 470.0)) < 2.0 * sigma


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


@pytest.mark.parametrize(
    ('clip', 'rows', 'masked'),
    [  # rows of the image that hold all overlays, and the least share of them that is text
        ('real/jamcam_a13_352x288/625_201709211326.mp4', ((0, 62), (268, 288)), 0.6),
        ('real/int_crosswalk_640x480/traffic.mp4', ((0, 45),), 0.3),
        ('real/road_cn_640x360_48s/cars.mp4', ((335, 360),), 0.15),
        ('real/tjunction_wide_640x352_38s/input_video.mp4', (), 0.0),
        ('scenes/S5/video.mp4', ((0, 64),), 0.2),
        ('scenes/S9/video.mp4', ((0, 64),), 0.2),
        ('scenes/S8/video.mp4', (), 0.0),
    ],
)
def test_burnt_in_text_is_masked_and_the_scene_is_not(
    clip: str, rows: tuple[tuple[int, int], ...], masked: float
) -> None:
    background, area = Background(), None
    for frame in open_source(DATA / clip, duration_s=9.0).frames():
        time_s = frame.stamp_ns * 1e-9
        if area is None:
            first_s, size = time_s, (frame.image.shape[1], frame.image.shape[0])
            area = PictureArea(size, size)
        background.update(frame.image, time_s - first_s)
        area.update(background)
    assert area is not None and area.picture.fills_image
    mask = np.zeros(size[::-1], np.uint8) if area.mask is None else area.mask
    with_overlays = np.concatenate([np.zeros(0, int), *(np.arange(*part) for part in rows)])
    assert not np.delete(mask, with_overlays, axis=0).any()
    if rows:
        assert mask[with_overlays].mean() >= masked

"""Evidence of several recordings as one."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.evidence.joining import JOINT_GAP_S, joined, moved
from autocalib_ros.evidence.read_recording import ReadRecording
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.evidence.tables import OUTLINE_COLUMNS

SECOND = 1_000_000_000


def part(first_vehicle: int, first_s: int = 0, **changes) -> Evidence:
    """Return ten seconds with two tracks, and one observation of each kind."""
    fields = {
        'image_size': (640, 360),
        'first_stamp_ns': first_s * SECOND,
        'newest_stamp_ns': (first_s + 10) * SECOND,
        'frames': 100,
        'track_starts': np.array([0, 2, 4]),
        'points_px': np.array([[10.0, 20.0], [30.0, 20.0], [100.0, 50.0], [120.0, 60.0]]),
        'times_s': np.array([1.0, 2.0, 3.0, 4.0]),
        'track_vehicles': np.array([first_vehicle, first_vehicle + 1]),
        'segments_px': np.array([[10.0, 20.0, 30.0, 20.0]]),
        'segment_vehicles': np.array([first_vehicle]),
        'segment_times_s': np.array([1.5]),
        'outlines_px': np.arange(OUTLINE_COLUMNS, dtype=np.float32)[None],
        'outline_vehicles': np.array([first_vehicle + 1]),
        'outline_times_s': np.array([2.5]),
        'drift_px': 0.1,
        'still_lines_px': np.array([[0.0, 0.0, 50.0, 0.0]]),
        'stripes_px': np.array([[10.0, 20.0, 14.0, 20.0, 60.0]]),
        'recordings': (ReadRecording(f'clip{first_s}', 10.0),),
    }
    return Evidence(**{**fields, **changes})


def test_recordings_come_one_after_the_other_with_vehicles_of_their_own():
    both = joined([part(5, drift_px=0.4), part(5, 100, still_lines_px=np.ones((3, 4)))])
    both.require_consistent()
    assert both.track_count == 4 and len(np.unique(both.track_vehicles)) == 4
    assert both.segment_vehicles.tolist() == both.track_vehicles[[0, 2]].tolist()
    assert both.outline_vehicles.tolist() == both.track_vehicles[[1, 3]].tolist()
    assert both.seconds == pytest.approx(20 + JOINT_GAP_S)
    assert both.track(2).times_s == pytest.approx([11 + JOINT_GAP_S, 12 + JOINT_GAP_S])
    assert both.newest_stamp_ns == 110 * SECOND and both.frames == 200 and both.drift_px == 0.4
    assert len(both.still_lines_px) == 3  # of the recording that has most: each shows the same lines
    assert [recording.name for recording in both.recordings] == ['clip0', 'clip100']


def test_one_recording_stays_as_it_is():
    one = part(1)
    assert joined([one]) is one


def test_all_pixels_are_moved_and_gaps_are_scaled():
    matrix = np.array([[2.0, 0.0, 1.0], [0.0, 2.0, -3.0]])
    after = moved(part(1), matrix)
    assert after.points_px[0].tolist() == [21.0, 37.0]
    assert after.segments_px.tolist() == [[21.0, 37.0, 61.0, 37.0]]
    assert after.still_lines_px.tolist() == [[1.0, -3.0, 101.0, -3.0]]
    assert after.outlines_px[0, :2].tolist() == [1.0, -1.0] and after.outlines_px[0, -1] == 32.0
    assert after.stripes_px.tolist() == [[21.0, 37.0, 29.0, 37.0, 60.0]]  # its contrast stays
    assert after.edges_px.shape == (0, 4)
    after.require_consistent()


def test_recordings_and_landmarks_survive_the_file(tmp_path):
    marks = {'landmarks_px': np.ones((2, 2)), 'landmark_descriptors': np.full((2, 128), 7, np.uint8)}
    recordings = (ReadRecording.of('/data/a.mp4', 12.5), ReadRecording.of('/other/a.mp4', np.inf))
    part(1, recordings=recordings, **marks).save(tmp_path / 'evidence.npz')
    again = Evidence.load(tmp_path / 'evidence.npz')
    assert again.recordings == recordings and again.recordings[0].name != again.recordings[1].name
    assert '/data' not in again.recordings[0].name and again.recordings[0].name.startswith('a.mp4#')
    assert (again.landmarks.descriptors == 7).all() and len(again.landmarks) == 2


def test_landmarks_of_another_shape_are_refused():
    with pytest.raises(ValueError, match='landmark_descriptors'):
        part(1, landmarks_px=np.ones((2, 2))).require_consistent()

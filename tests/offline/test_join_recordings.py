"""Which recordings are joined, and which are left out and named."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from autocalib_ros.config import GateOptions, Options
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.join_recordings import JoinedEvidence
from autocalib_ros.offline.recordings.sources import Frame, TimeWindow
from autocalib_ros.offline.replay_recording import replay
from autocalib_ros.perception.landmark_matching import find_landmarks
from synthetic_results import junction_evidence

SIZE = (320, 180)


def background(seed: int, shift_px: float = 0.0) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(30, 220, (20, 36)).astype(np.uint8)
    picture = cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC)
    return cv2.warpAffine(
        picture, np.array([[1.0, 0.0, shift_px], [0.0, 1.0, 0.0]]), SIZE, borderMode=cv2.BORDER_REFLECT
    )


@pytest.fixture(scope='module')
def clip():
    """Return a function that gives the evidence of a view, displaced by pixels."""
    evidence = junction_evidence()

    def make(seed: int = 0, shift_px: float = 0.0, **changes) -> Evidence:
        later = 1.1 if seed or shift_px or changes else 1.0  # other traffic
        moved = replace(evidence, points_px=evidence.points_px + [shift_px, 0.0], times_s=evidence.times_s * later)
        return replace(moved, **changes).with_landmarks(find_landmarks(background(seed, shift_px), None))

    return make


def test_recordings_are_registered_to_the_first(clip):
    joint = JoinedEvidence(GateOptions())
    first, later = clip(), clip(shift_px=1.5)
    assert joint.add(first, 'a') and joint.add(later, 'b')
    points = joint.all().points_px
    assert np.abs(points[len(first.points_px) :] - first.points_px).max() < 0.15
    assert not joint.left_out and joint.displacements_px == pytest.approx([1.5], abs=0.1)


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'seed': 1}, 'its background is not that of the first recording'),
        ({'shift_px': 9.0}, 'displaced by 9.0 px from that of the first recording, more than the 4.5 px'),
        ({'image_size': (640, 360)}, 'its images have 640x360, those of the first recording 320x180'),
        ({'pixel_aspect': 1.5}, 'its pixels have the aspect 1.5'),
        ({'drift_px': 40.0}, 'the camera moves'),
        ({}, 'it is the same recording as one before'),
    ],
)
def test_what_does_not_fit_is_left_out_and_named(clip, changes, reason, caplog):
    joint = JoinedEvidence(GateOptions())
    joint.add(clip(), 'a.mp4')
    assert not joint.add(clip(**changes), 'b.mp4')
    (line,) = joint.left_out
    assert line.startswith('b.mp4 is left out: ') and reason in line and line in caplog.text
    assert joint.all().track_count == clip().track_count


def test_a_first_recording_of_a_camera_that_moved_gives_way(clip):
    joint = JoinedEvidence(GateOptions())
    joint.add(clip(drift_px=40.0), 'a.mp4')
    assert joint.add(clip(seed=1), 'b.mp4')
    assert joint.left_out[0].startswith('a.mp4 is left out: ') and joint.all().drift_px == 0.0


class Road:
    """A road of one of two views with a box that crosses it, by `Frame`."""

    topic, image_type, camera_frame, duration_s, pixel_aspect, window = '', '', '', None, 0.0, TimeWindow()
    total = 50

    def __init__(self, name: str, seed: int, box: int) -> None:
        self.name, self._road, self._box = name, background(seed), background(10 + box)[:40, :60]

    def frames(self):
        noise = np.random.default_rng(1)
        for index in range(self.total):
            image = self._road.copy()
            image[90:130, 5 * index : 5 * index + 60] = self._box
            yield Frame(index * 100_000_000, cv2.add(image, noise.integers(0, 6, image.shape).astype(np.uint8)))


@pytest.mark.render
def test_clips_of_one_view_are_replayed_as_one_and_another_view_is_left_out():
    clips = [Road('a', 0, 1), Road('b', 1, 2), Road('c', 0, 3)]
    stored, told = [], []
    replayed = replay(clips, Options(), lambda done, note: told.append((done, note)), on_checkpoint=stored.append)
    assert told[-1] == (sum(clip.total for clip in clips), 'refused')  # of all that was read
    assert replayed.frames == 100 and replayed.evidence.frames == 100
    assert [line.split(' is left out')[0] for line in replayed.left_out] == ['b']
    assert [one.name.split('#')[0] for one in replayed.evidence.recordings] == ['a', 'c']
    assert len(replayed.displacements_px) == 1 and replayed.displacements_px[0] < 0.1
    assert stored[-1] is replayed.evidence and replayed.accepted_at_s is None

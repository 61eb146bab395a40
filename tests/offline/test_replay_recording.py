"""Replay of a synthetic recording with one moving box."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from autocalib_ros.config import GateOptions, Options
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.evidence.stillness import ViewChangeKind
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.recordings.sources import Frame, TimeWindow
from autocalib_ros.offline.replay_recording import replay, solve_evidence
from autocalib_ros.offline.resume import read_evidence_to_resume, sources_to_read
from autocalib_ros.results.calibration import Refusal

pytestmark = pytest.mark.render


class Drive:
    """A minimal `Source` of generated images."""

    name, topic, image_type, camera_frame, duration_s, is_live = 'drive', '', '', '', None, False
    pixel_aspect, window = 0.0, TimeWindow()

    def __init__(self, total: int) -> None:
        self.total = total
        texture = np.random.default_rng(0)
        self._road = texture.integers(90, 110, (120, 160)).astype(np.uint8)
        self._box = texture.integers(0, 255, (24, 40)).astype(np.uint8)

    def frames(self):
        for index in range(self.total):
            image = self._road.copy()
            image[50:74, 2 * index % 120 :][:, :40] = self._box
            image.flags.writeable = False
            yield Frame(index * 100_000_000, image)


def test_a_replay_counts_its_frames_and_reports_them():
    reports = []
    replayed = replay(Drive(40), Options(), lambda done, note: reports.append((done, note)))
    assert replayed.frames == replayed.evidence.frames == 40
    assert [done for done, _ in reports] == [*range(1, 41), 40, 40]
    assert [note for _, note in reports[-2:]] == ['solving', 'refused']
    assert reports[0][1].startswith('collecting 0 %: 0 of 40 tracks')
    assert replayed.background.shape == (120, 160, 3)


def test_one_box_is_no_calibration_and_nothing_was_accepted():
    replayed = replay(Drive(40), Options())
    assert not replayed.result
    assert replayed.accepted_at_s is None
    assert replayed.result.evidence.seconds == pytest.approx(3.9)


def test_the_evidence_keeps_what_the_recording_says_of_its_pixels():
    drive = Drive(5)
    drive.pixel_aspect = 64 / 45
    assert replay(drive, Options()).evidence.pixel_aspect == 64 / 45


def test_the_same_recording_gives_the_same_evidence():
    first, second = (replay(Drive(40), Options()).evidence for _ in range(2))
    assert np.array_equal(first.points_px, second.points_px)
    assert first.track_count > 0


def test_a_recording_without_images_is_an_error():
    with pytest.raises(InputError, match='drive has no images'):
        replay(Drive(0), Options())


def test_a_known_lens_goes_into_each_solution_in_the_size_of_the_images(monkeypatch):
    reports = []

    def recording_solve(evidence, options, *, lens):
        reports.append(lens)
        return solve(evidence, options)

    for module in ('solution_trials', 'replay_recording'):
        monkeypatch.setattr(f'autocalib_ros.offline.{module}.solve', recording_solve)
    options = Options(first_solve_s=0.0, gate=GateOptions(min_tracks=4))
    replay(Drive(150), options, lens=Camera.equidistant(320, 240, 200.0))
    assert len(reports) > 1
    assert set(reports) == {Camera.equidistant(160, 120, 100.0)}


def test_a_lens_of_another_shape_is_noticed_at_the_first_image():
    reports = []
    with pytest.raises(UsageError, match='images of 160x90, and these images have 160x120'):
        replay(Drive(40), Options(), lambda done, note: reports.append(done), lens=Camera.equidistant(160, 90, 100.0))
    assert not reports


def test_a_stopped_replay_solves_what_it_saw():
    seen = []
    replayed = replay(Drive(40), Options(), lambda done, note: seen.append(done), should_stop=lambda: seen[-1] == 25)
    assert (replayed.frames, replayed.evidence.frames, replayed.stopped) == (25, 25, True)
    assert replayed.result.evidence.seconds == pytest.approx(2.4)


def test_the_evidence_so_far_is_handed_out_on_the_way_and_at_the_end(monkeypatch):
    monkeypatch.setattr('autocalib_ros.offline.gather_evidence.CHECKPOINT_EVERY_S', 1.5)
    stored = []
    replayed = replay(Drive(40), Options(), on_checkpoint=stored.append)
    assert [evidence.frames for evidence in stored] == [16, 31, 40]
    assert stored[-1] is replayed.evidence
    assert np.array_equal(replayed.evidence.points_px, replay(Drive(40), Options()).evidence.points_px)


def test_evidence_solved_again_gives_the_same():
    replayed = replay(Drive(40), Options())
    again = solve_evidence(replayed.evidence, Options())
    assert again.result == replayed.result
    assert (again.frames, again.background, again.accepted_at_s) == (40, None, None)


def test_a_tiny_bag_goes_all_the_way(tmp_path, write_bag, images):
    replayed = replay(open_source(write_bag(tmp_path / 'bag', images(8))), Options())
    assert (replayed.frames, bool(replayed.result)) == (8, False)


def test_a_refused_solution_is_what_is_missing_and_then_since_when_it_is_calibrated(monkeypatch, full):
    accepted = replace(full.result, camera=Camera.equidistant(160, 120, 100.0))
    refusal = Refusal(
        code='x', message='the halves disagree', remedy='wait', method='joint', evidence=full.evidence.summary()
    )
    results = iter([refusal])
    for module in ('solution_trials', 'replay_recording'):
        monkeypatch.setattr(f'autocalib_ros.offline.{module}.solve', lambda due, options, lens: next(results, accepted))
    reports = []
    # the box is all that there is to see, so that the background seems to drift by up to 100 px
    gate = GateOptions(min_tracks=4, min_coverage=0.0, max_drift_px=1000.0)
    options = Options(first_solve_s=0.0, solve_interval_s=1.0, solve_growth=1.01, gate=gate)
    replay(Drive(300), options, lambda done, note: reports.append(note))
    assert 'collecting 100 %: the halves disagree' in reports
    assert any(note.startswith('calibrated since ') and note.endswith('focal length 100 px') for note in reports)
    assert reports.index('solving') < reports.index('collecting 100 %: the halves disagree')
    assert reports[-1] == 'calibrated'


class TwoViews:
    """A title card for three seconds, then a road with a box that crosses it, by `Frame`."""

    name, topic, image_type, camera_frame, duration_s, is_live = 'two views', '', '', '', None, False
    pixel_aspect, window = 0.0, TimeWindow()

    def frames(self):
        noise = np.random.default_rng(1)
        texture = [np.random.default_rng(seed).integers(40, 200, (30, 40)).astype(np.uint8) for seed in range(3)]
        title, road, box = (cv2.resize(one, (320, 240), interpolation=cv2.INTER_CUBIC) for one in texture)
        for index in range(160):
            image = title.copy() if index < 30 else road.copy()
            if index >= 60:
                left = 4 * (index - 60) % 260
                image[100:140, left : left + 60] = box[:40, :60]
            yield Frame(index * 100_000_000, cv2.add(image, noise.integers(0, 6, image.shape).astype(np.uint8)))


def test_the_longest_still_part_of_a_recording_is_solved_and_the_rest_is_named():
    replayed = replay(TwoViews(), Options())
    stillness = replayed.evidence.stillness
    assert [change.kind for change in stillness.changes] == [ViewChangeKind.CUT]
    assert stillness.start_s == pytest.approx(3.0, abs=0.3) and stillness.recorded_s == pytest.approx(15.9)
    assert replayed.evidence.track_count > 5 and replayed.evidence.times_s.min() >= 0.0
    assert replayed.result.code == 'too_few_tracks'  # a part of ten seconds, so that the cut is no reason


def test_stillness_survives_the_file(tmp_path):
    evidence = replay(TwoViews(), Options()).evidence
    evidence.save(tmp_path / 'evidence.npz')
    assert Evidence.load(tmp_path / 'evidence.npz').stillness == evidence.stillness


def test_a_stopped_replay_is_resumed_where_it_stopped(tmp_path, write_video):
    path = write_video(tmp_path / 'clip.avi', count=60, fps=10.0, size=(160, 120))
    seen = []
    first = replay(path, Options(), lambda done, _: seen.append(done), should_stop=lambda: len(seen) >= 40)
    first.evidence.save(tmp_path / 'evidence.npz')
    before = read_evidence_to_resume(tmp_path / 'evidence.npz')
    (left,) = sources_to_read([open_source(path)], before)
    assert [round(frame.stamp_ns * 1e-8) for frame in left.frames()] == list(range(40, 60))
    # rolled noise is of no view, so that only what was read is the question
    assert [one.read_s for one in before.recordings] == pytest.approx([3.9])


def test_what_was_read_to_its_end_is_not_read_again(tmp_path, write_video):
    path = write_video(tmp_path / 'clip.avi', count=30, fps=10.0)
    evidence = replay(path, Options()).evidence
    other = write_video(tmp_path / 'other.avi')
    assert [one.name for one in sources_to_read([open_source(path), open_source(other)], evidence)] == [str(other)]


def test_evidence_without_landmarks_is_not_resumed(tmp_path):
    replace(replay(Drive(5), Options()).evidence, recordings=()).save(tmp_path / 'evidence.npz')
    with pytest.raises(UsageError, match='does not say what it was read from'):
        read_evidence_to_resume(tmp_path / 'evidence.npz')
    assert read_evidence_to_resume(tmp_path / 'nowhere.npz') is None

"""Grouping of points into two-frame windows of bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.config import BufferOptions
from autocalib_ros.estimation.observations.track_set import SAMPLES_PER_TRACK
from autocalib_ros.estimation.observations.two_frame_windows import MIN_POINTS, find_windows, no_windows
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.snapshot import Evidence, Segments, Track

SIZE = (1280, 720)
CORNERS = np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 20.0], [30.0, 20.0], [15.0, 10.0], [20.0, 5.0]])


def evidence_of(tracks: list[Track], segments: list[Segments] | None = None) -> Evidence:
    buffer = EvidenceBuffer(BufferOptions())
    for track in tracks:
        buffer.add_track(track)
    for part in segments or []:
        buffer.add_segments(part)
    return buffer.snapshot(
        image_size=SIZE, first_stamp_ns=0, newest_stamp_ns=20_000_000_000, frames=200, drift_px=0.0, unfinished=[]
    )


def driving(
    start: tuple[float, float],
    speed: tuple[float, float],
    vehicle: int,
    begin_s: float = 0.0,
    points: np.ndarray = CORNERS,
    seconds: float = 2.0,
) -> list[Track]:
    times = begin_s + np.arange(0.0, seconds + 1e-9, 0.1)
    way = np.array(start) + (times - begin_s)[:, None] * np.array(speed)
    return [Track(vehicle, times, way + point) for point in points]


def test_points_of_one_vehicle_are_one_body_at_every_instant() -> None:
    windows = find_windows(evidence_of(driving((100, 300), (120, 0), 1)))
    assert len(windows) == 4 + 1  # of 0.8 s every 0.4 s, and of 1.6 s, in 2 s
    assert len(np.unique(windows.bodies)) == 1
    assert (windows.mask.sum(axis=1) == len(CORNERS)).all()
    moved = windows.second_px - windows.first_px
    assert set(np.round(moved[windows.mask][:, 0]).astype(int)) == {96, 192}
    assert np.allclose(windows.middle_px, (windows.first_px + windows.second_px) / 2)
    assert not windows.from_segments.any()


def test_separate_or_diverging_vehicles_are_different_bodies() -> None:
    tracks = driving((100, 300), (120, 0), 1) + driving((600, 300), (120, 0), 1)  # one label for both
    assert len(np.unique(find_windows(evidence_of(tracks)).bodies)) == 2
    tracks = driving((100, 300), (120, 0), 1) + driving((110, 305), (-120, 0), 1)
    windows = find_windows(evidence_of(tracks))
    assert all(
        len(np.unique(np.sign((windows.second_px - windows.first_px)[row, windows.mask[row], 0]))) == 1
        for row in range(len(windows))
    )


def test_too_few_points_and_standing_ones_make_no_window() -> None:
    assert not len(find_windows(evidence_of(driving((100, 300), (120, 0), 1, points=CORNERS[: MIN_POINTS - 1]))))
    assert not len(find_windows(evidence_of(driving((100, 300), (3, 0), 1))))
    assert not len(find_windows(evidence_of([])))
    assert not len(no_windows())


def test_points_seen_at_different_times_make_no_window() -> None:
    tracks = [
        track
        for number, point in enumerate(CORNERS)
        for track in driving((100, 300), (120, 0), 1, begin_s=3.0 * number, points=point[None])
    ]
    assert not len(find_windows(evidence_of(tracks)))


def test_a_vehicle_with_many_points_keeps_the_farthest() -> None:
    grid = np.stack(np.meshgrid(np.arange(0.0, 60.0, 6.0), np.arange(0.0, 30.0, 6.0)), axis=-1).reshape(-1, 2)
    windows = find_windows(evidence_of(driving((100, 300), (120, 0), 1, points=grid)))
    assert (windows.mask.sum(axis=1) == SAMPLES_PER_TRACK).all()
    extent = np.ptp(windows.first_px[0], axis=0)
    assert (extent >= [48.0, 24.0]).all()


def test_segments_make_a_window_of_the_body_at_the_same_place() -> None:
    tracks = driving((100, 300), (120, 0), 1)
    ends = np.hstack([CORNERS + (160.0, 300.0), CORNERS + (208.0, 300.0)])
    here = Segments(0.9, np.full(len(ends), 7), ends)
    elsewhere = replace(here, ends_px=ends + 350.0)
    windows = find_windows(evidence_of(tracks, [here, elsewhere]))
    assert windows.from_segments.sum() == 2
    of_tracks = windows.bodies[~windows.from_segments][0]
    assert (windows.bodies[windows.from_segments] == of_tracks).tolist() == [True, False]


def test_a_selection_takes_the_bodies_in_turn() -> None:
    tracks = [track for number in range(6) for track in driving((100, 300), (120, 0), number, begin_s=3.0 * number)]
    windows = find_windows(evidence_of(tracks))
    few = windows.balanced_subset(6)
    assert len(np.unique(few.bodies)) == 6
    assert len(windows.balanced_subset(10_000)) == len(windows)
    assert np.isclose(windows.body_weights.sum(), 6.0)


def test_a_track_of_one_point_is_no_body() -> None:
    lone = [Track(1, np.array([0.8]), np.array([[100.0, 300.0]]))]
    assert len(find_windows(evidence_of(lone))) == 0
    assert len(find_windows(evidence_of(driving((100, 300), (120, 0), 1) + lone))) == 4 + 1


def test_hours_without_traffic_change_no_window() -> None:
    gap_s = 36_000.0  # a whole number of windows, so that both vehicles meet the same instants
    lone = find_windows(evidence_of(driving((100, 300), (120, 0), 1)))
    both = find_windows(evidence_of(driving((100, 300), (120, 0), 1) + driving((100, 300), (120, 0), 2, begin_s=gap_s)))
    assert len(both) == 2 * len(lone)
    later = both.subset(both.times_s > gap_s)
    assert np.allclose(np.sort(later.times_s) - gap_s, np.sort(lone.times_s))
    assert np.allclose(later.first_px, lone.first_px, atol=1e-6)

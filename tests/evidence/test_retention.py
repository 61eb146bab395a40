"""Which evidence stays when there is too much: by what it adds, not by age alone."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from autocalib_ros.config import BufferOptions
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.retention import REPLACING_VEHICLES, cell_heading_bins, headings, novelty
from autocalib_ros.evidence.snapshot import Evidence, Segments, Track

pytestmark = pytest.mark.render

HOUR_S = 3600.0
MAIN = ((40.0, 300.0), (1200.0, 0.0))
SIDE = ((620.0, 700.0), (0.0, -500.0))
"""Where the two roads begin and how far their vehicles go, in pixels."""
POINTS = 5
"""Tracks of one vehicle."""


def drive(vehicle: int, begin_s: float, road: tuple, parts: int = 4) -> list[Track]:
    """Tracks of a vehicle that crosses the image: of each of its points one for each part of the way."""
    start, way = (np.array(place) for place in road)
    along = np.linspace(0.0, 1.0, 8 * parts + 1)
    tracks = []
    for number in range(POINTS):
        path = start + [5.0 * number, 3.0 * number] + along[:, None] * way
        tracks += [
            Track(vehicle, begin_s + 8.0 * along[part : part + 9], path[part : part + 9])
            for part in range(0, 8 * parts, 8)
        ]
    return tracks


def matches(tracks: list[Track]) -> Segments:
    """Return a segment for each track of one vehicle."""
    return Segments(
        tracks[0].times_s[-1],
        np.array([track.vehicle for track in tracks]),
        np.array([np.concatenate([track.points_px[0], track.points_px[1]]) for track in tracks]),
    )


def filled(buffer: EvidenceBuffer, vehicles: Iterable[list[Track]], most: int) -> EvidenceBuffer:
    for tracks in vehicles:
        for track in tracks:
            buffer.add_track(track)
            assert buffer.track_count <= most
        buffer.add_segments(matches(tracks))
    return buffer


def busy(hours: float, every_s: float = 6.0, first: int = 0) -> list[list[Track]]:
    return [drive(first + number, number * every_s, MAIN) for number in range(int(hours * HOUR_S / every_s))]


def snapshot(buffer: EvidenceBuffer) -> Evidence:
    return buffer.snapshot(
        image_size=(1280, 720), first_stamp_ns=0, newest_stamp_ns=10**13, frames=1, drift_px=0.0, unfinished=[]
    )


def test_a_lone_vehicle_of_the_second_road_outlives_hours_of_the_main_road() -> None:
    main = busy(3.0)
    traffic = [*main[:300], drive(100_000, 1800.0, SIDE), *main[300:]]
    evidence = snapshot(filled(EvidenceBuffer(BufferOptions(max_tracks=1000, max_segments=1000)), traffic, 1000))
    assert (evidence.track_vehicles == 100_000).sum() == 4 * POINTS
    assert (evidence.segment_vehicles == 100_000).sum() == 4 * POINTS
    assert evidence.track_vehicles[:-1].max() >= len(main) - 2  # and the newest are there


def test_among_equals_the_oldest_go_first() -> None:
    evidence = snapshot(filled(EvidenceBuffer(BufferOptions(max_tracks=1000)), busy(1.0), 1000))
    held = np.unique(evidence.track_vehicles)
    assert held.tolist() == list(range(held[0], 600)) and len(held) >= 40


def test_two_roads_come_to_have_equal_parts() -> None:
    traffic = [drive(number, 6.0 * number, SIDE if number % 10 == 0 else MAIN) for number in range(2000)]
    held = np.unique(snapshot(filled(EvidenceBuffer(BufferOptions(max_tracks=1000)), traffic, 1000)).track_vehicles)
    assert 0.4 < (held % 10 == 0).mean() < 0.6


def test_a_vehicle_goes_whole() -> None:
    generator = np.random.default_rng(3)
    traffic = [
        drive(number, 6.0 * number, (generator.uniform(0, 700, 2), generator.uniform(-600, 600, 2)), parts)
        for number, parts in enumerate(generator.integers(1, 6, 500))
    ]
    evidence = snapshot(filled(EvidenceBuffer(BufferOptions(max_tracks=500, max_segments=600)), traffic, 500))
    complete = np.array([len(tracks) for tracks in traffic])
    for owners in (evidence.track_vehicles, evidence.segment_vehicles):
        held, counts = np.unique(owners, return_counts=True)
        assert 10 < len(held) < 500
        np.testing.assert_array_equal(counts, complete[held])


def test_a_label_without_end_does_not_fill_the_buffer() -> None:
    buffer = filled(EvidenceBuffer(BufferOptions(max_tracks=400)), [drive(1, 0.0, SIDE)], 400)
    filled(buffer, [[track] for number in range(200) for track in drive(7, 10.0 + 6.0 * number, MAIN)], 400)
    owners = snapshot(buffer).track_vehicles
    assert (owners == 1).sum() == 4 * POINTS
    assert (owners == 7).sum() >= 200


def test_a_lone_point_is_worth_less_than_a_vehicle() -> None:
    lone = [[drive(50_000 + number, 6.0 * number + 3.0, SIDE, parts=1)[0]] for number in range(400)]
    cars = [drive(number, 6.0 * number, MAIN) for number in range(400)]
    traffic = [tracks for pair in zip(lone, cars, strict=True) for tracks in pair]
    owners = np.unique(snapshot(filled(EvidenceBuffer(BufferOptions(max_tracks=600)), traffic, 600)).track_vehicles)
    assert 1 <= (owners >= 50_000).sum() < (owners < 50_000).sum() / 2


def test_old_vehicles_stay_until_enough_newer_ones_replace_them() -> None:
    buffer = EvidenceBuffer(BufferOptions())
    filled(buffer, [drive(0, 0.0, MAIN), drive(1, 10.0, SIDE)], 8000)
    for number in range(2, REPLACING_VEHICLES + 2):
        buffer.forget_replaced(4 * HOUR_S)
        assert np.unique(snapshot(buffer).track_vehicles).tolist()[:2] == [0, 1]
        filled(buffer, [drive(number, 5 * HOUR_S + 60.0 * number, MAIN)], 8000)
    buffer.forget_replaced(4 * HOUR_S)
    evidence = snapshot(buffer)
    for owners in (evidence.track_vehicles, evidence.segment_vehicles):
        assert np.unique(owners).tolist() == list(range(1, REPLACING_VEHICLES + 2))


def test_recent_vehicles_stay_however_many_there_are() -> None:
    buffer = filled(EvidenceBuffer(BufferOptions()), busy(0.1), 8000)
    before = snapshot(buffer).track_count
    buffer.forget_replaced(-1.0)
    assert snapshot(buffer).track_count == before == 60 * 4 * POINTS


def test_the_same_traffic_leaves_the_same_evidence_to_the_last_bit() -> None:
    generator = np.random.default_rng(0)
    traffic = [
        drive(int(generator.integers(0, 400)), 6.0 * number, MAIN if generator.uniform() < 0.8 else SIDE)
        for number in range(600)
    ]
    first, second = (snapshot(filled(EvidenceBuffer(BufferOptions(max_tracks=700)), traffic, 700)) for _ in range(2))
    for name in vars(first):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


def test_rows_keep_their_order() -> None:
    evidence = snapshot(filled(EvidenceBuffer(BufferOptions(max_tracks=500)), busy(1.0), 500))
    ends = evidence.times_s[evidence.track_starts[1:] - 1]
    assert (np.diff(evidence.track_vehicles) >= 0).all() and ends.max() == ends[-1]
    assert all(len(track.points_px) == 9 for track in evidence.tracks())


@pytest.mark.parametrize('seed', range(5))
def test_novelty_matches_its_definition(seed: int) -> None:
    generator = np.random.default_rng(seed)
    vehicles = generator.integers(0, 8, 60)
    newest, bins = generator.permutation(8).astype(float), generator.integers(0, 5, 60)
    found = novelty(vehicles, newest, bins)
    for vehicle in np.unique(vehicles):
        rows = np.flatnonzero(vehicles == vehicle)
        newer = [
            len({other for other in vehicles[bins == bins[row]] if newest[other] > newest[vehicle]}) for row in rows
        ]
        assert found[vehicle] == pytest.approx(np.mean([1 / (1 + count) for count in newer]) * min(1, len(rows) / 3))


def test_kinds_tell_places_and_headings_apart() -> None:
    middles = np.array([[0.0, 0.0], [10.0, 5.0], [800.0, 400.0], [0.0, 0.0], [0.0, 0.0]])
    ways = np.array([[9.0, 0.5], [9.0, -0.5], [9.0, 0.0], [-9.0, 0.5], [-9.0, -0.5]])
    found = cell_heading_bins(middles, headings(ways))
    assert found[0] == found[1] and found[3] == found[4]
    assert len(set(found)) == 3

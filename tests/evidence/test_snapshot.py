"""The rolling buffer and its snapshots."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autocalib_ros.config import BufferOptions
from autocalib_ros.errors import InputError
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.snapshot import TRACK_KINDS, Edges, Evidence, Outlines, Segments, Track, TrackKind
from autocalib_ros.evidence.tables import EDGES, OUTLINE_COLUMNS, OUTLINES, STILL_LINES, STRIPE_COLUMNS


def track(vehicle: int, end_s: float) -> Track:
    times = np.linspace(end_s - 1.0, end_s, 10)
    return Track(vehicle, times, np.column_stack([100 + 50 * times, np.full(10, 80.0)]))


def segments(time_s: float, count: int) -> Segments:
    return Segments(time_s, np.arange(count), np.ones((count, 4)))


def outlines(time_s: float, vehicles: list[int]) -> Outlines:
    ends = np.arange(len(vehicles) * OUTLINE_COLUMNS) + 0.25
    return Outlines(time_s, np.array(vehicles), ends.reshape(-1, OUTLINE_COLUMNS))


def snapshot(buffer: EvidenceBuffer) -> Evidence:
    return buffer.snapshot(
        image_size=(640, 360), first_stamp_ns=0, newest_stamp_ns=2_000_000_000, frames=30, drift_px=0.1, unfinished=[]
    )


def test_a_snapshot_survives_its_file_to_the_last_bit(tmp_path: Path) -> None:
    buffer = EvidenceBuffer(BufferOptions())
    buffer.add_track(track(3, 5.0))
    buffer.add_segments(segments(5.0, 4))
    buffer.add_edges(Edges(5.0, np.array([3, 3]), np.arange(8.0).reshape(2, 4)))
    buffer.add_outlines(outlines(5.0, [3, 4, 3]))
    before = snapshot(buffer)
    assert len(before.edges_px) == 2 and len(before.outlines_px) == 3
    before.save(tmp_path / 'evidence.npz')
    after = Evidence.load(tmp_path / 'evidence.npz')
    for name in vars(before):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name), err_msg=name)


def of_kinds(*kinds: TrackKind) -> Evidence:
    buffer = EvidenceBuffer(BufferOptions())
    for index, kind in enumerate(kinds):
        one = track(index, 5.0 + index)
        buffer.add_track(Track(one.vehicle, one.times_s, one.points_px, kind))
    return snapshot(buffer)


def test_kinds_of_tracks_survive_their_file(tmp_path: Path) -> None:
    of_kinds(TrackKind.PERSON, TrackKind.VEHICLE, TrackKind.UNKNOWN).save(tmp_path / 'evidence.npz')
    after = Evidence.load(tmp_path / 'evidence.npz')
    assert [one.kind for one in after.tracks()] == [TrackKind.PERSON, TrackKind.VEHICLE, TrackKind.UNKNOWN]
    assert after.select_tracks(np.array([1])).track_kinds.tolist() == [TrackKind.VEHICLE]
    assert after.summary().vehicles == 2


def test_without_a_detector_a_file_has_no_track_kinds(tmp_path: Path) -> None:
    of_kinds(TrackKind.UNKNOWN, TrackKind.UNKNOWN).save(tmp_path / 'evidence.npz')
    with np.load(tmp_path / 'evidence.npz') as data:
        assert TRACK_KINDS not in data.files
    assert Evidence.load(tmp_path / 'evidence.npz').track_kinds.tolist() == [TrackKind.UNKNOWN] * 2


def test_the_shape_of_the_pixels_survives_its_file(tmp_path: Path) -> None:
    plain = of_kinds(TrackKind.UNKNOWN)
    squeezed = replace(plain, pixel_aspect=64 / 45)
    for evidence in (squeezed, plain):
        evidence.save(tmp_path / 'e.npz')
        assert Evidence.load(tmp_path / 'e.npz').pixel_aspect == evidence.pixel_aspect
    with np.load(tmp_path / 'e.npz') as arrays:
        assert 'pixel_aspect' not in arrays  # as in files of earlier versions


@pytest.mark.parametrize('kinds', [[1], [1, 3], [1.0, 2.0]])
def test_kinds_that_do_not_fit_are_an_input_error(tmp_path: Path, kinds: list) -> None:
    path = tmp_path / 'evidence.npz'
    of_kinds(TrackKind.PERSON, TrackKind.VEHICLE).save(path)
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    np.savez(path, **{**arrays, TRACK_KINDS: np.array(kinds)})
    with pytest.raises(InputError, match=TRACK_KINDS):
        Evidence.load(path)


def rewritten(tmp_path: Path, keep: tuple[str, ...]) -> Path:
    """A file of evidence with two edges, of whose arrays of edges only some are kept."""
    buffer = EvidenceBuffer(BufferOptions())
    buffer.add_track(track(3, 5.0))
    buffer.add_edges(Edges(5.0, np.array([3, 3]), np.arange(8.0).reshape(2, 4)))
    path = tmp_path / 'evidence.npz'
    snapshot(buffer).save(path)
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files if name not in EDGES.names or name in keep}
    np.savez(path, **arrays)
    return path


def test_a_file_from_before_edges_were_gathered_has_none(tmp_path: Path) -> None:
    evidence = Evidence.load(rewritten(tmp_path, ()))
    assert evidence.track_count == 1
    assert evidence.edges_px.shape == (0, 4) and evidence.edge_vehicles.shape == evidence.edge_times_s.shape == (0,)


def test_edges_without_their_vehicles_are_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='edge'):
        Evidence.load(rewritten(tmp_path, ('edges_px', 'edge_times_s')))


def test_a_file_without_outlines_has_none(tmp_path: Path) -> None:
    buffer = EvidenceBuffer(BufferOptions())
    buffer.add_track(track(3, 5.0))
    snapshot(buffer).save(tmp_path / 'evidence.npz')
    with np.load(tmp_path / 'evidence.npz') as data:
        assert not set(OUTLINES.names) & set(data.files)
    evidence = Evidence.load(tmp_path / 'evidence.npz')
    assert evidence.outlines_px.shape == (0, OUTLINE_COLUMNS) and evidence.outline_times_s.shape == (0,)


@pytest.mark.parametrize('missing', OUTLINES.names)
def test_outlines_that_are_not_all_there_are_an_input_error(tmp_path: Path, missing: str) -> None:
    buffer = EvidenceBuffer(BufferOptions())
    buffer.add_track(track(3, 5.0))
    buffer.add_outlines(outlines(5.0, [3]))
    path = tmp_path / 'evidence.npz'
    snapshot(buffer).save(path)
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files if name != missing}
    np.savez(path, **arrays)
    with pytest.raises(InputError, match='outline'):
        Evidence.load(path)


def test_the_buffer_keeps_no_more_outlines_than_allowed() -> None:
    buffer = EvidenceBuffer(BufferOptions(max_outlines=100))
    for index in range(50):
        buffer.add_outlines(outlines(float(index), list(range(3 * index, 3 * index + 7))))
        assert len(snapshot(buffer).outlines_px) <= 100
    assert len(snapshot(buffer).outlines_px) > 50


def test_evidence_without_a_vehicle_has_nothing_of_it() -> None:
    buffer = EvidenceBuffer(BufferOptions())
    for vehicle in (1, 2, 3):
        buffer.add_track(track(vehicle, 5.0))
    buffer.add_segments(segments(5.0, 4))
    buffer.add_edges(Edges(5.0, np.array([3, 2]), np.arange(8.0).reshape(2, 4)))
    buffer.add_outlines(outlines(5.0, [2, 1, 2]))
    left = snapshot(buffer).without_vehicles(np.array([2, 7]))
    assert left.track_vehicles.tolist() == [1, 3] and len(left.points_px) == len(left.times_s) == 20
    assert left.segment_vehicles.tolist() == [0, 1, 3] and len(left.segments_px) == len(left.segment_times_s) == 3
    assert left.edge_vehicles.tolist() == [3] and left.edges_px.tolist() == [[0.0, 1.0, 2.0, 3.0]]
    assert left.outline_vehicles.tolist() == [1] and left.outlines_px[0, 0] == OUTLINE_COLUMNS + 0.25


def with_lines(count: int) -> Evidence:
    lines = np.random.default_rng(0).uniform(0, 360, (count, 4))
    return replace(of_kinds(TrackKind.UNKNOWN, TrackKind.VEHICLE), still_lines_px=lines)


def test_still_lines_survive_their_file_to_the_last_bit(tmp_path: Path) -> None:
    before = with_lines(7)
    before.save(tmp_path / 'evidence.npz')
    after = Evidence.load(tmp_path / 'evidence.npz')
    np.testing.assert_array_equal(after.still_lines_px, before.still_lines_px)
    # selecting tracks does not affect the still lines
    np.testing.assert_array_equal(after.select_tracks(np.array([1])).still_lines_px, before.still_lines_px)


def test_stripes_survive_their_file_to_the_last_bit(tmp_path: Path) -> None:
    stripes = np.random.default_rng(1).uniform(0, 360, (5, STRIPE_COLUMNS))
    replace(with_lines(2), stripes_px=stripes).save(tmp_path / 'evidence.npz')
    np.testing.assert_array_equal(Evidence.load(tmp_path / 'evidence.npz').stripes_px, stripes)


def test_without_still_lines_a_file_has_no_such_array(tmp_path: Path) -> None:
    with_lines(0).save(tmp_path / 'evidence.npz')
    with np.load(tmp_path / 'evidence.npz') as data:
        assert STILL_LINES.values not in data.files
    assert Evidence.load(tmp_path / 'evidence.npz').still_lines_px.shape == (0, 4)


@pytest.mark.parametrize(
    'lines',
    [
        np.zeros(4),
        np.zeros((2, 3)),
        np.zeros((2, 2, 2)),
        np.zeros((2, 4), int),
        np.full((2, 4), np.inf),
        np.array([[0.0, 1.0, np.nan, 3.0]]),
        np.full((2, 4), 'x'),
        np.array(1.0),
    ],
)
def test_still_lines_that_are_none_are_an_input_error(tmp_path: Path, lines: np.ndarray) -> None:
    path = tmp_path / 'evidence.npz'
    with_lines(3).save(path)
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    np.savez(path, **{**arrays, STILL_LINES.values: lines})
    with pytest.raises(InputError, match='not a file of saved evidence'):
        Evidence.load(path)


def test_the_buffer_keeps_no_more_tracks_than_allowed() -> None:
    buffer = EvidenceBuffer(BufferOptions(max_tracks=50))
    for index in range(500):
        buffer.add_track(track(index, float(index)))
        assert snapshot(buffer).track_count == buffer.track_count <= 50
    assert buffer.track_count >= 40


def test_the_buffer_keeps_no_more_segments_than_allowed() -> None:
    buffer = EvidenceBuffer(BufferOptions(max_segments=100))
    for index in range(50):
        buffer.add_segments(segments(float(index), 30))
        assert len(snapshot(buffer).segments_px) <= 100
    buffer.add_segments(segments(50.0, 130))
    assert len(snapshot(buffer).segments_px) == 100


def test_coverage_counts_crossed_cells() -> None:
    buffer = EvidenceBuffer(BufferOptions())
    assert snapshot(buffer).coverage == 0.0
    buffer.add_track(Track(0, np.arange(2.0), np.array([[10.0, 10.0], [15.0, 12.0]])))
    assert snapshot(buffer).coverage == pytest.approx(1 / (16 * 9))


@pytest.mark.parametrize('content', [b'', b'not a file of numpy', b'PK\x03\x04 torn'])
def test_a_broken_file_is_an_input_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / 'evidence.npz'
    path.write_bytes(content)
    with pytest.raises(InputError, match='not a file of saved evidence'):
        Evidence.load(path)


def test_an_array_that_is_no_archive_is_an_input_error(tmp_path: Path) -> None:
    with (tmp_path / 'evidence.npz').open('wb') as stream:
        np.save(stream, np.zeros(3))
    with pytest.raises(InputError, match='not a file of saved evidence'):
        Evidence.load(tmp_path / 'evidence.npz')


@pytest.mark.parametrize('position', range(60, 1500, 120))
def test_a_damaged_byte_is_an_input_error_or_does_no_harm(tmp_path: Path, position: int) -> None:
    buffer = EvidenceBuffer(BufferOptions())
    buffer.add_track(track(3, 5.0))
    path = tmp_path / 'evidence.npz'
    snapshot(buffer).save(path)
    damaged = bytearray(path.read_bytes())
    damaged[position] ^= 0x55
    path.write_bytes(damaged)
    try:
        after = Evidence.load(path)
    except InputError as error:
        assert '\n' not in str(error)
    else:
        assert len(after.track(0).points_px) == 10


@pytest.mark.parametrize(
    ('changes', 'expected'),
    [
        ({'points_px': np.zeros((9, 2))}, 'times_s of float64'),
        ({'points_px': np.zeros(10)}, 'points_px of float64'),
        ({'points_px': np.full((10, 2), np.nan)}, 'points_px of float64'),
        ({'points_px': np.full((10, 2), 'x')}, 'points_px of <U1'),
        ({'points_px': np.array(3.0)}, 'not a file'),
        ({'track_vehicles': np.zeros(3, int)}, 'track_starts of int64'),
        ({'track_starts': np.array([0, 11])}, 'does not divide'),
        ({'track_starts': np.array([-1, 10])}, 'does not divide'),
        ({'times_s': np.full(10, 4.0)}, 'times_s does not increase'),
        ({'track_starts': np.array([0.0, 10.0])}, 'track_starts of float64'),
        ({'segments_px': np.zeros((0, 3))}, 'segments_px of float64'),
        ({'segment_times_s': np.zeros(2)}, 'segment_times_s of float64'),
        ({'image_size': np.array([0, 360])}, r'an image size of \(0, 360\)'),
        ({'image_size': np.array([640])}, 'not a file'),
        ({'stamps_ns': np.array([5, 1])}, 'in -4e-09 s'),
        ({'drift_px': np.nan}, 'a drift of nan px'),
        ({'frames': 'many'}, 'not a file'),
    ],
)
def test_evidence_that_does_not_fit_together_is_an_input_error(tmp_path: Path, changes: dict, expected: str) -> None:
    buffer = EvidenceBuffer(BufferOptions())
    buffer.add_track(track(3, 5.0))
    path = tmp_path / 'evidence.npz'
    snapshot(buffer).save(path)
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    np.savez(path, **{**arrays, **changes})
    with pytest.raises(InputError, match=expected):
        Evidence.load(path)


def test_a_missing_file_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='No such file'):
        Evidence.load(tmp_path / 'none.npz')

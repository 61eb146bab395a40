"""Vehicle tracks in metres."""

from __future__ import annotations

import csv
import sys
from dataclasses import replace

import numpy as np
import pytest

from autocalib_ros.cli import main
from autocalib_ros.commands.output import write_ground_tracks
from autocalib_ros.config import Options, ScaleOptions
from autocalib_ros.errors import UsageError
from autocalib_ros.offline.ground_tracks import GroundTracks, ground_tracks, require_tracks_path, write_tracks
from synthetic_results import SPEED_M_S, junction_evidence

ABOVE_M = 0.75
"""Height of the points of the small junction, as `scale.point_height_m` says."""


@pytest.fixture(scope='module')
def evidence():
    """Return exact tracks of points above two roads, along x and along y."""
    return junction_evidence(ABOVE_M)


@pytest.fixture
def tracks(full, evidence):
    """Return the tracks on the ground of that junction."""
    return ground_tracks(evidence, full.result, Options())


def test_speeds_and_directions_are_those_of_the_traffic(tracks):
    assert len(tracks.time_s) > 100
    assert np.abs(tracks.speed_m_s - SPEED_M_S).max() < 0.05
    turned = np.abs((tracks.direction_deg + 45) % 90 - 45)
    assert turned.max() < 0.5
    assert (tracks.kind == 'unknown').all()


def test_vehicles_keep_to_their_lane_and_advance(tracks):
    for vehicle in np.unique(tracks.vehicle_id):
        own = tracks.vehicle_id == vehicle
        along, across = (tracks.x_m, tracks.y_m) if vehicle % 2 == 0 else (tracks.y_m, tracks.x_m)
        assert across[own] == pytest.approx(3 + vehicle / 2, abs=0.02)
        assert np.diff(along[own]) == pytest.approx(SPEED_M_S * np.diff(tracks.time_s[own]), abs=0.05)


def test_the_height_of_the_points_is_a_part_of_the_sigmas(full, evidence):
    narrow = Options(scale=ScaleOptions(point_height_sigma_m=0.0))
    wide = Options(scale=ScaleOptions(point_height_sigma_m=0.5))
    one, other = (ground_tracks(evidence, full.result, options) for options in (narrow, wide))
    assert (other.sigma_m > one.sigma_m).all()
    assert (other.speed_sigma_m_s / other.speed_m_s).min() > 0.5 / 7.25 - 1e-6


def test_points_that_come_and_go_do_not_move_a_vehicle(full, evidence):
    """The second half of every track belongs to one point only, two metres behind."""
    whole = ground_tracks(evidence, full.result, Options())
    twice = replace(evidence, track_vehicles=evidence.track_vehicles // 4 * 4)
    steps = [
        np.abs(np.diff(np.column_stack([tracks.x_m, tracks.y_m])[tracks.vehicle_id == vehicle], axis=0)).max()
        for tracks in (whole, ground_tracks(twice, full.result, Options()))
        for vehicle in np.unique(tracks.vehicle_id)
        if (np.diff(tracks.time_s[tracks.vehicle_id == vehicle]) < 0.11).all()
    ]
    assert max(steps) < 1.1 * SPEED_M_S * 0.1


def test_a_csv_file_has_a_row_for_each_time(tracks, tmp_path):
    write_tracks(tmp_path / 'new' / 'tracks.csv', tracks)
    rows = list(csv.DictReader((tmp_path / 'new' / 'tracks.csv').read_text().splitlines()))
    assert len(rows) == len(tracks.time_s)
    assert list(rows[0]) == list(GroundTracks.__dataclass_fields__)
    assert float(rows[5]['x_m']) == pytest.approx(tracks.x_m[5], abs=1e-3)
    assert int(rows[5]['stamp_ns']) == tracks.stamp_ns[5]


def test_what_cannot_be_written_is_said_before_the_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'pandas', None)
    with pytest.raises(UsageError, match='pip install pandas pyarrow'):
        require_tracks_path(tmp_path / 'tracks.parquet')
    assert main(['evidence', 'nowhere.npz', '--tracks', 'tracks.xls']) == 2
    assert 'tracks are written as .csv or .parquet' in capsys.readouterr().err


def test_no_plane_is_no_file(tmp_path, refused, lens_only, capsys):
    for replayed in (refused, lens_only):
        write_ground_tracks(tmp_path / 'tracks.csv', replayed, quiet=False)
        assert 'is not written: no calibration with a ground plane' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())

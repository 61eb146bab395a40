"""Measured lengths predicted from some of them: `autocalib benchmark lengths`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from autocalib_ros.config import Options
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.ground import Ground
from autocalib_ros.offline.benchmark import lengths
from autocalib_ros.results.calibration import Calibration
from stored_results import SIZE, calibration

ALONG = np.array([True, True, True, False])


@pytest.fixture
def road(tmp_path: Path) -> Path:
    """A file with lengths of 6 m on the road of `calibration()`, one of them written down 10 % too long."""
    starts = np.array([[12.0, 0.0], [16.0, 1.0], [20.0, -1.0], [14.0, -3.0]])
    ends = starts + np.where(ALONG[:, None], [6.0, 0.0], [0.0, 6.0])
    pixels, _ = Ground.of(calibration()).pixels(np.stack([starts, ends], axis=1).reshape(-1, 2))
    points = np.linspace([200.0, 300.0], [320.0, 100.0], 15)
    np.savez(
        tmp_path / 'camera.npz',
        distance_px=pixels.reshape(-1, 4),
        distance_m=[6.0, 6.0, 6.6, 6.0],
        distance_along=ALONG,
        speed_km_h=[80.0, 90.0],
        fps=25.0,
        image_size=SIZE,
        flow_px=np.tile(points, (12, 1)),
        flow_frames=np.concatenate([np.arange(15) + 20 * vehicle for vehicle in range(12)]),
        flow_vehicles=np.repeat(np.arange(12), 15),
    )
    return tmp_path


def test_told_lengths_are_left_out_and_the_others_compared(road: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Options] = []

    def solved(evidence: object, options: Options) -> Calibration:
        told.append(options)
        return calibration()

    monkeypatch.setattr(lengths, 'solve', solved)
    runs = list(lengths.measure_lengths(road, draws=3))
    assert [(run.told, run.draws, len(run.errors)) for run in runs] == [('across', 3, 6), ('speed', 3, 6)]
    assert [len(each.scale.known_distances) for each in told] == [2, 2, 2, 1, 1, 1]
    assert [each.scale.speed_km_h for each in told] == [0.0, 0.0, 0.0, 85.0, 85.0, 85.0]
    for run in runs:
        assert sorted(run.errors.round(3)) == pytest.approx([-0.095, -0.095, 0, 0, 0, 0], abs=1e-3)
        assert ((run.sigmas > 0.05 / 6.6) & (run.sigmas < 0.3)).all()
    assert lengths.format_lengths(runs[0]).split()[:3] == ['camera', 'across', '3']
    assert not lengths.all_of(runs, 'speed').good


def test_points_of_a_vehicle_are_a_track(road: Path) -> None:
    read = lengths.read_measured_road(road / 'camera.npz')
    assert len(read.evidence.track_vehicles) == 12 and len(read.evidence.points_px) == 12 * 15
    assert read.mean_speed_km_h == 85.0


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r'no \.npz'):
        next(lengths.measure_lengths(tmp_path))
    np.savez(tmp_path / 'other.npz', a=1)
    with pytest.raises(InputError, match='no tracks and measured lengths'):
        next(lengths.measure_lengths(tmp_path))

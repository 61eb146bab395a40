"""Tracks of other programs as evidence: CSV and MOT files, and what is wrong with others."""

from pathlib import Path

import numpy as np
import pytest

from autocalib_ros.cli import main
from autocalib_ros.config import BufferOptions
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence
from autocalib_ros.offline.track_files import evidence_from_file

SIZE = (1280, 720)
HEADER = 'time_s,vehicle_id,track_id,x_px,y_px'


def read(path: Path, fps: float | None = None) -> Evidence:
    return evidence_from_file(path, SIZE, fps, BufferOptions())


@pytest.fixture(scope='module')
def evidence() -> Evidence:
    return synthetic_evidence(Junction(vehicles=30, points_per_vehicle=2), np.random.default_rng(0))


@pytest.fixture
def tracks(evidence: Evidence, tmp_path: Path) -> Path:
    lines = [
        f'{100 + time_s:.6f},{track.vehicle},{number},{x:.4f},{y:.4f}'
        for number, track in enumerate(evidence.tracks())
        for time_s, (x, y) in zip(track.times_s, track.points_px, strict=True)
    ]
    path = tmp_path / 'tracks.csv'
    path.write_text('\n'.join([HEADER, *lines]))
    return path


def test_tracks_survive_the_way_through_a_file(evidence: Evidence, tracks: Path) -> None:
    again = read(tracks)
    assert (again.track_count, again.image_size) == (evidence.track_count, SIZE)
    assert sorted(again.track_vehicles) == sorted(evidence.track_vehicles)
    assert again.seconds == pytest.approx(evidence.times_s.max() - evidence.times_s.min(), abs=1e-3)
    assert np.sort(again.points_px[:, 0]) == pytest.approx(np.sort(evidence.points_px[:, 0]), abs=1e-3)


@pytest.mark.solve
def test_a_camera_is_calibrated_from_a_file_of_tracks(
    tracks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ['evidence', str(tracks), '--image-size', '1280', '720', '--camera-height', '8']
    assert main([*command, '--out', str(tmp_path / 'out')]) == 0
    assert 'focal length' in capsys.readouterr().out
    assert (tmp_path / 'out' / 'calibration.json').exists()


def test_a_box_of_a_mot_file_is_the_middle_of_its_lower_side(tmp_path: Path) -> None:
    path = tmp_path / 'mot.txt'
    path.write_text('\n'.join(f'{frame},7,{100 + frame},200,40,30,1,-1,-1,-1' for frame in range(1, 6)))
    track = read(path, fps=10.0).track(0)
    assert track.vehicle == 7 and track.times_s == pytest.approx(np.arange(5) / 10)
    assert track.points_px[0] == pytest.approx([121.0, 230.0])
    with pytest.raises(UsageError, match='--fps'):
        read(path)


@pytest.mark.parametrize(
    ('text', 'says'),
    [
        ('', 'no file of tracks'),
        ('a,b,c\n1,2,3', 'time_s, vehicle_id, track_id, x_px, y_px'),
        (f'{HEADER}\n1,2,3,4', 'line 2: 5 finite numbers'),
        (f'{HEADER}\n1,2,3,4,high', "line 2.*'1,2,3,4,high'"),
        (f'{HEADER}\n1,2,3,4,nan', 'finite numbers'),
        (f'{HEADER}\n1,1e300,3,4,5', 'finite numbers'),
        (f'{HEADER}\n1,2,3,4,5\n2,2,3,4,5', 'no track of at least 3 points'),
        (HEADER + ''.join(f'\n{time},1,1,5000,{time}' for time in range(9)), '100 % of the points.*--image-size'),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / 'tracks.csv'
    path.write_text(text)
    with pytest.raises(InputError, match=says):
        read(path)


def test_bytes_and_missing_files_are_no_tracks(tmp_path: Path) -> None:
    (tmp_path / 'bytes.csv').write_bytes(bytes(range(128, 256)))
    for name, expected in (('bytes.csv', 'is no text'), ('none.csv', 'cannot read')):
        with pytest.raises(InputError, match=expected):
            read(tmp_path / name)


def test_the_size_of_the_images_is_asked_for(tracks: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['evidence', str(tracks), '--camera-height', '8']) == 2
    assert '--image-size WIDTH HEIGHT' in capsys.readouterr().err
    assert main(['evidence', str(tracks), '--image-size', '1280', '720', '--fps', '0']) == 2
    assert '--fps must be above 0' in capsys.readouterr().err

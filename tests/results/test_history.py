"""The history keeps the newest versions, one line each, whatever else is in the file."""

from __future__ import annotations

from pathlib import Path

from autocalib_ros.results.history import MAX_VERSIONS, append_version, describe_version, read_history, version_entry
from stored_results import calibration, lens_only


def test_versions_are_appended_and_described(quick_path: Path) -> None:
    path = quick_path / 'cam.history.jsonl'
    assert read_history(path) == []
    append_version(path, version_entry(calibration(300.0), 'solved', 1_700_000_000.0))
    append_version(path, version_entry(lens_only(calibration(310.0)), 'pose mended', 1_700_000_060.0))
    first, second = read_history(path)
    assert (first['time'], first['cause'], first['focal_px']) == ('2023-11-14T22:13:20+00:00', 'solved', 300.0)
    assert describe_version(first).startswith('solved: grade full, focal 300 ± 1 px, tilt 12.3 ± 0.2 deg')
    assert second['tilt_deg'] is None


def test_file_stays_small_and_strange_lines_are_left_out(quick_path: Path) -> None:
    path = quick_path / 'cam.history.jsonl'
    entry = version_entry(calibration(), 'solved', 0.0)
    path.write_text('no JSON\n[1]\n{"a": 1}\n')
    for _ in range(3):
        append_version(path, entry)
    assert read_history(path) == 3 * [entry]
    path.write_text((path.read_text().splitlines()[0] + '\n') * (MAX_VERSIONS + 5))
    append_version(path, entry)
    assert len(read_history(path)) == MAX_VERSIONS

"""Scenes that are drawn, rendered and calibrated: `autocalib benchmark scenes`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autocalib_ros.errors import UsageError
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import ground_plane
from autocalib_ros.offline.benchmark import drawn_scenes as scenes
from autocalib_ros.offline.simulate.lens import look_rotation
from autocalib_ros.results.calibration import Calibration
from stored_results import calibration


@pytest.fixture
def calibrated() -> Calibration:
    return calibration()


def test_a_scene_depends_on_seed_and_number_alone() -> None:
    assert scenes.draw_scene(3, 1) == scenes.draw_scene(3, 1)
    assert scenes.draw_scene(3, 1) != scenes.draw_scene(3, 2)


def test_scenes_span_what_they_promise() -> None:
    drawn = [scenes.draw_scene(number).options for number in range(60)]
    assert {options.scene for options in drawn} == set(scenes.DRAWN_LAYOUTS)
    assert {(options.width_px, options.height_px) for options in drawn} == set(scenes.SIZES_PX)
    assert any(options.k == scenes.DISTORTION_FREE for options in drawn)
    assert any(options.night for options in drawn) and any(options.thermal for options in drawn)
    offsets = [max(map(abs, options.principal_point_offset_px)) / options.width_px for options in drawn]
    assert 0.01 < max(offsets) <= scenes.MAX_OFFSET_FRACTION


def test_evidence_is_rendered_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scenes.draw_scene(0)
    short = replace(scene, options=replace(scene.options, duration_s=1.0, width_px=320, height_px=180, focal_px=150.0))
    evidence = scenes.evidence_of(short, tmp_path, 0)
    assert evidence.image_size == (320, 180) and evidence.frames == 15
    monkeypatch.setattr(scenes, 'gather', lambda scene: pytest.fail('rendered again'))
    assert isinstance(scenes.evidence_of(short, tmp_path, 0), Evidence)


def test_errors_are_against_the_truth(calibrated: Calibration) -> None:
    scene = scenes.draw_scene(0)
    true = scene.options
    up = look_rotation(true.yaw_deg, true.pitch_deg + 1.0, true.roll_deg)[2]
    found = replace(
        calibrated,
        grade='full',
        camera=replace(calibrated.camera, focal_px=1.02 * true.focal_px),
        ground=ground_plane(up, np.array([0.0, 0.0, 1.0]), 8.0, metric=True),
        stddev=replace(calibrated.stddev, focal_px=0.01 * true.focal_px, tilt_deg=0.5, roll_deg=0.5),
    )
    run = scenes.compare_with_truth(scene, found)
    np.testing.assert_allclose(run.z, [2.0, 2.0, 0.0], atol=0.02)
    assert run.normal_deg == pytest.approx(1.0, abs=0.01)
    assert not run.wrong
    assert scenes.compare_with_truth(
        scene, replace(found, camera=replace(found.camera, focal_px=1.06 * true.focal_px))
    ).wrong


def test_the_summary_counts_and_names_the_worst() -> None:
    runs = [
        scenes.SceneRun(0, 'junction day', 'full', True, (0.01, 0.01), (0.5, 0.5), (0.0, 0.5), 0.5),
        scenes.SceneRun(1, 'junction day', 'full', True, (0.08, 0.02), (0.5, 0.5), (0.0, 0.5), 0.5),
        scenes.SceneRun(2, 'roundabout day', 'no_agreement'),
    ]
    text = scenes.format_summary(runs)
    assert 'junction    2 of 2 accepted' in text and 'roundabout  0 of 1 accepted' in text
    assert 'beyond 3.5: 1 of 2, worst 4.0' in text
    assert text.endswith('at grade full: 1')
    assert [scenes.format_run(run).endswith('WRONG') for run in runs] == [False, True, False]


def test_wrong_numbers_are_named() -> None:
    with pytest.raises(UsageError, match='--jobs'):
        next(scenes.measure_scenes(1, jobs=0))

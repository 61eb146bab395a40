"""Cost of a live camera: what is measured, and its history."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from autocalib_ros.errors import InputError
from autocalib_ros.offline.benchmark.cost_history import COST_COLUMNS, add_to_history
from autocalib_ros.offline.benchmark.runtime import LiveCost, format_cost, measure_live_cost


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of 25 images with a truth beside it."""
    there = tmp_path_factory.mktemp('measured')
    images = there / 'images'
    images.mkdir()
    random = np.random.default_rng(0)
    for index in range(25):
        image = images / f'{index:03d}.png'
        cv2.imwrite(str(image), random.integers(0, 255, (90, 160), np.uint8))
        os.utime(image, (1e9 + 0.1 * index,) * 2)
    pose = {'R_world_from_camera': np.eye(3).tolist(), 'height': 6.0, 'position': [0, 0, 6.0]}
    (there / 'truth.json').write_text(json.dumps({'lens': {'f': 100.0}, 'camera': pose}))
    return images


@pytest.fixture(scope='module')
def measured(folder: Path) -> LiveCost:
    return measure_live_cost(folder, None)


def test_every_image_is_timed_and_the_floor_is_taken_from_frames_in_between(measured: LiveCost) -> None:
    assert measured.images_s.shape == (25,) and (measured.images_s > 0).all()
    assert len(measured.floor_s) == 3  # frames 1, 11 and 21
    assert measured.ratio == pytest.approx(measured.images_s.mean() / measured.floor_s.mean())
    assert measured.cores[0] > 0 and measured.progress_s > 0


def test_a_refusal_has_no_error_but_a_cost(measured: LiveCost) -> None:
    assert not measured.result and measured.focal_error is None and measured.normal_error_deg is None
    text = format_cost(measured)
    assert '160x90, 25 frames' in text and 'refused' in text and 'standard deviations' not in text


def test_each_measurement_adds_a_row_to_the_history(measured: LiveCost, folder: Path, tmp_path: Path) -> None:
    history = tmp_path / 'benchmarks' / 'history.csv'
    for _ in range(2):
        add_to_history(history, measured, folder)
    rows = list(csv.DictReader(history.read_text(encoding='utf-8').splitlines()))
    assert len(rows) == 2 and tuple(rows[0]) == COST_COLUMNS
    assert rows[0]['recording'] == f'{folder.parent.name}/images' and rows[0]['size'] == '160x90'
    assert rows[0]['commit'] and rows[0]['machine'] and rows[0]['grade'] == measured.result.code
    assert float(rows[0]['image_ratio']) == pytest.approx(measured.ratio, abs=0.005)
    assert rows[0]['focal_error_percent'] == ''


def test_a_file_with_other_columns_is_not_changed(measured: LiveCost, folder: Path, tmp_path: Path) -> None:
    other = tmp_path / 'other.csv'
    other.write_text('a,b\n1,2\n')
    with pytest.raises(InputError, match='other columns'):
        add_to_history(other, measured, folder)
    assert other.read_text() == 'a,b\n1,2\n'

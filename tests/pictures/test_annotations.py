"""Labels, scale bars and metre grids on top views."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.pictures.annotations import add_label, add_metre_grid, add_scale_bar
from autocalib_ros.pictures.drawing import Overlay
from autocalib_ros.pictures.scene_geometry import ScaleBar
from autocalib_ros.pictures.views import TopView

VIEW = TopView((0.0, 0.0), 12.0, 600, 400)
GROUND = GroundPlane(np.eye(3), 8.0, metric=True)


def test_a_scale_bar_is_as_long_as_its_label_says():
    bar = ScaleBar.of(VIEW, GROUND)
    assert bar == ScaleBar(10.0, 120.0, '10 m')
    overlay = Overlay(VIEW.rows, VIEW.columns)
    add_scale_bar(overlay, bar, 20.0, 380.0, 16.0, 1)
    row = overlay.composite(np.zeros((VIEW.rows, VIEW.columns), np.uint8))[378:383].max(axis=(0, 2))
    columns = np.flatnonzero(row > 100)
    assert columns.max() - columns.min() == pytest.approx(120, abs=8)  # with the rim at its ends


def test_the_scale_bar_of_a_plane_without_scale_is_in_camera_heights():
    view = TopView((0.0, 0.0), 60.0, 300, 200)
    assert ScaleBar.of(view, GroundPlane(np.eye(3), 1.0, metric=False)).text == '1 camera height'


def test_a_label_is_dark_on_light_over_any_image():
    overlay = Overlay(60, 200)
    add_label(overlay, 'camera', 20.0, 20.0, 16.0)
    for shade in (0, 255):
        label = overlay.composite(np.full((60, 200), shade, np.uint8))[19:37, 20:70]
        assert label.max() - int(label.min()) > 120


def test_the_lines_of_the_metre_grid_are_at_round_coordinates():
    overlay = Overlay(VIEW.rows, VIEW.columns)
    add_metre_grid(overlay, VIEW, 'm')
    lit = overlay.composite(np.zeros((VIEW.rows, VIEW.columns), np.uint8))[200, :500, 0] > 50
    columns = np.flatnonzero(lit)
    for x_m in (5.0, 10.0, 15.0):
        assert np.abs(columns - VIEW.pixels(np.array([x_m, 0.0]))[0]).min() <= 1
    assert len(columns) < 40

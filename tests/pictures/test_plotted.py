"""Drawings that are laid over pictures."""

from __future__ import annotations

import numpy as np
import pytest

from autocalib_ros.pictures.plotted import PlotOverlay, draw_scale_bar
from autocalib_ros.pictures.views import TopView


def test_where_nothing_is_drawn_the_picture_is_as_it_was():
    picture = np.random.default_rng(0).integers(0, 255, (60, 90, 3)).astype(np.uint8)
    assert (PlotOverlay.render(90, 60, lambda axes: None).composite(picture) == picture).all()


def test_a_pixel_of_the_drawing_is_the_pixel_of_the_picture():
    overlay = PlotOverlay.render(90, 60, lambda axes: axes.plot([20, 40], [30, 30], color='#ff0000', linewidth=3))
    laid = overlay.composite(np.zeros((60, 90), np.uint8))
    assert laid[30, 30].tolist() == [0, 0, 255]  # BGR
    columns = np.flatnonzero(laid[30, :, 2] > 128)
    rows = np.flatnonzero(laid[:, 30, 2] > 128)
    assert (rows.mean(), columns.mean()) == (pytest.approx(30, abs=0.51), pytest.approx(30, abs=0.51))


def test_a_scale_bar_is_as_long_as_it_says(monkeypatch):
    view = TopView((0.0, 0.0), 12.0, 600, 400)
    told = []
    monkeypatch.setattr('matplotlib.axes.Axes.text', lambda axes, x, y, words, **how: told.append(words))
    laid = PlotOverlay.render(600, 400, lambda axes: draw_scale_bar(axes, view, 'm')).composite(
        np.zeros((400, 600), np.uint8)
    )
    assert told == ['10 m']
    white = np.argwhere(laid[..., 0] > 200)
    row = np.bincount(white[:, 0]).argmax()
    columns = white[white[:, 0] == row, 1]
    assert columns.max() - columns.min() == pytest.approx(120, abs=3)  # with the strokes at its ends

"""Lines, words and what is laid over images."""

import numpy as np
import pytest

from autocalib_ros.pictures.drawing import (
    GREY,
    INK,
    PAPER,
    Caption,
    Overlay,
    bgr,
    caption_panel,
    draw_dots,
    draw_paths,
    draw_text,
    text_height_px,
    text_size,
    truncate_text,
    wrap_text,
)

SIZES = [(320, 240), (640, 360), (1280, 720), (1920, 1080)]
LONG = (
    '17 of 40 tracks; too little traffic across the main road yet: 3 of 10 tracks; traffic covers 9 % of the image,'
    ' 15 % are needed; about 6 min more at this rate '
) * 6


@pytest.mark.parametrize('size', SIZES)
@pytest.mark.parametrize('text', ['', 'focal length 612.30 px', LONG, 'x' * 500])
def test_words_stay_inside_their_panel_and_the_panel_in_the_picture(size, text):
    width, height = size
    panel = caption_panel(Caption('COLLECTING 42 %', text, PAPER), height, width)
    assert panel.shape[0] <= 0.45 * height and panel.shape[1] <= width
    border = np.concatenate([panel[[0, -1]].reshape(-1, 3), panel[:, [0, -1]].reshape(-1, 3)])
    assert (border == bgr(INK)).all()
    assert (panel.max(axis=2) > 200).any()


def test_letters_are_read_in_small_pictures_and_no_larger_than_needed_in_large_ones():
    assert text_height_px(240) == text_height_px(360) == 13.0
    assert 20 < text_height_px(720) < text_height_px(1080) <= text_height_px(4000) == 34.0


def test_lines_break_between_words_and_fit():
    lines = wrap_text(LONG, 15.0, 300.0, 100)
    assert ' '.join(lines) == ' '.join(LONG.split())
    assert max(text_size(line, 15.0)[0] for line in lines) <= 300


def test_text_without_room_is_truncated_with_dots():
    lines = wrap_text(LONG, 15.0, 300.0, 3)
    assert len(lines) == 3 and lines[-1].endswith(' ...')
    assert text_size(lines[-1], 15.0)[0] <= 300
    assert text_size(truncate_text('x' * 200, 15.0, 100.0), 15.0)[0] <= 100


def test_a_path_is_drawn_where_it_is_said_to_be():
    picture = np.zeros((100, 100, 3), np.uint8)
    draw_paths(picture, [np.array([[20.0, 40.0], [70.0, 40.0]])], '#ff0000', 1)
    rows, columns = np.nonzero(picture[..., 2] > 128)
    assert set(rows) == {40} and (columns.min(), columns.max()) == (20, 70)
    assert not picture[..., :2].any()


def test_a_dot_has_its_point_in_the_middle():
    picture = np.zeros((100, 100, 3), np.uint8)
    draw_dots(picture, np.array([[30.0, 60.0]]), PAPER, 5)
    rows, columns = np.nonzero(picture[..., 0] > 128)
    assert (rows.mean(), columns.mean()) == pytest.approx((60.0, 30.0), abs=0.3)


@pytest.mark.parametrize('path', [[[1e9, 0.0], [0.0, 1e9]], [[-1e9, 50.0], [1e9, 50.0]]])
def test_points_far_outside_do_no_harm(path):
    draw_paths(np.zeros((100, 100, 3), np.uint8), [np.array(path)], PAPER, 1)


def test_an_overlay_covers_by_its_opacity():
    overlay = Overlay(40, 60)
    overlay.add_box(10, 5, 30, 25, PAPER, 0.5)
    overlay.add_box(10, 5, 20, 25, GREY, 1.0)
    image = np.full((40, 60, 3), 100, np.uint8)
    picture = overlay.composite(image)
    assert (image == 100).all() and (picture == overlay.composite(image[..., 0])).all()
    assert picture[10, 25] == pytest.approx(177.5, abs=1)  # halfway between 100 and 255, rounded twice
    assert tuple(picture[10, 15]) == bgr(GREY)
    assert (picture[30:] == 100).all() and (picture[:, 30:] == 100).all()


def test_text_is_written_in_ascii():
    pictures = [np.zeros((40, 200, 3), np.uint8) for _ in range(2)]
    draw_text(pictures[0], '20 ± 3', 5, 5, 20.0, PAPER)
    draw_text(pictures[1], '20 +- 3', 5, 5, 20.0, PAPER)
    assert (pictures[0] == pictures[1]).all() and pictures[0].any()

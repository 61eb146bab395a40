"""The pictures of a running calibration against a lens and a pose that are known."""

import cv2
import numpy as np
import pytest

from autocalib_ros.lens.camera_info import camera_info
from autocalib_ros.pictures.drawing import Caption, bgr
from autocalib_ros.pictures.live_overlay import (
    HORIZON_COLOUR,
    MAX_PATHS,
    TRACKED_COLOUR,
    DebugPicture,
    LabelledTracks,
    RectifiedPicture,
    TopPicture,
)
from autocalib_ros.pictures.road import GroundGrid
from autocalib_ros.pictures.views import ground_to_image, image_to_ground

pytestmark = pytest.mark.render

SIZE = (640, 480)
BLACK = np.zeros((480, 640, 3), np.uint8)
NOTHING = np.zeros((0, 16, 2))
WORDS = Caption('CALIBRATED')


def spot(camera, ground, point_m: tuple[float, float]) -> np.ndarray:
    """A dark image with a bright spot where a point of the road is seen, grey."""
    pixel = ground_to_image(camera, ground, np.array([*point_m, 0.0]))
    apart = np.stack(np.meshgrid(np.arange(640), np.arange(480)), axis=-1) - pixel
    return (255 * np.exp(-0.5 * (apart**2).sum(axis=-1) / 2.0**2)).astype(np.uint8)


def middle_of_spot(picture: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Where a spot is, pixels (2,), in a picture that else is like `plain`."""
    weight = (picture.astype(float) - plain)[..., 0].clip(0)
    rows, columns = np.mgrid[: weight.shape[0], : weight.shape[1]]
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


@pytest.mark.parametrize('point_m', [(9.0, 0.0), (12.0, 3.0), (11.0, -5.0)])
def test_a_point_of_the_road_is_at_its_place_in_the_top_view(camera, ground, calibrated, point_m):
    picture = TopPicture.of(calibrated)
    found = middle_of_spot(picture.draw(spot(camera, ground, point_m)), picture.draw(BLACK[..., 0]))
    # the far side of a spot in the image is longer on the road, by less than a pixel here
    assert found == pytest.approx(picture.view.pixels(np.array(point_m)), abs=1.0)


def test_in_the_top_view_x_is_to_the_right_and_y_up_in_true_scale(camera, ground, calibrated):
    picture = TopPicture.of(calibrated)
    plain = picture.draw(BLACK[..., 0])
    near, ahead, left = (
        middle_of_spot(picture.draw(spot(camera, ground, point)), plain)
        for point in ((9.0, 0.0), (13.0, 0.0), (9.0, 4.0))
    )
    assert ahead - near == pytest.approx([4 * picture.view.px_per_m, 0.0], abs=1.0)
    assert left - near == pytest.approx([0.0, -4 * picture.view.px_per_m], abs=1.0)


def test_the_top_view_holds_the_camera_and_the_road_that_is_seen(calibrated):
    view = TopPicture.of(calibrated).view
    foot = view.pixels(np.zeros(2))
    assert (foot > 0).all() and foot[0] < view.columns and foot[1] < view.rows


def test_there_is_no_top_view_without_a_plane_or_without_a_road_in_sight(camera, lens_only, calibration, looking_down):
    assert TopPicture.of(lens_only) is None
    assert TopPicture.of(calibration(camera, looking_down(-80.0))) is None


def test_a_straight_line_on_the_road_is_straight_when_rectified(camera, ground, calibrated):
    line = np.column_stack([np.full(400, 6.5), np.linspace(-6, 6, 400), np.zeros(400)])
    image = np.zeros((480, 640), np.uint8)
    cv2.polylines(
        image, [np.round(16 * ground_to_image(camera, ground, line)).astype(np.int32)], False, 255, 2, cv2.LINE_AA, 4
    )
    bent, straight = (bend_px(picture) for picture in (image, RectifiedPicture(calibrated).draw(image)))
    assert bent > 5.0
    assert straight < 0.5


def bend_px(picture: np.ndarray) -> float:
    """How far the middle of a bright line strays from a straight one, pixels."""
    columns = np.flatnonzero((picture > 128).any(axis=0))
    rows = (picture[:, columns] * np.arange(len(picture))[:, None]).sum(axis=0) / picture[:, columns].sum(axis=0)
    return float(np.abs(rows - np.polyval(np.polyfit(columns, rows, 1), columns)).max())


@pytest.mark.parametrize('balance', [0.0, 0.5, 1.0])
def test_rectified_equals_the_result_of_opencv_for_the_published_camera_info(camera, ground, calibration, balance):
    info = camera_info(camera, rectified_balance=balance)
    maps = cv2.fisheye.initUndistortRectifyMap(
        np.reshape(info.k, (3, 3)),
        np.array(info.d),
        np.reshape(info.r, (3, 3)),
        np.reshape(info.p, (3, 4))[:, :3],
        SIZE,
        cv2.CV_32FC1,
    )
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8), (0, 0), 4)
    ours = RectifiedPicture(calibration(camera, ground, rectified_balance=balance)).draw(image)
    theirs = cv2.remap(image, *maps, cv2.INTER_LINEAR)
    # where the image ends, one of both may be black for a 32th of a pixel
    assert np.percentile(cv2.absdiff(ours, theirs), 99.5) <= 1


def test_rectified_is_grey_or_coloured_as_the_image_is(calibrated):
    picture = RectifiedPicture(calibrated)
    assert picture.draw(BLACK[..., 0]).shape == (480, 640)
    assert picture.draw(BLACK).shape == (480, 640, 3)


def test_the_horizon_is_drawn_where_the_road_ends(camera, ground, calibrated):
    picture = DebugPicture(SIZE, calibrated, None).draw(BLACK, NOTHING, WORDS)
    like = (np.abs(picture.astype(int) - bgr(HORIZON_COLOUR)) < 30).all(axis=2)
    like[:60, :200] = like[-60:] = False  # words
    columns = np.flatnonzero(like.any(axis=0))
    rows = np.array([np.flatnonzero(like[:, column]).mean() for column in columns])
    below, above = (image_to_ground(camera, ground, np.column_stack([columns, rows + shift])) for shift in (3, -3))
    assert len(columns) > 400
    assert np.isfinite(below).all() and np.isnan(above).all()


def test_the_grid_is_on_the_road(camera, ground, calibrated):
    picture = DebugPicture(SIZE, calibrated, None).draw(BLACK, NOTHING, WORDS)
    grid = GroundGrid.of(camera, ground)
    corners, insides = (
        ground_to_image(
            camera,
            ground,
            np.array(
                [
                    [*(grid.middle_m + grid.step_m * (np.array(place) + shift)), 0.0]
                    for place in ((-1, 0), (-1, 1), (-1, -1), (0, -1))
                ]
            ),
        )
        for shift in (0.0, 0.5)
    )
    for points, lit in ((corners, True), (insides, False)):
        columns, rows = np.round(points).astype(int).T
        assert ((picture[rows, columns].max(axis=1) > 100) == lit).all()
    assert grid.step_m == 5.0


def test_tracked_points_are_drawn_with_their_tails(calibrated):
    tail = np.column_stack([np.linspace(200, 260, 16), np.full(16, 300.0)])
    picture = DebugPicture(SIZE, None, None).draw(BLACK, tail[None], WORDS)
    # smooth lines are a little fainter than their colour
    assert picture[300, [230, 260]] == pytest.approx(np.array([bgr(TRACKED_COLOUR)] * 2), abs=30)
    assert not picture[290:310, :190].any()


def test_tracks_have_the_colour_of_their_road_and_too_many_are_thinned():
    paths = [np.array([[0.0, 100.0 + row], [600.0, 100.0 + row]]) for row in range(3 * MAX_PATHS)]
    labelled_tracks = LabelledTracks(
        SIZE, np.concatenate(paths), 2 * np.arange(len(paths) + 1), np.repeat([0, -1, -2], MAX_PATHS)
    )
    picture = DebugPicture(SIZE, None, labelled_tracks).draw(BLACK, NOTHING, WORDS)
    blue, red = picture[100 + MAX_PATHS // 2, 300, 0], picture[100 + MAX_PATHS // 2, 300, 2]
    assert blue > 80 and red < 30
    assert not picture[100 + MAX_PATHS + 10, 300].any()
    grey = picture[105 + 2 * MAX_PATHS, 300]
    assert grey.min() > 60 and int(grey.max()) - int(grey.min()) < 20
    assert (
        len(LabelledTracks(SIZE, np.concatenate(paths), labelled_tracks.starts, np.zeros(len(paths), int)).of(0))
        <= MAX_PATHS
    )


def test_tracks_of_another_image_size_are_left_out():
    labelled_tracks = LabelledTracks(
        (1280, 720), np.array([[0.0, 200.0], [600.0, 200.0]]), np.array([0, 2]), np.array([0])
    )
    assert not DebugPicture(SIZE, None, labelled_tracks).draw(BLACK, NOTHING, WORDS)[200].any()


@pytest.mark.parametrize('size', [(320, 240), (640, 360), (1920, 1080)])
def test_the_legend_stays_in_the_picture(size):
    width, height = size
    labels = np.arange(-2, 6)
    labelled_tracks = LabelledTracks(size, np.tile([[5.0, 60.0]], (16, 1)), 2 * np.arange(9), labels)
    picture = DebugPicture(size, None, labelled_tracks).draw(
        np.zeros((height, width, 3), np.uint8), NOTHING, Caption('')
    )
    legend = picture[height // 2 :]
    assert (legend[:, [0, -1]] == legend[:, [0]]).all() and (legend[-1] == legend[-1, 0]).all()
    assert (legend.max(axis=2) > 200).any()


@pytest.mark.parametrize('image', [BLACK, BLACK[..., 0]], ids=['colour', 'grey'])
def test_the_image_itself_is_not_drawn_on(calibrated, image):
    image = image.copy()
    image.flags.writeable = False
    pictures = [
        DebugPicture(SIZE, calibrated, None).draw(image, np.full((3, 16, 2), 200.0), WORDS),
        TopPicture.of(calibrated).draw(image),
    ]
    assert all(picture.ndim == 3 and picture.any() for picture in pictures)
    assert not image.any()


def test_words_are_written_anew_when_they_change(calibrated):
    picture = DebugPicture(SIZE, calibrated, None)
    first, second = (picture.draw(BLACK, NOTHING, Caption(title)) for title in ('COLLECTING 42 %', 'CALIBRATED'))
    assert (first != second).any()
    assert (first == picture.draw(BLACK, NOTHING, Caption('COLLECTING 42 %'))).all()

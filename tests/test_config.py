"""Options: defaults, types and ranges."""

from __future__ import annotations

import pytest

from autocalib_ros.config import NodeOptions, Options, ScaleOptions, flatten, walk_options, with_overrides
from autocalib_ros.errors import UsageError


def test_a_nested_option_is_set_by_its_full_name() -> None:
    assert with_overrides(Options(), {'tracking.max_points': 77}).tracking.max_points == 77


def test_setting_one_option_leaves_the_others() -> None:
    changed = with_overrides(Options(), {'gate.min_tracks': 50})
    assert with_overrides(changed, {'gate.min_tracks': Options().gate.min_tracks}) == Options()


def test_an_unknown_option_names_its_nearest_neighbour() -> None:
    with pytest.raises(UsageError, match=r"unknown option 'tracking.max_point'.*'tracking.max_points'"):
        with_overrides(Options(), {'tracking.max_point': 5})


@pytest.mark.parametrize(
    ('name', 'value', 'says'),
    [
        ('camera_height', -1.0, 'lies between 0 and 500'),
        ('camera_height', float('nan'), 'lies between'),
        ('camera_height', 'eight', 'takes a float'),
        ('method', 'magic', 'one of joint, paper'),
        ('tracking.max_points', 2.5, 'takes a int'),
        ('allow_unit_scale', 1, 'takes a bool'),
    ],
)
def test_a_value_out_of_range_says_what_is_expected(name: str, value: object, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        with_overrides(Options(), {name: value})


def test_a_whole_number_is_taken_for_a_float() -> None:
    height = with_overrides(Options(), {'camera_height': 8}).camera_height
    assert isinstance(height, float) and height == 8.0


PIXELS = '412 530 888 530'


@pytest.mark.parametrize(
    ('values', 'says'),
    [
        ({'scale_from': 'distance'}, "needs 'scale.distance_px'"),
        ({'scale_from': 'distance', 'scale.distance_px': PIXELS}, "needs 'scale.distance_m'"),
        ({'scale_from': 'distance', 'scale.distance_m': 10.0}, "needs 'scale.distance_px'"),
        ({'scale_from': 'speed'}, "needs 'scale.speed_km_h'"),
        ({'scale_from': 'guess'}, 'one of all, height, distance, speed'),
        ({'scale_from': 'speed', 'scale.speed_km_h': 50.0, 'camera_height': 8.0}, "'camera_height' is given too"),
        ({'scale.distance_px': PIXELS}, "needs 'scale.distance_m'"),
        ({'scale.distances': '1 2 300 4'}, 'five numbers for each distance'),
        ({'scale.distances': [1.0, 2.0, 300.0, 4.0, 5.0]}, 'five numbers for each distance'),
        ({'scale_from': 'height', 'scale.distances': PIXELS + ' 9'}, "'scale.distances' is given too"),
        ({'scale.distances': '1 2 3 4 5'}, 'px apart'),
        ({'lens.focal_px': 800.0, 'lens.hfov_deg': 60.0}, 'not both'),
        (
            {'scale_from': 'speed', 'scale.speed_km_h': 50.0, 'scale.distance_m': 10.0},
            "'scale.distance_m' is given too",
        ),
        ({'camera_height_sigma': 0.1}, "needs 'camera_height'"),
        ({'scale_from': 'speed', 'scale.speed_km_h': 50.0, 'method': 'paper'}, 'height or distance'),
        ({'scale_from': 'distance', 'scale.distance_px': PIXELS, 'scale.distance_m': -1.0}, 'lies between 0 and 1000'),
        ({'scale.distance_px': '1 2 3'}, "four numbers in one text.* got '1 2 3'"),
        ({'scale.distance_px': '1 2 3 nan'}, 'four numbers'),
        ({'scale.distance_px': 'here there now then'}, 'four numbers'),
        ({'scale.distance_px': [412.0, 530.0, 888.0, 530.0]}, 'four numbers in one text'),
        ({'scale.distance_px': '412 530 412 530'}, '0.0 px apart'),
        ({'scale.distance_px': '412 530 418 538'}, 'are 10.0 px apart.* standard deviation of 2 px'),
    ],
)
def test_the_scale_comes_from_one_complete_source(values: dict[str, object], says: str) -> None:
    more = {'scale.pixel_sigma_px': 2.0} if '418' in str(values) else {}
    with pytest.raises(UsageError, match=says):
        with_overrides(Options(), {**values, **more})


@pytest.mark.parametrize('text', [PIXELS, '412, 530, 888, 530', ' 412.0  530 8.88e2,530 '])
def test_pixels_are_read_from_text(text: str) -> None:
    assert ScaleOptions(distance_px=text).pixels == ((412.0, 530.0), (888.0, 530.0))


def test_pixels_reach_to_the_border_of_the_image() -> None:
    whole = ScaleOptions(distance_px='-0.5 -0.5 639.5 479.5')
    whole.require_inside(640, 480)
    with pytest.raises(UsageError, match=r'pixel \(639.5, 479.5\).* outside the images, which have 639x480'):
        whole.require_inside(639, 480)


@pytest.mark.parametrize('options', [Options(), NodeOptions()])
def test_every_option_has_a_description(options: object) -> None:
    assert all(item.doc for item in walk_options(options))


def test_names_of_core_and_node_do_not_collide() -> None:
    core, node = ({item.name for item in walk_options(options)} for options in (Options(), NodeOptions()))
    assert not core & node


def test_nested_mappings_become_full_names() -> None:
    assert flatten({'a': 1, 'b': {'c': 2, 'd': {'e': 3}}}) == {'a': 1, 'b.c': 2, 'b.d.e': 3}

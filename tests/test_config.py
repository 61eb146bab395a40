"""Options: one home for defaults, checked at the door."""

from __future__ import annotations

import pytest

from autocalib_ros.config import NodeOptions, Options, declared, flattened, with_values
from autocalib_ros.errors import UsageError


def test_a_nested_option_is_set_by_its_full_name() -> None:
    assert with_values(Options(), {'tracking.max_points': 77}).tracking.max_points == 77


def test_setting_one_option_leaves_the_others() -> None:
    changed = with_values(Options(), {'gate.min_tracks': 50})
    assert with_values(changed, {'gate.min_tracks': Options().gate.min_tracks}) == Options()


def test_an_unknown_option_names_its_nearest_neighbour() -> None:
    with pytest.raises(UsageError, match=r"unknown option 'tracking.max_point'.*'tracking.max_points'"):
        with_values(Options(), {'tracking.max_point': 5})


@pytest.mark.parametrize(('name', 'value', 'says'), [
    ('camera_height', -1.0, 'lies between 0 and 500'),
    ('camera_height', float('nan'), 'lies between'),
    ('camera_height', 'eight', 'takes a float'),
    ('method', 'magic', 'one of joint, paper'),
    ('tracking.max_points', 2.5, 'takes a int'),
    ('allow_unit_scale', 1, 'takes a bool'),
])
def test_a_value_out_of_range_says_what_is_expected(name: str, value: object, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        with_values(Options(), {name: value})


def test_a_whole_number_is_taken_for_a_float() -> None:
    height = with_values(Options(), {'camera_height': 8}).camera_height
    assert isinstance(height, float) and height == 8.0


@pytest.mark.parametrize('options', [Options(), NodeOptions()])
def test_every_option_has_a_description(options: object) -> None:
    assert all(item.doc for item in declared(options))


def test_names_of_core_and_node_do_not_collide() -> None:
    core, node = ({item.name for item in declared(options)} for options in (Options(), NodeOptions()))
    assert not core & node


def test_nested_mappings_become_full_names() -> None:
    assert flattened({'a': 1, 'b': {'c': 2, 'd': {'e': 3}}}) == {'a': 1, 'b.c': 2, 'b.d.e': 3}

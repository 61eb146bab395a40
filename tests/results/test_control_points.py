"""Control points, and the place of the ground frame in a map."""

from __future__ import annotations

import json
import math
import sys

import numpy as np
import pytest

from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.results.control_points import (
    ControlPoints,
    MapPlacement,
    place_in_map,
    read_control_points,
    to_lon_lat,
    to_utm,
)

GROUND_M = np.array([[10.0, -3.0], [25.0, 4.0], [14.0, 9.0], [31.0, -8.0]])
HEADING = math.radians(35.0)


def points_in_map(scale: float = 1.0, noise_m: float = 0.0) -> ControlPoints:
    turned = GROUND_M @ np.array([[math.cos(HEADING), math.sin(HEADING)], [-math.sin(HEADING), math.cos(HEADING)]])
    places = scale * turned + [412_000.0, 5_655_000.0] + np.random.default_rng(0).normal(0, noise_m, (4, 2))
    return ControlPoints(tuple('abcd'), np.arange(8.0).reshape(4, 2), places, 'EPSG:32633')


def test_the_ground_is_placed_and_turned():
    placement = place_in_map(GROUND_M, points_in_map())
    assert placement.heading_deg == pytest.approx(35.0)
    assert placement.translation_m == pytest.approx((412_000.0, 5_655_000.0))
    assert placement.scale == pytest.approx(1.0)
    assert max(placement.residuals_m) < 1e-6 and max(placement.left_out_m) < 1e-6
    assert placement.to_map(GROUND_M) == pytest.approx(points_in_map().places_m)


def test_a_wrong_scale_is_told_and_not_hidden():
    placement = place_in_map(GROUND_M, points_in_map(scale=1.1))
    assert placement.scale == pytest.approx(1.1)
    assert max(placement.residuals_m) > 0.5  # of 20 m


def test_a_point_left_out_is_farther_off_than_one_that_is_fitted():
    placement = place_in_map(GROUND_M, points_in_map(noise_m=0.1))
    assert all(left > kept for left, kept in zip(placement.left_out_m, placement.residuals_m, strict=True))


def test_two_points_give_no_check():
    points = points_in_map()
    two = ControlPoints(points.names[:2], points.pixels[:2], points.places_m[:2])
    assert place_in_map(GROUND_M[:2], two).left_out_m == ()


def test_a_point_above_the_horizon_is_named():
    ground = GROUND_M.copy()
    ground[2] = np.nan
    with pytest.raises(UsageError, match='control points c lie above the horizon'):
        place_in_map(ground, points_in_map())


def test_distances_join_all_points_once():
    pairs = points_in_map().distances()
    assert len(pairs) == 3 and {index for one, other, _ in pairs for index in (one, other)} == {0, 1, 2, 3}
    assert pairs[0][2] == pytest.approx(np.hypot(*(GROUND_M[3] - GROUND_M[0])))


def test_a_placement_survives_its_document():
    points = points_in_map(noise_m=0.1)
    placement = place_in_map(GROUND_M, points)
    document = json.loads(json.dumps(placement.document(points)))
    assert MapPlacement.from_document(document) == placement
    assert document['points'][1]['name'] == 'b'
    with pytest.raises(InputError, match=r'it is no map\.json'):
        MapPlacement.from_document({'crs': 'local'})


@pytest.mark.parametrize('delimiter', [', ', ';'])
def test_a_csv_file_is_read(tmp_path, delimiter):
    rows = [['name', 'u_px', 'v_px', 'x_m', 'y_m'], ['kerb', '10.5', '20', '0', '0'], ['pole', '30', '40', '3', '4']]
    path = tmp_path / 'points.csv'
    path.write_text('# measured in May\n' + '\n'.join(delimiter.join(row) for row in rows))
    points = read_control_points(path)
    assert (points.names, points.crs, points.distances()) == (('kerb', 'pole'), 'local', [(0, 1, 5.0)])
    assert points.pixels.tolist() == [[10.5, 20.0], [30.0, 40.0]]


def test_reference_points_of_otvision_are_read(tmp_path):
    point = {'x_px': 14, 'y_px': 259, 'hemisphere': 'N', 'zone_utm': 32, 'lon_utm': 844098.58, 'lat_utm': 5673186.1}
    path = tmp_path / 'site.otrfpts'
    path.write_text(json.dumps({'1': point, '2': point | {'x_px': 652, 'lon_utm': 844079.0}}))
    points = read_control_points(path)
    assert (points.crs, points.places_m[1].tolist()) == ('EPSG:32632', [844079.0, 5673186.1])


@pytest.mark.parametrize(
    ('name', 'text', 'message'),
    [
        ('p.csv', 'u_px,v_px,x_m,y_m\n1,2,3,4\n', 'has 1 control points, 2 to 1000 are needed'),
        ('p.csv', 'u,v,x,y\n1,2,3,4\n5,6,7,8\n', 'its columns are u, v, x, y; expected a CSV file'),
        ('p.csv', 'u_px,v_px,x_m,y_m\n1,2,3,four\n5,6,7,8\n', 'could not convert'),
        ('p.csv', 'u_px,v_px,x_m,y_m\n1,2,3,4\n5,6,3,4\n', 'all control points have one place'),
        ('p.csv', 'u_px,v_px,x_m,y_m\n1,2,3,nan\n5,6,7,8\n', 'not finite'),
        ('p.csv', '', 'it has no points'),
        ('p.otrfpts', '{"1": {"x_px": 1}}', 'expected a CSV file'),
        ('p.otrfpts', '[', 'expected a CSV file'),
    ],
)
def test_what_is_no_file_of_control_points_is_one_clear_line(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_control_points(tmp_path / name)


def test_latitudes_and_longitudes_go_through_utm_and_back():
    pytest.importorskip('pyproj', reason='pyproj converts maps: pip install pyproj')
    lat_lon = np.array([[51.05, 13.74], [51.051, 13.742]])
    places, code = to_utm(lat_lon)
    assert code == 'EPSG:32633' and to_lon_lat(places, code) == pytest.approx(lat_lon[:, ::-1])
    assert np.hypot(*(places[1] - places[0])) == pytest.approx(178.5, abs=1.0)


def test_without_pyproj_the_remedy_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'pyproj', None)
    (tmp_path / 'p.csv').write_text('u_px,v_px,lat,lon\n1,2,51,13\n5,6,51.1,13\n')
    with pytest.raises(UsageError, match='pip install pyproj'):
        read_control_points(tmp_path / 'p.csv')
    with pytest.raises(UsageError, match='in local metres'):
        to_lon_lat(GROUND_M, 'local')

"""Calibrations in the formats of other programs."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from autocalib_ros.cli import main
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.offline.export_formats import ExportedCamera, apply_homography, export
from autocalib_ros.results.calibration_json import write_calibration_json
from autocalib_ros.results.control_points import MapPlacement, read_control_points

NO_LIMIT = 1000.0
IN_MAP = MapPlacement('EPSG:32633', 30.0, (412_000.0, 5_655_000.0), 1.0, (), ())


@pytest.fixture
def camera(tmp_path, full):
    """Return the exported camera of a small calibration."""
    write_calibration_json(tmp_path / 'calibration.json', full.result)
    return ExportedCamera(tmp_path / 'calibration.json', 40.0)


def test_the_homography_of_the_rectified_image_is_exact(camera, tmp_path):
    (tmp_path / 'h.txt').write_text(export(camera, 'homography', None, 0.5))
    matrix = np.loadtxt(tmp_path / 'h.txt')
    pixels, points_m = camera.area
    info = camera.calibration.camera_info
    bearings, _ = camera.ground.lens.unproject(pixels)
    # a lens of 130 degrees sees nothing of the rectified image's plane near its border
    ahead = bearings[:, 2] > 0.1
    rectified = apply_homography(np.reshape(info.p, (3, 4))[:, :3], bearings[ahead, :2] / bearings[ahead, 2:])
    assert np.abs(apply_homography(matrix, rectified) - points_m[ahead]).max() < 1e-6


def test_a_homography_of_raw_pixels_states_its_error_and_is_refused_above_the_limit(camera, tmp_path):
    (tmp_path / 'h.txt').write_text(export(camera, 'raw-homography', None, NO_LIMIT))
    pixels, points_m = camera.area
    errors = np.hypot(*(apply_homography(np.loadtxt(tmp_path / 'h.txt'), pixels) - points_m).T)
    assert camera.raw.high_m == pytest.approx(np.quantile(errors, 0.95)) and camera.raw.high_m > 0.5
    for kind in ('raw-homography', 'view-transformer'):
        with pytest.raises(UsageError, match=r'is not exported\. Undistort the images first'):
            export(camera, kind, None, 0.5)


def test_four_points_give_the_same_homography(camera):
    document = json.loads(export(camera, 'view-transformer', None, NO_LIMIT))
    source, target = (np.array(document[name], np.float32) for name in ('source', 'target'))
    matrix = cv2.getPerspectiveTransform(source, target)
    pixels, _ = camera.area
    difference = apply_homography(matrix, pixels) - apply_homography(camera.raw.matrix, pixels)
    assert np.median(np.abs(difference)) < 0.02  # pixels are written to a hundredth
    assert 'pixels of the images as delivered to metres; a 3x3 homography' in document['note']


def test_opencv_projects_as_the_calibration_does(camera, tmp_path):
    (tmp_path / 'c.yml').write_text(export(camera, 'opencv', None, 0.5))
    storage = cv2.FileStorage(str(tmp_path / 'c.yml'), cv2.FILE_STORAGE_READ)
    assert storage.getNode('distortion_model').string() == 'fisheye'
    names = ('rotation_vector', 'translation_vector', 'camera_matrix', 'distortion_coefficients')
    turn, shift, matrix, coefficients = (storage.getNode(name).mat() for name in names)
    pixels, points_m = camera.area
    world = np.column_stack([points_m, np.zeros(len(points_m))])[:, None]
    projected, _ = cv2.fisheye.projectPoints(world, turn, shift, matrix, coefficients)
    assert np.abs(projected[:, 0] - pixels).max() < 1e-3


def test_kalibr_gets_its_camera_chain(camera):
    chain = yaml.safe_load(export(camera, 'kalibr', None, 0.5))['cam0']
    assert (chain['camera_model'], chain['distortion_model'], chain['resolution']) == (
        'pinhole',
        'equidistant',
        [320, 180],
    )
    assert chain['intrinsics'][0] == 140.0 and len(chain['distortion_coeffs']) == 4


def test_otvision_gets_reference_points_in_utm(camera, tmp_path):
    path = tmp_path / 'site.otrfpts'
    path.write_text(export(camera, 'otrfpts', IN_MAP, 0.5))
    points = read_control_points(path)
    assert points.crs == 'EPSG:32633' and 6 <= len(points.pixels) <= 12
    expected = IN_MAP.to_map(camera.ground.points(points.pixels).points_m[:, :2])
    assert np.abs(points.places_m - expected).max() < 0.3  # pixels are written to a hundredth


@pytest.mark.parametrize(
    ('kind', 'placement', 'message'),
    [
        ('otrfpts', None, 'calibrate with --control-points'),
        ('geojson', None, 'calibrate with --control-points'),
        ('otrfpts', replace(IN_MAP, crs='local'), 'OTVision takes UTM'),
        ('geojson', replace(IN_MAP, crs='local'), 'in local metres'),
    ],
)
def test_a_map_that_is_missing_is_said(camera, kind, placement, message):
    with pytest.raises(UsageError, match=message):
        export(camera, kind, placement, 0.5)


def test_geojson_shows_camera_and_road(camera):
    pytest.importorskip('pyproj', reason='pyproj converts maps: pip install pyproj')
    document = json.loads(export(camera, 'geojson', IN_MAP, 0.5))
    foot, road = (feature['geometry'] for feature in document['features'])
    assert foot['coordinates'] == pytest.approx([13.74, 51.04], abs=0.05)
    assert road['type'] == 'Polygon' and road['coordinates'][0][0] == road['coordinates'][0][-1]


def test_a_lens_without_ground_is_not_exported(tmp_path, lens_only):
    write_calibration_json(tmp_path / 'calibration.json', lens_only.result)
    with pytest.raises(InputError, match='it has no ground plane'):
        ExportedCamera(tmp_path / 'calibration.json', 40.0)


def test_the_command_writes_a_file_and_tells_the_error(camera, tmp_path, capsys):
    out = tmp_path / 'h.txt'
    arguments = ['export', str(tmp_path / 'calibration.json'), '--format', 'homography', '--out', str(out)]
    assert main(arguments) == 0
    assert np.loadtxt(out).shape == (3, 3)
    assert 'A 3x3 homography of raw pixels' in capsys.readouterr().err
    assert main([*arguments, '--range', '0']) == 2
    assert 'the range must lie between' in capsys.readouterr().err

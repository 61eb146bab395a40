"""One page over many cameras."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from autocalib_ros.cli import main
from autocalib_ros.errors import InputError
from autocalib_ros.report.index_page import write_index
from autocalib_ros.results.calibration_json import write_calibration_json
from browser import browser, chromium


@pytest.fixture
def site(tmp_path, full, refused, lens_only):
    """Return a folder with a calibration, a lens, a refusal and a file that is none."""
    for name, scene in (('north', full), ('<b>', lens_only), ('south/cam 2', refused)):
        write_calibration_json(tmp_path / name / 'calibration.json', scene.result)
    (tmp_path / 'south' / 'cam 2' / 'report.html').write_text('page')
    (tmp_path / 'north' / 'figures').mkdir()
    cv2.imwrite(str(tmp_path / 'north' / 'figures' / 'ground_grid.png'), np.full((90, 160, 3), 90, np.uint8))
    (tmp_path / 'torn').mkdir()
    (tmp_path / 'torn' / 'calibration.json').write_text('{')
    return tmp_path


def test_each_camera_has_a_card_and_what_needs_attention_comes_first(site):
    path, cameras = write_index(site)
    page = path.read_text()
    assert cameras == 4
    assert re.findall('<li class="([a-z]+)">', page) == ['refused', 'unreadable', 'partial', 'calibrated']
    assert 'href="south/cam%202/report.html"' in page and '&lt;b&gt;' in page and '<b>' not in page
    assert 'data:image/jpeg;base64,' in page and 'it is not JSON' in page
    assert '140 ± 1.5 px' in page and '8.00 ± 0.05 m' in page


def test_the_command_says_what_it_wrote(site, tmp_path, capsys):
    assert main(['index', str(site)]) == 0
    assert capsys.readouterr().out == f'Written to {site / "index.html"}: 4 cameras\n'
    assert main(['index', str(site / 'north')]) == 0
    assert capsys.readouterr().out.endswith(': 1 camera\n')
    (tmp_path / 'empty').mkdir()
    with pytest.raises(InputError, match=r'there is no calibration\.json'):
        write_index(tmp_path / 'empty')


@pytest.mark.render
@pytest.mark.skipif(chromium() is None, reason='no Chromium: apt-get install chromium')
def test_the_page_fits_a_desk_and_a_telephone(site):
    path, _ = write_index(site)
    with browser() as page:
        for width in (1280, 390):
            page.open(path, width)
            assert page.value('document.documentElement.scrollWidth <= document.documentElement.clientWidth')
        assert not page.complaints


def test_a_file_that_is_a_list_is_a_card_and_no_end(site):
    (site / 'torn' / 'calibration.json').write_text('[]')
    path, cameras = write_index(site)
    assert cameras == 4 and 'it holds no names with values' in path.read_text()


def test_cameras_beyond_the_most_pictures_are_shown_without_one_and_the_page_says_so(site, monkeypatch):
    monkeypatch.setattr('autocalib_ros.report.index_page.MAX_PICTURES', 1)
    path, cameras = write_index(site)
    page = path.read_text()
    assert cameras == 4 and page.count('<li class=') == 4 and '<img' not in page  # the first one has no picture
    assert 'The first 1 are shown with a picture' in page

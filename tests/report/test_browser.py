"""The page in a real browser, on a desk and on a telephone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest

from autocalib_ros.ground import PERTURBATION_SIGMAS, Ground
from browser import Browser, browser, chromium

pytestmark = [
    pytest.mark.render,
    pytest.mark.skipif(chromium() is None, reason='no Chromium: apt-get install chromium'),
]
WIDTHS = {'desktop': 1280, 'telephone': 390}
UNDECODED = '[...document.images].filter(image => !(image.complete && image.naturalWidth)).length'
TOO_WIDE = (
    '[...document.querySelectorAll("body *")].filter(one => !one.closest("figure label") && '
    'one.getBoundingClientRect().right > innerWidth + 0.5).map(one => one.tagName + ": " + one.textContent)'
)


@pytest.fixture(scope='module')
def page() -> Iterator[Browser]:
    """Yield a browser."""
    with browser() as one:
        yield one


@pytest.mark.parametrize('kind', ['full', 'lens_only', 'refused'])
def test_the_page_renders_whole_and_complains_of_nothing(page, written, kind):
    report = written(kind)
    for width in WIDTHS.values():
        page.open(report, width)
        assert page.value('innerWidth') == width
        assert page.value('document.documentElement.scrollWidth <= document.documentElement.clientWidth')
        assert page.value(TOO_WIDE) == []
        assert page.value('document.images.length') == len(list((report.parent / 'figures').iterdir()))
        assert page.value(UNDECODED) == 0
    shown = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape[1] == width and shown.std() > 10
    assert not page.complaints


def test_a_touch_enlarges_a_picture_and_leaves_the_page_as_wide(page, written):
    page.open(written('refused'), WIDTHS['telephone'])
    before = page.value('document.images[0].clientWidth')
    page.value('document.querySelector("figure label").click()')
    assert page.value('document.images[0].clientWidth') > 2 * before
    assert page.value('document.documentElement.scrollWidth <= document.documentElement.clientWidth')


def test_the_browser_collects_the_complaints_of_a_page(page, tmp_path):
    path = tmp_path / 'bad.html'
    path.write_text('<img src="https://example.invalid/a.png"><script>console.error("broken"); nothing.there</script>')
    page.open(path, 390)
    complaints = ' '.join(page.complaints)
    page.complaints.clear()  # those of the other pages are none
    assert 'broken' in complaints and 'nothing is not defined' in complaints and 'example.invalid' in complaints


def length_m(ground, lens, rotation, camera_m, pixels):
    ends = replace(ground, lens=lens, rotation=rotation, camera_m=camera_m).points(pixels).points_m
    return np.hypot(*(ends[0] - ends[1])[:2])


def test_two_clicks_measure_a_length_and_its_sigma(page, written, full):
    page.open(written('full'), WIDTHS['desktop'])
    ground = Ground.of(full.result)
    pixels, _ = ground.pixels(np.array([[6.0, 2.0], [14.0, 10.0]]))
    found_m, sigma_m = page.value(f'autocalibRuler({pixels[0].tolist()}, {pixels[1].tolist()})')
    assert found_m == pytest.approx(np.hypot(8, 8), abs=1e-6)
    moved = [length_m(ground, *camera, pixels) for camera in ground.perturbations]
    by_camera = (np.array(moved[::2]) - moved[1::2]) / (2 * PERTURBATION_SIGMAS)
    clicks = pixels + np.eye(4).reshape(4, 2, 2)
    by_click = [length_m(ground, ground.lens, ground.rotation, ground.camera_m, one) - found_m for one in clicks]
    assert sigma_m == pytest.approx(np.sqrt((by_camera**2).sum() + np.square(by_click).sum()), rel=1e-3)
    assert page.value(f'autocalibRuler([10, -5000], {pixels[1].tolist()})') is None
    for picture in ('ruler-image', 'ruler-top'):
        click = (
            f'(() => {{ const svg = document.getElementById("{picture}"), box = svg.getBoundingClientRect();'
            'for (const [x, y] of [[0.5, 0.7], [0.6, 0.9]]) svg.dispatchEvent(new MouseEvent("click", {clientX: '
            'box.left + x * box.width, clientY: box.top + y * box.height, bubbles: true}));'
            f'return document.getElementById("{picture}-length").textContent; }})()'
        )
        assert page.value(click).split()[1] == 'm'
    assert not page.complaints

"""The page in a real browser, on a desk and on a telephone."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

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

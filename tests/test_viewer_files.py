"""The files for RViz and Foxglove: that they parse, and name what the README lists."""

import json
import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
RVIZ, FOXGLOVE = ROOT / 'config' / 'autocalib.rviz', ROOT / 'config' / 'foxglove_layout.json'
NODE = '/cam1/autocalib/'


@pytest.fixture(scope='module')
def rviz() -> dict:
    return yaml.safe_load(RVIZ.read_text(encoding='utf-8'))['Visualization Manager']


@pytest.fixture(scope='module')
def foxglove() -> dict:
    return json.loads(FOXGLOVE.read_text(encoding='utf-8'))


def panels(layout: str | dict) -> list[str]:
    """Return the panels of a layout tree, from the left and the top."""
    if isinstance(layout, str):
        return [layout]
    assert layout['direction'] in ('row', 'column') and 0 < layout['splitPercentage'] < 100
    return panels(layout['first']) + panels(layout['second'])


def test_rviz_shows_every_picture_markers_points_and_frames(rviz):
    classes = sorted(display['Class'].partition('/')[2] for display in rviz['Displays'])
    assert classes == ['Image', 'Image', 'Image', 'MarkerArray', 'PointCloud2', 'TF']
    names = [display['Name'] for display in rviz['Displays']]
    assert len(set(names)) == len(names)


def test_rviz_asks_for_latched_markers(rviz):
    (topic,) = (display['Topic'] for display in rviz['Displays'] if display['Class'].endswith('MarkerArray'))
    assert topic['Durability Policy'] == 'Transient Local'


def test_every_panel_of_foxglove_is_placed_once_and_has_its_settings(foxglove):
    assert sorted(panels(foxglove['layout'])) == sorted(foxglove['configById'])
    kinds = {name.partition('!')[0] for name in foxglove['configById']}
    assert kinds == {'Image', '3D', 'DiagnosticSummary', 'DiagnosticStatusPanel', 'RawMessages'}


def test_both_show_topics_that_the_reference_lists(rviz, foxglove):
    page = (ROOT / 'docs' / 'reference' / 'topics-services-diagnostics.md').read_text(encoding='utf-8')
    names = re.findall(r'^\| `([~/\w]+)`', page, re.MULTILINE)
    # ground_points is of the node that stands beside it, in its namespace
    listed = {NODE + name if name == 'ground_points' else name.replace('~/', NODE) for name in names}
    shown = {display['Topic']['Value'] for display in rviz['Displays'] if 'Topic' in display}
    shown |= set(re.findall(r'"(/[\w/]+)"', json.dumps(foxglove)))
    assert shown >= {NODE + name for name in ('debug_image', 'top_view', 'markers', 'ground_points')}
    assert shown <= listed


def test_both_files_are_installed():
    assert "glob('config/*')" in (ROOT / 'setup.py').read_text(encoding='utf-8')

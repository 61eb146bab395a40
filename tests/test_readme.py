"""The README's two commands: what a user runs first, and what .ci/run tests."""

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from autocalib_ros.calibrator import solve
from autocalib_ros.cli import main
from autocalib_ros.commands.replay_command import DEFAULT_OUT
from autocalib_ros.config import NodeOptions, Options, OptionSpec, walk_options
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence
from autocalib_ros.results.calibration_json import write_calibration_json
from autocalib_ros.ros.status import Counts, Situation, status

ROOT = Path(__file__).parent.parent
README = ROOT / 'README.md'
START = 'python3 -m venv'
MADE = re.compile(r"(?:create_\w+\([^')]*|\w+_publisher\([^')]*|resolve_topic_name\()'([~/\w]+)'")
"""A publisher, subscription, service or client that is made, and its name."""
LARGEST_PICTURE = 300_000
"""Bytes that a page at its top may take to load."""


@pytest.fixture(scope='module')
def commands() -> list[str]:
    """Return the fenced commands that install into a virtual environment, in order."""
    blocks = re.findall(r'^```[a-z]*\n(.*?)^```$', README.read_text(encoding='utf-8'), re.MULTILINE | re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.startswith(START)]


def test_readme_holds_two_commands(commands):
    assert len(commands) == 2
    assert commands[0].endswith('.venv/bin/autocalib demo')
    assert commands[1].endswith('-m pytest -n 2')


def table_row(name: str) -> str:
    """Return the row of the table that begins with a name."""
    rows = re.findall(rf'^\| `{re.escape(name)}`.*$', README.read_text(encoding='utf-8'), re.MULTILINE)
    assert len(rows) == 1, f'{name}: {rows}'
    return rows[0]


@pytest.mark.parametrize('item', list(walk_options(NodeOptions())), ids=lambda item: item.name)
def test_every_option_of_the_node_stands_in_the_table_with_its_default_and_choices(item: OptionSpec):
    default = str(item.default).lower() if isinstance(item.default, bool) else str(item.default) or "`''`"
    choices = f'; one of {", ".join(item.choices)}' if item.choices else ''
    assert table_row(item.name) == f'| `{item.name}` | {default} | {item.doc}{choices} |'


def test_every_value_of_diagnostics_is_listed():
    keys = [key for key, _ in status(Situation(topic='', counts=Counts())).values]
    prose = ' '.join(README.read_text(encoding='utf-8').split())
    assert ', '.join(f'`{key}`' for key in keys) + '.' in prose


@pytest.mark.parametrize('source', sorted((ROOT / 'autocalib_ros' / 'ros').glob('*.py')), ids=lambda path: path.name)
def test_every_topic_and_service_of_the_live_shell_stands_in_a_table(source: Path):
    for name in MADE.findall(source.read_text(encoding='utf-8')):
        assert table_row(name)


def test_topics_and_services_are_found_in_the_code():
    text = ''.join(path.read_text(encoding='utf-8') for path in (ROOT / 'autocalib_ros' / 'ros').glob('*.py'))
    known = {'image', 'camera_info_in', '/diagnostics', '~/camera_info', '~/calibrate', '~/top_view'}
    assert known <= set(MADE.findall(text))


def test_ci_runs_the_second_command(commands):
    script = (ROOT / '.ci' / 'run').read_text(encoding='utf-8')
    extraction = re.search(r'test_command=\$\((.*)\)$', script, re.MULTILINE)
    assert extraction is not None
    done = subprocess.run(
        ['bash', '-c', extraction.group(1)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, 'root': str(ROOT)},
    )
    assert done.stdout.strip() == commands[1]


def test_the_example_of_a_tracker_runs(tmp_path, monkeypatch):
    (block,) = re.findall(r'^```python\n(.*?)^```$', README.read_text(encoding='utf-8'), re.MULTILINE | re.DOTALL)
    evidence = synthetic_evidence(Junction(), np.random.default_rng(0))
    (tmp_path / 'results').mkdir()
    write_calibration_json(tmp_path / 'results' / 'calibration.json', solve(evidence, Options(camera_height=8.0)))
    monkeypatch.chdir(tmp_path)
    measured = []
    names = {'tracker': SimpleNamespace(measure=lambda place, noise: measured.append((place.shape, noise.shape)))}
    exec(compile(block, str(README), 'exec'), names)
    assert measured == [((2,), (2, 2))] * 2
    assert names['seen'].shape == (2,) and (names['found'].sigma_m > 0).all()


def test_the_picture_at_the_top_is_what_its_command_makes(tmp_path, monkeypatch):
    ((link, title),) = re.findall(r'!\[[^\]]+\]\((\S+) "([^"]+)"\)', README.read_text(encoding='utf-8'))
    demo, picture = (shlex.split(command) for command in title.split(' && '))
    assert demo == ['autocalib', 'demo', '--keep-bag']
    assert picture[:2] == ['autocalib', 'picture'] and picture[4] == link
    assert Path(picture[2]).parent == Path(picture[3]).parent == DEFAULT_OUT
    assert (ROOT / link).stat().st_size < LARGEST_PICTURE
    # the same command on images of a moment, in place of the recording that takes minutes to simulate
    evidence = synthetic_evidence(Junction(), np.random.default_rng(0))
    monkeypatch.chdir(tmp_path)
    write_calibration_json(Path(picture[2]), solve(evidence, Options(camera_height=8.0)))
    still = picture[3] + '.avi'
    writer = cv2.VideoWriter(still, cv2.VideoWriter_fourcc(*'MJPG'), 0.1, (1280, 720))
    for _ in range(6):
        writer.write(np.full((720, 1280, 3), 90, np.uint8))
    writer.release()
    assert main([*picture[1:3], still, *picture[4:]]) == 0
    assert cv2.imread(link).shape == cv2.imread(str(ROOT / link)).shape


@pytest.mark.slow
@pytest.mark.skipif(
    os.environ.get('AUTOCALIB_README_TEST') != '1',
    reason='installs everything anew, minutes: set AUTOCALIB_README_TEST=1',
)
def test_first_command_calibrates_the_demo(commands, tmp_path):
    checkout = tmp_path / 'autocalib_ros'
    made = shutil.ignore_patterns('.git', '.venv*', 'build', 'install', 'log', '*.egg-info')
    shutil.copytree(ROOT, checkout, ignore=made)
    # A ROS of pip in this process would leak its libraries into the new environment.
    clean = {
        name: value
        for name, value in os.environ.items()
        if name not in ('_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'LD_LIBRARY_PATH', 'PYTHONPATH', 'VIRTUAL_ENV')
    }
    done = subprocess.run(
        ['bash', '-euo', 'pipefail', '-c', commands[0]],
        cwd=checkout,
        env=clean,
        text=True,
        capture_output=True,
        timeout=1800,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr

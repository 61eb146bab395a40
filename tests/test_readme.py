"""The README's two commands, which a user runs first and .ci/run tests, and its picture.

What its text says is tested with the other pages in test_docs.py.
"""

import os
import re
import shlex
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from autocalib_ros.cli import main
from autocalib_ros.commands.replay_command import DEFAULT_OUT
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration_json import write_calibration_json
from synthetic_results import full_result, junction_evidence

ROOT = Path(__file__).parent.parent
README = ROOT / 'README.md'
START = 'python3 -m venv'
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
    assert commands[1].endswith('-m pytest -n 3 --dist worksteal')


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


def test_the_picture_at_the_top_is_what_its_command_makes(tmp_path, monkeypatch):
    ((link, title),) = re.findall(r'!\[[^\]]+\]\((\S+) "([^"]+)"\)', README.read_text(encoding='utf-8'))
    demo, picture = (shlex.split(command) for command in title.split(' && '))
    assert demo == ['autocalib', 'demo', '--keep-bag']
    assert picture[:2] == ['autocalib', 'picture'] and picture[4] == link
    assert Path(picture[2]).parent == Path(picture[3]).parent == DEFAULT_OUT
    assert (ROOT / link).stat().st_size < LARGEST_PICTURE
    # the same command on images of a moment, in place of the recording that takes minutes to simulate
    monkeypatch.chdir(tmp_path)
    result = full_result(junction_evidence())
    evidence = replace(result.evidence, image_size=(1280, 720))
    write_calibration_json(
        Path(picture[2]), replace(result, camera=Camera.equidistant(1280, 720, 560.0), evidence=evidence)
    )
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

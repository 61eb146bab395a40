"""The README's two commands: what a user runs first, and what .ci/run tests."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = ROOT / 'README.md'
START = 'python3 -m venv'


@pytest.fixture(scope='module')
def commands() -> list[str]:
    """Return the fenced commands that install into a virtual environment, in order."""
    blocks = re.findall(r'^```[a-z]*\n(.*?)^```$', README.read_text(encoding='utf-8'), re.MULTILINE | re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.startswith(START)]


def test_readme_holds_two_commands(commands):
    assert len(commands) == 2
    assert commands[0].endswith('.venv/bin/autocalib demo')
    assert commands[1].endswith('-m pytest')


def test_ci_runs_the_second_command(commands):
    script = (ROOT / '.ci' / 'run').read_text(encoding='utf-8')
    extraction = re.search(r'test_command=\$\((.*)\)$', script, re.MULTILINE)
    assert extraction is not None
    done = subprocess.run(['bash', '-c', extraction.group(1)], capture_output=True, text=True, check=True,
                          env={**os.environ, 'root': str(ROOT)})
    assert done.stdout.strip() == commands[1]


@pytest.mark.slow
@pytest.mark.skipif(os.environ.get('AUTOCALIB_README_TEST') != '1',
                    reason='installs everything anew, minutes: set AUTOCALIB_README_TEST=1')
def test_first_command_calibrates_the_demo(commands, tmp_path):
    checkout = tmp_path / 'autocalib_ros'
    made = shutil.ignore_patterns('.git', '.venv*', 'build', 'install', 'log', '*.egg-info')
    shutil.copytree(ROOT, checkout, ignore=made)
    # A ROS of pip in this process would leak its libraries into the new environment.
    clean = {name: value for name, value in os.environ.items()
             if name not in ('_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'LD_LIBRARY_PATH', 'PYTHONPATH', 'VIRTUAL_ENV')}
    done = subprocess.run(['bash', '-euo', 'pipefail', '-c', commands[0]], cwd=checkout, env=clean, text=True,
                          capture_output=True, timeout=1800, check=False)
    assert done.returncode == 0, done.stdout + done.stderr

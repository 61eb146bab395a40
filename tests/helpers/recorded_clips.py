"""Where the recorded clips are that some tests need."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get('AUTOCALIB_TEST_DATA', '')) / 'data'
needs_recorded_clips = pytest.mark.skipif(
    not os.environ.get('AUTOCALIB_TEST_DATA') or not DATA.is_dir(),
    reason='AUTOCALIB_TEST_DATA does not name a folder with recorded clips',
)
"""Marks a test, or a module, that reads `DATA`; the variable may be unset or empty."""

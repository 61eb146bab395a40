"""Parameters of tests that cost seconds for each of many cases."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def one_and_exhaustive(cases: Iterable[Any]) -> list[Any]:
    """Return the first case as it is, and the others for `pytest -m exhaustive`."""
    first, *others = cases
    return [first, *(pytest.param(case, marks=pytest.mark.exhaustive) for case in others)]

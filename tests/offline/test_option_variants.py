"""Documented options on evidence with known truth: `autocalib benchmark options`."""

from __future__ import annotations

from pathlib import Path

import pytest

from autocalib_ros.config import Options
from autocalib_ros.errors import UsageError
from autocalib_ros.offline.benchmark import option_variants as variants
from autocalib_ros.offline.benchmark.golden import read_cases
from autocalib_ros.offline.parameter_file import override_options
from autocalib_ros.results.calibration import Calibration
from stored_results import calibration

GOLDEN = Path(__file__).parents[1] / 'golden'


@pytest.fixture
def quick_golden(monkeypatch: pytest.MonkeyPatch) -> Path:
    """The golden folder, of which the first two cases count."""
    monkeypatch.setattr(variants, 'read_cases', lambda folder: read_cases(folder)[:2])
    return GOLDEN


def test_every_variant_is_an_option_with_another_value() -> None:
    for name, value in variants.VARIANTS:
        changed = override_options(Options(), {name: value})
        assert changed != Options(), name


def test_options_and_pairs_are_tried_on_all_cases(monkeypatch: pytest.MonkeyPatch, quick_golden: Path) -> None:
    seen = []
    monkeypatch.setattr(variants, 'solve', lambda evidence, options: seen.append(options))
    runs = list(variants.measure_variants(quick_golden, pairs=True, only=['joint.road_angle', 'joint.max_tracks']))
    assert [run.name for run in runs] == [
        '(none)',
        'joint.road_angle=free',
        'joint.max_tracks=300',
        'joint.road_angle=free joint.max_tracks=300',
    ]
    cases = runs[0].cases
    assert cases >= 1 and len(seen) == 4 * cases
    assert (seen[-1].joint.road_angle, seen[-1].joint.max_tracks) == ('free', 300)


def test_a_wrong_result_is_found_and_named(monkeypatch: pytest.MonkeyPatch, quick_golden: Path) -> None:
    wrong: Calibration = calibration(focal_px=100.0)
    monkeypatch.setattr(variants, 'solve', lambda evidence, options: wrong)
    run = next(variants.measure_variants(quick_golden))
    assert run.wrong and run.worst_case and run.accepted == run.cases
    assert variants.format_variant(run).endswith('WRONG')


def test_unknown_options_are_named(quick_golden: Path) -> None:
    with pytest.raises(UsageError, match=r"no such option 'joint\.lens'"):
        next(variants.measure_variants(quick_golden, only=['joint.lens']))

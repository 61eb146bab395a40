"""Results with a tenth of the vehicles left out: `autocalib benchmark stability`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autocalib_ros.config import Options
from autocalib_ros.errors import UsageError
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.benchmark import stability
from autocalib_ros.results.calibration import Calibration
from stored_results import calibration

EVIDENCE = Path(__file__).parents[1] / 'golden' / 'sparse.npz'


def measured(monkeypatch: pytest.MonkeyPatch, *results: Calibration) -> tuple[stability.StabilityRun, list[int]]:
    """Measure with results that are given in turn; and the numbers of vehicles that they were found from."""
    vehicles: list[int] = []
    rest = list(results)

    def solved(evidence: Evidence, options: Options) -> Calibration:
        vehicles.append(len(np.unique(evidence.track_vehicles)))
        return rest.pop(0)

    monkeypatch.setattr(stability, 'solve', solved)
    return next(stability.measure_stability([EVIDENCE], Options(), draws=len(results) - 1)), vehicles


def test_a_tenth_of_the_vehicles_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    run, vehicles = measured(monkeypatch, *[calibration()] * 4)
    assert vehicles[0] > 10
    assert set(vehicles[1:]) == {vehicles[0] - round(0.1 * vehicles[0])}
    assert run.stable and run.same == 1.0 and run.spread_sigmas == (0.0, 0.0, 0.0)


def test_numbers_that_spread_are_unstable(monkeypatch: pytest.MonkeyPatch) -> None:
    run, _ = measured(monkeypatch, calibration(300.0), calibration(301.0), calibration(299.0))
    assert run.spread_sigmas[0] == pytest.approx(1.0, abs=0.01)
    assert not run.stable and stability.format_stability(run).endswith('UNSTABLE')


def test_a_grade_that_changes_is_unstable(monkeypatch: pytest.MonkeyPatch) -> None:
    run, _ = measured(monkeypatch, calibration(), calibration(), replace(calibration(), grade='assumed'))
    assert run.same == 0.5 and not run.stable
    assert 'assumed' in stability.format_stability(run)


def test_wrong_numbers_of_draws_are_named() -> None:
    with pytest.raises(UsageError, match='--draws'):
        next(stability.measure_stability([EVIDENCE], Options(), draws=0))

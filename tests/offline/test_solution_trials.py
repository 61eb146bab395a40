"""When solutions are tried on the way through a recording."""

from __future__ import annotations

from concurrent.futures import Future
from functools import partial

import pytest

from autocalib_ros.config import Options
from autocalib_ros.offline import solution_trials
from autocalib_ros.offline.solution_trials import SolutionTrials
from autocalib_ros.solver_process import SolverDied


class Late(Future):
    """A solution that takes until somebody waits for it."""

    def __init__(self, outcome):
        super().__init__()
        self._outcome = outcome

    def result(self, timeout=None):
        return self._outcome


def done(outcome):
    future = Future()
    future.set_result(outcome)
    return future


def lost(_outcome):
    future = Future()
    future.set_exception(SolverDied('the solver process ended with status -9'))
    return future


@pytest.fixture(autouse=True)
def snapshots(monkeypatch):
    """Snapshots that are the outcomes themselves."""
    monkeypatch.setattr(solution_trials, 'append_snapshot', lambda moments, result: (*moments, result))


def tried(make, outcomes, until_s=200, duration_s=None):
    """Return at which seconds solutions began, and the trials."""
    began, outcomes = [], iter(outcomes)

    def start(evidence, options, lens):
        began.append(evidence())
        return make(next(outcomes))

    trials = SolutionTrials(Options(), start)
    for seconds in range(10, until_s):
        if trials.is_due(seconds, duration_s):
            trials.start(seconds, partial(int, seconds), None)
        trials.take_finished()
    trials.finish()
    return began, trials


@pytest.mark.parametrize('make', [done, Late])
def test_a_refused_solution_is_tried_at_twice_the_length_and_an_accepted_one_at_four_times(make):
    began, trials = tried(make, ['', '', 'accepted', 'accepted'])
    assert began == [10, 20, 40, 160]
    assert (trials.accepted_at_s, trials.latest, len(trials.moments)) == (40, 'accepted', 4)


def test_evidence_that_may_be_due_waits_for_the_solution_before():
    began, first = [], Late('accepted')
    trials = SolutionTrials(Options(), lambda evidence, options, lens: began.append(evidence()) or first)
    for seconds in range(10, 50):
        if trials.is_due(seconds, None):
            trials.start(seconds, partial(int, seconds), None)
        trials.take_finished()
    assert began == [10]
    trials.finish()
    assert began == [10, 40]


def test_no_solution_is_tried_in_the_second_half_of_a_recording():
    assert tried(done, ['', '', ''], duration_s=70)[0] == [10, 20]


def test_another_still_part_begins_anew():
    _, trials = tried(Late, ['accepted'], until_s=15)
    trials.begin_part(30.0)
    assert (trials.accepted_at_s, trials.latest, trials.moments) == (None, None, ())
    assert trials.is_due(10, None)


def test_a_solver_that_dies_costs_one_solution_and_not_the_recording(caplog):
    began, trials = tried(lost, ['', '', ''], until_s=50)
    assert began == [10, 20, 40] and trials.accepted_at_s is None
    assert 'ended with status -9' in caplog.text

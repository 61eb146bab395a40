"""Solutions that tests share: the same question is solved once in a session."""

from __future__ import annotations

import hashlib
import pickle
from unittest import mock

import numpy as np

from autocalib_ros.config import JointOptions, Options
from autocalib_ros.estimation import estimate
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.solution import Solution
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import Junction, synthetic_evidence
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.refusals import Reason

ONE_FAMILY = JointOptions(lens_prior='equidistant', single_road=False)
"""For questions that depend neither on how the family of the lens is chosen, each of which is another solution, nor on
a single road without further evidence."""
FIND_SOLUTION = estimate.find_solution
_RESULTS: dict[bytes, Calibration | Refusal] = {}
_SOLUTIONS: dict[bytes, Solution | Reason] = {}
_TRAFFIC: dict[bytes, Evidence] = {}


def solve_once(evidence: Evidence, options: Options, *, lens: Camera | None = None) -> Calibration | Refusal:
    """Return what `solve` returns, from memory where the very same arguments were solved before.

    `solve` is a pure function of its arguments. A test that shows this calls `solve` itself. Questions that differ in
    the known lengths alone share lens, plane and roads.
    """
    key = _key(evidence, options, lens)
    if key not in _RESULTS:
        with mock.patch.object(estimate, 'find_solution', find_once):
            _RESULTS[key] = estimate.solve(evidence, options, lens=lens)
    return _RESULTS[key]


def _key(*arguments: object) -> bytes:
    return hashlib.sha256(pickle.dumps(arguments)).digest()


def find_once(
    evidence: Evidence, tracks: TrackSet, options: Options, *, height_m: float = 0.0, lens: Camera | None = None
) -> Solution | Reason:
    """Return what `find_solution` returns, which sees of the known lengths but a height."""
    key = _key(evidence, tracks, options.joint, options.gate, options.lens, options.random_seed, height_m, lens)
    if key not in _SOLUTIONS:
        _SOLUTIONS[key] = FIND_SOLUTION(evidence, tracks, options, height_m=height_m, lens=lens)
    return _SOLUTIONS[key]


def evidence_once(junction: Junction, seed: int = 0) -> Evidence:
    """Return the evidence of a junction, driven through once in a session."""
    key = _key(junction, seed)
    if key not in _TRAFFIC:
        _TRAFFIC[key] = synthetic_evidence(junction, np.random.default_rng(seed))
    return _TRAFFIC[key]


def solved_junction(
    junction: Junction, options: Options, seed: int = 0, lens: Camera | None = None
) -> Calibration | Refusal:
    """Return the solution of the traffic of a junction."""
    return solve_once(evidence_once(junction, seed), options, lens=lens)

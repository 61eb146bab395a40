"""The rows of the verification table that follow from a solution itself: identifiability, and its priors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from autocalib_ros.config import GateOptions
from autocalib_ros.estimation.solution import Solution
from autocalib_ros.estimation.verification.gates import MAX_K1_SIGMAS, k1_prior_sigmas
from autocalib_ros.geometry.ground_plane import MIN_FRACTION_BELOW_HORIZON
from autocalib_ros.results.verification_table import VerificationRow, verified

MAX_PRINCIPAL_POINT_SIGMAS = 3.5
"""Largest deviation of the principal point from the centre of the picture, across or down, in standard deviations of
its prior: 0.1 % of the lenses exceed it."""


def with_solution_rows(found: Solution, gate: GateOptions) -> Solution:
    """Return a solution with all rows of its verification table.

    Some failed checks lower the grade: a principal point that contradicts its prior, for one, means that the picture
    was cut, or that the lens is another.
    """
    found = found.compared(*_rows(found, gate))
    return replace(found, reduced=True) if any(row.lowers_grade for row in found.comparisons) else found


def _rows(found: Solution, gate: GateOptions) -> Iterator[VerificationRow]:
    prior = found.fit.problem.config.prior
    if not prior.focal_known:
        yield verified('focal_sigma', found.fit.focal_sigma, gate.max_sigma_focal_rel)
    if prior.sigma[3] > 0:
        yield verified('k1_prior', k1_prior_sigmas(found.fit), MAX_K1_SIGMAS)
    if (prior.sigma[1:3] > 0).all():
        away = np.subtract(found.fit.state.camera.principal_point_px, prior.centre.principal_point_px)
        yield verified(
            'principal_point_prior', float(np.abs(away / prior.sigma[1:3]).max()), MAX_PRINCIPAL_POINT_SIGMAS
        )
    if found.plane_refusal is None:
        plane = found.plane
        yield verified('below_horizon', plane.fraction_below_horizon, MIN_FRACTION_BELOW_HORIZON)
        yield verified('plane_sigma', plane.worst_sigma_deg, gate.max_sigma_tilt_deg)

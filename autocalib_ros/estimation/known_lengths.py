"""Lens and plane adjusted to several known lengths: heights, distances and speeds that have to agree on one scale.

A single length gives the scale alone. Of two or more, each further one tells how lengths in different places and
directions compare, and thereby focal length and plane. The solution is the prior, and the differences between the
logarithms of the camera heights that follow from each length are observations of zero: an iterated Kalman update.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.estimation.adjustment.bundle_adjustment import evaluate_at
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.solution import Solution
from autocalib_ros.estimation.verification.ground_normal import STEP_RAD
from autocalib_ros.estimation.verification.scale import MIN_HEIGHT_M, Scale, relative_sigmas, scale_sources
from autocalib_ros.results.refusals import Reason
from autocalib_ros.results.verification_table import verified

ITERATIONS = 5
"""Iterations of the update; lengths are nearly linear in the logarithms of what they depend on."""
LENGTH_STEP = 1e-4
"""Step of the numerical derivatives, in units of the parameters."""
MAX_STEP_SIGMAS = 5.0
"""Farthest that the update may move a parameter, in its standard deviations."""
MAX_LENGTH_SIGMAS = 3.0
"""Largest difference between known lengths, in standard deviations for one degree of freedom: 0.3 % of true ones."""


def adjust_to_lengths(found: Solution, tracks: TrackSet, options: Options) -> Solution:
    """Return a solution that agrees with all known lengths; itself if fewer than two are given.

    Lengths that contradict each other through the solution are a failed row of the verification table.
    """
    if found.plane_refusal is not None or not np.isfinite(found.fit.covariance).all():
        return found
    sources = scale_sources(options, *found.plane.lens_and_normal, found.flow)
    if isinstance(sources, Reason) or len(sources) < 2:
        return found
    plane, parameters, covariance = found.plane, found.fit.problem.parameters, found.fit.covariance
    differ = np.column_stack([-np.ones(len(sources) - 1), np.eye(len(sources) - 1)])

    def differences(state: AdjustmentState, turn_rad: float = 0.0) -> np.ndarray:
        return differ @ _log_heights(sources, state, plane.normal(state, turn_rad))

    noise = differ @ np.diag(relative_sigmas(sources, *plane.lens_and_normal) ** 2) @ differ.T
    if plane.assumed is not None:
        turned = differences(found.fit.state, STEP_RAD) - differences(found.fit.state, -STEP_RAD)
        turned *= plane.assumed.step_sigma_rad / (2 * STEP_RAD)
        noise = noise + np.outer(turned, turned)
    step, sigmas = np.zeros(parameters.size), np.sqrt(np.maximum(np.diag(covariance), 1e-18))
    probes = LENGTH_STEP * np.eye(parameters.size)
    contradiction = 0.0
    for iteration in range(ITERATIONS):
        here = differences(parameters.state(step))
        changes = [differences(parameters.state(step + probe)) - here for probe in probes]
        jacobian = np.array(changes).T / LENGTH_STEP
        innovation = jacobian @ covariance @ jacobian.T + noise
        if not (np.isfinite(innovation).all() and np.isfinite(here).all()):
            return found
        gain = covariance @ jacobian.T @ np.linalg.inv(innovation)
        if iteration == 0:
            contradiction = float(np.sqrt(here @ np.linalg.solve(innovation, here) / len(here)))
        step = np.clip(gain @ (jacobian @ step - here), -MAX_STEP_SIGMAS * sigmas, MAX_STEP_SIGMAS * sigmas)
    found = found.compared(verified('known_lengths', contradiction, MAX_LENGTH_SIGMAS))
    updated = covariance - gain @ jacobian @ covariance
    fit = evaluate_at(parameters.state(step), tracks, parameters.config, 0.5 * (updated + updated.T))
    return replace(found, fit=fit, plane=replace(plane, fit=fit))


def _log_heights(sources: list[Scale], state: AdjustmentState, normal: np.ndarray) -> np.ndarray:
    """Log of the camera height by each source, shape (sources,)."""
    return np.log([max(source.height(state.camera, normal), MIN_HEIGHT_M) for source in sources])

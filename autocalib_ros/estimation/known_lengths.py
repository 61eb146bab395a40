"""Lens and plane adjusted to several known lengths: heights, distances, speeds and lanes that agree on one scale.

A single length gives the scale alone. Of two or more, each further one tells how lengths in different places and
directions compare, and thereby focal length and plane. The solution is the prior, and the differences between the
logarithms of the camera heights that follow from each length are observations of zero: an iterated Kalman update.
The dashes of lane lines are a length that nobody needs to know: they are as long far away as they are near.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag

from autocalib_ros.config import Options
from autocalib_ros.estimation.adjustment.bundle_adjustment import evaluate_at
from autocalib_ros.estimation.adjustment.noise_model import DEFAULT_CAMERA_HEIGHT_M
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.estimation.lanes.lane_dashes import MeanLog, measure_lanes
from autocalib_ros.estimation.lanes.lane_scales import ToldLanes, lane_scales, spacing_scales
from autocalib_ros.estimation.lanes.lane_spacing import measure_lane_spacing
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.solution import Solution
from autocalib_ros.estimation.steady_speeds import measure_steady_speeds
from autocalib_ros.estimation.verification.ground_normal import STEP_RAD, PlaneEstimate
from autocalib_ros.estimation.verification.scale import (
    MIN_HEIGHT_M,
    Scale,
    combined_scale,
    relative_sigmas,
    scale_sources,
)
from autocalib_ros.estimation.verification.vehicle_size import measure_vehicle_size
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import Statement, assumption, check
from autocalib_ros.results.verification_table import VerificationRow, verified

ITERATIONS = 5
"""Iterations of the update; lengths are nearly linear in the logarithms of what they depend on."""
LENGTH_STEP = 1e-4
"""Step of the numerical derivatives, in units of the parameters."""
MAX_STEP_SIGMAS = 5.0
"""Farthest that the update may move a parameter, in its standard deviations."""
MAX_LENGTH_SIGMAS = 3.0
"""Largest difference between known lengths, in standard deviations for one degree of freedom: 0.3 % of true ones."""
SOURCE_NAMES = {
    'scale_height': 'the given camera height',
    'scale_distance': 'the distance of {distance_m:g} m',
    'scale_speed': 'the mean speed of {speed_km_h:g} km/h',
    'scale_lanes': 'the lane width of {width_m:g} m',
    'scale_dashes': 'the dash period of {period_m:g} m',
}
"""Each source of scale in a sentence."""


def with_seen_lengths(found: Solution, evidence: Evidence, options: Options) -> Solution:
    """Return a solution with what shows lengths on the road: dashes, and vehicles where no length is told."""
    if found.plane_refusal is not None:
        return found
    found = _with_lanes(found, evidence)
    if ToldLanes.of(options.lanes).width_m > 0 and (found.lanes is None or not found.lanes.has_width):
        found = _with_spacing(found, evidence)
    if options.allow_unit_scale or _sources(found, options):
        return found
    at = (*found.plane.lens_and_normal, DEFAULT_CAMERA_HEIGHT_M)
    size = measure_vehicle_size(evidence, *at)
    return found if size is None else replace(found, vehicles=size.scale(*at))


def _with_lanes(found: Solution, evidence: Evidence) -> Solution:
    sigma_rad = float(np.radians(found.plane.worst_sigma_deg))
    lanes = measure_lanes(evidence, *found.plane.lens_and_normal, found.along, sigma_rad)
    if lanes is None:
        return found
    camera, normal = found.plane.lens_and_normal
    width = lanes.width(camera, normal) if lanes.has_width else None
    period = lanes.period(camera, normal)
    seen = check(
        'lane_dashes',
        period=period,
        spacings=lanes.spacings,
        width=width,
        dash=period * lanes.dash_share(camera, normal),
        rival=period * lanes.rival if lanes.rival else None,
    )
    return replace(found, lanes=lanes, checks=(*found.checks, seen))


def _with_spacing(found: Solution, evidence: Evidence) -> Solution:
    """Return a solution with lines or vehicles at equal spacing, where dashes show no width of the lanes."""
    spacing = measure_lane_spacing(evidence, found.flow, *found.plane.lens_and_normal, found.along)
    if spacing is None:
        return found
    width = spacing.width(*found.plane.lens_and_normal)
    seen = check('lane_spacing', of=spacing.kind, width=width, places=len(spacing.places_px))
    return replace(found, spacing=spacing, checks=(*found.checks, seen))


def scale_of(solution: Solution, options: Options) -> Scale | Reason:
    """Return the scale that the options ask for in a solution, or why there is none."""
    sources = _sources(solution, options)
    if not sources and solution.vehicles is not None:
        return solution.vehicles
    if not sources and options.lanes.given and not options.allow_unit_scale:
        return reason('no_height', 'no_dashes' if options.lanes.dash_period_m > 0 else 'no_lanes')
    return combined_scale(sources, options, *solution.plane.lens_and_normal)


def _sources(solution: Solution, options: Options) -> list[Scale] | Reason:
    """Return a scale for all that the options give; a reason if one of them gives none."""
    at = solution.plane.lens_and_normal
    sources = scale_sources(options, *at, solution.flow)
    if isinstance(sources, Reason):
        return sources
    told = ToldLanes.of(options.lanes)
    sources += spacing_scales(solution.spacing, told, options.scale, *at)
    return [*sources, *lane_scales(solution.lanes, told, *at, sources)]


@dataclass(frozen=True)
class ChangeWithDistance:
    """What does not change with distance in the right plane."""

    kind: str
    """Kind of the row that compares it."""
    of: Callable[[Camera, np.ndarray], MeanLog | None]
    """Its change by lens and upward normal (3,); None if it cannot be measured there."""
    said: tuple[Statement, ...] = ()
    """What it assumes."""


@dataclass(frozen=True)
class _Lengths:
    """What is observed: lengths that agree on one camera height, dashes and speeds that do not change with distance."""

    plane: PlaneEstimate
    sources: list[Scale]
    changes: tuple[ChangeWithDistance, ...]
    """Of dashes, and of the speed of the traffic."""

    def log_heights(self, state: AdjustmentState, turn_rad: float = 0.0) -> np.ndarray:
        """Return the log of the camera height by each source, and the changes with distance, shape (n,)."""
        camera, normal = state.camera, self.plane.normal(state, turn_rad)
        heights = np.log([max(source.height(camera, normal), MIN_HEIGHT_M) for source in self.sources])
        changes = [change.of(camera, normal) for change in self.changes]
        return np.append(heights, [0.0 if change is None else change.mean for change in changes])

    @property
    def combinations(self) -> np.ndarray:
        """Matrix that takes `log_heights` to what is observed as zero: differences of heights, and the changes."""
        return block_diag(_differences(len(self.sources)), np.eye(len(self.changes)))

    @property
    def noise(self) -> np.ndarray:
        """Covariance of `log_heights` for exact lens and plane, with the part of an assumed plane."""
        camera, normal = self.plane.lens_and_normal
        sigmas = relative_sigmas(self.sources, camera, normal)
        changes = [change.of(camera, normal) for change in self.changes]
        covariance = np.diag(np.append(sigmas, [1.0 if change is None else change.sigma for change in changes]) ** 2)
        if self.plane.assumed is None:
            return covariance
        state = self.plane.fit.state
        turned = self.log_heights(state, STEP_RAD) - self.log_heights(state, -STEP_RAD)
        turned *= self.plane.assumed.step_sigma_rad / (2 * STEP_RAD)
        return covariance + np.outer(turned, turned)


def adjust_to_lengths(found: Solution, tracks: TrackSet, options: Options) -> Solution:
    """Return a solution that agrees with all known lengths; itself if nothing can be compared.

    Lengths that contradict each other through the solution are a failed row of the verification table, and a check
    names the two that differ most.
    """
    if found.plane_refusal is not None or not np.isfinite(found.fit.covariance).all():
        return found
    sources = _sources(found, options)
    if isinstance(sources, Reason):
        return found
    # crossing roads and turning vehicles know the plane better than dashes and speeds, whose road may sag
    lengths = _Lengths(found.plane, sources, _changes(found) if found.assumed else ())
    if not len(lengths.combinations):
        return found
    plane, parameters, covariance = found.plane, found.fit.problem.parameters, found.fit.covariance
    combine, noise = lengths.combinations, lengths.noise
    step, sigmas = np.zeros(parameters.size), np.sqrt(np.maximum(np.diag(covariance), 1e-18))
    probes = LENGTH_STEP * np.eye(parameters.size)
    rows: tuple[VerificationRow, ...] = ()
    differing: tuple[Statement, ...] = ()
    for iteration in range(ITERATIONS):
        here = lengths.log_heights(parameters.state(step))
        changes = [lengths.log_heights(parameters.state(step + probe)) - here for probe in probes]
        slopes = np.array(changes).T / LENGTH_STEP
        spread = slopes @ covariance @ slopes.T + noise
        innovation = combine @ spread @ combine.T
        if not (np.isfinite(innovation).all() and np.isfinite(here).all()):
            return found
        if iteration == 0:
            rows, differing = _compared(lengths, here, spread)
        gain = covariance @ (combine @ slopes).T @ np.linalg.inv(innovation)
        step = gain @ (combine @ (slopes @ step - here))
        step = np.clip(step, -MAX_STEP_SIGMAS * sigmas, MAX_STEP_SIGMAS * sigmas)
    said = (each for change in lengths.changes for each in change.said)
    found = replace(found.compared(*rows), checks=(*found.checks, *differing), assumptions=(*found.assumptions, *said))
    updated = covariance - gain @ combine @ slopes @ covariance
    fit = evaluate_at(parameters.state(step), tracks, parameters.config, 0.5 * (updated + updated.T))
    return replace(found, fit=fit, plane=replace(plane, fit=fit))


def _changes(found: Solution) -> tuple[ChangeWithDistance, ...]:
    """Return what shows a change with distance about a solution."""
    at = found.plane.lens_and_normal
    steady = measure_steady_speeds(*at, found.flow)
    changes = [] if found.lanes is None else [ChangeWithDistance('dash_period', found.lanes.change_with_distance)]
    if steady is not None:
        change = steady.change_with_distance(*at)
        own = float(found.plane.sigma(lambda *here: np.array([steady.change_with_distance(*here).mean]))[0])
        if abs(change.mean) < MAX_LENGTH_SIGMAS * np.hypot(change.sigma, own):  # else the traffic brakes or speeds up
            said = assumption('steady_speed', vehicles=steady.vehicles, sigma=steady.sigma)
            changes.append(ChangeWithDistance('steady_speed', steady.change_with_distance, (said,)))
    return tuple(change for change in changes if change.of(*at) is not None)


def _compared(
    lengths: _Lengths, here: np.ndarray, spread: np.ndarray
) -> tuple[tuple[VerificationRow, ...], tuple[Statement, ...]]:
    """Return rows of the comparisons before the update, and in words the two lengths that contradict each other most.

    `here` (n,) are the log heights and the changes with distance, `spread` (n, n) is their covariance.
    """
    count = len(lengths.sources)
    sigmas = np.sqrt(np.diag(spread))
    rows = [
        verified(change.kind, abs(here[at]) / sigmas[at], MAX_LENGTH_SIGMAS)
        for at, change in enumerate(lengths.changes, start=count)
    ]
    if count < 2:
        return tuple(rows), ()
    heights, covariance = here[:count], spread[:count, :count]
    combine = _differences(count)
    apart = combine @ heights
    squared = apart @ np.linalg.solve(combine @ covariance @ combine.T, apart)
    rows.append(verified('known_lengths', float(np.sqrt(squared / (count - 1))), MAX_LENGTH_SIGMAS))
    if rows[-1].passed:
        return tuple(rows), ()

    def difference(pair: tuple[int, int]) -> float:
        one, other = pair
        variance = covariance[one, one] + covariance[other, other] - 2.0 * covariance[one, other]
        return float(abs(heights[one] - heights[other]) / max(variance, 1e-18) ** 0.5)

    first, second = max(combinations(range(count), 2), key=difference)
    metres, own = np.exp(heights), np.sqrt(np.diag(covariance))
    statement = check(
        'known_lengths',
        first=_name(lengths.sources[first]),
        first_m=metres[first],
        first_sigma_m=metres[first] * own[first],
        second=_name(lengths.sources[second]),
        second_m=metres[second],
        second_sigma_m=metres[second] * own[second],
        sigmas=difference((first, second)),
    )
    return tuple(rows), (statement,)


def _differences(count: int) -> np.ndarray:
    """Return the matrix (count - 1, count) that subtracts the first of some numbers from each other one."""
    others = max(count - 1, 0)
    return np.hstack([-np.ones((others, min(count, 1))), np.eye(others)])


def _name(source: Scale) -> str:
    return SOURCE_NAMES[source.kind].format(**source.values)

"""Test of the shape of the pixels by what gives the lens, and the choice between square and squeezed ones.

A lens images a straight path as the same curve wherever it lies about the axis, and a right angle on the road as one
set of vanishing points: a squeeze breaks both. With the pixel aspect as one more free parameter the traffic measures
it, to a few per cent where lens curvature is seen. Where lens and plane come from lane markings alone, these do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.config import GateOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.lens_prior import LENS_PARAMETERS
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.pixels.aspect_hypotheses import AspectHypotheses
from autocalib_ros.estimation.solution import Solution, same_change
from autocalib_ros.estimation.verification.gates import check_plane
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import UNDETERMINED, Statement, assumption, check
from autocalib_ros.results.verification_table import verified

FREEDOM = 10.0
"""Degrees of freedom of Student's t for the error of a measured pixel aspect: about as many vehicles decide it, and
model errors, such as pedestrians among them, give it heavy tails. Judgement."""
CONSISTENT_SIGMAS = 4.0
"""A pixel aspect that differs by more standard deviations from the measured one contradicts the traffic (0.3 % of
consistent ones, by that distribution)."""
EXCLUDED_SIGMAS = 8.0
"""The same for a measurement that starts from a solution with wrong pixels: twice as much, as it is less exact."""
EXPECTED_NATS = 2.0
"""Log prior odds of the expected pixel aspect: about one recording in eight has another: two of 17 public
clips of road cameras. Judgement."""
MARKINGS_NATS = 3.0
"""Log odds for a pixel aspect with which lane markings agree with the traffic, against one with which they do not: by
chance one grid of lines in twenty does. Judgement."""
CLEAR_NATS = 4.5
"""Smallest log odds between two pixel aspects of which one is taken for sure: 1 in 90 is wrong."""
UNUSUAL_SCALE, UNUSUAL_FREEDOM = 0.08, 3.0
"""Scale and degrees of freedom of Student's t for the logarithm of a pixel aspect other than the expected one: most
squeezes are of 2 to 20 %, some of a factor of 4/3 to 2."""
UNUSUAL_RANGE, UNUSUAL_STEPS = 1.0, 201
"""Largest logarithm of a pixel aspect that is tried, and the number of values."""
CONTRADICTIONS = ('horizon', 'too_little_curvature', 'lens_model', 'halves_disagree', 'markings_contradicted')
"""Refusals of the expected pixels after which others are tried: those that a squeeze causes."""
POSSIBLE_CONTRADICTIONS = ('no_agreement', 'turning_traffic', 'too_little_turning', 'one_direction')
"""The same for sizes that are usually squeezed: a squeeze may cause them, but most often the traffic does."""

ASPECT_STEP = 1e-3
"""Step of the logarithm of the pixel aspect for the derivative of lens and plane by it."""
ASPECT = LENS_PARAMETERS.index('pixel aspect')
"""Index of the pixel aspect among the parameters of a lens."""

SolveUnder = Callable[[float, float], Solution | Reason]
"""Solves with a pixel aspect, given with the standard deviation of its logarithm."""


@dataclass(frozen=True)
class MeasuredAspect:
    """The pixel aspect that traffic or lane markings give, starting from a solution."""

    free: Adjustment
    """The solution with the pixel aspect free."""

    @property
    def aspect(self) -> float:
        """The measured pixel aspect."""
        return self.free.state.camera.pixel_aspect

    @property
    def sigma(self) -> float:
        """Standard deviation of its logarithm, without a prior."""
        return float(self.free.sigma(lambda state: np.array([np.log(state.camera.pixel_aspect)]))[0])

    def sigmas_from(self, aspect: float, its_sigma: float = 0.0) -> float:
        """Return the difference from another pixel aspect in standard deviations; 0 if nothing tells it.

        `its_sigma` is the standard deviation of the logarithm of that aspect.
        """
        sigma = float(np.hypot(self.sigma, its_sigma))
        return abs(float(np.log(self.aspect / aspect))) / sigma if np.isfinite(sigma) else 0.0

    def log_odds(self, aspect: float, other: float, sigma: float = 0.0) -> float:
        """Return the log odds in nats, without a prior, of a pixel aspect against another.

        `sigma` is the standard deviation of the logarithm of either.
        """
        squares = np.square([self.sigmas_from(other, sigma), self.sigmas_from(aspect, sigma)])
        losses = _student_loss(squares)
        return float(losses[0] - losses[1])

    def unexpected(self, expected: float, prior_odds: float) -> tuple[float, float]:
        """Return the probability of another pixel aspect than the expected one, and its mean squared logarithm.

        Bayesian model averaging (Hoeting et al. 1999) over the expected aspect and others, whose prior odds against it
        are `prior_odds`.
        """
        logs = np.linspace(-UNUSUAL_RANGE, UNUSUAL_RANGE, UNUSUAL_STEPS)
        prior = np.exp(-_student_loss((logs / UNUSUAL_SCALE) ** 2, UNUSUAL_FREEDOM))
        away = (np.log(self.aspect / expected) - np.append(logs, 0.0)) / self.sigma
        likelihood = np.exp(-_student_loss(away**2))
        posterior = prior / prior.sum() * likelihood[:-1]
        other, as_expected = prior_odds * float(posterior.sum()), float(likelihood[-1])
        return other / (other + as_expected), float((posterior * logs**2).sum() / posterior.sum())

    def state_at(self, aspect: float) -> AdjustmentState:
        """Return the state that would result with another pixel aspect, to first order.

        The measured state where the covariance is infinite.
        """
        parameters, covariance = self.free.problem.parameters, self.free.covariance
        if not np.isfinite(covariance).all():
            return self.free.state
        at = int(np.flatnonzero(parameters.config.prior.free == ASPECT)[0])
        change = float(np.log(aspect / self.aspect))
        return parameters.state(covariance[:, at] / max(covariance[at, at], 1e-12) * change)


def _student_loss(squares: np.ndarray, freedom: float = FREEDOM) -> np.ndarray:
    """Negative log density, up to a constant, of squared differences in standard deviations."""
    return 0.5 * (freedom + 1.0) * np.log1p(squares / freedom)


def measure_aspect(found: Solution, tracks: TrackSet) -> MeasuredAspect:
    """Return the pixel aspect that what gives the lens of a solution measures: traffic, or lane markings alone.

    The angle of the roads is free, unless given.
    """
    if found.with_free_aspect is not None:
        return MeasuredAspect(found.with_free_aspect)
    fit = found.of_traffic or found.fit
    config, camera = fit.problem.config, fit.state.camera
    given = config.options.crossing_deg is not None
    free = adjust(
        fit.state,
        tracks,
        replace(
            config,
            prior=config.prior.with_pixel_aspect(camera.pixel_aspect, np.inf),
            crossing_rad=config.crossing_rad if given else None,
        ),
        refine=True,
        warm_start=fit.problem.warm_start,
    )
    return MeasuredAspect(free)


def choose_aspect(
    hypotheses: AspectHypotheses, solve_under: SolveUnder, tracks: TrackSet, gate: GateOptions
) -> Solution | Reason:
    """Solve with the expected pixels, test them, and take others where the traffic clearly shows them.

    A pixel aspect that stays open widens the covariance by the difference that it makes, or is a reason to refuse.
    """
    expected, near = hypotheses.expected, hypotheses.near_sigma
    found = solve_under(expected, near)
    if isinstance(found, Reason):
        tried_after = CONTRADICTIONS + (POSSIBLE_CONTRADICTIONS if hypotheses.doubtful else ())
        if found.code not in tried_after:
            return found
        return _clear_other(hypotheses, solve_under, tracks) or found
    if found.single_road:
        return found
    measured = measure_aspect(found, tracks)
    found = _compared(found, measured, expected, near)
    contradicted = measured.sigmas_from(expected, near) > CONSISTENT_SIGMAS
    less_likely = any(measured.log_odds(aspect, expected) > 0.0 for aspect in hypotheses.others.values())
    if contradicted or (less_likely and not _is_confirmed(found)):
        other = _clear_other(hypotheses, solve_under, tracks, measured, confirmed=_is_confirmed(found))
        if other is not None:
            return other
    found = _with_near_aspect(found, hypotheses) if near > 0.0 else found
    if contradicted:
        return _widened(found, measured, measured.free.state, gate, against=measured.aspect)
    undecided = [aspect for aspect in hypotheses.others.values() if measured.log_odds(expected, aspect) < CLEAR_NATS]
    if hypotheses.doubtful and undecided:
        farthest = max(undecided, key=lambda aspect: abs(np.log(aspect / expected)))
        return _widened(found, measured, measured.state_at(farthest), gate, against=farthest)
    return found if near > 0.0 else _averaged(found, measured, expected, gate)


def _compared(found: Solution, measured: MeasuredAspect, aspect: float, its_sigma: float) -> Solution:
    """Add the comparison of a pixel aspect with the measured one, where the traffic measures it."""
    if not np.isfinite(measured.sigma):
        return found
    return found.compared(verified('pixel_aspect', measured.sigmas_from(aspect, its_sigma), CONSISTENT_SIGMAS))


def _is_confirmed(found: Solution) -> bool:
    """Whether lane markings agree with the traffic of a solution."""
    return found.from_markings and found.of_traffic is not None


def _clear_other(
    hypotheses: AspectHypotheses,
    solve_under: SolveUnder,
    tracks: TrackSet,
    first: MeasuredAspect | None = None,
    *,
    confirmed: bool = False,
) -> Solution | Reason | None:
    """Return the solution with other pixels that traffic and lane markings show clearly; None if there is none.

    It rests on an assumption, and has the grade of one: the shape of the picture is taken from the usual ones.

    A reason if there is one that they do not tell from another, in images of a size that is usually squeezed or with
    lane markings that agree with it alone. Pixels that a first measurement excludes are not tried; `confirmed`: lane
    markings agree with the expected ones.
    """
    shown: list[Solution] = []
    undecided: Reason | None = None
    sigma, expected, others = hypotheses.others_sigma, hypotheses.expected, hypotheses.others
    for shape, aspect in others.items():
        if first is not None and first.sigmas_from(aspect, sigma) > EXCLUDED_SIGMAS:
            continue
        found = solve_under(aspect, sigma)
        if isinstance(found, Reason) or found.single_road:
            continue
        measured = measure_aspect(found, tracks)
        if measured.sigmas_from(aspect, sigma) > CONSISTENT_SIGMAS:
            continue
        found = _compared(found, measured, aspect, sigma)
        odds = {other: measured.log_odds(aspect, other, sigma) for other in (expected, *others.values())}
        odds[expected] -= 0.0 if hypotheses.doubtful else EXPECTED_NATS
        odds[expected] += MARKINGS_NATS * (_is_confirmed(found) - confirmed)
        likeliest = min((other for other in odds if other != aspect), key=odds.__getitem__)
        if odds[likeliest] > CLEAR_NATS:
            statement = _squeezed(shape, found, measured, odds[expected])
            shown.append(replace(found, reduced=True, assumptions=(*found.assumptions, statement)))
        elif hypotheses.doubtful or (_is_confirmed(found) and not confirmed):
            undecided = _undecided(hypotheses, aspect, measured, likeliest)
    return shown[0] if len(shown) == 1 else undecided


def _undecided(hypotheses: AspectHypotheses, aspect: float, measured: MeasuredAspect, other: float) -> Reason:
    width, height = hypotheses.size
    sigma = min(measured.aspect * measured.sigma, UNDETERMINED)
    return reason(
        'pixel_aspect',
        'undecided',
        aspect=aspect,
        measured=measured.aspect,
        sigma=sigma,
        other=other,
        width=width,
        height=height,
    )


def _squeezed(shape: str, found: Solution, measured: MeasuredAspect, odds: float) -> Statement:
    return assumption(
        'squeezed_pixels',
        aspect=found.fit.state.camera.pixel_aspect,
        shape=shape,
        measured=measured.aspect,
        sigma=measured.aspect * measured.sigma,
        log_odds=odds,
    )


def _with_near_aspect(found: Solution, hypotheses: AspectHypotheses) -> Solution:
    """Say what was taken of pixels that may be squeezed a little."""
    aspect = found.fit.state.camera.pixel_aspect
    sigma = aspect * float(found.fit.sigma(lambda state: np.array([np.log(state.camera.pixel_aspect)]))[0])
    width, height = hypotheses.size
    statement = assumption('nearly_square_pixels', aspect=aspect, sigma=sigma, width=width, height=height)
    return replace(found, assumptions=(*found.assumptions, statement))


def _averaged(found: Solution, measured: MeasuredAspect, expected: float, gate: GateOptions) -> Solution | Reason:
    """Widen the covariance for the chance that the pixels are not as expected; a reason if that is too much.

    Traffic that hardly measures the pixel aspect tells squeezed pixels from another focal length hardly either.
    """
    if not np.isfinite(measured.free.covariance).all():
        return found
    prior_odds = np.exp(-EXPECTED_NATS - MARKINGS_NATS * _is_confirmed(found))
    probability, square = measured.unexpected(expected, float(prior_odds))
    before, after = (measured.state_at(expected * float(np.exp(step))) for step in (0.0, ASPECT_STEP))
    step = same_change(found.fit, before, after) / ASPECT_STEP
    covering = found.covering(np.sqrt(probability * square) * step)
    if covering.fit.focal_sigma > gate.max_sigma_focal_rel >= found.fit.focal_sigma:
        return _uncertain(measured, covering.fit, gate, against=measured.aspect)
    return covering


def _widened(
    found: Solution, measured: MeasuredAspect, state: AdjustmentState, gate: GateOptions, *, against: float
) -> Solution | Reason:
    """Add the difference to the state with another pixel aspect to the covariance; a reason if that is too much."""
    covering = found.covering(same_change(found.fit, (found.of_traffic or found.fit).state, state))
    expected = found.fit.problem.config.prior.centre.pixel_aspect
    sigma, sigmas = measured.aspect * measured.sigma, measured.sigmas_from(expected)
    if not (np.isfinite(sigma) and covering.fit.focal_sigma <= gate.max_sigma_focal_rel):
        return _uncertain(measured, covering.fit, gate, against=against)
    uncertain = found.plane_refusal or check_plane(covering.plane, gate)
    statement = check(
        'pixel_aspect', aspect=against, measured=measured.aspect, sigma=min(sigma, UNDETERMINED), sigmas=sigmas
    )
    return replace(covering, plane_refusal=uncertain, reduced=True, checks=(*found.checks, statement))


def _uncertain(measured: MeasuredAspect, fit: Adjustment, gate: GateOptions, *, against: float) -> Reason:
    sigma = measured.aspect * measured.sigma
    return reason(
        'pixel_aspect',
        aspect=against,
        measured=measured.aspect,
        sigma=min(sigma, UNDETERMINED),
        focal=min(fit.focal_sigma, UNDETERMINED) if np.isfinite(sigma) else UNDETERMINED,
        limit=gate.max_sigma_focal_rel,
    )


def with_stated_aspect(found: Solution | Reason, aspect: float, source: str) -> Solution | Reason:
    """Add to a solution the pixel aspect that an option ('given') or the recording states, unless it is 1."""
    if (
        isinstance(found, Reason)
        or aspect in (0.0, 1.0)
        or found.fit.problem.config.prior.centre.pixel_aspect != aspect
    ):
        return found
    statement = assumption('pixel_aspect', aspect=aspect, source=source)
    return replace(found, assumptions=(*found.assumptions, statement))

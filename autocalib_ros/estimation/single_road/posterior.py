"""Posterior of lens and plane over a single straight road, on a grid of focal length, curvature and turn.

Straight tracks give the vanishing point of the road, and how much the lens curves. Edges of vehicles and lines of the
still scene lie along, across and upright to the road, which gives the turn about it and, by their angles, the focal
length. What they leave open is closed by wide priors of field of view and roll. Mean and covariance are over the whole
grid, so that the standard deviations cover all lenses and planes that the evidence leaves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import softmax

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.estimation.adjustment.lens_prior import DISTORTION_FREE, LensPrior
from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState, Parameterisation
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.single_road.barrel_lens import MAX_KAPPA, MIN_KAPPA, LensChoice
from autocalib_ros.estimation.single_road.bent_road import Bend, across_and_up
from autocalib_ros.estimation.single_road.direction_mixture import (
    MIXTURE_ROUNDS,
    SEARCHED_TURNS_RAD,
    TURNS_RAD,
    DirectionMixture,
    SeenSegments,
    Tilts,
)
from autocalib_ros.estimation.single_road.road_through_lens import RoadThrough
from autocalib_ros.estimation.vehicle_edges.edge_mixture import SYSTEMATIC_SIGMA_RAD
from autocalib_ros.geometry.cubic_curves import cubic_through, spline_slopes
from autocalib_ros.geometry.great_circles import unproject_rays
from autocalib_ros.geometry.small_matrices import cross
from autocalib_ros.lens.camera import Camera

TEMPER = 0.5
"""Share of the log likelihood of edges and lines that counts: where the road bends, those of one place are turned
alike. The errors of focal length have a root mean square of 0.6 standard deviations on 57 simulated straight roads
and of 0.95 on 31 bends; with 0.7 it was 1.5 on 16 bends, up to 4.2."""
KAPPA_NODES = 4
"""Curvatures at each focal length, within 2.5 standard deviations of what straight tracks show."""
MIN_SPACINGS, FINER_SHIFTS = 1.0, np.linspace(-2.5, 2.5, 16)
"""Standard deviation of the focal length, in spacings of the grid, below which a finer grid is solved; and the shifts
of that grid from the mean, in spacings of the first: at least 2.5 standard deviations."""
MAX_END_WEIGHT = 0.02
"""Probability of the longest focal length above which longer ones are tried: the prior alone leaves 1 % there."""
KAPPA_TRIALS = 7
"""Curvatures at each focal length by which straight tracks measure it."""
MAX_NATS_BEHIND = 15.0
"""Lenses through which the tracks are less probable by more are left out: edges and lines do not make up for it."""
MIN_WEIGHT = 1e-4
"""Lenses less probable than this share of the likeliest are left out of what follows."""
ROAD_SIGMA_RAD = np.radians(0.5)
"""Standard deviation of the direction of the road under the camera from that of its vanishing point: carriageways
differ by about a degree, and the grade changes along a road. Judgement."""
COMMON_TILTS = (
    (Tilts(across_rad=float(SYSTEMATIC_SIGMA_RAD[0])), Tilts()),
    (Tilts(upright_rad=float(SYSTEMATIC_SIGMA_RAD[1])), Tilts()),
    (Tilts(), Tilts(upright_rad=np.radians(1.2))),
    (Tilts(), Tilts(grade_rad=np.radians(1.2))),
)
"""Errors common to all vehicle edges, and to all lines, one standard deviation each; of the lines bank and grade of the
road (2 %). Judgement."""
MIN_KAPPA_REACH = 0.02
"""Least range of the curvature, to either side, at one focal length."""
NEAR_TURNS_RAD = np.radians(np.arange(-5.0, 5.1, 1.0))
"""Turns about the best one, in the rounds after the first."""


@dataclass(frozen=True)
class _Node:
    """One lens of the grid."""

    camera: Camera
    along: np.ndarray
    """Direction of the road through this lens, from straight tracks, shape (3,)."""
    bend: Bend | None
    """The likeliest bend of the road; None: the road is straight."""
    log_weight: float
    """Log prior and likelihood of the tracks, times the width of the node."""
    turns: np.ndarray
    """Turns about the road, shape (t,)."""
    log_density: np.ndarray
    """Log likelihood of edges and lines and log prior of the roll at these turns, shape (t,)."""

    @property
    def log_evidence(self) -> float:
        """Log of the weight of the node, its turn integrated out."""
        return self.log_weight + float(np.logaddexp.reduce(self.log_density))

    @property
    def turn_moments(self) -> tuple[float, float]:
        """Mean and variance of the turn."""
        weights = softmax(self.log_density)
        mean = float(weights @ self.turns)
        return mean, float(weights @ (self.turns - mean) ** 2)


@dataclass(frozen=True)
class _RoadScene:
    """Edges and lines about the road, and the prior of the roll."""

    mixtures: tuple[DirectionMixture, DirectionMixture]
    """Of vehicle edges and of still lines; either may be empty."""
    roll_sigma_rad: float

    def fitted_to(self, node: _Node) -> _FittedScene:
        """Fit shares and spreads through a lens, and find the best turn."""
        seen = tuple(mixture.through(node.camera, node.along, node.bend) for mixture in self.mixtures)
        fitted = _FittedScene(self, node, self.mixtures, seen, 0.0)
        turns = SEARCHED_TURNS_RAD
        for _ in range(MIXTURE_ROUNDS):
            turn = float(turns[np.argmax(fitted.log_density(turns))])
            mixtures = tuple(
                mixture if mixture.empty else mixture.fitted(each, turn)
                for mixture, each in zip(fitted.mixtures, seen, strict=True)
            )
            fitted = replace(fitted, mixtures=mixtures, turn=turn)
            turns = turn + NEAR_TURNS_RAD
        return fitted


@dataclass(frozen=True)
class _FittedScene:
    """The scene through one lens, with fitted shares and spreads."""

    scene: _RoadScene
    node: _Node
    mixtures: tuple[DirectionMixture, ...]
    seen: tuple[SeenSegments, ...]
    turn: float
    """The best turn, among those that were tried."""

    def log_density(self, turns: np.ndarray) -> np.ndarray:
        """Return the log likelihood of the segments and the log prior of the roll at turns (t,)."""
        _, up = across_and_up(self.node.along, turns)
        rolls = np.arctan2(-up[:, 0], -up[:, 1])
        density = -0.5 * (rolls / self.scene.roll_sigma_rad) ** 2
        for mixture, each in zip(self.mixtures, self.seen, strict=True):
            if not mixture.empty:
                density = density + TEMPER * mixture.log_likelihood(each, turns)
        return density

    def weighed(self, tilts: tuple[Tilts, Tilts] = (Tilts(), Tilts())) -> _Node:
        """Return the lens with the density of its turns, where edges and lines have common errors `tilts`."""
        tilted = tuple(replace(mixture, tilts=tilt) for mixture, tilt in zip(self.mixtures, tilts, strict=True))
        turns = self.turn + TURNS_RAD
        return replace(self.node, turns=turns, log_density=replace(self, mixtures=tilted).log_density(turns))


def road_posterior(
    fit: Adjustment,
    tracks: TrackSet,
    choice: LensChoice,
    segments: tuple[DirectionMixture, DirectionMixture],
    roll_sigma_rad: float,
) -> tuple[Parameterisation, np.ndarray]:
    """Return the parameters about lens and plane of one straight road, and their covariance (p, p).

    `fit` is a solution of the road by any lens, `tracks` those by which lenses are compared. `segments` are vehicle
    edges and still lines, either may be empty; `roll_sigma_rad` is the standard deviation of the roll.
    """
    scene, solve = _RoadScene(segments, roll_sigma_rad), RoadThrough(fit, tracks)
    focals = choice.focal_lengths()
    fitted, nodes = _solve_grid(scene, solve, choice, focals)
    longer = choice.longer_than(focals)
    if len(longer) and _weights(nodes) @ [node.camera.focal_px > 0.999 * focals[-1] for node in nodes] > MAX_END_WEIGHT:
        further = _solve_grid(scene, solve, choice, longer)
        fitted, nodes = [*fitted, *further[0]], [*nodes, *further[1]]
    mean, sigma = _focal_moments(nodes)
    spacing = float(np.log(focals[1] / focals[0])) if len(focals) > 1 else 0.0
    if sigma < MIN_SPACINGS * spacing:
        fitted, nodes = _solve_grid(scene, solve, choice, np.exp(mean + spacing * FINER_SHIFTS))
    base = _mean_node(nodes, scene, solve, choice)
    parameters = _parameters(base, fit.problem.config, _published_prior(choice, base.camera))
    covariance = _covariance(fitted, nodes, parameters) + _prior_covariance(parameters, tracks)
    turns = slice(parameters.lens + 1, parameters.lens + 3)
    covariance[turns, turns] += _road_covariance(parameters.base, solve.adjusted(base.camera, base.along))
    return parameters, covariance


def _solve_grid(
    scene: _RoadScene, solve: RoadThrough, choice: LensChoice, focals: np.ndarray
) -> tuple[list[_FittedScene], list[_Node]]:
    """Return the scene through each lens of a grid of focal lengths (n,), and the lenses with their turns weighed."""
    fitted = [scene.fitted_to(node) for node in _lens_nodes(scene, solve, choice, focals)]
    return fitted, [each.weighed() for each in fitted]


def _parameters(base: _Node, config: AdjustmentConfig, prior: LensPrior) -> Parameterisation:
    """Return the parameters about a lens and its mean turn: the lens, and all rotations of the plane."""
    state = _state_at(base, base.turn_moments[0])
    return Parameterisation(state, replace(config, prior=prior, crossing_rad=np.pi / 2, crossing_sigma_rad=0.0))


def _covariance(fitted: list[_FittedScene], nodes: list[_Node], parameters: Parameterisation) -> np.ndarray:
    """Return the covariance over lenses and turns, with errors common to all edges or lines, and of the road itself."""
    evidence = np.array([node.log_evidence for node in nodes])
    kept = np.flatnonzero(evidence > evidence.max() + np.log(MIN_WEIGHT)).tolist()
    mean, covariance = _moments([nodes[index] for index in kept], parameters)
    for tilts in COMMON_TILTS:
        change = _moments([fitted[index].weighed(tilts) for index in kept], parameters)[0] - mean
        covariance = covariance + np.outer(change, change)
    covariance += np.outer(mean, mean)  # the state is that of the mean lens, which is near the mean state
    road = np.zeros(len(covariance))
    road[parameters.lens + 1 : parameters.lens + 3] = ROAD_SIGMA_RAD**2
    return covariance + np.diag(road)


def _published_prior(choice: LensChoice, camera: Camera) -> LensPrior:
    """Return the prior with a mean of the lens itself: k1 free, further coefficients fixed."""
    if choice.known:
        return choice.prior
    sigma = choice.prior.sigma.copy()
    sigma[3], sigma[4] = max(sigma[3], 1e-3), 0.0
    return replace(choice.prior, family='barrel', centre=camera, sigma=sigma)


def _lens_nodes(scene: _RoadScene, solve: RoadThrough, choice: LensChoice, focals: np.ndarray) -> list[_Node]:
    """Return the lenses of the grid of focal lengths (n,), with the direction of the road through each."""
    if choice.known:
        return [_node(solve, choice.prior.centre, 0.0)]
    nodes = [
        node
        for focal_px in focals.tolist()
        for node in _curvature_nodes(_with_bends(solve, focal_px, scene, choice), choice, focal_px)
    ]
    best = max(node.log_weight for node in nodes)
    return [node for node in nodes if node.log_weight > best - MAX_NATS_BEHIND]


def _with_bends(solve: RoadThrough, focal_px: float, scene: _RoadScene, choice: LensChoice) -> RoadThrough:
    """Return the same for a road that may bend: in a level plane, or in that of the scene at a focal length."""
    lens = solve.start.state.camera
    kappa = 1.0 - (1.0 - lens.k[0] / DISTORTION_FREE[0]) * (focal_px / lens.focal_px) ** 2  # of the same barrel
    camera = choice.lens(focal_px, float(np.clip(kappa, MIN_KAPPA, MAX_KAPPA)))
    return solve.on_planes((0.0, scene.fitted_to(_node(solve, camera, 0.0)).turn))


def _curvature_nodes(solve: RoadThrough, choice: LensChoice, focal_px: float) -> list[_Node]:
    """Return the lenses of one focal length, about the curvature that straight tracks show."""
    tried = np.linspace(MIN_KAPPA, MAX_KAPPA, KAPPA_TRIALS)
    costs = np.array([solve(choice.lens(focal_px, kappa))[1] for kappa in tried.tolist()])
    near = np.linspace(MIN_KAPPA, MAX_KAPPA, 50 * KAPPA_TRIALS)
    costs = costs - costs.min()
    density = np.exp(-cubic_through(tried, costs, spline_slopes(tried, costs), near))
    density /= density.sum()
    mean = float(density @ near)
    reach = max(2.5 * float(np.sqrt(density @ (near - mean) ** 2)), MIN_KAPPA_REACH)
    kappas = np.linspace(max(mean - reach, MIN_KAPPA), min(mean + reach, MAX_KAPPA), KAPPA_NODES)
    width = float(np.log(kappas[1] - kappas[0]))
    return [
        _node(solve, choice.lens(focal_px, kappa), choice.log_prior(focal_px, kappa) + width)
        for kappa in kappas.tolist()
    ]


def _node(solve: RoadThrough, camera: Camera, log_weight: float) -> _Node:
    along, cost, bend = solve(camera)
    return _Node(camera, along, bend, log_weight - cost, np.zeros(1), np.zeros(1))


def _weights(nodes: list[_Node]) -> np.ndarray:
    """Return the probability of each node, shape (nodes,)."""
    return softmax([node.log_evidence for node in nodes])


def _focal_moments(nodes: list[_Node]) -> tuple[float, float]:
    """Return mean and standard deviation of the log focal length."""
    weights, logs = _weights(nodes), np.log([node.camera.focal_px for node in nodes])
    mean = float(weights @ logs)
    return mean, float(np.sqrt(weights @ (logs - mean) ** 2))


def _mean_node(nodes: list[_Node], scene: _RoadScene, solve: RoadThrough, choice: LensChoice) -> _Node:
    """Return the node at the mean log focal length and the mean curvature."""
    focal_px = float(np.exp(_focal_moments(nodes)[0]))
    kappa = float(_weights(nodes) @ [node.camera.k[0] for node in nodes]) / DISTORTION_FREE[0]
    return scene.fitted_to(
        _node(_with_bends(solve, focal_px, scene, choice), choice.lens(focal_px, kappa), 0.0)
    ).weighed()


def _state_at(node: _Node, turn: float) -> AdjustmentState:
    """Return the state with the road and the direction across it as its two axes."""
    up = across_and_up(node.along, np.array([turn]))[1][0]
    rotation = np.column_stack([node.along, cross(up, node.along), up])
    return AdjustmentState(node.camera, rotation, np.array([0.0, np.pi / 2]))


def _moments(nodes: list[_Node], parameters: Parameterisation) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (p,) and covariance (p, p) of the steps from the base to what the nodes give."""
    weights = _weights(nodes)
    steps, within = [], np.zeros((parameters.size, parameters.size))
    lens = parameters.lens
    for node, weight in zip(nodes, weights, strict=True):
        turn, variance = node.turn_moments
        steps.append(parameters.step_to(_state_at(node, turn)))
        own = np.zeros_like(within)
        own[lens, lens] = variance
        within += weight * own
    points = np.array(steps)
    mean = weights @ points
    return mean, within + (points - mean).T @ ((points - mean) * weights[:, None])


def _road_covariance(base: AdjustmentState, road: Adjustment) -> np.ndarray:
    """Covariance (2, 2) of the rotations of the road about the direction across and about the normal."""
    axes = base.rotation
    spread = road.covariance_of(lambda state: state.directions[0])
    # a rotation by w about y moves x by -w z, one by w about z moves it by w y
    by = np.stack([-axes[:, 2], axes[:, 1]])
    return by @ spread @ by.T


def _prior_covariance(parameters: Parameterisation, tracks: TrackSet) -> np.ndarray:
    """Covariance of principal point and pixel aspect under their priors, with the rotation that keeps the traffic.

    The evidence does not measure them.
    """
    prior, base = parameters.config.prior, parameters.base
    covariance = np.zeros((parameters.size, parameters.size))
    pixels = tracks.pixels[tracks.weights > 0][:: max(1, int((tracks.weights > 0).sum() // 200))]
    before = unproject_rays(base.camera, pixels).bearings
    for index in (1, 2, 5):
        at = np.flatnonzero(prior.free == index)
        if not len(at):
            continue
        step = np.zeros(parameters.lens)
        step[at] = 1.0
        after = unproject_rays(prior.moved(base.camera, step), pixels).bearings
        turn, _ = Rotation.align_vectors(after, before)
        change = np.zeros(parameters.size)
        change[: parameters.lens] = step
        change[parameters.lens : parameters.lens + 3] = base.rotation.T @ turn.as_rotvec()
        covariance += np.outer(change, change)
    return covariance

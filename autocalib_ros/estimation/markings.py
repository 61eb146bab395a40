"""Road markings: straight lines on the road that are parallel to one of two directions square to each other.

Lane lines, stop lines, the stripes of crosswalks, kerbs and slabs mostly are. So the lens and the plane are those that
bring as many lines as can be to two directions in one plane, a quarter of a turn apart, and to the upright one, of
posts: a mixture of three peaks and a uniform rest, as `edge_mixture.py` is of edges on vehicles. How an image line
misses a direction is the angle, on the sphere about the camera, between the line and the way from its middle to where
that direction vanishes. Lines are no more than chords of what the lens bends: in its middle a chord has the direction
of the arc.

That markings are square is an assumption. Where the traffic tells less than they do, it has to agree with them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from autocalib_ros.camera import Camera
from autocalib_ros.estimation.edge_mixture import FREEDOM, STUDENT, folded
from autocalib_ros.estimation.great_circles import along_px, earlier_ones, independence, rays_of
from autocalib_ros.estimation.lens_prior import LensPrior
from autocalib_ros.estimation.uncertainty import cluster_covariance
from autocalib_ros.evidence import Evidence

NEAR_TRAFFIC = 0.06
"""A line is on the road when all of it lies within this of a place where traffic was seen, share of the image width:
half of a lane, or what vehicles are high."""
NEAR_TRAFFIC_HEIGHTS = 0.5
"""The same on the road, once the plane is known: a lane, for a camera as high as usual."""
GRAIN = 0.01
"""Places of traffic are told apart by so much, share of the image width."""
MOST_LINES = 400
"""Lines in one solution: of each group in turn, the longest first."""
TOGETHER, TOGETHER_RAD = 0.05, np.radians(12.0)
"""Lines of one group, a crosswalk say, lie within this of a neighbour, share of the image width, and are as parallel in
the image: whoever painted one askew did so with all."""
CORRELATION = 0.3
"""How much the errors of a group's lines correlate: several edges are of one stripe, and stripes of one crosswalk."""
END_PX, PAINTED_RAD = 0.4, np.radians(0.5)
"""Standard deviation of an end of a line, across it, in the image; and of painted lines about their direction on the
road. A scale for both is fitted."""
ASKEW_RAD = np.radians(1.0)
"""Standard deviation of the angle between the two directions from a right one: junctions are built to about that."""
LEAN_RAD = np.radians(1.0)
"""Standard deviation of posts from the upright."""
LEAST_SCALE, LARGEST_SCALE = 0.15, 2.0
LOWEST = 0.1
"""Sine of the angle below the horizon from which on lines are on the road: ten heights of the camera away. What is
farther is too foreshortened to tell from what stands there."""
DIAGONALS = np.geomspace(0.3, 1.6, 10)
"""Focal lengths to start from, in image diagonals: half of the ratio of two is bridged by the widened peaks."""
TILTS_DEG = (5.0, 10.0, 16.0, 23.0, 31.0, 40.0, 50.0, 62.0)
ROLLS_DEG = (-9.0, -4.5, 0.0, 4.5, 9.0)
HEADINGS_DEG = tuple(range(0, 90, 6))
WIDENED_RAD = (np.radians(3.0), np.radians(1.5), np.radians(0.7), 0.0)
"""The peaks are widened by this, round by round, so that a start some degrees off still reaches the best solution."""
NEARBY = (0.8, 0.87, 0.93, 1.07, 1.14, 1.22)
"""Focal lengths to start from once more, in ones of the best solution: along focal length and distortion, which lines
hardly tell apart, there are several solutions that single groups of lines hold in place."""
STARTS = 6
ASKED_FOR = 4.5
"""A rarer family of lenses is chosen when that makes the lines so much more probable: the logarithm, three sigmas."""
APART_LOG, APART_RAD = 0.3, np.radians(8.0)
"""Starts differ by so much in the logarithm of the focal length, or in the normal."""
ROUNDS, LAST_ROUNDS, TRIALS = 8, 40, 8
SETTLED = 1e-5
START_SHARES = np.array([0.35, 0.35, 0.1])[:, None]
LEAST_SHARE, LARGEST_SHARE, LARGEST_SUM = 0.02, 0.9, 0.95
DIFFERENCE = 1e-5
LENSES_KEPT = 8
"""Lenses whose sight is kept: that of a pose, and those a step of a parameter away. Most steps leave the lens."""


@dataclass(frozen=True)
class Lines:
    """Straight lines on the road."""

    ends_px: np.ndarray
    """x0, y0, x1, y1, shape (n, 4)."""
    groups: np.ndarray
    """Which belong together, shape (n,)."""

    def __len__(self) -> int:
        return len(self.groups)

    def subset(self, keep: np.ndarray) -> Lines:
        """Return the lines that `keep`, a mask or indices, selects."""
        return Lines(self.ends_px[keep], self.groups[keep])

    @property
    def lengths_px(self) -> np.ndarray:
        """Shape (n,)."""
        return np.hypot(*(self.ends_px[:, 2:] - self.ends_px[:, :2]).T)

    @property
    def weights(self) -> np.ndarray:
        """Shape (n,): those of one group count less each."""
        return independence(self.groups, CORRELATION)


def lines_on_road(evidence: Evidence) -> Lines:
    """Return the still lines where traffic was seen, at most `MOST_LINES`."""
    width, ends = evidence.image_size[0], evidence.still_lines_px
    if not len(ends) or not len(evidence.points_px):
        return Lines(np.zeros((0, 4)), np.zeros(0, int))
    ends = ends[_within(along_lines(ends), traffic_places(evidence), NEAR_TRAFFIC * width)]
    lines = Lines(ends, _groups(ends, width))
    best_first = lines.subset(np.argsort(-lines.lengths_px, kind='stable'))
    return best_first.subset(np.argsort(earlier_ones(best_first.groups), kind='stable')[:MOST_LINES])


def traffic_places(evidence: Evidence) -> np.ndarray:
    """Pixels (n, 2) where traffic was seen, each once."""
    grain = GRAIN * evidence.image_size[0]
    return np.unique(np.round(evidence.points_px / grain), axis=0) * grain


def along_lines(ends: np.ndarray) -> np.ndarray:
    """Points along lines (n, 4), shape (n, 5, 2)."""
    share = np.linspace(0.0, 1.0, 5)[:, None]
    return ends[:, None, :2] + share * (ends[:, 2:] - ends[:, :2])[:, None]


def _within(points: np.ndarray, places: np.ndarray, reach: float) -> np.ndarray:
    """Tell of which lines all points (n, m, 2) are within reach of one of some places (k, 2), shape (n,)."""
    away, _ = cKDTree(places).query(points.reshape(-1, 2), distance_upper_bound=reach)
    return np.isfinite(away).reshape(points.shape[:2]).all(axis=1)


def _groups(ends: np.ndarray, width: int) -> np.ndarray:
    """Number the groups of lines (n, 4), shape (n,)."""
    middle, step = (ends[:, :2] + ends[:, 2:]) / 2, ends[:, 2:] - ends[:, :2]
    heading = np.arctan2(step[:, 1], step[:, 0])
    near = np.hypot(*(middle[:, None] - middle).transpose(2, 0, 1)) < TOGETHER * width
    parallel = np.abs(folded(heading[:, None] - heading)) < TOGETHER_RAD
    return connected_components(coo_matrix(near & parallel), directed=False)[1]


@dataclass(frozen=True)
class Sight:
    """Lines as a lens sees them, on the sphere about the camera."""

    bearings: np.ndarray
    """Of the lines' middles, shape (n, 3)."""
    along: np.ndarray
    """Unit tangents there, shape (n, 3)."""
    circles: np.ndarray
    """Normals of the lines' great circles, shape (n, 3)."""

    @classmethod
    def through(cls, camera: Camera, ends_px: np.ndarray) -> Sight:
        """See lines (n, 4) through a lens."""
        middle, step = (ends_px[:, :2] + ends_px[:, 2:]) / 2, ends_px[:, 2:] - ends_px[:, :2]
        rays = rays_of(camera, middle)
        along = along_px(rays, camera, middle, step)
        along /= np.maximum(np.linalg.norm(along, axis=1), 1e-12)[:, None]
        return cls(rays.bearings, along, np.cross(rays.bearings, along))

    def misses(self, directions: np.ndarray) -> np.ndarray:
        """Angle of each line from each of some directions (..., 3): within a quarter of a turn, shape (..., n)."""
        return folded(np.arctan2(directions @ self.circles.T, directions @ self.along.T))

    def levers(self, directions: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """How far misses change with a turn of the directions (k, 3) about the normal (3,), shape (k, n)."""
        turned = np.cross(normal, directions)
        sine, cosine = directions @ self.circles.T, directions @ self.along.T
        sine_by, cosine_by = turned @ self.circles.T, turned @ self.along.T
        return (cosine * sine_by - sine * cosine_by) / np.maximum(sine**2 + cosine**2, 1e-12)


@dataclass(frozen=True)
class Grid:
    """A lens, and a plane with two directions in it, nearly square to each other, to which lines are parallel."""

    prior: LensPrior
    camera: Camera
    rotation: np.ndarray
    """camera_from_plane, shape (3, 3): the first direction is x, the normal, up, is z."""
    askew_rad: float
    """How much more than a quarter of a turn the second direction is from the first."""
    cost: float
    """Negative logarithm of how probable the lines are, with the prior."""
    shares: np.ndarray
    """Of the lines along the two directions and the upright one, shape (3,)."""
    members: np.ndarray
    """Probability of each line to be along each, shape (3, n)."""
    volume: float
    """Half the logarithm of the determinant of the information: what Laplace's approximation adds to the cost."""
    covariance: np.ndarray
    """Of steps of the free parameters of the lens, turns of the plane about its axes, and `askew_rad`."""

    @property
    def improbability(self) -> float:
        """Negative logarithm of how probable the lines are under any lens and plane near this one."""
        return self.cost + self.volume


def square_grids(lines: Lines, priors: list[LensPrior]) -> list[Grid]:
    """Find lenses and planes under which lines are parallel to two directions square to each other, the best first.

    From many starts with the first family of lenses, and from beside the best; the best of these with the others.
    """
    if not _enough(lines, priors[0]):
        return []
    grids = [_settled(lines, priors[0], *start, WIDENED_RAD) for start in _starts(lines, priors[0])]
    best = min(grids, key=lambda grid: grid.improbability, default=None)
    if best:
        grids += _beside(lines, best)
        best = min(grids, key=lambda grid: grid.improbability)
    rarer = []
    for prior in priors[1:] if best else []:
        near = replace(prior.start(best.camera.focal_px), principal_point_px=best.camera.principal_point_px)
        rarer.append(_settled(lines, prior, near, best.rotation, WIDENED_RAD))
    return sorted([*grids, *rarer], key=lambda grid: grid.improbability + (
        ASKED_FOR if grid.prior is not priors[0] else 0.0))


def square_grids_near(lines: Lines, prior: LensPrior, camera: Camera, normal: np.ndarray) -> list[Grid]:
    """Find those near a lens and a normal (3,), the best first."""
    if not _enough(lines, prior):
        return []
    headings = _headings(normal)
    costs = _widened_costs(lines, camera, np.array(headings), WIDENED_RAD[1])
    near = _settled(lines, prior, camera, headings[int(np.argmin(costs))], WIDENED_RAD[1:])
    return sorted([near, *_beside(lines, near)], key=lambda grid: grid.improbability)


def _beside(lines: Lines, best: Grid) -> list[Grid]:
    """Solutions from other focal lengths than that of the best, if it is free."""
    prior = best.prior
    return [] if prior.focal_known or not len(prior.free) else [
        _settled(lines, prior, prior.start(ratio * best.camera.focal_px), best.rotation, WIDENED_RAD[-2:])
        for ratio in NEARBY]


def _enough(lines: Lines, prior: LensPrior) -> bool:
    """Whether there are more lines than unknowns."""
    return len(lines) >= len(prior.free) + 4


def beside_traffic(lines: Lines, grid: Grid, evidence: Evidence) -> tuple[Lines, Grid] | None:
    """Keep the lines that are beside traffic on the plane of a grid, and settle it with them; None where few are."""
    places, points = (_on_plane(grid, pixels) for pixels in (traffic_places(evidence), along_lines(lines.ends_px)))
    there = np.isfinite(points).all(axis=(1, 2))
    kept = there & _within(np.where(there[:, None, None], points, 0.0), places[np.isfinite(places).all(axis=1)],
                           NEAR_TRAFFIC_HEIGHTS)
    # posts stand anywhere
    kept |= grid.members[2] > 0.5
    if not _enough(lines.subset(kept), grid.prior):
        return None
    return lines.subset(kept), _settled(lines.subset(kept), grid.prior, grid.camera, grid.rotation, WIDENED_RAD[-2:])


def _on_plane(grid: Grid, pixels: np.ndarray) -> np.ndarray:
    """Places (..., 2) of pixels (..., 2) on the plane in heights of the camera, nan where they are too far away."""
    bearings = rays_of(grid.camera, pixels).bearings @ grid.rotation
    below = np.where(bearings[..., 2] < -LOWEST, -bearings[..., 2], np.nan)
    return bearings[..., :2] / below[..., None]


def _planes() -> np.ndarray:
    """camera_from_plane (n, 3, 3) of the planes to start from."""
    found = []
    for tilt in np.radians(TILTS_DEG):
        for roll in np.radians(ROLLS_DEG):
            up = -np.array([np.sin(roll) * np.cos(tilt), np.cos(roll) * np.cos(tilt), np.sin(tilt)])
            found += _headings(up)
    return np.array(found)


def _headings(up: np.ndarray) -> list[np.ndarray]:
    """camera_from_plane (3, 3) of planes with a normal (3,), turned about it."""
    right = np.cross([0.0, 0.0, 1.0], up)
    right /= max(np.linalg.norm(right), 1e-9)
    ahead = np.cross(up, right)
    first = [np.cos(heading) * ahead + np.sin(heading) * right for heading in np.radians(HEADINGS_DEG)]
    return [np.column_stack([along, np.cross(up, along), up]) for along in first]


def _widened_costs(lines: Lines, camera: Camera, planes: np.ndarray, widened: float) -> np.ndarray:
    """Negative logarithm of how probable lines are with widened peaks, seen by a lens over planes (n, 3, 3); (n,)."""
    sight, sigmas = Sight.through(camera, lines.ends_px), np.hypot(_noise_rad(lines), widened)
    each = START_SHARES * _student(sight.misses(planes.transpose(0, 2, 1)), sigmas)
    each[:, :2] *= (planes[:, :, 2] @ sight.bearings.T < -LOWEST)[:, None]
    return -np.log(each.sum(axis=1) + (1.0 - START_SHARES.sum()) / np.pi) @ lines.weights


def _starts(lines: Lines, prior: LensPrior) -> list[tuple[Camera, np.ndarray]]:
    """Lenses and planes whose widened peaks hold most, distinct."""
    planes, found = _planes(), []
    diagonal = np.hypot(prior.centre.width, prior.centre.height)
    for focal in [prior.centre.focal_px] if prior.focal_known else diagonal * DIAGONALS:
        camera = prior.start(focal)
        costs = _widened_costs(lines, camera, planes, WIDENED_RAD[0])
        found += [(costs[index], camera, planes[index]) for index in np.argsort(costs, kind='stable')[:5 * STARTS]]
    chosen: list[tuple[Camera, np.ndarray]] = []
    for _, camera, plane in sorted(found, key=lambda start: start[0]):
        if not any(abs(np.log(camera.focal_px / other.focal_px)) < APART_LOG
                   and plane[:, 2] @ elsewhere[:, 2] > np.cos(APART_RAD) for other, elsewhere in chosen):
            chosen.append((camera, plane))
        if len(chosen) == STARTS:
            break
    return chosen


def _noise_rad(lines: Lines) -> np.ndarray:
    return END_PX * np.sqrt(2.0) / lines.lengths_px


def _student(misses: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    apart = 1.0 + (misses / sigmas) ** 2 / FREEDOM
    return STUDENT / sigmas / (apart * apart * np.sqrt(apart))


@dataclass(frozen=True)
class _Pose:
    """What is solved for: a lens, and a plane with its two directions."""

    camera: Camera
    rotation: np.ndarray
    askew_rad: float = 0.0

    @property
    def directions(self) -> np.ndarray:
        """The two directions, and the upright one, shape (3, 3)."""
        along, across, up = self.rotation.T
        return np.stack([along, np.cos(self.askew_rad) * across - np.sin(self.askew_rad) * along, up])

    def moved(self, step: np.ndarray, prior: LensPrior) -> _Pose:
        """Return the pose after a step of the lens, of turns about the axes of the plane, and of the angle."""
        lens = len(prior.free)
        return _Pose(prior.moved(self.camera, step[:lens]),
                     self.rotation @ Rotation.from_rotvec(step[lens:lens + 3]).as_matrix(),
                     self.askew_rad + float(step[lens + 3]))


class _Mixture:
    """What poses make of lines, while shares and scale are fitted."""

    def __init__(self, lines: Lines, prior: LensPrior) -> None:
        self.lines, self.prior, self.weights, self._noise = lines, prior, lines.weights, _noise_rad(lines)
        self.shares, self.scale = START_SHARES[:, 0], 1.0
        self._through = lru_cache(maxsize=LENSES_KEPT)(partial(Sight.through, ends_px=lines.ends_px))

    def misses(self, pose: _Pose) -> np.ndarray:
        """Of each direction, shape (3, n)."""
        return self._through(pose.camera).misses(pose.directions)

    def sigmas(self, pose: _Pose, widened: float) -> np.ndarray:
        """What is expected of them, shape (3, n)."""
        levers = self._through(pose.camera).levers(pose.directions[:2], pose.rotation[:, 2])
        askew = np.concatenate([PAINTED_RAD * levers, np.full((1, len(self.lines)), LEAN_RAD)])
        return np.sqrt(self.scale**2 * (self._noise**2 + askew**2) + widened**2)

    def cost(self, pose: _Pose, sigmas: np.ndarray) -> tuple[float, np.ndarray]:
        """Negative logarithm of the probability, and of each line to be along each direction, shape (3, n)."""
        sight = self._through(pose.camera)
        each = self.shares[:, None] * _student(sight.misses(pose.directions), sigmas)
        each[:2] *= sight.bearings @ pose.rotation[:, 2] < -LOWEST
        density = each.sum(axis=0) + (1.0 - self.shares.sum()) / np.pi
        known = np.append(self.prior.deviations(pose.camera), pose.askew_rad / ASKEW_RAD)
        return float(-np.log(density) @ self.weights + 0.5 * known @ known), each / density

    def fit_shares(self, members: np.ndarray) -> None:
        """One round of maximisation for the shares."""
        shares = np.clip(members @ self.weights / self.weights.sum(), LEAST_SHARE, LARGEST_SHARE)
        self.shares = shares * min(1.0, LARGEST_SUM / shares.sum())

    def fit_scale(self, members: np.ndarray, misses: np.ndarray, sigmas: np.ndarray) -> None:
        """One round of maximisation for the scale."""
        squared, held = (misses / sigmas) ** 2, members * self.weights
        robust = held * _robust(misses, sigmas) * squared
        self.scale *= float(np.sqrt(robust.sum() / max(held.sum(), 1e-12)))
        self.scale = float(np.clip(self.scale, LEAST_SCALE, LARGEST_SCALE))

    def linearised(self, pose: _Pose, members: np.ndarray, sigmas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (n, p) and information (n, p, p) of each line by the parameters, their weights aside."""
        here, size = self.misses(pose), len(self.prior.free) + 4
        slopes = np.stack([folded(self.misses(pose.moved(DIFFERENCE * unit, self.prior)) - here) / DIFFERENCE
                           for unit in np.eye(size)], axis=-1)
        pull = members * _robust(here, sigmas) / sigmas**2
        return (((pull * here)[..., None] * slopes).sum(axis=0),
                np.einsum('kn,kni,knj->nij', pull, slopes, slopes))

    def known(self, pose: _Pose) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (p,) and information (p,) of what is known before of lens and angle."""
        lens = len(self.prior.free)
        gradient, information = np.zeros(lens + 4), np.zeros(lens + 4)
        gradient[:lens], information[:lens] = self.prior.deviations(pose.camera), self.prior.information
        gradient[-1], information[-1] = pose.askew_rad / ASKEW_RAD**2, ASKEW_RAD**-2
        return gradient, information


def _robust(misses: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Weight of each miss by Student's distribution."""
    return (FREEDOM + 1.0) / (FREEDOM + (misses / sigmas) ** 2)


def _settled(lines: Lines, prior: LensPrior, camera: Camera, rotation: np.ndarray,
             widening: tuple[float, ...]) -> Grid:
    """Solve from a start: shares, scale, and damped Gauss-Newton steps on the mixture's probability."""
    mixture, pose = _Mixture(lines, prior), _Pose(camera, rotation)
    for widened in widening:
        damping = 1e-3
        for _ in range(ROUNDS if widened else LAST_ROUNDS):
            sigmas = mixture.sigmas(pose, widened)
            mixture.fit_shares(mixture.cost(pose, sigmas)[1])
            if not widened:
                mixture.fit_scale(mixture.cost(pose, sigmas)[1], mixture.misses(pose), sigmas)
                sigmas = mixture.sigmas(pose, widened)
            stepped = _stepped(mixture, pose, sigmas, damping)
            if stepped is None:
                break
            pose, size, damping = stepped
            if size < SETTLED:
                break
    sigmas = mixture.sigmas(pose, 0.0)
    cost, members = mixture.cost(pose, sigmas)
    gradients, curvatures = mixture.linearised(pose, members, sigmas)
    _, known = mixture.known(pose)
    covariance = cluster_covariance(gradients, curvatures, lines.weights, np.zeros(len(lines)), lines.groups, known)
    units = np.append(np.ones(len(known) - 1), ASKEW_RAD)
    information = (np.tensordot(lines.weights, curvatures, 1) + np.diag(known + 1e-9)) * np.outer(units, units)
    return Grid(prior, pose.camera, pose.rotation, pose.askew_rad, cost, mixture.shares, members,
                float(0.5 * np.linalg.slogdet(information)[1]), covariance)


def _stepped(mixture: _Mixture, pose: _Pose, sigmas: np.ndarray, damping: float) -> tuple[_Pose, float, float] | None:
    """Return the pose after a step that lowers the cost, its size and the next damping; None where none does."""
    cost, members = mixture.cost(pose, sigmas)
    gradients, curvatures = mixture.linearised(pose, members, sigmas)
    pull, known = mixture.known(pose)
    gradient = mixture.weights @ gradients + pull
    information = np.tensordot(mixture.weights, curvatures, 1) + np.diag(known)
    for _ in range(TRIALS):
        damped = information + damping * np.diag(np.diag(information)) + 1e-9 * np.eye(len(gradient))
        step = np.clip(-np.linalg.solve(damped, gradient), -0.5, 0.5)
        there = pose.moved(step, mixture.prior)
        if mixture.cost(there, sigmas)[0] <= cost:
            return there, float(np.abs(step).max()), max(damping / 10.0, 1e-6)
        damping *= 10.0
    return None

"""Planar rigid motion between two frames: rotation about the ground normal and translation along the ground.

The points of a vehicle obey an essential matrix E = [t]x R(turn) with t in the ground plane: two unknowns a window,
the turn and the heading of t, while lens and ground normal are shared by all. Straight paths, vanishing points and
point heights are not needed. Residuals are Sampson distances (Sampson 1982) in observed pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.observations.two_frame_windows import TwoFrameWindows
from autocalib_ros.geometry.great_circles import Rays, unproject_rays
from autocalib_ros.geometry.lens_slopes import PolarRays
from autocalib_ros.geometry.robust_kernels import cauchy_loss, cauchy_weight
from autocalib_ros.lens.camera import Camera

START_TURNS_DEG = (0.0, 2.0, 4.5, 7.5, 11.0, 15.0, 20.0, 26.0, 33.0, 42.0, 52.0, 65.0, 80.0, 100.0)
"""Initial turns, to either side: denser where turns are common, and close enough to any turn."""
CAUCHY_SCALE = 2.0
"""Standard deviations at which a point has half its weight (Cauchy kernel): windows contain points of other vehicles.
Judgement."""
WARM_START_ROUNDS = 5
"""Iterations on the motion of each window after a small change of lens and plane."""
NEGLIGIBLE_GAIN = 1e-5
"""Predicted relative decrease of the cost of all windows below which their motions have converged."""
MIN_TURN_DEG = 5.0
"""Smallest turn within a window that counts as turning. Judgement."""
MAX_SIDE_SLIP_DEG, MAX_SIDE_SLIP_FRACTION = 4.0, 0.25
"""A wheeled vehicle rotates as its path does. The difference within a window, from changes of curvature, is at most
this many degrees plus this fraction of the turn. Judgement."""
MAX_TURN_SIGMA_DEG = 2.0
"""Largest standard deviation of a window's turn. A turn that is mostly noise adapts to a wrong lens (Neyman & Scott
1948). The standard deviation follows from where the points lie, not from the estimated turn. Judgement."""
WALKING_SPEED_M_S = 2.5
"""Slower objects may be pedestrians: not rigid, and free to turn on the spot. A head, projected to the ground, appears
a quarter faster at the usual camera height."""
MAX_SEGMENT_TIME_DIFFERENCE_S = 1.0
"""Windows of segments are classified by windows of tracks of the same body within this time."""
MIN_DEPRESSION_RAD = 0.02
"""Smallest angle below the horizon at which rays are intersected with the ground."""


@dataclass(frozen=True)
class PlanarMotion:
    """Motion of each window (windows,): turn about the ground normal, heading of the translation in the plane."""

    turn_rad: np.ndarray
    heading_rad: np.ndarray

    def moved(self, turn: np.ndarray | float, heading: np.ndarray | float) -> PlanarMotion:
        """Return the motion after a step."""
        return PlanarMotion(self.turn_rad + turn, self.heading_rad + heading)

    def subset(self, keep: np.ndarray) -> PlanarMotion:
        """Return the motion of the windows that `keep` selects."""
        return PlanarMotion(self.turn_rad[keep], self.heading_rad[keep])


@dataclass(frozen=True)
class WindowRays:
    """Windows as rays: bearings in the frame of the plane, whose z axis is the normal."""

    components: np.ndarray
    """Bearing, radial and tangential vectors by component, of both ends; shape (3, 3, 2, windows, points)."""
    mask: np.ndarray
    sigma_px: np.ndarray
    """Standard deviation of a tracked point over the window, shape (windows, points)."""
    rays: Rays
    """The same in the frame of the camera, of shape (2, windows, points)."""

    @classmethod
    def of(
        cls, windows: TwoFrameWindows, camera: Camera, camera_from_plane: np.ndarray, options: JointOptions
    ) -> WindowRays:
        """Unproject windows with a camera over a plane (3, 3)."""
        rays = unproject_rays(camera, windows.ends_px)
        components = np.empty((3, 3, *windows.ends_px.shape[:-1]))
        for kind, vectors in enumerate((rays.bearings, rays.radial, rays.tangential)):
            np.matmul(camera_from_plane.T, vectors.reshape(-1, 3).T, out=components[kind].reshape(3, -1))
        # a tracked point drifts as a random walk; each end gets half of the variance
        sigma = np.sqrt(options.noise_px**2 + 0.5 * options.drift_px**2 * windows.lengths_px)
        return cls(components, windows.mask, sigma, rays)

    @property
    def first(self) -> np.ndarray:
        """Vectors of the first end by kind and component, shape (3, 3, windows, points)."""
        return self.components[:, :, 0]

    @property
    def second(self) -> np.ndarray:
        """Vectors of the second end by kind and component, shape (3, 3, windows, points)."""
        return self.components[:, :, 1]

    def distances(self, motion: PlanarMotion) -> np.ndarray:
        """Signed Sampson distances in standard deviations, shape (windows, points); 0 outside the mask."""
        lines = _EpipolarLines.of(self, motion)
        return lines.error / np.sqrt(lines.gradient2) * self._masked_weight

    def distances_and_jacobian(self, motion: PlanarMotion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the distances and their derivatives by turn and by heading, each of shape (windows, points)."""
        lines = _EpipolarLines.of(self, motion)
        scale = self._masked_weight / np.sqrt(lines.gradient2)
        ratio = lines.error / lines.gradient2
        by_turn, by_heading = (
            scale * (error - ratio * half_gradient2) for error, half_gradient2 in lines.derivatives(self, motion)
        )
        return scale * lines.error, by_turn, by_heading

    def shared_slopes(
        self, motion: PlanarMotion, polar: PolarRays, lens: np.ndarray, axes: np.ndarray
    ) -> list[np.ndarray]:
        """Return the derivatives (windows, points) of the distances by what all windows share, with fixed motions.

        By each parameter in `lens` (see `geometry.lens_slopes`), then by rotations of the plane about `axes` (n, 3) in
        its own frame. `polar` are the rays of both ends, of shape (2, windows, points).
        """
        lines = _EpipolarLines.of(self, motion)
        scale = self._masked_weight / np.sqrt(lines.gradient2)
        pulls = lines.pulls(self)
        far = np.stack(_line_back(pulls[1], motion)), np.stack(_line_ahead(pulls[0], motion)[1])
        columns = [scale * slope for slope in lines.lens_slopes(self, far, polar, lens)]
        if len(axes):
            levers = lines.rotation_levers(self, pulls, far)
            columns += [scale * _dot_components(levers, tuple(axis)) for axis in axes.tolist()]
        return columns

    @cached_property
    def _masked_weight(self) -> np.ndarray:
        """One over the standard deviation, 0 outside the mask, shape (windows, points)."""
        return self.mask / self.sigma_px


@dataclass(frozen=True)
class _EpipolarLines:
    """Epipolar error of each point of the windows, with the lines of both ends; by component, (windows, points)."""

    turned: tuple[np.ndarray, ...]
    """x and y of the first bearing after the turn."""
    line: tuple[np.ndarray, ...]
    """Line of the first point in the frame of the second, t x R a."""
    back: tuple[np.ndarray, ...]
    """Line of the second point in the frame of the first, R^T (b x t)."""
    error: np.ndarray
    gradient2: np.ndarray
    """Squared norm of the derivative of the error by the pixels of both ends."""
    slopes: tuple[np.ndarray, ...]
    """Derivative of the error along the radial and tangential direction of the second end, and of the first."""

    @classmethod
    def of(cls, view: WindowRays, motion: PlanarMotion) -> _EpipolarLines:
        (first, radial, tangential), (second, radial_second, tangential_second) = view.first, view.second
        turned, line = _line_ahead(first, motion)
        back = _line_back(second, motion)
        slopes = (
            _dot_components(radial_second, line),
            _dot_components(tangential_second, line),
            _dot_components(radial, back),
            _dot_components(tangential, back),
        )
        gradient2 = np.maximum(_dot_components(slopes, slopes) + slopes[3] ** 2, 1e-18)
        return cls(turned, line, back, _dot_components(second, line), gradient2, slopes)

    def lens_slopes(
        self, view: WindowRays, far: tuple[np.ndarray, np.ndarray], polar: PolarRays, parameters: np.ndarray
    ) -> Iterator[np.ndarray]:
        """Yield the derivatives by the lens of the error, less those of half the squared gradient times the ratio.

        `far` is the derivative of half the squared slopes of the other end by the bearing of each end, first end first.
        """
        ratio, (far_first, far_second) = self.ratio, far
        (_, radial, tangential), (_, radial_second, tangential_second) = view.first, view.second
        by_u, by_v = np.stack([self.slopes[2], self.slopes[0]]), np.stack([self.slopes[3], self.slopes[1]])
        far_u = np.stack([_dot_components(radial, far_first), _dot_components(radial_second, far_second)])
        far_v = np.stack([_dot_components(tangential, far_first), _dot_components(tangential_second, far_second)])
        for both_ends in polar.epipolar_slopes(
            self.error,
            polar.normal_along(by_u, by_v),
            polar.normal_along(by_u - ratio * far_u, by_v - ratio * far_v),
            ratio,
            parameters,
        ):
            yield both_ends[0] + both_ends[1]

    def rotation_levers(
        self, view: WindowRays, pulls: tuple[np.ndarray, np.ndarray], far: tuple[np.ndarray, np.ndarray]
    ) -> np.ndarray:
        """Return the same derivatives by the three rotations of the plane, shape (3, windows, points)."""
        ratio, (far_first, far_second), (pull_first, pull_second) = self.ratio, far, pulls
        (first, _, _), (second, _, _) = view.first, view.second
        line, back = np.stack(self.line), np.stack(self.back)
        # every ray turns the other way; the line of the other end turns with it
        levers = _cross_components(second - ratio * pull_second, line) - ratio * _cross_components(second, far_second)
        levers += _cross_components(first, back - ratio * far_first) - ratio * _cross_components(pull_first, back)
        return -levers

    @property
    def ratio(self) -> np.ndarray:
        """Error over its squared gradient: how much the change of the gradient counts."""
        return self.error / self.gradient2

    def pulls(self, view: WindowRays) -> tuple[np.ndarray, np.ndarray]:
        """Sum of the directions of both ends times their slopes, shape (3, windows, points) each, first end first."""
        (_, radial, tangential), (_, radial_second, tangential_second) = view.first, view.second
        by_second, around_second, by_first, around_first = self.slopes
        return (
            by_first * radial + around_first * tangential,
            by_second * radial_second + around_second * tangential_second,
        )

    def derivatives(self, view: WindowRays, motion: PlanarMotion) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the derivatives of the error and of half the squared gradient, by the turn and by the heading."""
        along, across = _cosine_sine(motion.heading_rad)
        ((_, _, z), radial, tangential), ((u, v, w), radial_second, tangential_second) = view.first, view.second
        turned, back, slopes = self.turned, self.back, self.slopes
        rise = along * turned[0] + across * turned[1]
        by_turn = (
            radial_second[2] * rise,
            tangential_second[2] * rise,
            radial[0] * back[1] - radial[1] * back[0],
            tangential[0] * back[1] - tangential[1] * back[0],
        )
        yield w * rise, _dot_components(slopes, by_turn) + slopes[3] * by_turn[3]
        line = (along * z, across * z, -rise)
        line_back = (-back[1], back[0], u * along + v * across)
        by_heading = (
            _dot_components(radial_second, line),
            _dot_components(tangential_second, line),
            _dot_components(radial, line_back),
            _dot_components(tangential, line_back),
        )
        yield (
            u * line[0] + v * line[1] + w * line[2],
            _dot_components(slopes, by_heading) + slopes[3] * by_heading[3],
        )


def _line_ahead(
    vectors: np.ndarray, motion: PlanarMotion
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, ...]]:
    """Turn vectors a (3, windows, points) of the first end: x and y of R a, and the epipolar line t x R a."""
    (cosine, sine), (along, across) = _cosine_sine(motion.turn_rad), _cosine_sine(motion.heading_rad)
    x, y, z = vectors
    turned = (cosine * x - sine * y, sine * x + cosine * y)
    return turned, (across * z, -along * z, along * turned[1] - across * turned[0])


def _line_back(vectors: np.ndarray, motion: PlanarMotion) -> tuple[np.ndarray, ...]:
    """Return the epipolar line R^T (b x t) of vectors b (3, windows, points) of the second end."""
    (cosine, sine), (along, across) = _cosine_sine(motion.turn_rad), _cosine_sine(motion.heading_rad)
    u, v, w = vectors
    # R^T turns the heading back: the line of the second point is b x t in the frame of the first
    along_back, across_back = cosine * along + sine * across, cosine * across - sine * along
    return -w * across_back, w * along_back, u * across - v * along


def _cross_components(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Cross product of vectors that are given by component, (3, ...)."""
    (x, y, z), (u, v, w) = first, second
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u])


def _cosine_sine(angle_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cosine and sine, shape (windows, 1), of the angle of each window."""
    return np.cos(angle_rad)[:, None], np.sin(angle_rad)[:, None]


def _dot_components(
    vectors: np.ndarray | tuple[np.ndarray, ...], other: np.ndarray | tuple[np.ndarray, ...]
) -> np.ndarray:
    """Scalar product of vectors that are given by component, (3, ...)."""
    total = vectors[0] * other[0]
    total += vectors[1] * other[1]
    total += vectors[2] * other[2]
    return total


def turn_sigma(view: WindowRays, motion: PlanarMotion) -> np.ndarray:
    """Standard deviation of each window's turn in radians, shape (windows,)."""
    here, by_turn, by_heading = view.distances_and_jacobian(motion)
    a, b, d = _normal_matrix(by_turn, by_heading, robust_weight(here))
    return np.sqrt(d / np.maximum(a * d - b * b, 1e-12))


def _normal_matrix(by_turn: np.ndarray, by_heading: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, ...]:
    """Entries (windows,) of the weighted J^T J, of derivatives and weights of shape (windows, points)."""
    weighted = weight * by_turn
    return (
        (weighted * by_turn).sum(axis=1),
        (weighted * by_heading).sum(axis=1),
        (weight * by_heading * by_heading).sum(axis=1),
    )


def without_side_slip(
    windows: TwoFrameWindows,
    view: WindowRays,
    motion: PlanarMotion,
    camera: Camera,
    camera_from_plane: np.ndarray,
    height_m: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return masks (windows,) of the windows without side slip, and of those among them that turn.

    Two vehicles side by side that are grouped as one seem to turn when one is faster, while their paths are straight.
    The turn of a point's path does not depend on its height.
    """
    before, after, point_turns_deg = _chords_and_turns(windows, camera, camera_from_plane)
    path_deg, body_deg = _path_and_body_turns_deg(point_turns_deg, motion)
    path_sigma_deg = (point_turns_deg.std(axis=1) / np.sqrt(np.maximum(windows.mask.sum(axis=1), 1))).filled(0.0)
    sigma_deg = np.degrees(turn_sigma(view, motion))
    no_slip = (
        np.abs(body_deg - path_deg) < MAX_SIDE_SLIP_DEG + MAX_SIDE_SLIP_FRACTION * np.abs(path_deg) + 2.0 * sigma_deg
    )
    reliable = sigma_deg < MAX_TURN_SIGMA_DEG
    lengths = np.hypot(*np.moveaxis(before, -1, 0)) + np.hypot(*np.moveaxis(after, -1, 0))
    path_m = height_m * np.ma.median(np.ma.array(lengths, mask=~windows.mask), axis=1).filled(0.0)
    fast_enough = path_m > WALKING_SPEED_M_S * np.nan_to_num(windows.duration_s)
    without_slip = no_slip & reliable & fast_enough & ~windows.from_segments
    turning = without_slip & (np.abs(path_deg) > MIN_TURN_DEG + 2.0 * path_sigma_deg)
    for row in np.flatnonzero(windows.from_segments & reliable):
        near = (windows.bodies == windows.bodies[row]) & (
            np.abs(windows.times_s - windows.times_s[row]) < MAX_SEGMENT_TIME_DIFFERENCE_S
        )
        near &= ~windows.from_segments
        without_slip[row], turning[row] = (near & without_slip).any(), (near & turning).any()
    return without_slip, turning


def point_slip(windows: TwoFrameWindows, motion: PlanarMotion, camera: Camera, camera_from_plane: np.ndarray) -> float:
    """Return the fraction by which bodies seem to turn less than their paths, at least 0.

    Tracked points slip on a turning body: points on its occluding contour do not turn with it.
    """
    from_tracks = np.flatnonzero(~windows.from_segments)
    _, _, point_turns_deg = _chords_and_turns(windows.subset(from_tracks), camera, camera_from_plane)
    path_deg, body_deg = _path_and_body_turns_deg(point_turns_deg, motion.subset(from_tracks))
    turned = np.abs(path_deg) > MIN_TURN_DEG
    return max(1.0 - float(np.median(body_deg[turned] / path_deg[turned])), 0.0) if turned.any() else 0.0


def _path_and_body_turns_deg(point_turns_deg: np.ma.MaskedArray, motion: PlanarMotion) -> tuple[np.ndarray, np.ndarray]:
    """Turns of the paths, from those of their points (windows, points), and turns of the bodies, in degrees."""
    return np.ma.median(point_turns_deg, axis=1).filled(0.0), np.degrees(np.angle(np.exp(1j * motion.turn_rad)))


def _chords_and_turns(
    windows: TwoFrameWindows, camera: Camera, camera_from_plane: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ma.MaskedArray]:
    """Chords (windows, points, 2) on the plane to and from the middle, and the turn of each point's path in degrees."""
    first, middle, second = paths(windows, camera, camera_from_plane)
    before, after = middle - first, second - middle
    across = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
    # the path turns by twice the angle between its two chords
    turn = 2.0 * np.degrees(np.arctan2(across, (before * after).sum(axis=-1)))
    return before, after, np.ma.array(turn, mask=~windows.mask)


def paths(windows: TwoFrameWindows, camera: Camera, camera_from_plane: np.ndarray) -> tuple[np.ndarray, ...]:
    """Points of the windows on the plane at three instants, in camera heights; shape (windows, points, 2) each."""
    return tuple(
        _on_plane(unproject_rays(camera, np.nan_to_num(pixels)).bearings @ camera_from_plane)
        for pixels in (windows.first_px, windows.middle_px, windows.second_px)
    )


def _on_plane(bearings: np.ndarray) -> np.ndarray:
    """Intersect bearings (..., 3) in the frame of the plane with it, in camera heights, shape (..., 2)."""
    depth = bearings[..., 2:] * (np.sign(np.median(bearings[..., 2])) if bearings.size else 1.0)
    return bearings[..., :2] / np.maximum(depth, MIN_DEPRESSION_RAD)


def robust_weight(distances: np.ndarray) -> np.ndarray:
    """Cauchy weight of distances in standard deviations: 1 at 0, a half at `CAUCHY_SCALE`."""
    return cauchy_weight((distances / CAUCHY_SCALE) ** 2)


def point_cost(distances: np.ndarray) -> np.ndarray:
    """Cauchy loss summed over each window, shape (windows,); `robust_weight` is its weight."""
    return CAUCHY_SCALE**2 * cauchy_loss((distances / CAUCHY_SCALE) ** 2).sum(axis=1)


def initial_motion(view: WindowRays) -> PlanarMotion:
    """Initialise the motion of each window: the best of many turns, each with its best heading in closed form."""
    count = len(view.mask)
    best = np.full(count, np.inf)
    best_motion = PlanarMotion(np.zeros(count), np.zeros(count))
    if not count:  # empty arrays cost as much as small ones
        return best_motion
    first, (u, v, w) = view.first[0], view.second[0]
    for turn in np.radians([*START_TURNS_DEG, *(-turn for turn in START_TURNS_DEG[1:])]):
        # b . (t x R a) = t . (R a x b)
        a, b = np.cos(turn) * first[0] - np.sin(turn) * first[1], np.sin(turn) * first[0] + np.cos(turn) * first[1]
        x, y = b * w - first[2] * v, first[2] * u - a * w
        size = view.mask / np.maximum(np.sqrt(x * x + y * y + (a * v - b * u) ** 2), 1e-3)
        x, y = x * size, y * size
        heading = 0.5 * np.arctan2(2 * (x * y).sum(axis=1), (x * x - y * y).sum(axis=1)) + np.pi / 2
        trial = PlanarMotion(np.full(count, turn), heading)
        cost = point_cost(view.distances(trial))
        better = cost < best
        best = np.where(better, cost, best)
        best_motion = PlanarMotion(
            np.where(better, trial.turn_rad, best_motion.turn_rad),
            np.where(better, trial.heading_rad, best_motion.heading_rad),
        )
    return refined(view, best_motion, 2 * WARM_START_ROUNDS)


def refined(view: WindowRays, motion: PlanarMotion, rounds: int = WARM_START_ROUNDS) -> PlanarMotion:
    """Refine the motion of each window by Levenberg-Marquardt iterations."""
    if not len(view.mask):
        return motion
    damping = np.full(len(view.mask), 1e-4)
    cost = None
    for _ in range(rounds):
        here, by_turn, by_heading = view.distances_and_jacobian(motion)
        cost = point_cost(here) if cost is None else cost
        weight = robust_weight(here)
        a, b, d = _normal_matrix(by_turn, by_heading, weight)
        here *= weight
        p, q = (by_turn * here).sum(axis=1), (by_heading * here).sum(axis=1)
        lift = damping * (a + d) + 1e-9
        a, d = a + lift, d + lift
        determinant = a * d - b * b
        turn = np.clip((b * q - d * p) / determinant, -0.2, 0.2)
        heading = np.clip((b * p - a * q) / determinant, -0.2, 0.2)
        if -(turn * p + heading * q).sum() < NEGLIGIBLE_GAIN * cost.sum():
            break
        trial = motion.moved(turn, heading)
        cost_there = point_cost(view.distances(trial))
        better = cost_there <= cost
        motion = PlanarMotion(
            np.where(better, trial.turn_rad, motion.turn_rad), np.where(better, trial.heading_rad, motion.heading_rad)
        )
        cost = np.where(better, cost_there, cost)
        damping = np.where(better, np.maximum(damping / 10, 1e-6), np.minimum(damping * 20, 1e3))
    return motion

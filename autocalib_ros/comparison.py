"""Comparison of two calibrations of one camera: differences as values, and a verdict.

The same pixels are traced through both lenses and poses. A side without standard deviations is taken as exact. Lenses
are compared as they are, and after the rotation of B that aligns its rays with A's, because two lenses can trade
principal point against rotation. On the road both share the camera's foot point, and the heading of B's ground frame,
a free choice of each calibration, is aligned on the pixels of the near road.

Every difference is B minus A, and is counted in combined standard deviations where any are stated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np

from autocalib_ros.geometry.ground_plane import GroundPlane, angles_deg, pixels_ahead, tilt_and_roll_deg
from autocalib_ros.ground import PERTURBATION_SIGMAS, Ground
from autocalib_ros.lens.camera import Camera, pixel_grid
from autocalib_ros.results.calibration import GROUND_DISTANCES_M
from autocalib_ros.results.saved_camera import SavedCamera

COMPARISON_GRID = (49, 28)
"""Pixels horizontally and vertically at which two lenses are compared, borders included."""
COMPARABLE_COEFFICIENTS = 2
"""Number of coefficients up to which k1 and k2 are comparable: further ones are correlated with them."""
AGREEMENT_SIGMAS = 3.0
"""Two calibrations of one camera differ by more than this in one number out of 400."""
SAME_LENS_TOLERANCE_PX = 0.5
"""Maximum distance in pixels between the images of one direction in two lenses that are equivalent in use."""
EQUAL_RTOL = 1e-9
"""Relative tolerance below which two numbers are equal."""


def compare_calibrations(first: SavedCamera, second: SavedCamera) -> Comparison:
    """Compare B, `second`, with A, `first`; UsageError if the aspect ratios of their images differ."""
    notes = []
    if (first.width, first.height) != (second.width, second.height):
        notes.append(f'B is scaled from {second.width}x{second.height} to {first.width}x{first.height}')
        second = second.scaled_to(first.width, first.height)
    stated = first.stddev.focal_px is not None, second.stddev.focal_px is not None
    notes += [
        f'{name} states no standard deviations and is taken as exact'
        for name, has_sigma, other in zip('AB', stated, stated[::-1], strict=True)
        if not has_sigma and other
    ]
    ground_a, ground_b = first.ground, second.ground
    metric = ground_a is not None and ground_b is not None and ground_a.metric and ground_b.metric
    ahead = np.zeros((0, 2))
    if ground_a is not None and metric:
        lens_a = cast(Camera, first.lens)  # pixels_ahead works with any Lens
        ahead = pixels_ahead(lens_a, ground_a.normal_in_camera, ground_a.height_m, np.array(GROUND_DISTANCES_M))
    grid = pixel_grid(first, *COMPARISON_GRID)
    sides = _PerturbedRays.of(first, np.vstack([grid, ahead])), _PerturbedRays.of(second, np.vstack([grid, ahead]))
    everywhere = sides[0].subset(slice(len(grid))), sides[1].subset(slice(len(grid)))
    lens, lens_notes = _lens_differences(first, second)
    pose, pose_notes = _pose_differences(first, second)
    road, road_notes = _road_differences(*sides, ahead) if metric else ((), [])
    return Comparison(
        lens=lens,
        lens_px=max_lens_difference_px(first, second),
        rays=_ray_difference(*everywhere, grid, aligned=False),
        rays_aligned=_ray_difference(*everywhere, grid, aligned=True),
        alignment_deg=_rotation_angle_deg(best_rotation(everywhere[0].nominal.rays, everywhere[1].nominal.rays)),
        pose=pose,
        normal_deg=None if ground_a is None or ground_b is None else _normal_angle_deg(ground_a, ground_b),
        road=road,
        stated=stated,
        notes=(*notes, *lens_notes, *pose_notes, *road_notes),
    )


def max_lens_difference_px(first: SavedCamera | Camera, second: SavedCamera | Camera) -> float:
    """Return the largest distance in pixels between the images of one direction in two lenses of one image size."""
    pixels = pixel_grid(first, *COMPARISON_GRID)
    bearings, reached = first.unproject(pixels)
    seen, valid = second.project(np.where(reached[:, None], bearings, [0.0, 0.0, 1.0]))
    difference = np.hypot(*(seen - pixels).T)[reached & valid]
    return float(difference.max()) if len(difference) else math.inf


def _lens_differences(first: SavedCamera, second: SavedCamera) -> tuple[tuple[Difference, ...], list[str]]:
    points = [known.stddev.principal_point_px or (None, None) for known in (first, second)]
    found = [
        _difference(
            'focal length', 'px', first.focal_px, second.focal_px, first.stddev.focal_px, second.stddev.focal_px
        )
    ]
    found += [
        _difference(
            f'principal point {axis}',
            'px',
            first.principal_point_px[index],
            second.principal_point_px[index],
            points[0][index],
            points[1][index],
        )
        for index, axis in enumerate('xy')
    ]
    if first.k is None or second.k is None:
        return tuple(found), ['k1 and k2 are not compared: one lens is not close to Kannala-Brandt, see the rays']
    if any(first.k[COMPARABLE_COEFFICIENTS:]) or any(second.k[COMPARABLE_COEFFICIENTS:]):
        return tuple(found), ['k1 and k2 are not compared: one lens has further coefficients, see the rays']
    found += [
        _difference('k1', '', first.k[0], second.k[0], first.stddev.k1, second.stddev.k1),
        _difference('k2', '', first.k[1], second.k[1], first.stddev.k2, second.stddev.k2),
    ]
    return tuple(found), []


def _pose_differences(first: SavedCamera, second: SavedCamera) -> tuple[tuple[Difference, ...], list[str]]:
    if first.ground is None or second.ground is None:
        missing = [name for name, known in (('A', first), ('B', second)) if known.ground is None]
        return (), [
            f'poses are not compared: {" and ".join(missing)} {"has" if len(missing) == 1 else "have"} no ground plane'
        ]
    angles = [tilt_and_roll_deg(ground.normal_in_camera) for ground in (first.ground, second.ground)]
    sigmas = [(known.stddev.tilt_deg, known.stddev.roll_deg) for known in (first, second)]
    found = [
        _difference(name, 'deg', float(angles[0][index]), float(angles[1][index]), sigmas[0][index], sigmas[1][index])
        for index, name in enumerate(('tilt', 'roll'))
    ]
    if not (first.ground.metric and second.ground.metric):
        return tuple(found), ['heights and road points are not compared: one plane is in units of the camera height']
    # a given height without standard deviation is exact
    height = Difference(
        'height',
        'm',
        first.ground.height_m,
        second.ground.height_m,
        math.hypot(first.stddev.height_m or 0.0, second.stddev.height_m or 0.0),
    )
    return (*found, height), []


def _difference(name: str, unit: str, first: float, second: float, *sigmas: float | None) -> Difference:
    known = [sigma for sigma in sigmas if sigma is not None]
    return Difference(name, unit, first, second, math.hypot(*known) if known else None)


@dataclass(frozen=True)
class _PixelRays:
    """Unit rays (n, 3) of pixels, nan outside the range of the lens, and the pose if there is one."""

    rays: np.ndarray
    ground: GroundPlane | None

    @classmethod
    def of(cls, lens: SavedCamera | Camera, ground: GroundPlane | None, pixels: np.ndarray) -> _PixelRays:
        there = np.isfinite(pixels).all(axis=1)
        bearings, valid = lens.unproject(np.where(there[:, None], pixels, 0.0))
        return cls(np.where((there & valid)[:, None], bearings, np.nan), ground)

    def subset(self, which: slice | np.ndarray) -> _PixelRays:
        return _PixelRays(self.rays[which], self.ground)

    def ground_points(self) -> np.ndarray:
        """Ground points of the rays in the ground frame, x + iy (n,); nan at and above the horizon."""
        if self.ground is None:
            raise ValueError('rays without a ground plane have no ground points')
        rays = self.rays @ self.ground.rotation.T
        down = np.where(rays[:, 2] < -1e-6, rays[:, 2], np.nan)
        return rays[:, :2] @ [1.0, 1.0j] * (-self.ground.height_m / down)


@dataclass(frozen=True)
class _PerturbedRays:
    """Rays of pixels in A or B, and their uncertainty."""

    nominal: _PixelRays
    perturbed: list[_PixelRays] | None
    """Rays after a small step to both sides along each principal axis of the covariance; empty if the calibration is
    exact, None if it has standard deviations without a covariance."""

    @classmethod
    def of(cls, known: SavedCamera, pixels: np.ndarray) -> _PerturbedRays:
        nominal = _PixelRays.of(known, known.ground, pixels)
        if known.covariance is None or known.ground is None:
            return cls(nominal, [] if known.stddev.focal_px is None else None)
        ground = Ground(
            lens=known.lens,
            rotation=known.ground.rotation,
            camera_m=known.ground.translation_m,
            covariance=known.covariance,
        )
        perturbations = ground.perturbations
        if perturbations is None:
            return cls(nominal, None)
        return cls(
            nominal,
            [
                _PixelRays.of(lens, GroundPlane(rotation, float(camera_m[2])), pixels)
                for lens, rotation, camera_m in perturbations
            ],
        )

    def subset(self, which: slice | np.ndarray) -> _PerturbedRays:
        return _PerturbedRays(
            self.nominal.subset(which),
            None if self.perturbed is None else [view.subset(which) for view in self.perturbed],
        )


def _ray_difference(
    first: _PerturbedRays, second: _PerturbedRays, pixels: np.ndarray, *, aligned: bool
) -> RayDifference:
    def difference(one: _PixelRays, other: _PixelRays) -> np.ndarray:
        return (other.rays @ best_rotation(one.rays, other.rays).T if aligned else other.rays) - one.rays

    chords = np.linalg.norm(difference(first.nominal, second.nominal), axis=1)
    seen = np.isfinite(chords)
    if not seen.any():
        return RayDifference(math.nan, math.inf, (math.nan, math.nan), None)
    angles_deg = np.degrees(2 * np.arcsin(np.clip(np.where(seen, chords, 0.0) / 2, 0, 1)))
    worst = int(np.argmax(angles_deg))
    sigma = _sigma(first, second, lambda one, other: difference(one, other)[worst])
    return RayDifference(
        float(angles_deg[seen].mean()),
        float(angles_deg[worst]),
        _as_pixel(pixels[worst]),
        None if sigma is None else math.degrees(sigma),
    )


def _road_differences(
    first: _PerturbedRays, second: _PerturbedRays, ahead: np.ndarray
) -> tuple[tuple[RoadDifference, ...], list[str]]:
    """Compare the ground points of the pixels `ahead` (m, 2), the last of both sides; nan is outside the image."""
    far, count = max(GROUND_DISTANCES_M), len(ahead)
    near = np.logical_and(*(np.abs(side.nominal.ground_points()) <= far for side in (first, second)))  # nan is False
    near[-count:] = False
    if np.count_nonzero(near) < 2:
        return (), [f'the road is not compared: hardly any pixel shows it within {far:g} m in both']
    found: list[RoadDifference] = []
    notes: list[str] = []
    for index, (distance, pixel) in enumerate(zip(GROUND_DISTANCES_M, ahead, strict=True)):
        if not np.isfinite(pixel).all():
            notes.append(f'{distance:g} m straight ahead is not in the image')
            continue

        def difference(one: _PixelRays, other: _PixelRays, index: int = index - count) -> np.ndarray:
            ones, others = one.ground_points(), other.ground_points()
            between = (ones * np.conj(others))[near]
            heading = np.nansum(between / np.abs(between))
            gap = others[index] * heading / np.abs(heading) - ones[index]
            return np.array([gap.real, gap.imag])

        separation_m = float(np.hypot(*difference(first.nominal, second.nominal)))
        found.append(
            RoadDifference(
                distance,
                _as_pixel(pixel),
                math.inf if math.isnan(separation_m) else separation_m,
                _sigma(first, second, difference),
            )
        )
    return tuple(found), notes


def _sigma(
    first: _PerturbedRays, second: _PerturbedRays, difference: Callable[[_PixelRays, _PixelRays], np.ndarray]
) -> float | None:
    """Return one sigma of the length of `difference` (n,) by both covariances; None if one is unknown."""
    if first.perturbed is None or second.perturbed is None:
        return None
    moves = [difference(view, second.nominal) for view in first.perturbed] + [
        difference(first.nominal, view) for view in second.perturbed
    ]
    if not moves:
        return None
    steps = (np.array(moves[::2]) - np.array(moves[1::2])) / (2 * PERTURBATION_SIGMAS)
    return float(np.sqrt((steps**2).sum()))


def best_rotation(ones: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) that best aligns rays `others` (n, 3) with `ones` in least squares (Kabsch 1976)."""
    both = np.isfinite(ones).all(axis=1) & np.isfinite(others).all(axis=1)
    if not both.any():
        return np.eye(3)
    left, _, right = np.linalg.svd(ones[both].T @ others[both])
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def _as_pixel(values: np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _rotation_angle_deg(rotation: np.ndarray) -> float:
    """Return the angle of a rotation (3, 3) in degrees."""
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return float(np.degrees(np.arctan2(np.linalg.norm(axis), np.trace(rotation) - 1.0)))


def _normal_angle_deg(first: GroundPlane, second: GroundPlane) -> float:
    return float(angles_deg(first.normal_in_camera, second.normal_in_camera))


@dataclass(frozen=True)
class Difference:
    """One parameter of A and of B, and the combined sigma of their difference, None if unknown."""

    name: str
    unit: str
    first: float
    second: float
    sigma: float | None

    @property
    def difference(self) -> float:
        """B minus A."""
        return self.second - self.first

    @property
    def sigmas(self) -> float | None:
        """The difference in combined sigmas."""
        return _sigma_count(abs(self.difference), self.sigma, max(abs(self.first), abs(self.second)))


@dataclass(frozen=True)
class RayDifference:
    """Angles between the rays of equal pixels over the whole image, and one sigma of the largest."""

    mean_deg: float
    largest_deg: float
    at_px: tuple[float, float]
    sigma_deg: float | None

    @property
    def sigmas(self) -> float | None:
        """The largest angle in combined sigmas."""
        return _sigma_count(self.largest_deg, self.sigma_deg, 1.0)


@dataclass(frozen=True)
class RoadDifference:
    """Distance on the road between A's and B's ground points of the pixel that A sees straight ahead at a distance."""

    distance_m: float
    pixel: tuple[float, float]
    separation_m: float
    sigma_m: float | None

    @property
    def sigmas(self) -> float | None:
        """The distance in combined sigmas."""
        return _sigma_count(self.separation_m, self.sigma_m, self.distance_m)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """All differences between A and B; None or empty where one of them lacks the quantity."""

    lens: tuple[Difference, ...]
    """Focal length, principal point x and y, and k1 and k2 if comparable."""
    lens_px: float
    """Largest distance in pixels between the images of one direction in the two lenses."""
    rays: RayDifference
    rays_aligned: RayDifference
    """The same after the rotation that aligns B's rays with A's."""
    alignment_deg: float
    """Angle of that rotation."""
    pose: tuple[Difference, ...] = ()
    """Tilt, roll, and height if both are in metres."""
    normal_deg: float | None = None
    """Angle between the ground normals in the camera frame."""
    road: tuple[RoadDifference, ...] = ()
    stated: tuple[bool, bool] = (True, True)
    """Whether A and B state standard deviations."""
    notes: tuple[str, ...] = ()
    """Quantities that were not compared, and why."""

    @property
    def same_lens(self) -> bool:
        """Whether the lenses are equivalent in use, whatever their parameters."""
        return self.lens_px <= SAME_LENS_TOLERANCE_PX

    def terms(self) -> list[tuple[str, float | None]]:
        """Return the terms of the verdict with their difference in sigmas; None if unknown."""
        lens = [*((item.name, item.sigmas) for item in self.lens)]
        if self.rays_aligned.sigma_deg is not None:
            lens.append(('the shape of the lens', self.rays_aligned.sigmas))
        return (
            ([] if self.same_lens else lens)
            + [(item.name, item.sigmas) for item in self.pose]
            + [(f'the road {item.distance_m:g} m ahead', item.sigmas) for item in self.road if item.sigma_m is not None]
        )

    @property
    def agrees(self) -> bool | None:
        """Whether all terms are within `AGREEMENT_SIGMAS`; None if that is unknown."""
        sigmas = [sigmas for _, sigmas in self.terms()]
        if any(value is not None and value > AGREEMENT_SIGMAS for value in sigmas):
            return False
        return None if None in sigmas else True

    def verdict(self) -> str:
        """Return the verdict as one sentence."""
        what = 'The calibrations' if self.pose else 'The lenses'
        if self.agrees is None:
            return (
                f'Agreement of {what.lower()} is unknown: neither states standard deviations, and the lenses'
                f' differ by up to {self.lens_px:.3g} px.'
            )
        if self.agrees:
            known = [(name, sigmas) for name, sigmas in self.terms() if sigmas is not None]
            largest, sigmas = max(known, key=lambda pair: pair[1], default=('', 0.0))
            detail = (
                f'; the largest difference is {largest}, {sigmas:.1f} sigmas'
                if largest
                else f': they differ by up to {self.lens_px:.2g} px'
            )
            return f'{what} agree within {AGREEMENT_SIGMAS:g} combined sigmas{detail}.'
        beyond = [
            f'{name} ({_format_sigmas(sigmas)})'
            for name, sigmas in self.terms()
            if sigmas is not None and sigmas > AGREEMENT_SIGMAS
        ]
        return f'{what} differ in {_listed(beyond)}.'


def _sigma_count(difference: float, sigma: float | None, size: float) -> float | None:
    if difference <= EQUAL_RTOL * size:
        return 0.0
    if sigma is None:
        return None
    return difference / sigma if sigma > 0 else math.inf


def _format_sigmas(sigmas: float) -> str:
    return f'{sigmas:.1f} sigmas' if math.isfinite(sigmas) else 'both exact'


def _listed(parts: list[str]) -> str:
    return parts[0] if len(parts) == 1 else f'{", ".join(parts[:-1])} and {parts[-1]}'

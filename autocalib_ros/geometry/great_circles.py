"""Great circles of straight paths: unprojection, circle fits and distances in observed pixels.

A straight path in space and the projection centre of a central camera span a plane. Its bearings b therefore lie on
a great circle with unit normal n, beyond 90 degrees from the optical axis too. The residual is the Sampson distance in
observed pixels: n.b over the norm of its gradient with respect to the pixel. A residual in the undistorted plane
shrinks with the focal length and would bias the estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autocalib_ros.geometry.small_matrices import LAST, NEXT, cofactors, cross, dot, smallest_eigenvectors
from autocalib_ros.lens.camera import Camera

MIN_RADIUS_SLOPE = 1e-3
"""Smallest derivative of the image radius by the angle, in focal lengths: a ray farther out bends no more."""


@dataclass(frozen=True)
class Rays:
    """Bearings of pixels and their derivatives with respect to the pixel."""

    bearings: np.ndarray
    """Unit vectors, shape (..., 3)."""
    radial: np.ndarray
    """Derivative of the bearing by the image radius, per pixel, shape (..., 3)."""
    tangential: np.ndarray
    """Derivative of the bearing along the circle around the principal point, per pixel, shape (..., 3).

    Of pixels that are not square, the two are the derivatives by u and v: at right angles in the image too."""

    def subset(self, keep: np.ndarray) -> Rays:
        """Return the rays of a mask or of indices `keep`."""
        return Rays(self.bearings[keep], self.radial[keep], self.tangential[keep])

    def pixel_scale(self, normals: np.ndarray) -> np.ndarray:
        """Return pixels per unit of n.b, shape (...), for circle normals (..., 3) that broadcast to the bearings."""
        outwards, around = dot(self.radial, normals), dot(self.tangential, normals)
        return 1.0 / np.sqrt(np.maximum(outwards * outwards + around * around, 1e-18))

    def distance_px(self, normals: np.ndarray) -> np.ndarray:
        """Return the signed Sampson distance in pixels, shape (...), from the great circles with normals (..., 3)."""
        return dot(self.bearings, normals) * self.pixel_scale(normals)


def unproject_rays(camera: Camera, pixels: np.ndarray) -> Rays:
    """Unproject pixels (..., 2) to rays.

    Beyond the largest image radius of the lens model, a pixel gets the outermost bearing of the model.
    """
    x, y = pixels[..., 0] - camera.principal_point_px[0], pixels[..., 1] - camera.principal_point_px[1]
    if not camera.has_square_pixels:
        x = camera.pixel_aspect * x - camera.skew * y
    radius = np.maximum(np.sqrt(x * x + y * y), 1e-9)
    theta = camera.nearest_angle(radius)
    # half-angle formulas: one tangent is cheaper than a sine and a cosine
    half = np.tan(0.5 * theta)
    cosine2 = 1.0 / (1.0 + half * half)
    sine, cosine = 2.0 * half * cosine2, (1.0 - half * half) * cosine2
    x, y = x / radius, y / radius
    outward = 1.0 / np.maximum(camera.radius_derivative(theta), MIN_RADIUS_SLOPE * camera.focal_px)
    around = sine / radius
    rays = Rays(*(np.empty((*radius.shape, 3)) for _ in range(3)))
    rays.bearings[..., 0], rays.bearings[..., 1], rays.bearings[..., 2] = sine * x, sine * y, cosine
    along = cosine * outward
    rays.radial[..., 0], rays.radial[..., 1], rays.radial[..., 2] = along * x, along * y, -sine * outward
    rays.tangential[..., 0], rays.tangential[..., 1], rays.tangential[..., 2] = -y * around, x * around, 0.0
    return rays if camera.has_square_pixels else _along_pixel_axes(rays, camera, x[..., None], y[..., None])


def _along_pixel_axes(rays: Rays, camera: Camera, x: np.ndarray, y: np.ndarray) -> Rays:
    """Return the rays with derivatives by u and v; (x, y), shape (..., 1), is the unit vector along the radius."""
    by_x, by_y = x * rays.radial - y * rays.tangential, y * rays.radial + x * rays.tangential
    return Rays(rays.bearings, camera.pixel_aspect * by_x, by_y - camera.skew * by_x)


def middles_and_ways(ends_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles (n, 2) of segments (n, 4), and the ways (n, 2) from end to end."""
    return (ends_px[:, :2] + ends_px[:, 2:]) / 2, ends_px[:, 2:] - ends_px[:, :2]


@dataclass(frozen=True)
class SegmentRays:
    """Line segments through a lens: the rays of their middles, and how these move with the segment."""

    rays: Rays
    """Of the middles."""
    along: np.ndarray
    """Change of the bearing by a pixel along the segment, shape (n, 3)."""
    aside: np.ndarray
    """Change of the bearing by a pixel at right angles to it, shape (n, 3)."""
    lengths_px: np.ndarray
    """Shape (n,)."""

    @classmethod
    def through(cls, camera: Camera, ends_px: np.ndarray) -> SegmentRays:
        """Unproject segments x0, y0, x1, y1 (n, 4)."""
        middle, way = middles_and_ways(ends_px)
        lengths = np.maximum(np.hypot(*way.T), 1e-9)
        unit = way / lengths[:, None]
        rays = unproject_rays(camera, middle)
        return cls(
            rays,
            bearing_change(rays, camera, middle, unit),
            bearing_change(rays, camera, middle, np.column_stack([-unit[:, 1], unit[:, 0]])),
            lengths,
        )


def bearing_change(rays: Rays, camera: Camera, pixels: np.ndarray, way_px: np.ndarray) -> np.ndarray:
    """Return the change (n, 3) of the bearings of pixels (n, 2) for image displacements `way_px` (n, 2)."""
    if not camera.has_square_pixels:
        return rays.radial * way_px[:, :1] + rays.tangential * way_px[:, 1:]
    outward = pixels - camera.principal_point_px
    outward = outward / np.maximum(np.hypot(*outward.T), 1e-9)[:, None]
    return (
        rays.radial * dot(way_px, outward)[:, None]
        + rays.tangential * (way_px[:, 1] * outward[:, 0] - way_px[:, 0] * outward[:, 1])[:, None]
    )


def scatter(rays: Rays, weights: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the scatter matrix S = sum w s^2 b b^T per track, shape (tracks, 3, 3).

    n^T S n is the mean squared distance in px^2 from the great circle with normal n, for weights w and pixel scales s
    of shape (tracks, samples).
    """
    weighted = rays.bearings * (weights * scale * scale)[..., None]
    return weighted.transpose(0, 2, 1) @ rays.bearings


def fit_circles(rays: Rays, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit a great circle to each track.

    Returns the normals (tracks, 3), the mean squared distances in px^2 (tracks,) and the scatter (tracks, 3, 3).
    """
    matrix = circle_scatter(rays, weights)
    normals, distance2 = smallest_eigenvectors(matrix)
    return normals, np.maximum(distance2, 0.0), matrix


def circle_scatter(rays: Rays, weights: np.ndarray) -> np.ndarray:
    """Return each track's scatter (tracks, 3, 3) at the pixel scale of its own best great circle."""
    return scatter(rays, weights, circle_pixel_scale(rays, weights))


def circle_pixel_scale(rays: Rays, weights: np.ndarray) -> np.ndarray:
    """Return pixels per unit of n.b (tracks, samples) at each track's best great circle.

    The scale depends on the circle: two fixed-point iterations from scale 1.
    """
    scale = np.ones(weights.shape)
    for _ in range(2):
        normals, _ = smallest_eigenvectors(scatter(rays, weights, scale))
        scale = rays.pixel_scale(normals[:, None])
    return scale


def orthonormal_basis(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors (..., 3) that span the plane perpendicular to unit vectors (..., 3)."""
    if directions.ndim == 1:  # in searches about one direction: arrays of three cost thirty times as much as floats
        return _basis_of_one(directions)
    helper = np.eye(3)[np.argmin(np.abs(directions), axis=-1)]
    first = cross(directions, helper)
    first /= np.sqrt(dot(first, first))[..., None]
    return first, cross(directions, first)


def _basis_of_one(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what `orthonormal_basis` returns for one unit vector (3,)."""
    x, y, z = vector = direction.tolist()
    axis = min(range(3), key=lambda index: abs(vector[index]))
    after, before = NEXT[axis], LAST[axis]
    length = math.hypot(vector[before], vector[after])
    first = [0.0, 0.0, 0.0]
    first[after], first[before] = vector[before] / length, -vector[after] / length
    u, v, w = first
    return np.array(first), np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def fit_circles_through(matrix: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the great circle through a given direction (tracks, 3) to each track's scatter (tracks, 3, 3).

    Returns normals (tracks, 3) and mean squared distances in px^2 (tracks,): the smaller eigenpair of the 2x2
    restriction of the scatter to the plane perpendicular to the direction.
    """
    first, second = orthonormal_basis(directions)
    image = np.einsum('tij,tj->ti', matrix, first)
    a, b = dot(first, image), dot(second, image)
    c = dot(second, np.einsum('tij,tj->ti', matrix, second))
    angle = 0.5 * np.arctan2(2 * b, a - c) + np.pi / 2
    cosine, sine = np.cos(angle), np.sin(angle)
    normals = first * cosine[:, None] + second * sine[:, None]
    return normals, np.maximum(a * cosine**2 + 2 * b * cosine * sine + c * sine**2, 0.0)


def squared_distances_through(matrix: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the mean squared distance of every track from its best circle through every direction.

    Scatter matrices (tracks, 3, 3) and unit directions (directions, 3) give px^2 of shape (directions, tracks).
    """
    return squared_distances(quadratic_forms(matrix), directions)


def quadratic_forms(matrix: np.ndarray) -> np.ndarray:
    """Return two quadratic forms of a unit direction d per scatter matrix S (tracks, 3, 3), shape (2, 6, tracks).

    Their values are the sum and the product of the two eigenvalues of S restricted to the plane perpendicular to d:
    trace S - d^T S d, and d^T C d with the cofactor matrix C of S.
    """
    diagonal, off_diagonal, minors, mixed = cofactors(matrix)
    return np.stack([np.concatenate([diagonal.sum(axis=0) - diagonal, -off_diagonal]), np.concatenate([minors, mixed])])


def squared_distances(forms: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the smaller restricted eigenvalue for unit directions (directions, 3), shape (directions, tracks).

    `forms` are those of `quadratic_forms`.
    """
    products = np.concatenate([directions**2, 2.0 * directions[:, NEXT] * directions[:, LAST]], axis=1)
    total, product = products @ forms
    root = np.sqrt(np.maximum(total * total - 4.0 * product, 0.0))
    return np.maximum(2.0 * product / np.maximum(total + root, 1e-300), 0.0)

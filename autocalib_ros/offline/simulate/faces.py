"""Ray casting of textured rectangles through any lens, the only primitive of the renderer.

Every image sample has its own ray.  With corner o and edges a, b of a rectangle in the camera frame and n = a x b, the
ray r intersects its plane at distance t = n.o / n.r and at the texture coordinates ((t r - o).a / a.a,
(t r - o).b / b.b).  Both are quotients of linear functions of r: one 3x3 matrix and one division per sample.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from autocalib_ros.offline.simulate.lens import CameraPose, KannalaBrandtLens

NO_MAP: Any = None  # for cv2.remap with x and y in the first map; the type stubs lack None
SAMPLES_PER_PIXEL = 2  # along either axis
_CELL_SAMPLES = 4  # samples per cell; rays are intersected at the cells and interpolated between
_EDGE_FRACTIONS = np.linspace(0.0, 1.0, 5)[:-1]
# Points round the rim of a face as fractions along both edges: straight edges project to curves.
_RIM_FRACTIONS = np.concatenate(
    [
        np.stack([_EDGE_FRACTIONS, 0 * _EDGE_FRACTIONS], 1),
        np.stack([0 * _EDGE_FRACTIONS + 1, _EDGE_FRACTIONS], 1),
        np.stack([1 - _EDGE_FRACTIONS, 0 * _EDGE_FRACTIONS + 1], 1),
        np.stack([0 * _EDGE_FRACTIONS, 1 - _EDGE_FRACTIONS], 1),
    ]
)
_TOP, _RIGHT, _BOTTOM, _LEFT = 2, 6, 10, 14  # indices of the edge midpoints in the rim
_BOUNDS_MARGIN_PX = 1.5  # added to the bounds of a projected face
_BULGE_FRACTION = 0.005  # bulge of a projected edge between two rim points, as a fraction of the extent
_BAND_HEIGHT_PX = 24  # large faces are drawn in bands of this height
_MIN_AREA_PX2 = 1.0  # smaller faces are not drawn


class Texture:
    """A BGRA image (h, w, 4) uint8 with an anisotropic mipmap (ripmap) against aliasing.

    The colour is defined everywhere and alpha alone is the silhouette, so no other colour bleeds in at edges.
    """

    def __init__(self, bgra: np.ndarray) -> None:
        self.height, self.width = bgra.shape[:2]
        self._halved = {(0, 0): np.ascontiguousarray(bgra)}
        self._framed: dict[tuple[int, int], np.ndarray] = {}

    def level(self, across: int, down: int) -> np.ndarray:
        """Return the image halved the given number of times along x and y, as far as possible.

        It has a border of one transparent texel, so that alpha is one half exactly on the edge.
        """
        across = min(across, max(0, self.width.bit_length() - 2))
        down = min(down, max(0, self.height.bit_length() - 2))
        if (across, down) not in self._framed:
            image = self._halve(across, down)
            framed = cv2.copyMakeBorder(image, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
            framed[[0, -1], :, 3] = 0
            framed[:, [0, -1], 3] = 0
            self._framed[across, down] = framed
        return self._framed[across, down]

    def _halve(self, across: int, down: int) -> np.ndarray:
        if (across, down) not in self._halved:
            finer = self._halve(across - 1, down) if across else self._halve(across, down - 1)
            height, width = finer.shape[:2]
            size = ((width + 1) // 2, height) if across else (width, (height + 1) // 2)
            self._halved[across, down] = cv2.resize(finer, size, interpolation=cv2.INTER_AREA)
        return self._halved[across, down]


@dataclass(frozen=True)
class Faces:
    """Textured rectangles: corners (n, 3, 3) are origin, edge along and edge down of each, in metres.

    The cross product along x down points into the body; faces are visible from the other side only.
    """

    corners: np.ndarray
    textures: tuple[Texture, ...]

    def moved(self, x: float, y: float, heading: float) -> Faces:
        """Return the faces of a body moved to a position and heading on the ground."""
        c, s = np.cos(heading), np.sin(heading)
        turned = self.corners @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        turned[:, 0, :2] += (x, y)
        return Faces(turned, self.textures)


def concatenate_faces(parts: Sequence[Faces]) -> Faces:
    """Merge several bodies into one."""
    return Faces(
        np.concatenate([p.corners for p in parts]) if parts else np.zeros((0, 3, 3)),
        tuple(t for p in parts for t in p.textures),
    )


@dataclass(frozen=True)
class PixelRect:
    """A rectangle of pixels, upper bounds exclusive."""

    x0: int
    y0: int
    x1: int
    y1: int

    @classmethod
    def around(cls, drawings: list[Drawing]) -> PixelRect:
        """Return the bounding rectangle of all drawings."""
        rects = [w for d in drawings for w in d.rects]
        return cls(
            min(w.x0 for w in rects),
            min(w.y0 for w in rects),
            max(w.x1 for w in rects),
            max(w.y1 for w in rects),
        )

    def pixels(self) -> tuple[slice, slice]:
        """Return the slices of its pixels."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    def samples(self) -> tuple[slice, slice]:
        """Return the slices of its samples."""
        return (
            slice(self.y0 * SAMPLES_PER_PIXEL, self.y1 * SAMPLES_PER_PIXEL),
            slice(self.x0 * SAMPLES_PER_PIXEL, self.x1 * SAMPLES_PER_PIXEL),
        )


@dataclass(frozen=True)
class Drawing:
    """A projected face: image regions, homogeneous matrix from ray to texel, and texture.

    offset_m: distance of its plane from the camera.  distance_m: mean distance of its rim.
    """

    rects: list[PixelRect]
    matrix: np.ndarray
    offset_m: float
    texture: np.ndarray
    gain: bool
    distance_m: float


class Canvas:
    """Supersampled framebuffer: colour BGRA (h, w, 4) and distance (h, w) in metres.

    SAMPLES_PER_PIXEL x SAMPLES_PER_PIXEL samples per pixel.  Intersections are computed for cells of
    2 x 2 pixels and interpolated linearly: over that size the error is below 0.01 px.
    """

    def __init__(self, lens: KannalaBrandtLens, width_px: int, height_px: int, margin_px: int = 0) -> None:
        self.lens = lens
        self.width_px, self.height_px, self.margin_px = width_px, height_px, margin_px
        shape = tuple((n + 2 * margin_px) * SAMPLES_PER_PIXEL for n in (height_px, width_px))
        self.colour = np.zeros((*shape, 4), np.uint8)
        self.distance = np.full(shape, np.inf, np.float32)
        # One extra cell on every side for the interpolation.
        rows, columns = (np.arange(-1, -(-n // _CELL_SAMPLES) + 1) for n in shape)
        self._cell_bearings = self._bearings((columns + 0.5) * _CELL_SAMPLES - 0.5, (rows + 0.5) * _CELL_SAMPLES - 0.5)

    def bearings(self) -> np.ndarray:
        """Return the rays (h, w, 3) float32 of all samples in the optical frame."""
        height, width = self.distance.shape
        return self._bearings(np.arange(width), np.arange(height))

    def _bearings(self, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the rays of a grid of sample coordinates."""
        x, y = ((n + 0.5) / SAMPLES_PER_PIXEL - 0.5 - self.margin_px for n in (columns, rows))
        grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), -1)
        return self.lens.bearings(grid).astype(np.float32)

    def empty_copy(self) -> Canvas:
        """Return an empty canvas for the same rays."""
        other = copy.copy(self)
        other.colour = np.zeros_like(self.colour)
        other.distance = np.full_like(self.distance, np.inf)
        return other

    def project_faces(self, bodies: Sequence[Faces], pose: CameraPose, gain: bool = False) -> list[list[Drawing]]:
        """Project the visible faces of each body for a camera pose.

        gain: multiply the image by texture / 100 instead of covering it, and keep the distances.
        """
        groups: list[list[Drawing]] = [[] for _ in bodies]
        faces = concatenate_faces(bodies)
        corners = faces.corners @ pose.world_from_camera
        corners[:, 0] = pose.to_camera(faces.corners[:, 0])
        normals = np.cross(corners[:, 1], corners[:, 2])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        offsets = (normals * corners[:, 0]).sum(1)
        facing = offsets > 1e-3
        body_indices = np.repeat(np.arange(len(bodies)), [len(b.corners) for b in bodies])[facing]
        corners, normals, offsets = corners[facing], normals[facing], offsets[facing]
        textures = [faces.textures[i] for i in np.flatnonzero(facing)]
        rim = corners[:, None, 0] + _RIM_FRACTIONS @ corners[:, 1:]
        pixels, valid = self.lens.project(rim)
        levels, large = _mip_levels(pixels, textures)
        bounds = self._bounds(pixels)
        visible = np.flatnonzero(valid.any(1) & large & (bounds[:, 1] > bounds[:, 0]).all(1))
        chosen = [textures[i].level(*levels[i]) for i in visible]
        matrices = _ray_matrices(corners[visible], normals[visible], [t.shape for t in chosen])
        distances = np.linalg.norm(rim[visible].mean(1), axis=1).tolist()
        for i, texture, matrix, distance in zip(visible, chosen, matrices, distances, strict=True):
            rects = self._bands(pixels[i], bounds[i])
            drawing = Drawing(rects, matrix, float(offsets[i]), texture, gain, distance)
            groups[body_indices[i]].append(drawing)
        return groups

    def draw(self, drawings: Iterable[Drawing]) -> None:
        """Draw projected faces with a depth test."""
        # Front to back: occluded faces are skipped early.
        for drawing in sorted(drawings, key=lambda d: d.distance_m):
            for rect in drawing.rects:
                self._draw(drawing, rect)

    def resolve(self, rect: PixelRect) -> np.ndarray:
        """Return the BGR pixels of a rectangle as means of their samples."""
        samples = self.colour[rect.samples()]
        size = (rect.x1 - rect.x0, rect.y1 - rect.y0)
        means = cv2.resize(samples, size, interpolation=cv2.INTER_AREA)
        return cv2.cvtColor(means, cv2.COLOR_BGRA2BGR)

    def _bounds(self, rims: np.ndarray) -> np.ndarray:
        """Return the pixel bounds (n, 2, 2), low and high (x, y), of rims (n, 16, 2)."""
        limit = np.array([self.width_px, self.height_px]) + 2 * self.margin_px
        low, high = rims.min(1), rims.max(1)
        margin = _BOUNDS_MARGIN_PX + _BULGE_FRACTION * (high - low)
        bounds = np.stack([np.floor(low - margin), np.ceil(high + margin) + 1], 1)
        return np.clip(bounds + self.margin_px, 0, limit).astype(int)

    def _bands(self, rim: np.ndarray, bounds: np.ndarray) -> list[PixelRect]:
        """Return narrow horizontal bands that cover a rim (16, 2) within its bounds."""
        (left, top), (right, bottom) = bounds.tolist()
        if bottom - top <= 1.5 * _BAND_HEIGHT_PX:
            return [PixelRect(left, top, right, bottom)]
        margin = _BOUNDS_MARGIN_PX + _BULGE_FRACTION * np.ptp(rim, axis=0)
        edges = np.append(np.arange(top, bottom, _BAND_HEIGHT_PX), bottom)
        low, high = edges[:-1] - margin[1], edges[1:] + margin[1]
        begin, end = _band_extents(rim + self.margin_px, low, high)
        x0 = np.clip(np.floor(begin - margin[0]), left, right).astype(int).tolist()
        x1 = np.clip(np.ceil(end + margin[0]) + 1, left, right).astype(int).tolist()
        rows = edges.tolist()
        bands = [PixelRect(*w) for w in zip(x0, rows[:-1], x1, rows[1:], strict=True) if w[2] > w[0]]
        return bands or [PixelRect(left, top, right, bottom)]

    def _draw(self, drawing: Drawing, rect: PixelRect) -> None:
        """Draw a face within a rectangle; its texture's alpha cuts the outline."""
        samples = rect.samples()
        cells, inner = _cells(samples)
        homogeneous = cv2.transform(self._cell_bearings[cells], drawing.matrix)
        # Rays that point away from the plane get a distance beyond everything.
        inverse = 1.0 / np.maximum(homogeneous[..., 2], 1e-9)
        distance = _refined(inverse * np.float32(drawing.offset_m), inner)
        visible = distance < self.distance[samples]
        if not visible.any():
            return
        texels = _refined(np.clip(homogeneous[..., :2] * inverse[..., None], -3e4, 3e4), inner)
        sampled = cv2.remap(drawing.texture, texels, NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        # Alpha is the highest byte: the sign bit is set where alpha exceeds one half.
        visible &= sampled.view(np.int32)[..., 0] < 0
        mask, colour = visible.view(np.uint8), self.colour[samples]
        if drawing.gain:
            sampled = cv2.multiply(colour, sampled, scale=0.01)
        else:
            cv2.copyTo(distance, mask, self.distance[samples])
        cv2.copyTo(sampled, mask, colour)


def _cells(samples: tuple[slice, slice]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the slices of the cells around samples, and of the samples in the interpolated cells."""
    outer, inner = [], []
    for part in samples:
        first, last = part.start // _CELL_SAMPLES, -(-part.stop // _CELL_SAMPLES)
        outer.append(slice(first, last + 2))  # index 0 is the cell before the image
        start = part.start - (first - 1) * _CELL_SAMPLES
        inner.append(slice(start, start + part.stop - part.start))
    return (outer[0], outer[1]), (inner[0], inner[1])


def _refined(values: np.ndarray, inner: tuple[slice, slice]) -> np.ndarray:
    """Interpolate cell values (h, w[, 2]) to samples and crop them."""
    return cv2.resize(values, None, fx=_CELL_SAMPLES, fy=_CELL_SAMPLES)[inner]


def _band_extents(rim: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and largest x (m,) of a closed polyline (n, 2) between rows low and high (m,)."""
    start, end = rim, np.roll(rim, -1, axis=0)
    rise = end[:, 1] - start[:, 1]
    rise = np.where(np.abs(rise) < 1e-9, 1e-9, rise)
    cuts = [(bound[:, None] - start[:, 1]) / rise for bound in (low, high)]
    fractions = np.clip(np.stack(cuts), 0.0, 1.0)
    x = start[:, 0] + fractions * (end[:, 0] - start[:, 0])
    top, bottom = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
    meets = (bottom >= low[:, None]) & (top <= high[:, None])
    return (np.where(meets, x.min(0), np.inf).min(1), np.where(meets, x.max(0), -np.inf).max(1))


def _mip_levels(pixels: np.ndarray, textures: list[Texture]) -> tuple[list[list[int]], np.ndarray]:
    """Return the mip level (across, down) of each texture, for about one texel per sample along either axis.

    pixels: the rims (n, 16, 2).  Also returns a mask of the faces that are large enough to draw.
    """
    along = pixels[:, _RIGHT] - pixels[:, _LEFT]
    down = pixels[:, _BOTTOM] - pixels[:, _TOP]
    area = np.abs(along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0])
    sizes = np.array([(t.width, t.height) for t in textures], float).reshape(-1, 2)
    spread = np.stack([np.hypot(*down.T), np.hypot(*along.T)], 1)
    texels = sizes * spread / np.maximum(area, 1e-6)[:, None] / SAMPLES_PER_PIXEL
    levels = (np.log2(np.maximum(texels, 1.0)) + 0.3).astype(int)
    return levels.tolist(), area > _MIN_AREA_PX2


def _ray_matrices(corners: np.ndarray, normals: np.ndarray, shapes: list[tuple[int, ...]]) -> np.ndarray:
    """Return homogeneous matrices (n, 3, 3) from rays to (texel x, texel y, 1).

    normals (n, 3) are unit vectors, so the divisor is the cosine of the angle of incidence.
    """
    origin = corners[:, 0]
    offset = (normals * origin).sum(1)
    sizes = np.array([(shape[1] - 2, shape[0] - 2) for shape in shapes], float).reshape(-1, 2)
    rows = []
    for axis in (0, 1):
        edge = corners[:, 1 + axis]
        edge = edge / (edge * edge).sum(1)[:, None]
        start = (origin * edge).sum(1)
        fraction = offset[:, None] * edge - start[:, None] * normals
        # Texel 0 is the border, so the image begins half a texel after its centre.
        rows.append(sizes[:, axis, None] * fraction + 0.5 * normals)
    return np.stack([*rows, normals], 1)

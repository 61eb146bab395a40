"""The one thing the renderer draws: textured rectangles in space, seen through any lens.

Every sample of the picture has its own ray, so a rectangle with corner o and edges a, b (camera
frame, n = a x b) is met exactly: the ray r meets it at distance t = n.o / n.r, at the fractions
((t r - o).a / a.a, (t r - o).b / b.b).  Both are quotients of linear functions of r:
one 3x3 matrix and one division per sample.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from autocalib_ros.offline.simulate.lens import CameraPose, KannalaBrandtLens

NO_MAP: Any = None  # to cv2.remap: its first map holds x and y; the stubs know no None
SAMPLES_PER_PIXEL = 2  # per pixel and axis
_CELL_SAMPLES = 4  # samples between the points where faces are met exactly
_EDGE_FRACTIONS = np.linspace(0.0, 1.0, 5)[:-1]
# The rim of a face as fractions along both edges, once round: straight edges appear curved.
_RIM_FRACTIONS = np.concatenate(
    [
        np.stack([_EDGE_FRACTIONS, 0 * _EDGE_FRACTIONS], 1),
        np.stack([0 * _EDGE_FRACTIONS + 1, _EDGE_FRACTIONS], 1),
        np.stack([1 - _EDGE_FRACTIONS, 0 * _EDGE_FRACTIONS + 1], 1),
        np.stack([0 * _EDGE_FRACTIONS, 1 - _EDGE_FRACTIONS], 1),
    ]
)
_TOP, _RIGHT, _BOTTOM, _LEFT = 2, 6, 10, 14  # middles of the edges within the rim
_BOUNDS_MARGIN_PX = 1.5
_BULGE_FRACTION = 0.005  # of the extent: what an edge bulges between two points of the rim
_BAND_HEIGHT_PX = 24
_MIN_AREA_PX2 = 1.0


class Texture:
    """A BGRA picture (h, w, 4) uint8 with copies halved along either axis against aliasing.

    The colour is defined everywhere; alpha alone cuts the outline, so edges take no foreign colour.
    """

    def __init__(self, bgra: np.ndarray) -> None:
        self.height, self.width = bgra.shape[:2]
        self._halved = {(0, 0): np.ascontiguousarray(bgra)}
        self._framed: dict[tuple[int, int], np.ndarray] = {}

    def level(self, across: int, down: int) -> np.ndarray:
        """Return the picture halved this often along x and along y, as far as it goes.

        It stands in a frame of one transparent texel, so that alpha is halved on its very edge.
        """
        across = min(across, max(0, self.width.bit_length() - 2))
        down = min(down, max(0, self.height.bit_length() - 2))
        if (across, down) not in self._framed:
            picture = self._halve(across, down)
            framed = cv2.copyMakeBorder(picture, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
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
    """Rectangles: corners (n, 3, 3) are origin, edge along and edge down of each, in metres.

    along x down points into the body: faces are seen from the other side only.
    """

    corners: np.ndarray
    textures: tuple[Texture, ...]

    def moved(self, x: float, y: float, heading: float) -> Faces:
        """Return the faces of a body moved to a place on the ground."""
        c, s = np.cos(heading), np.sin(heading)
        turned = self.corners @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        turned[:, 0, :2] += (x, y)
        return Faces(turned, self.textures)


def concatenate_faces(parts: Sequence[Faces]) -> Faces:
    """Return several bodies as one."""
    return Faces(
        np.concatenate([p.corners for p in parts]) if parts else np.zeros((0, 3, 3)),
        tuple(t for p in parts for t in p.textures),
    )


@dataclass(frozen=True)
class PixelRect:
    """A rectangle of pixels, upper bounds excluded."""

    x0: int
    y0: int
    x1: int
    y1: int

    @classmethod
    def around(cls, drawings: list[Drawing]) -> PixelRect:
        """Return the window that holds all drawings."""
        windows = [w for d in drawings for w in d.windows]
        return cls(
            min(w.x0 for w in windows),
            min(w.y0 for w in windows),
            max(w.x1 for w in windows),
            max(w.y1 for w in windows),
        )

    def pixels(self) -> tuple[slice, slice]:
        """Index of the pixels."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    def samples(self) -> tuple[slice, slice]:
        """Index of the samples."""
        return (
            slice(self.y0 * SAMPLES_PER_PIXEL, self.y1 * SAMPLES_PER_PIXEL),
            slice(self.x0 * SAMPLES_PER_PIXEL, self.x1 * SAMPLES_PER_PIXEL),
        )


@dataclass(frozen=True)
class Drawing:
    """A face ready to be drawn: where, by which matrix from ray to texel, and with what.

    offset_m: distance of its plane from the camera.
    """

    windows: list[PixelRect]
    matrix: np.ndarray
    offset_m: float
    texture: np.ndarray
    gain: bool
    distance_m: float


class Canvas:
    """Samples of a picture: colour BGRA (h, w, 4) and distance (h, w) in metres.

    There are SAMPLES x SAMPLES samples to the pixel.  Where rays meet a face is worked out for
    cells of 2 x 2 pixels and interpolated: over so little the meeting point is linear to 0.01 px.
    """

    def __init__(self, lens: KannalaBrandtLens, width_px: int, height_px: int, margin_px: int = 0) -> None:
        self.lens = lens
        self.width_px, self.height_px, self.margin_px = width_px, height_px, margin_px
        shape = tuple((n + 2 * margin_px) * SAMPLES_PER_PIXEL for n in (height_px, width_px))
        self.colour = np.zeros((*shape, 4), np.uint8)
        self.distance = np.full(shape, np.inf, np.float32)
        # One cell more on every side, so that interpolation never runs out of cells.
        rows, columns = (np.arange(-1, -(-n // _CELL_SAMPLES) + 1) for n in shape)
        self._cell_bearings = self._bearings((columns + 0.5) * _CELL_SAMPLES - 0.5, (rows + 0.5) * _CELL_SAMPLES - 0.5)

    def bearings(self) -> np.ndarray:
        """Return the rays (h, w, 3) float32 of all samples, in the optical frame."""
        height, width = self.distance.shape
        return self._bearings(np.arange(width), np.arange(height))

    def _bearings(self, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the rays of a grid of sample coordinates."""
        x, y = ((n + 0.5) / SAMPLES_PER_PIXEL - 0.5 - self.margin_px for n in (columns, rows))
        grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), -1)
        return self.lens.bearings(grid).astype(np.float32)

    def empty_copy(self) -> Canvas:
        """Return another canvas for the same rays."""
        other = copy.copy(self)
        other.colour = np.zeros_like(self.colour)
        other.distance = np.full_like(self.distance, np.inf)
        return other

    def project_faces(self, bodies: Sequence[Faces], pose: CameraPose, gain: bool = False) -> list[list[Drawing]]:
        """Find the faces of each body that are seen from a pose, and where.

        gain: do not cover the picture but multiply it by texture / 100, leaving distances.
        """
        groups: list[list[Drawing]] = [[] for _ in bodies]
        faces = concatenate_faces(bodies)
        corners = faces.corners @ pose.world_from_camera
        corners[:, 0] = pose.to_camera(faces.corners[:, 0])
        normals = np.cross(corners[:, 1], corners[:, 2])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        offsets = (normals * corners[:, 0]).sum(1)
        facing = offsets > 1e-3
        owners = np.repeat(np.arange(len(bodies)), [len(b.corners) for b in bodies])[facing]
        corners, normals, offsets = corners[facing], normals[facing], offsets[facing]
        textures = [faces.textures[i] for i in np.flatnonzero(facing)]
        rim = corners[:, None, 0] + _RIM_FRACTIONS @ corners[:, 1:]
        pixels, valid = self.lens.project(rim)
        levels, large = _mip_levels(pixels, textures)
        bounds = self._bounds(pixels)
        seen = np.flatnonzero(valid.any(1) & large & (bounds[:, 1] > bounds[:, 0]).all(1))
        chosen = [textures[i].level(*levels[i]) for i in seen]
        matrices = _ray_matrices(corners[seen], normals[seen], [t.shape for t in chosen])
        distances = np.linalg.norm(rim[seen].mean(1), axis=1).tolist()
        for i, texture, matrix, distance in zip(seen, chosen, matrices, distances, strict=True):
            windows = self._bands(pixels[i], bounds[i])
            drawing = Drawing(windows, matrix, float(offsets[i]), texture, gain, distance)
            groups[owners[i]].append(drawing)
        return groups

    def draw(self, drawings: Iterable[Drawing]) -> None:
        """Draw what was planned where it is the nearest."""
        # From near to far: what is hidden costs least.
        for drawing in sorted(drawings, key=lambda d: d.distance_m):
            for window in drawing.windows:
                self._draw(drawing, window)

    def resolve(self, window: PixelRect) -> np.ndarray:
        """Return the BGR pixels of a window as the means of their samples."""
        samples = self.colour[window.samples()]
        size = (window.x1 - window.x0, window.y1 - window.y0)
        means = cv2.resize(samples, size, interpolation=cv2.INTER_AREA)
        return cv2.cvtColor(means, cv2.COLOR_BGRA2BGR)

    def _bounds(self, rims: np.ndarray) -> np.ndarray:
        """Return the window bounds (n, 2, 2), low and high (x, y), of outlines (n, 16, 2)."""
        limit = np.array([self.width_px, self.height_px]) + 2 * self.margin_px
        low, high = rims.min(1), rims.max(1)
        slack = _BOUNDS_MARGIN_PX + _BULGE_FRACTION * (high - low)
        bounds = np.stack([np.floor(low - slack), np.ceil(high + slack) + 1], 1)
        return np.clip(bounds + self.margin_px, 0, limit).astype(int)

    def _bands(self, rim: np.ndarray, bounds: np.ndarray) -> list[PixelRect]:
        """Return windows, narrow bands of rows, that hold an outline (16, 2) within its bounds."""
        (left, top), (right, bottom) = bounds.tolist()
        if bottom - top <= 1.5 * _BAND_HEIGHT_PX:
            return [PixelRect(left, top, right, bottom)]
        slack = _BOUNDS_MARGIN_PX + _BULGE_FRACTION * np.ptp(rim, axis=0)
        edges = np.append(np.arange(top, bottom, _BAND_HEIGHT_PX), bottom)
        low, high = edges[:-1] - slack[1], edges[1:] + slack[1]
        begin, end = _band_extents(rim + self.margin_px, low, high)
        x0 = np.clip(np.floor(begin - slack[0]), left, right).astype(int).tolist()
        x1 = np.clip(np.ceil(end + slack[0]) + 1, left, right).astype(int).tolist()
        rows = edges.tolist()
        bands = [PixelRect(*w) for w in zip(x0, rows[:-1], x1, rows[1:], strict=True) if w[2] > w[0]]
        return bands or [PixelRect(left, top, right, bottom)]

    def _draw(self, drawing: Drawing, window: PixelRect) -> None:
        """Draw a face within a window; its picture alone tells where it ends."""
        samples = window.samples()
        cells, inner = _cells(samples)
        places = cv2.transform(self._cell_bearings[cells], drawing.matrix)
        # Rays that turn away from the plane meet it beyond everything.
        inverse = 1.0 / np.maximum(places[..., 2], 1e-9)
        distance = _refined(inverse * np.float32(drawing.offset_m), inner)
        seen = distance < self.distance[samples]
        if not seen.any():
            return
        texels = _refined(np.clip(places[..., :2] * inverse[..., None], -3e4, 3e4), inner)
        picked = cv2.remap(drawing.texture, texels, NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        # Alpha is the highest byte: a set sign bit means more than one half.
        seen &= picked.view(np.int32)[..., 0] < 0
        mask, colour = seen.view(np.uint8), self.colour[samples]
        if drawing.gain:
            picked = cv2.multiply(colour, picked, scale=0.01)
        else:
            cv2.copyTo(distance, mask, self.distance[samples])
        cv2.copyTo(picked, mask, colour)


def _cells(samples: tuple[slice, slice]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the cells around samples, and where the samples lie in the refined cells."""
    outer, inner = [], []
    for part in samples:
        first, last = part.start // _CELL_SAMPLES, -(-part.stop // _CELL_SAMPLES)
        outer.append(slice(first, last + 2))  # index 0 is the cell before the picture
        start = part.start - (first - 1) * _CELL_SAMPLES
        inner.append(slice(start, start + part.stop - part.start))
    return (outer[0], outer[1]), (inner[0], inner[1])


def _refined(values: np.ndarray, inner: tuple[slice, slice]) -> np.ndarray:
    """Interpolate values of cells (h, w[, 2]) to samples and cut out the inner ones."""
    return cv2.resize(values, None, fx=_CELL_SAMPLES, fy=_CELL_SAMPLES)[inner]


def _band_extents(rim: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and greatest x of a closed line (n, 2) between rows low and high (m,)."""
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
    """Choose how often to halve each texture: about one texel to the sample along either axis.

    pixels: the rims (n, 16, 2).  Returns (across, down) of each and whether it is large enough.
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
    """Return matrices (n, 3, 3) from rays to (texel x, texel y, 1), homogeneous.

    normals (n, 3) are unit vectors, so the divisor is the cosine at which the ray meets the plane.
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
        # Texel 0 is the frame, so the picture begins half a texel after its centre.
        rows.append(sizes[:, axis, None] * fraction + 0.5 * normals)
    return np.stack([*rows, normals], 1)

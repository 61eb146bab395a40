"""Vehicle bodies: vehicle shapes as textured rectangles with enough detail for a feature tracker."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from autocalib_ros.offline.simulate import paint
from autocalib_ros.offline.simulate.faces import Faces, Texture
from autocalib_ros.offline.simulate.palette import palette_for
from autocalib_ros.offline.simulate.shapes import SHAPES, BodyPart, Profile, VehicleShape

FINE_TEXELS_PER_M, COARSE_TEXELS_PER_M = 80, 40
_DIRT_BANK_TEXELS = 1024
_Texels = Callable[[Profile], np.ndarray]
# Octaves of dirt on the paint: size in texels, standard deviation in grey levels.
_DIRT = ((2.0, 3.0), (6.0, 4.0), (18.0, 4.0), (60.0, 5.0))
_REAR_LABELS = ('rear', 'rear_screen', 'boot', 'doors', 'plain')


@lru_cache(maxsize=256)
def body_faces(kind: str, colour: int, thermal: bool, texels_per_m: int = FINE_TEXELS_PER_M) -> Faces:
    """Return the faces of a vehicle in its body frame (x forward, y left, origin on the ground)."""
    painter = _BodyPainter(SHAPES[kind], colour, thermal, texels_per_m)
    corners: list[list[tuple[float, float, float]]] = []
    textures: list[Texture] = []
    for part in SHAPES[kind].parts:
        for side in (1, -1):
            corners.append(_side_corners(part, side))
            textures.append(painter.side(part, side))
        for i, label in enumerate(part.labels):
            corners.append(_strip_corners(part, i))
            textures.append(painter.strip(part, i, label))
    return Faces(np.array(corners), tuple(textures))


@lru_cache(maxsize=1)
def _dirt_bank() -> np.ndarray:
    return paint.octave_noise(_DIRT_BANK_TEXELS, _DIRT_BANK_TEXELS, _DIRT, np.random.default_rng(10))


@lru_cache(maxsize=16)
def shadow_faces(kind: str, thermal: bool) -> Faces:
    """Return the soft shadow under a vehicle, to be drawn as a gain."""
    shape = SHAPES[kind]
    margin = 0.7
    length, width = shape.length_m + 2 * margin, shape.width_m + 2 * margin
    x, y = (np.linspace(-0.5, 0.5, n) * m for n, m in ((96, length), (48, width)))
    outside = np.hypot(
        np.maximum(np.abs(x)[None] - shape.length_m / 2 + 0.3, 0),
        np.maximum(np.abs(y)[:, None] - shape.width_m / 2 + 0.3, 0),
    )
    depth = 12 if thermal else 72
    image = np.full((48, 96, 4), 255, np.uint8)
    image[..., :3] = (100 - depth * np.exp(-((outside / 0.45) ** 2)))[..., None]
    corners = [[(-length / 2, width / 2, 0.01), (length, 0, 0), (0, -width, 0)]]
    return Faces(np.array(corners), (Texture(image),))


def _side_corners(part: BodyPart, side: int) -> list[tuple[float, float, float]]:
    """Return origin and edges of the left (side 1) or right (-1) wall, from the ground to the top."""
    xs = [x for x, _ in part.profile]
    front, rear = max(xs), min(xs)
    start = front if side > 0 else rear
    return [
        (start, side * part.width_m / 2, part.top_m),
        (-side * (front - rear), 0.0, 0.0),
        (0.0, 0.0, -part.top_m),
    ]


def _strip_corners(part: BodyPart, i: int) -> list[tuple[float, float, float]]:
    """Return origin and edges of the strip that an edge of the profile sweeps over the width."""
    (x0, z0), (x1, z1) = part.profile[i], part.profile[i + 1]
    half = part.width_m / 2
    if part.labels[i] in _REAR_LABELS and x1 <= x0 and i > 0:
        return [(x0, half, z0), (0.0, -2 * half, 0.0), (x1 - x0, 0.0, z1 - z0)]
    return [(x1, -half, z1), (0.0, 2 * half, 0.0), (x0 - x1, 0.0, z0 - z1)]


class _BodyPainter:
    """Paints the textures of one vehicle."""

    def __init__(self, shape: VehicleShape, colour: int, thermal: bool, texels_per_m: int) -> None:
        self.shape = shape
        self.scale = texels_per_m
        self.palette = palette_for(thermal)
        self.body = self.palette.bodies[colour]
        self.rng = np.random.default_rng([colour, thermal, *shape.kind.encode()])

    def side(self, part: BodyPart, side: int) -> Texture:
        """Paint a side wall with windows, doors and wheels; alpha is the silhouette of profile and wheels."""
        xs = [x for x, _ in part.profile]
        front, rear = max(xs), min(xs)
        scale = self.scale
        width, height = round((front - rear) * scale), round(part.top_m * scale)

        def texels(points: tuple[tuple[float, float], ...]) -> np.ndarray:
            xz = np.array(points)
            across = (front - xz[:, 0]) if side > 0 else (xz[:, 0] - rear)
            return np.stack([across, part.top_m - xz[:, 1]], 1) * scale

        image = paint.filled_image(height, width, self.body)
        self._dirt(image)
        outline = texels(part.profile)
        self._panels(image, part, texels)
        for window in part.windows:
            self._window(image, texels(window))
        alpha = np.zeros((image.shape[0], image.shape[1]), np.uint8)
        paint.polygon(alpha, outline, (255,))
        self._wheels(image, alpha, part, texels)
        image[..., 3] = alpha
        return Texture(image)

    def strip(self, part: BodyPart, i: int, label: str) -> Texture:
        """Paint a strip across the vehicle."""
        (x0, z0), (x1, z1) = part.profile[i], part.profile[i + 1]
        height = round(float(np.hypot(x1 - x0, z1 - z0)) * self.scale)
        image = paint.filled_image(height, round(part.width_m * self.scale), self.body)
        self._dirt(image)
        getattr(self, '_' + label)(image)
        return Texture(image)

    def _dirt(self, image: np.ndarray) -> None:
        height, width = image.shape[:2]
        row, column = (int(self.rng.integers(_DIRT_BANK_TEXELS - n)) for n in (height, width))
        dirt = _dirt_bank()[row : row + height, column : column + width]
        paint.add_noise(image, dirt * np.float32(self.palette.texture))

    def _shade(self, part: float) -> tuple[int, ...]:
        """Return the body colour mixed with the dark trim."""
        return (*paint.mix_colours(self.body, self.palette.trim, part), 255)

    def _panels(self, image: np.ndarray, part: BodyPart, texels: _Texels) -> None:
        """Draw door gaps, a rubbing strip, handles, lamps and the lettering."""
        low = min(z for _, z in part.profile)
        xs = [x for x, _ in part.profile]
        front, rear = max(xs), min(xs)
        waist = part.windows[0][0][1] if part.windows else part.top_m - 0.1
        for x in np.arange(front - 1.1, rear + 0.4, -1.05):
            top, bottom = texels(((x, waist), (x, low + 0.05)))
            paint.line(image, tuple(top), tuple(bottom), self._shade(0.75), 2)
            handle = texels(((x + 0.10, waist - 0.08), (x + 0.28, waist - 0.08)))
            paint.line(image, tuple(handle[0]), tuple(handle[1]), self._shade(0.9), 3)
        strip = texels(((front, low + 0.22), (rear, low + 0.22)))
        paint.line(image, tuple(strip[0]), tuple(strip[1]), self._shade(0.55), 4)
        for x, colour in ((front, self.palette.head_lamp), (rear, self.palette.tail_lamp)):
            lamp = texels(((x - 0.22, 0.72 * waist), (x + 0.22, 0.86 * waist)))
            box = np.array([lamp[0], (lamp[1][0], lamp[0][1]), lamp[1], (lamp[0][0], lamp[1][1])])
            paint.polygon(image, box, (*colour, 255))
        if part.lettering:
            self._lettering(image, part, texels, front, rear)

    def _lettering(self, image: np.ndarray, part: BodyPart, texels: _Texels, front: float, rear: float) -> None:
        end = min([x for w in part.windows for x, _ in w] or [front]) - 0.2
        low, high, first = 0.62 * part.top_m, 0.85 * part.top_m, end
        if len(part.windows) > 1:  # below the windows, not behind them
            low, high, first = 0.62, 1.05, front - 0.6
        (xa, ya), (xb, yb) = texels(((rear + 0.3, low), (first, high)))
        box = (min(xa, xb), min(ya, yb), max(xa, xb), max(ya, yb))
        paint.draw_text(image, part.lettering, box, self.palette.ink)

    def _window(self, image: np.ndarray, outline: np.ndarray) -> None:
        """Fill an outline with glass, with seats behind it and a reflection on it."""
        centre = outline.mean(0)
        frame = centre + (outline - centre) * 1.06
        paint.polygon(image, frame, (*self.palette.trim, 255))
        paint.polygon(image, outline, (*self.palette.glass, 255))
        low, high = outline.min(0), outline.max(0)
        size = high - low
        bright = (*paint.mix_colours(self.palette.glass, self.palette.sky_low, 0.3), 255)
        dark = (*paint.mix_colours(self.palette.glass, self.palette.trim, 0.8), 255)
        for x in self.rng.uniform(0.15, 0.85, 2):
            spot = low + size * (x, self.rng.uniform(0.45, 0.75))
            paint.disc(image, tuple(spot), 0.18 * min(size), dark)
        streak = low + size * np.array([(0.30, 0.98), (0.42, 0.98), (0.55, 0.04), (0.47, 0.04)])
        paint.polygon(image, streak, bright)

    def _wheels(self, image: np.ndarray, alpha: np.ndarray, part: BodyPart, texels: _Texels) -> None:
        xs = [x for x, _ in part.profile]
        radius = self.shape.wheel_radius_m
        for x in self.shape.wheels_x_m:
            if not min(xs) < x < max(xs):
                continue
            ((cx, cy),) = texels(((x, radius),))
            paint.disc(image, (cx, cy), 1.18 * radius * self.scale, (*self.palette.trim, 255))
            paint.disc(image, (cx, cy), radius * self.scale, (*self.palette.tyre, 255))
            paint.disc(image, (cx, cy), 0.6 * radius * self.scale, (*self.palette.hub, 255))
            paint.disc(alpha, (cx, cy), radius * self.scale, (255,))

    def _box(self, image: np.ndarray, x0: float, y0: float, x1: float, y1: float, colour: tuple[int, ...]) -> None:
        """Fill a box given in fractions of the texture."""
        height, width = image.shape[:2]
        box = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]) * (width, height)
        paint.polygon(image, box, (*colour[:3], 255))

    def _front(self, image: np.ndarray) -> None:
        if self.palette.engine:
            self._box(image, 0.1, 0.0, 0.9, 1.0, self.palette.engine)
        self._box(image, 0.25, 0.40, 0.75, 0.85, self.palette.trim)
        self._plate(image)
        for x in (0.03, 0.80):
            self._box(image, x, 0.15, x + 0.17, 0.55, self.palette.head_lamp)

    def _rear(self, image: np.ndarray) -> None:
        self._box(image, 0.0, 0.86, 1.0, 1.0, self.palette.trim)
        self._plate(image)
        for x in (0.02, 0.84):
            self._box(image, x, 0.10, x + 0.14, 0.45, self.palette.tail_lamp)

    def _plate(self, image: np.ndarray) -> None:
        self._box(image, 0.36, 0.55, 0.64, 0.80, self.palette.marking)
        height, width = image.shape[:2]
        box = (0.38 * width, 0.58 * height, 0.62 * width, 0.77 * height)
        paint.draw_text(image, f'K {self.rng.integers(100, 999)}', box, self.palette.ink)

    def _bonnet(self, image: np.ndarray) -> None:
        height, width = image.shape[:2]
        if self.palette.engine:
            warm = paint.mix_colours(self.body, self.palette.engine, 0.7)
            self._box(image, 0.12, 0.1, 0.88, 1.0, warm)
        for x, lean in ((0.14, 0.06), (0.86, -0.06), (0.38, 0.03), (0.62, -0.03)):
            ends = (x * width, 0.0), ((x + lean) * width, float(height))
            paint.line(image, *ends, self._shade(0.45), 2)
        self._box(image, 0.42, 0.02, 0.58, 0.10, self._shade(0.8))

    def _boot(self, image: np.ndarray) -> None:
        self._box(image, 0.06, 0.10, 0.94, 0.16, self._shade(0.6))
        self._box(image, 0.44, 0.55, 0.56, 0.75, self._shade(0.7))

    def _screen(self, image: np.ndarray) -> None:
        self._glass(image, 0.05)
        self._box(image, 0.46, 0.05, 0.54, 0.20, self.palette.trim)
        self._box(image, 0.10, 0.80, 0.20, 0.92, self.palette.marking)

    def _rear_screen(self, image: np.ndarray) -> None:
        self._glass(image, 0.08)
        self._box(image, 0.45, 0.10, 0.55, 0.22, self.palette.tail_lamp)

    def _glass(self, image: np.ndarray, frame: float) -> None:
        height, width = image.shape[:2]
        outline = np.array([(frame, 0.06), (1 - frame, 0.06), (1 - frame, 0.94), (frame, 0.94)])
        self._window(image, outline * (width, height))

    def _roof(self, image: np.ndarray) -> None:
        for x in (0.07, 0.91):
            self._box(image, x, 0.02, x + 0.02, 0.98, self._shade(0.7))
        self._box(image, 0.25, 0.12, 0.75, 0.45, self._shade(0.85))
        self._box(image, 0.47, 0.88, 0.53, 0.95, self.palette.trim)

    def _bus_roof(self, image: np.ndarray) -> None:
        for y in (0.08, 0.38, 0.70):
            self._box(image, 0.28, y, 0.72, y + 0.14, self._shade(0.35))
            self._box(image, 0.34, y + 0.03, 0.66, y + 0.06, self.palette.trim)

    def _tarpaulin(self, image: np.ndarray) -> None:
        height, width = image.shape[:2]
        for y in np.linspace(0.04, 0.96, 9):
            line = (0.0, y * height), (float(width), y * height)
            paint.line(image, *line, self._shade(0.35), 3)
        self._box(image, 0.47, 0.0, 0.53, 1.0, self._shade(0.2))

    def _doors(self, image: np.ndarray) -> None:
        height, width = image.shape[:2]
        paint.line(image, (width / 2, 0.0), (width / 2, float(height)), self._shade(0.9), 3)
        for x in (0.30, 0.62):
            self._box(image, x, 0.1, x + 0.03, 0.85, self._shade(0.5))
        paint.draw_text(
            image,
            '24 H',
            (0.15 * width, 0.2 * height, 0.85 * width, 0.5 * height),
            self.palette.ink,
        )
        for x in (0.02, 0.86):
            self._box(image, x, 0.75, x + 0.12, 0.92, self.palette.tail_lamp)

    def _plain(self, image: np.ndarray) -> None:
        self._box(image, 0.0, 0.9, 1.0, 1.0, self._shade(0.8))

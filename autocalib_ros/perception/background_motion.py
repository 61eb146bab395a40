"""Motion of the whole picture between a reference image and a later one: shift, rotation and zoom with their sigmas.

Corners spread over the reference are followed by Lucas-Kanade. The background is what most cells of the picture agree
on, or what stays where it was; whatever moves otherwise is traffic.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

MAX_CORNERS = 80
"""Most corners: the error of their mean is a ninth of that of one; more cost time and add little."""
CELLS = (6, 4)
"""Columns and rows of the grid over which corners are spread. Judgement: a lorry nearby covers a quarter of it."""
CORNERS_PER_CELL = 5
"""Most corners of a cell, so that a textured front of a house does not outvote the rest."""
MIN_CORNERS = 8
"""Least number of corners that agree: twice the four parameters. Unrelated images let two or three agree by chance."""
MIN_AGREEING_CELLS = 8
"""Least cells that a motion of the picture has to show in, a third of all: a motion that only a part of the picture
shows is traffic. A reference needs corners in as many: where there are fewer, nothing tells motion from traffic."""
MIN_CELLS, MIN_LINES = 5, 2
"""Least cells with agreeing corners, and rows and columns of cells that they lie in, to say that the picture stays as
it was, even where traffic covers most of it: a burnt-in line of text or a lorry covers fewer. Judgement."""
CORNER_QUALITY = 0.01
"""Least strength of a corner, fraction of the strongest one (Shi and Tomasi 1994). Judgement."""
NOISE_ENERGY = 4.0
"""Least energy of the gradients about a corner in its weaker direction, times that of the noise of the image: their
amplitude is twice that of noise, whose corners are elsewhere in the next image."""
NOISE_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
"""Second differences that see noise and hardly any structure; white noise comes out 6 times as strong (Immerkaer
1996)."""
LAMP_QUANTILE = 0.97
"""Fraction of a night image that is neither lamp nor glare. Corner strength is relative to the strongest one: headlamps
at night, which move, would suppress all others, so that grey levels are clipped there. Judgement."""
MASK_MARGIN_PX = 12
"""Distance of corners from ignored regions, more than half a window: their borders do not move with the camera."""
WINDOW_PX, PYRAMID_LEVELS = 15, 2
"""Window and pyramid levels of the usual search: finds steps up to 20 px from where the corner was last."""
WIDE_WINDOW_PX, WIDE_PYRAMID_LEVELS = 21, 4
"""Those of the search after the background was not found near its last place: finds steps up to about 100 px."""
AGREEMENT_PX = 1.0
"""Distance within which displacements agree, pixels of the reduced image: blocks of compressed video scatter corners by
0.5 to 0.8 px (one sigma at 320 px), vehicles move on by more within a second."""
LASTING_SHARE = 0.5
"""Fraction of the best other agreement that the motion of before needs to be kept: a lorry with a third of all corners
may drive by, but a camera that was bumped leaves hardly a corner in place."""
FIT_ROUNDS = 4
"""Robust fits, each to the corners that agree with the one before; the second adds those at the borders of a picture
that rotates or zooms."""
UNRELATED_ERROR = 0.7
"""Ratio of the mean grey level difference of matched windows to their mean deviation above which they are looked at
more closely: it is 1.41 for pure noise (0.8 if that is clipped at black), and large where light changed."""
MIN_WINDOW_CORRELATION = 0.4
"""Least median correlation of matched windows: Lucas-Kanade raises that of pure noise to 0.2, and noise as strong as
the pattern leaves 0.5. A covered lens shows nothing but noise, which seems to stand still."""
SIGNIFICANCE = 3.0
"""Rotation and zoom below this number of their sigmas are taken for noise. Judgement: 0.3 % of the images by chance."""


@dataclass(frozen=True)
class PictureMotion:
    """A similarity about the centre of the picture: x goes to centre + scale (x - centre) + shift, as complex numbers.

    The real part is x, the imaginary part y (downwards); shift and sigma are pixels of the image that it was made for.
    """

    shift: complex = 0j
    scale: complex = 1 + 0j
    """Zoom factor times exp(i rotation)."""
    sigma_px: float = 0.0
    """Standard error of each coordinate of the shift."""
    share: float = 1.0
    """Fraction of the corners that agree with it."""

    def after(self, other: PictureMotion) -> PictureMotion:
        """Return `other` followed by this motion."""
        return PictureMotion(
            self.shift + self.scale * other.shift,
            self.scale * other.scale,
            float(np.hypot(self.sigma_px, other.sigma_px)),
            self.share,
        )

    def inverse(self) -> PictureMotion:
        """Return the motion back."""
        return PictureMotion(-self.shift / self.scale, 1 / self.scale, self.sigma_px, self.share)

    def enlarged(self, factor: float) -> PictureMotion:
        """Return the same motion in an image of `factor` times the width."""
        return PictureMotion(self.shift * factor, self.scale, self.sigma_px * factor, self.share)

    def moved(self, points_px: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Return where the motion takes points (n, 2) of an image of `size` (width, height)."""
        centre = _centre(size)
        ends = centre + self.scale * (points_px[:, 0] + 1j * points_px[:, 1] - centre) + self.shift
        return np.column_stack([ends.real, ends.imag])

    def matrix(self, size: tuple[int, int]) -> np.ndarray:
        """Return the 2x3 matrix of `moved` for cv2.warpAffine."""
        centre, scale = _centre(size), self.scale
        offset = centre - scale * centre + self.shift
        return np.array([[scale.real, -scale.imag, offset.real], [scale.imag, scale.real, offset.imag]])

    def largest_px(self, size: tuple[int, int]) -> float:
        """Return the root mean square displacement over an image of `size`, pixels."""
        # mean square distance from the centre of a rectangle: (width^2 + height^2) / 12
        spread = (size[0] ** 2 + size[1] ** 2) / 12.0
        return float(np.sqrt(abs(self.shift) ** 2 + abs(self.scale - 1) ** 2 * spread))


class ReferenceImage:
    """Corners of a grey image (H, W) that later images are compared with; none where the mask `ignored` is not 0."""

    def __init__(self, image: np.ndarray, ignored: np.ndarray | None = None) -> None:
        self.image = image
        self.corners_px = spread_corners(image, ignored)
        self._cells = cells_of(self.corners_px, image.shape)
        self._cell_count = len(np.unique(self._cells))
        patterns = _windows(image, self.corners_px)
        self._deviations = np.abs(patterns - patterns.mean(axis=1, keepdims=True)).mean(axis=1)

    @property
    def is_textured(self) -> bool:
        """Whether there are enough corners to be found again; not in darkness, fog, or with a covered lens."""
        return len(self.corners_px) >= MIN_CORNERS and self._cell_count >= MIN_AGREEING_CELLS

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.image.shape[1], self.image.shape[0]

    def motion_to(self, image: np.ndarray, before: PictureMotion, wide: bool = False) -> PictureMotion | None:
        """Return the motion of the picture from the reference to a later image; None if too few corners agree.

        The search starts from the motion `before`; a `wide` one is slower and finds larger steps.
        """
        if not self.is_textured or image.shape != self.image.shape:
            return None
        side, levels = (WIDE_WINDOW_PX, WIDE_PYRAMID_LEVELS) if wide else (WINDOW_PX, PYRAMID_LEVELS)
        guess = before.moved(self.corners_px, self.size)
        found, status, differences = cv2.calcOpticalFlowPyrLK(
            self.image,
            image,
            np.ascontiguousarray(self.corners_px, np.float32).reshape(-1, 1, 2),
            np.ascontiguousarray(guess, np.float32).reshape(-1, 1, 2),
            winSize=(side, side),
            maxLevel=levels,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.02),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        ends = found[:, 0].astype(float)
        inside = ((ends >= 0) & (ends < self.size)).all(axis=1) & (status.ravel() == 1)
        agreed = self._agreed(self.corners_px[inside], ends[inside], guess[inside], self._cells[inside])
        if agreed is None:
            return None
        motion, rows = agreed[0], np.flatnonzero(inside)[agreed[1]]
        ratios = differences.ravel()[rows] / np.maximum(self._deviations[rows], 1e-6)
        if (wide or np.median(ratios) > UNRELATED_ERROR) and not self._correlates(image, rows, ends[rows]):
            return None
        return motion

    def _correlates(self, image: np.ndarray, rows: np.ndarray, ends: np.ndarray) -> bool:
        """Whether the windows about corners `rows` (n,) look like those about their `ends` (n, 2) in another image."""
        before, after = _windows(self.image, self.corners_px[rows]), _windows(image, ends)
        before, after = before - before.mean(axis=1, keepdims=True), after - after.mean(axis=1, keepdims=True)
        norms = np.sqrt((before**2).sum(axis=1) * (after**2).sum(axis=1))
        return bool(np.median((before * after).sum(axis=1) / np.maximum(norms, 1e-6)) >= MIN_WINDOW_CORRELATION)

    def _agreed(
        self, starts: np.ndarray, ends: np.ndarray, guess: np.ndarray, cells: np.ndarray
    ) -> tuple[PictureMotion, np.ndarray] | None:
        """Return the motion that most cells agree on, fitted to the corners that show it, and their mask (n,)."""
        if len(starts) < MIN_CORNERS:
            return None
        centre = _centre(self.size)
        origin, target = _complex(starts) - centre, _complex(ends) - centre
        weights = 1.0 / np.bincount(cells)[cells]
        step = _complex(ends - guess)
        votes = (np.abs(step[:, None] - step) < AGREEMENT_PX) @ weights
        best = int(np.argmax(votes))
        lasting = np.abs(step) < AGREEMENT_PX
        lasts = weights[lasting].sum() >= LASTING_SHARE * votes[best]
        agree = lasting if lasts else np.abs(step - step[best]) < AGREEMENT_PX
        for _ in range(FIT_ROUNDS):
            if agree.sum() < MIN_CORNERS:
                return None
            scale, shift = _similarity(origin[agree], target[agree])
            errors = np.abs(scale * origin + shift - target)
            now = errors < AGREEMENT_PX
            if (now == agree).all():
                break
            agree = now
        count = int(agree.sum())
        if count < MIN_CORNERS or not self._is_spread(cells[agree], lasts):
            return None
        # of a two-dimensional normal error the median length is 1.1774 sigma
        sigma = float(np.median(errors[agree])) / 1.1774 / np.sqrt(count)
        shrunk = _shrunk(scale - 1, sigma / float(np.sqrt(np.mean(np.abs(origin[agree]) ** 2))))
        return PictureMotion(complex(shift), 1 + shrunk, sigma, count / len(self.corners_px)), agree

    def _is_spread(self, cells: np.ndarray, lasts: bool) -> bool:
        """Whether the cells (n,) of agreeing corners are those of a picture, and not of a part of it."""
        seen = np.unique(cells)
        rows, columns = np.unique(seen // CELLS[0]), np.unique(seen % CELLS[0])
        least = MIN_CELLS if lasts else MIN_AGREEING_CELLS
        return len(seen) >= least and min(len(rows), len(columns)) >= MIN_LINES


def _shrunk(change: complex, sigma: float) -> complex:
    """Return rotation and zoom with the non-negative garrote (Breiman 1995): 0 below `SIGNIFICANCE` sigmas each."""
    parts = [
        part * max(0.0, 1.0 - (SIGNIFICANCE * sigma / part) ** 2) if part else 0.0
        for part in (change.real, change.imag)
    ]
    return complex(*parts)


def _similarity(origin: np.ndarray, target: np.ndarray) -> tuple[complex, complex]:
    """Return the complex scale and shift of least squares that take points to others, both complex (n,)."""
    middle, aim = origin.mean(), target.mean()
    arms = origin - middle
    scale = (np.conj(arms) @ (target - aim)) / max(float(np.vdot(arms, arms).real), 1e-9)
    return complex(scale), complex(aim - scale * middle)


def spread_corners(image: np.ndarray, ignored: np.ndarray | None = None) -> np.ndarray:
    """Return strong corners (n, 2) of a grey image (H, W), spread over its cells, away from the mask `ignored`."""
    dimmed = np.minimum(image, np.uint8(np.quantile(image[::2, ::2], LAMP_QUANTILE)))
    where = (cv2.cornerMinEigenVal(dimmed, 3) > NOISE_ENERGY * _noise_energy(image)).astype(np.uint8)
    if ignored is not None and ignored.any():
        side = 2 * MASK_MARGIN_PX + 1
        where[cv2.dilate(ignored, np.ones((side, side), np.uint8)) > 0] = 0
    spacing = max(6, image.shape[1] // 40)
    found = cv2.goodFeaturesToTrack(dimmed, 4 * MAX_CORNERS, CORNER_QUALITY, spacing, mask=where)
    if found is None:
        return np.zeros((0, 2))
    corners = found[:, 0].astype(float)  # strongest first
    rank = rank_in_cell(cells_of(corners, image.shape))
    order = np.argsort(rank, kind='stable')
    return corners[order[rank[order] < CORNERS_PER_CELL][:MAX_CORNERS]]


def _noise_energy(image: np.ndarray) -> float:
    """Return what cv2.cornerMinEigenVal makes of the noise of a grey image (H, W), with a block of 3 pixels."""
    # nine pixels of a Sobel derivative of variance 12 sigma^2, in the scale of OpenCV: 1 / (4 * 3 * 255)
    return 9.0 * 12.0 * noise_sigma(image) ** 2 / (4.0 * 3.0 * 255.0) ** 2


def noise_sigma(image: np.ndarray) -> float:
    """Return the standard deviation of the noise of a grey image (H, W), grey levels."""
    # whole numbers: to count them is faster than to sort them
    steps = np.bincount(np.abs(cv2.filter2D(image, cv2.CV_16S, NOISE_KERNEL)).ravel())
    middle = np.searchsorted(np.cumsum(steps), [(image.size - 1) // 2, image.size // 2], side='right').mean()
    return float(middle) / (6.0 * 0.6745)


def _windows(image: np.ndarray, points_px: np.ndarray) -> np.ndarray:
    """Return the grey levels (n, `WINDOW_PX`^2) of the windows about the pixels nearest to points (n, 2)."""
    reach = np.arange(WINDOW_PX) - WINDOW_PX // 2
    columns, rows = np.round(points_px).astype(int).T
    columns = np.clip(columns[:, None] + reach, 0, image.shape[1] - 1)
    rows = np.clip(rows[:, None] + reach, 0, image.shape[0] - 1)
    return image[rows[:, :, None], columns[:, None, :]].reshape(len(points_px), WINDOW_PX**2).astype(np.float32)


def cells_of(points_px: np.ndarray, shape: tuple[int, ...], grid: tuple[int, int] = CELLS) -> np.ndarray:
    """Return the cell number (n,) of points (n, 2) in an image of `shape` (height, width), by columns and rows."""
    places = np.floor(points_px / (shape[1], shape[0]) * grid).astype(int)
    return np.clip(places, 0, np.array(grid) - 1) @ [1, grid[0]]


def rank_in_cell(cells: np.ndarray) -> np.ndarray:
    """Return how many points before each one lie in its cell, by the cell numbers (n,), shape (n,)."""
    rank = np.zeros(len(cells), int)
    for cell in np.unique(cells):
        mine = np.flatnonzero(cells == cell)
        rank[mine] = np.arange(len(mine))
    return rank


def _complex(points: np.ndarray) -> np.ndarray:
    return points[:, 0] + 1j * points[:, 1]


def _centre(size: tuple[int, int]) -> complex:
    return complex((size[0] - 1) / 2.0, (size[1] - 1) / 2.0)

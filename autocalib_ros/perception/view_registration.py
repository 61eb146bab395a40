"""Registration of an image to a reference through the lens: how the camera has turned and zoomed since.

Near the last pose, corners of the reference are followed by Lucas-Kanade; anywhere else SIFT keypoints are matched. In
both cases the pose is what most bearing rays agree on. Both images are normalised to local mean and contrast before, so
that neither clouds nor exposure count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from autocalib_ros.geometry.robust_kernels import MAD_TO_SIGMA
from autocalib_ros.lens.camera import Camera
from autocalib_ros.perception.background_motion import cells_of, spread_corners
from autocalib_ros.perception.ratio_test import distinctive_matches
from autocalib_ros.results.camera_move import rotation_from_turn, turn_of_rotation

REGISTERED_WIDTH_PX = 640
"""Image width at which views are registered: 0.3 degrees are 1.5 px there with a lens of 130 degrees."""
CONTRAST_WINDOW_PX = 31
"""Window of local mean and contrast: wider than the windows that are matched, narrower than most shadows."""
CONTRAST_FLOOR = 6.0
"""Grey levels added to the local contrast: three times the noise of a camera by night, which is not to be enhanced."""
NEAR_WINDOW_PX, NEAR_LEVELS = 21, 3
"""Window and pyramid levels of Lucas-Kanade: finds steps up to 60 px or so from the last pose."""
AGREEMENT_RAYS_PX = 1.0
"""Distance within which a matched corner agrees with a pose; blocks of compressed video scatter corners by 0.5 px."""
MATCH_AGREEMENT_PX = 2.0
"""The same for keypoints, which are found again to a pixel or so where light or scale is another."""
MIN_RAYS = 10
"""Least rays that agree: more than twice the four parameters."""
MIN_NEAR_CELLS, MIN_FAR_CELLS = 5, 6
"""Least cells of the picture with rays that agree: near the last pose, and anywhere else. A lorry that drives by shows
in one or two, a jam leaves the borders."""
MIN_PART_CELLS = 4
"""The same in a half of the picture, which has twelve."""
MIN_NEAR_SHARE = 0.5
"""Share of the best agreement that the last pose needs to be kept as the start: traffic that moves together may outvote
the few corners that a jam leaves."""
MIN_MATCH_SHARE = 0.25
"""Least share of the keypoint matches that agree: chance gives two or three."""
MAX_KEYPOINTS = 500
"""Most keypoints of an image in the search for a view."""
KEYPOINT_RATIO = 0.8
"""Largest ratio of the distances to the best and the second-best match, Lowe's: wrong ones are outvoted later."""
HYPOTHESES = 160
"""Pairs of rays that are tried: with a third of right ones, one in 10^8 searches finds none."""
ZOOMS = tuple(1.15**step for step in range(-5, 6))
"""Zoom factors that are tried in the search, 0.5 to 2; between them least squares find the rest."""
REFINEMENTS = 4
"""Fits in turn, each to the rays that agree with the one before."""
DERIVATIVE_STEP_RAD = 1e-4
"""Step of numerical derivatives: a twentieth of a pixel."""
COMMON_ERROR_PX = 0.03
"""What corners err by together, pixels: interpolation and compression shift all of them alike. Judgement."""


@dataclass(frozen=True)
class ViewPose:
    """How a camera has turned and zoomed since a reference image."""

    rotation: np.ndarray
    """now_from_reference of directions in the camera, shape (3, 3)."""
    log_zoom: float
    """Logarithm of the focal length now over that of the reference."""
    covariance: np.ndarray
    """Of pan, tilt, roll in radians and the logarithm of the zoom, shape (4, 4)."""
    share: float = 1.0
    """Fraction of the corners or keypoint matches that agree."""

    @classmethod
    def identity(cls) -> ViewPose:
        """Return the pose of the reference itself."""
        return cls(np.eye(3), 0.0, np.zeros((4, 4)))

    @property
    def turn_rad(self) -> np.ndarray:
        """Pan, tilt and roll, radians (3,)."""
        return turn_of_rotation(self.rotation)

    def without_zoom(self) -> ViewPose:
        """Return the pose if the zoom is known to be that of the reference, by conditioning."""
        gain = self.covariance[:3, 3] / max(float(self.covariance[3, 3]), 1e-18)
        covariance = np.zeros((4, 4))
        covariance[:3, :3] = self.covariance[:3, :3] - np.outer(gain, self.covariance[3, :3])
        turn = self.turn_rad - gain * self.log_zoom
        return ViewPose(rotation_from_turn(turn), 0.0, covariance, self.share)

    def after(self, before: ViewPose) -> ViewPose:
        """Return the pose since an earlier reference, from which `before` leads to the reference of this one."""
        return ViewPose(
            self.rotation @ before.rotation,
            self.log_zoom + before.log_zoom,
            self.covariance + before.covariance,
            self.share,
        )


class ViewReference:
    """A grey image (H, W) of a view, at most `REGISTERED_WIDTH_PX` wide, that others are registered to.

    `camera` is the lens for images of this size, `ignored` a mask (H, W) of pixels that are no picture of the scene,
    `pattern` the normalised image, if it is known.
    """

    def __init__(
        self,
        image: np.ndarray,
        camera: Camera,
        ignored: np.ndarray | None = None,
        pattern: np.ndarray | None = None,
    ) -> None:
        self.image, self.camera, self.ignored = image, camera, ignored
        self.pattern = normalised(image) if pattern is None else pattern
        corners_px = spread_corners(image, ignored)
        bearings, valid = camera.unproject(corners_px)
        self.corners_px, self.bearings = corners_px[valid], bearings[valid]
        self._cells = cells_of(self.corners_px, image.shape)

    @property
    def is_registrable(self) -> bool:
        """Whether the image has enough corners over the picture to be found again."""
        return len(self.corners_px) >= MIN_RAYS and len(np.unique(self._cells)) >= MIN_FAR_CELLS

    @cached_property
    def _keypoints(self) -> tuple[np.ndarray, np.ndarray]:
        return _described_keypoints(self.pattern, self.ignored)

    @cached_property
    def _outlines(self) -> np.ndarray:
        return outlines(self.pattern)

    def near_by_outlines(self, pattern: np.ndarray, last: ViewPose) -> ViewPose | None:
        """Return the same as `near` where bright and dark may have changed places, as by infrared light."""
        return self.near(outlines(pattern), last, self._outlines)

    def near(self, pattern: np.ndarray, last: ViewPose, own: np.ndarray | None = None) -> ViewPose | None:
        """Return the pose of a normalised image (H, W) near a last one; None if too few rays agree.

        `own` replaces the normalised image of the reference.
        """
        found = self._followed(pattern, last, own)
        return None if found is None else self._agreed(*found, last)

    def _followed(
        self, pattern: np.ndarray, last: ViewPose, own: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the corners (n,) that are found in a normalised image near a last pose, and their places (n, 2)."""
        if not self.is_registrable:
            return None
        guess, seen = self._projected(last.rotation, last.log_zoom)
        height, width = pattern.shape
        inside = seen & (guess > 2).all(axis=1) & (guess < [width - 3, height - 3]).all(axis=1)
        if inside.sum() < MIN_RAYS:
            return None
        starts = np.ascontiguousarray(self.corners_px[inside], np.float32).reshape(-1, 1, 2)
        ends, status, _ = cv2.calcOpticalFlowPyrLK(
            self.pattern if own is None else own,
            pattern,
            starts,
            np.ascontiguousarray(guess[inside], np.float32).reshape(-1, 1, 2),
            winSize=(NEAR_WINDOW_PX, NEAR_WINDOW_PX),
            maxLevel=NEAR_LEVELS,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        found = status.ravel() == 1
        rows = np.flatnonzero(inside)[found]
        return rows, ends[found, 0].astype(float)

    def parallax(self, pattern: np.ndarray, pose: ViewPose) -> tuple[float, float] | None:
        """Return the angle between the turns that the lower and the upper half of the picture show, and its sigma.

        Radians; None if one of them shows too little. A camera that turned about its centre gives 0: what is below, and
        near, turns as what is far does. One that was shifted sees it turn by the shift over the distance besides.
        `pattern` is a normalised image (H, W) near `pose`.
        """
        found = self._followed(pattern, pose)
        if found is None:
            return None
        rows, ends = found
        lower = self.corners_px[rows, 1] > 0.5 * pattern.shape[0]
        poses = [self._turn_of_part(rows[part], ends[part], pose) for part in (lower, ~lower)]
        if poses[0] is None or poses[1] is None:
            return None
        below, above = (each.without_zoom() for each in poses if each is not None)
        difference = turn_of_rotation(below.rotation @ above.rotation.T)
        covariance = below.covariance[:3, :3] + above.covariance[:3, :3]
        angle = float(np.linalg.norm(difference))
        along = difference / max(angle, 1e-12)
        return angle, float(np.sqrt(along @ covariance @ along))

    def _turn_of_part(self, rows: np.ndarray, ends: np.ndarray, pose: ViewPose) -> ViewPose | None:
        """Return the pose that most corners of a part of the picture agree on; None if they are too few."""
        if len(rows) < MIN_RAYS:
            return None
        bearings, cells = self.bearings[rows], self._cells[rows]
        start = _best_hypothesis(self.camera, bearings, ends, (float(np.exp(pose.log_zoom)),), cells)
        fitted = self._refined(bearings, ends, start, AGREEMENT_RAYS_PX)
        if fitted is None or len(np.unique(cells[fitted[1]])) < MIN_PART_CELLS:
            return None
        return fitted[0]

    def anywhere(self, pattern: np.ndarray) -> ViewPose | None:
        """Return the pose of a normalised image (H, W), wherever the camera points; None if it shows another view."""
        (points, words), (others, other_words) = self._keypoints, _described_keypoints(pattern, self.ignored)
        if min(len(points), len(others)) < MIN_RAYS:
            return None
        good = distinctive_matches(words, other_words, KEYPOINT_RATIO)
        if len(good) < MIN_RAYS:
            return None
        bearings, valid = self.camera.unproject(points[good[:, 0]])
        ends = others[good[:, 1]][valid]
        bearings = bearings[valid]
        if len(bearings) < MIN_RAYS:
            return None
        start = _best_hypothesis(self.camera, bearings, ends, ZOOMS)
        fitted = self._refined(bearings, ends, start, MATCH_AGREEMENT_PX)
        if fitted is None:
            return None
        pose, agree = fitted
        cells = len(np.unique(cells_of(ends[agree], pattern.shape)))
        is_enough = agree.mean() >= MIN_MATCH_SHARE and cells >= MIN_FAR_CELLS // 2
        return pose if is_enough and abs(pose.log_zoom) < np.log(ZOOMS[-1] * 1.1) else None

    def aligned(self, image: np.ndarray, pose: ViewPose) -> np.ndarray:
        """Return an image (H, W) of a known pose moved onto the reference, for small turns."""
        pixels, seen = self._projected(pose.rotation, pose.log_zoom)
        matrix, _ = cv2.estimateAffine2D(self.corners_px[seen], pixels[seen])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return image if matrix is None else cv2.warpAffine(image, matrix, image.shape[::-1], flags=flags)

    def _projected(self, rotation: np.ndarray, log_zoom: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (n, 2) of the corners after a turn and zoom, and which are valid (n,)."""
        return zoomed(self.camera, log_zoom).project(self.bearings @ rotation.T)

    def _agreed(self, rows: np.ndarray, ends: np.ndarray, last: ViewPose) -> ViewPose | None:
        """Return the pose that most corners `rows` (n,) with their `ends` (n, 2) agree on; None if they are too few."""
        if len(rows) < MIN_RAYS:
            return None
        bearings, cells = self.bearings[rows], self._cells[rows]
        weights = 1.0 / np.bincount(cells)[cells]

        def votes(pose: ViewPose) -> float:
            return float((_errors_px(self.camera, bearings, ends, pose) < AGREEMENT_RAYS_PX) @ weights)

        start, stays = last, True
        if votes(last) < MIN_NEAR_SHARE * weights.sum():
            best = _best_hypothesis(self.camera, bearings, ends, (float(np.exp(last.log_zoom)),), cells)
            stays = votes(last) >= MIN_NEAR_SHARE * votes(best)
            start = last if stays else best
        fitted = self._refined(bearings, ends, start, AGREEMENT_RAYS_PX)
        if fitted is None:
            return None
        pose, agree = fitted
        if len(np.unique(cells[agree])) < (MIN_NEAR_CELLS if stays else MIN_FAR_CELLS):
            return None
        return replace(pose, share=float(agree.sum() / len(self.corners_px)))

    def _refined(
        self, bearings: np.ndarray, ends: np.ndarray, start: ViewPose, agreement_px: float
    ) -> tuple[ViewPose, np.ndarray] | None:
        """Return the pose of least squares of the rays that agree with it, and their mask (n,)."""
        pose, agree = start, _errors_px(self.camera, bearings, ends, start) < 2 * agreement_px
        for _ in range(REFINEMENTS):
            if agree.sum() < MIN_RAYS:
                return None
            pose = _least_squares(self.camera, bearings[agree], ends[agree], pose)
            now = _errors_px(self.camera, bearings, ends, pose) < agreement_px
            if (now == agree).all():
                break
            agree = now
        if agree.sum() < MIN_RAYS:
            return None
        return replace(pose, share=float(agree.mean())), agree


def _best_hypothesis(
    camera: Camera, bearings: np.ndarray, ends: np.ndarray, zooms: tuple[float, ...], cells: np.ndarray | None = None
) -> ViewPose:
    """Return the turn by two rays, and the zoom of `zooms`, that most rays agree with (RANSAC with a fixed seed)."""
    pairs = np.random.default_rng(0).integers(len(bearings), size=(HYPOTHESES, 2))
    weights = np.ones(len(bearings)) if cells is None else 1.0 / np.bincount(cells)[cells]
    best, best_votes = ViewPose.identity(), -1.0
    for zoom in zooms:
        lens = zoomed(camera, float(np.log(zoom)))
        seen, valid = lens.unproject(ends)
        rotations = _frames(seen[pairs]) @ _frames(bearings[pairs]).transpose(0, 2, 1)
        chords = np.linalg.norm(bearings @ rotations.transpose(0, 2, 1) - seen, axis=2)
        limit = 2.0 * AGREEMENT_RAYS_PX * (1.0 if len(zooms) == 1 else 4.0) / lens.focal_px
        votes = ((chords < limit) & valid) @ weights
        first = int(np.argmax(votes))
        if votes[first] > best_votes:
            best, best_votes = ViewPose(rotations[first], float(np.log(zoom)), np.zeros((4, 4))), float(votes[first])
    return best


def _frames(pairs: np.ndarray) -> np.ndarray:
    """Return the right-handed frames (n, 3, 3), as columns, of pairs of unit vectors (n, 2, 3)."""
    middle = pairs[:, 0] + pairs[:, 1]
    across = np.cross(pairs[:, 0], pairs[:, 1])
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-9)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    return np.stack([middle, across, np.cross(middle, across)], axis=2)


def _errors_px(camera: Camera, bearings: np.ndarray, ends: np.ndarray, pose: ViewPose) -> np.ndarray:
    """Return the distances (n,) in pixels of rays (n, 3) after a pose from where they were found (n, 2)."""
    pixels, valid = zoomed(camera, pose.log_zoom).project(bearings @ pose.rotation.T)
    return np.where(valid, np.linalg.norm(pixels - ends, axis=1), np.inf)


def _least_squares(camera: Camera, bearings: np.ndarray, ends: np.ndarray, pose: ViewPose) -> ViewPose:
    """Return the pose after one step of Gauss and Newton, with the covariance of what the rays scatter by."""

    def pixels(step: np.ndarray) -> np.ndarray:
        turned = rotation_from_turn(step[:3]) @ pose.rotation
        return zoomed(camera, pose.log_zoom + step[3]).project(bearings @ turned.T)[0].ravel()

    now = pixels(np.zeros(4))
    slopes = np.stack([(pixels(step) - now) / DERIVATIVE_STEP_RAD for step in DERIVATIVE_STEP_RAD * np.eye(4)], axis=1)
    information = slopes.T @ slopes
    inverse = np.linalg.pinv(information, hermitian=True)
    step = inverse @ slopes.T @ (ends.ravel() - now)
    errors = ends.ravel() - now - slopes @ step
    # the corners share some of their error, which their number does not average out
    variance = (MAD_TO_SIGMA * float(np.median(np.abs(errors)))) ** 2 + len(bearings) * COMMON_ERROR_PX**2
    turned = rotation_from_turn(step[:3]) @ pose.rotation
    return ViewPose(turned, pose.log_zoom + float(step[3]), variance * inverse, pose.share)


def zoomed(camera: Camera, log_zoom: float) -> Camera:
    """Return a lens at another magnification."""
    return camera if log_zoom == 0 else replace(camera, focal_px=camera.focal_px * float(np.exp(log_zoom)))


def registered_image(image: np.ndarray, size: tuple[int, int] | None = None) -> np.ndarray:
    """Return a grey or BGR image (H, W) or (H, W, 3) in grey, of `size` or at most `REGISTERED_WIDTH_PX` wide."""
    height, width = image.shape[:2]
    if size is None:
        scale = min(1.0, REGISTERED_WIDTH_PX / width)
        size = (round(width * scale), max(1, round(height * scale)))
    if size != (width, height):
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image


def normalised(image: np.ndarray) -> np.ndarray:
    """Return a grey image (H, W) with one local mean and contrast, uint8."""
    levels = cv2.GaussianBlur(image, (3, 3), 0).astype(np.float32)
    levels -= _locally_averaged(levels)
    levels /= cv2.sqrt(_locally_averaged(levels * levels)) + CONTRAST_FLOOR
    return cv2.convertScaleAbs(levels, alpha=45.0, beta=128.0)


def _locally_averaged(levels: np.ndarray) -> np.ndarray:
    """Return the mean of a float image (H, W) over `CONTRAST_WINDOW_PX`, computed in a quarter of its size."""
    size = (max(1, levels.shape[1] // 4), max(1, levels.shape[0] // 4))
    side = max(1, CONTRAST_WINDOW_PX // 4)
    small = cv2.blur(cv2.resize(levels, size, interpolation=cv2.INTER_AREA), (side, side))
    return cv2.resize(small, (levels.shape[1], levels.shape[0]), interpolation=cv2.INTER_LINEAR)


def outlines(pattern: np.ndarray) -> np.ndarray:
    """Return the strength of the edges of a normalised image (H, W), itself normalised."""
    across, down = cv2.Sobel(pattern, cv2.CV_32F, 1, 0), cv2.Sobel(pattern, cv2.CV_32F, 0, 1)
    return normalised(cv2.convertScaleAbs(cv2.magnitude(across, down), alpha=0.25))


def _described_keypoints(pattern: np.ndarray, ignored: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return keypoints (n, 2) of a normalised image (H, W) with their descriptors (n, 128)."""
    mask = None if ignored is None else (ignored == 0).astype(np.uint8)
    sift = cv2.SIFT_create(MAX_KEYPOINTS)  # type: ignore[attr-defined]  # for OpenCV 4.5
    points, words = sift.detectAndCompute(pattern, mask)
    if words is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    return np.array([point.pt for point in points]), words

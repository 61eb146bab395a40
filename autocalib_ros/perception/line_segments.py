"""Line segments of the static scene: lane markings, kerbs, joints of slabs.

LSD finds them on the background image, and a fit to their edges gives their direction.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from autocalib_ros.perception.edge_fit import fit_edges

MIN_LINE_LENGTH = 0.02
"""Shortest segment, fraction of the image width: dashes and crosswalk stripes are longer. Judgement."""
MIN_LINE_LENGTH_PX = 10.0
"""Shortest segment, pixels of the tracked image."""
MAX_LINES = 800
"""Most segments, the longest first: 26 kB."""
SAMPLES_PER_LINE = 7
"""Points along a segment at which masks are sampled."""
BORDER_PX = 3
"""Distance from the border of the picture, of the image and of text, pixels of the tracked image, of lines that run
along it and belong to it: resized images have a border of one or two dim pixels, and LSD places an edge to one."""
MAX_ALONG_BORDER = 0.5
"""Largest share of a segment that may lie there: a road line that ends at the border has a small part of itself there.
"""

MIN_SHARE_OF_SAMPLES = 0.5
"""Least share of the samples that show a segment: a median shows what stands still in more than half of them, and where
vehicles pass all the time edges between parts of them that no image has."""
PROBE_PX = 1.5
"""Distance of the probes on either side of a segment, pixels: beyond an edge that is soft over two pixels."""
MIN_PROBE_CONTRAST = 0.5
"""Least contrast across a segment in a sample that shows it, relative to that in the background."""


class LineSegmentDetector:
    """Detects line segments in the background; the result is cached until the background changes."""

    def __init__(self, ignored: np.ndarray | None) -> None:
        """Segments are kept where the mask `ignored` (H, W) is 0."""
        self._detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_ADV)
        self._ignored = ignored
        self._source_times_s: tuple[float, ...] | None = None
        self._lines = np.zeros((0, 4))

    def is_current(self, times_s: tuple[float, ...]) -> bool:
        """Whether the cached segments belong to the background computed from images of these times."""
        return times_s == self._source_times_s

    def find(
        self,
        grey: np.ndarray | None,
        times_s: tuple[float, ...],
        no_picture: np.ndarray | None = None,
        samples: Sequence[np.ndarray] = (),
    ) -> None:
        """Detect segments in a background (H, W) computed from images of these times; None if there is none yet.

        Segments along the border of the image and of the mask `no_picture` (H, W) are dropped, and those that half of
        the `samples` (H, W), of which the background is the median, do not show.
        """
        self._source_times_s, self._lines = times_s, np.zeros((0, 4))
        found = None if grey is None else self._detector.detect(grey)[0]
        if grey is None or found is None:
            return
        lines = found.reshape(-1, 4).astype(float)
        least = max(MIN_LINE_LENGTH_PX, MIN_LINE_LENGTH * grey.shape[1])
        lines = fit_edges(lines[_lengths(lines) >= least], grey)
        lines = lines[np.argsort(-_lengths(lines), kind='stable')]
        lines = lines[_shares_inside(lines, _border_zone(grey.shape, no_picture)) <= MAX_ALONG_BORDER]
        lines = lines[~self._touches_ignored(lines)]
        self._lines = lines[_shares_of_samples(lines, grey, samples) > MIN_SHARE_OF_SAMPLES][:MAX_LINES]

    def _touches_ignored(self, lines: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of segments (n, 4) that touch the ignored regions."""
        if self._ignored is None:
            return np.zeros(len(lines), bool)
        return _shares_inside(lines, self._ignored) > 0

    def fresh(self) -> LineSegmentDetector:
        """Return a detector with the same ignored regions that has not found anything."""
        return LineSegmentDetector(self._ignored)

    @property
    def lines_px(self) -> np.ndarray:
        """Segments x0, y0, x1, y1 in pixels of the background passed to `find`, longest first, shape (n, 4)."""
        return self._lines


def _lengths(lines: np.ndarray) -> np.ndarray:
    """Return the lengths (n,) of segments (n, 4)."""
    return np.asarray(np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1]))


def _shares_inside(lines: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the shares (n,) of segments (n, 4) that lie where the mask (H, W) is not 0."""
    share = np.linspace(0.0, 1.0, SAMPLES_PER_LINE)[:, None]
    points = lines[:, None, :2] + share * (lines[:, 2:] - lines[:, :2])[:, None]
    height, width = mask.shape
    columns, rows = np.round(points).astype(int).T
    inside = mask[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)] > 0
    return np.asarray(inside.mean(axis=0))


def _shares_of_samples(lines: np.ndarray, background: np.ndarray, samples: Sequence[np.ndarray]) -> np.ndarray:
    """Return the shares (n,) of the samples that show the segments (n, 4) as the background does; 1 without samples."""
    if not len(lines) or not samples:
        return np.ones(len(lines))
    reference = _contrasts(lines, background)
    shown = [_contrasts(lines, sample) * np.sign(reference) for sample in samples]
    return np.mean(np.array(shown) >= MIN_PROBE_CONTRAST * np.abs(reference), axis=0)


def _contrasts(lines: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """Return the mean grey level on the right of segments (n, 4) less that on the left, shape (n,)."""
    along = lines[:, 2:] - lines[:, :2]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(along[:, 0], along[:, 1])[:, None]
    share = np.linspace(0.1, 0.9, SAMPLES_PER_LINE)[:, None]
    points = lines[:, None, :2] + share * along[:, None]
    right, left = (_levels(grey, points + side * PROBE_PX * normal[:, None]).mean(axis=1) for side in (1, -1))
    return np.asarray(right - left)


def _levels(grey: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the grey levels of an image (H, W) at points (n, m, 2), shape (n, m)."""
    x, y = np.moveaxis(points.astype(np.float32), -1, 0)
    return cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)


def _border_zone(shape: tuple[int, ...], no_picture: np.ndarray | None) -> np.ndarray:
    """Return the mask uint8 (H, W) of what is no picture and of `BORDER_PX` about it."""
    zone = np.zeros(shape, np.uint8) if no_picture is None else no_picture
    zone = cv2.copyMakeBorder(zone, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    size = 2 * BORDER_PX + 1
    return np.asarray(cv2.dilate(zone, np.ones((size, size), np.uint8))[1:-1, 1:-1])

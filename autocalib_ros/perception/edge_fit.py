"""Straight lines through edges of an image, to hundredths of a pixel: where the grey level changes across a segment.

LSD gives the axis of a region of pixels, whose outline changes with the least noise. The centre of the change of grey
level, found at many points along the segment, averages noise instead.
"""

from __future__ import annotations

import cv2
import numpy as np

from autocalib_ros.geometry.robust_kernels import MAD_TO_SIGMA

EDGE_REACH_PX = 2.5
"""Distance on either side of a segment in which its edge is looked for, pixels: beyond the soft edge, from which LSD is
off by less than half a pixel in 19 of 20 segments of rendered scenes."""
PROFILE_STEP_PX = 0.5
"""Distance between the grey levels of a profile, pixels: edges are soft over two."""
PROFILES = 25
"""Profiles across a segment: one a pixel in the shortest segments of images that are 1280 pixels wide."""
PROFILE_SPAN = 0.96
"""Share of a segment, about its middle, from which the profiles come: at its ends other edges begin."""
EDGE_FIT_ROUNDS = 3
"""Fits, each about the line of the one before, which leaves a third of its distance from the edge."""
EDGE_FIT_REWEIGHTINGS = 6
"""Iterations of the robust fit."""
EDGE_REJECTION_SIGMAS = 4.0
"""Standard deviations at which Tukey's biweight ends: profiles across something that hides the edge."""
MIN_EDGE_SIGMA_PX = 0.03
"""Least standard deviation of the edge in one profile, pixels: that of clean drawings."""
MIN_EDGE_PROFILES = 0.5
"""Least share of the profiles on the line of an edge; with fewer it stays where it was."""


def fit_edges(lines: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """Move segments x0, y0, x1, y1 (n, 4) across themselves on to the edges of a grey image (H, W); they keep ends.

    Segments without one straight edge along half of them stay where they are. Centre of the change of grey level in
    profiles across a segment, weighted by the change, and a line through the centres by iteratively reweighted least
    squares with Tukey's biweight (Beaton & Tukey 1974).
    """
    fitted, levels = lines, grey.astype(np.float32)
    for _ in range(EDGE_FIT_ROUNDS if len(lines) else 0):
        fitted = _fit_once(fitted, levels)
    return fitted


def _fit_once(lines: np.ndarray, grey: np.ndarray) -> np.ndarray:
    along = lines[:, 2:] - lines[:, :2]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(along[:, 0], along[:, 1])[:, None]
    shares = PROFILE_SPAN * (np.linspace(0.0, 1.0, PROFILES) - 0.5)
    centres, weights = _edge_centres(_profiles(lines, normal, shares, grey))
    middle, slope, support = _robust_lines(shares, centres, weights)
    across = np.stack([middle - 0.5 * slope, middle + 0.5 * slope], axis=1)
    across[support < MIN_EDGE_PROFILES] = 0.0
    return lines + (across[:, :, None] * normal[:, None]).reshape(-1, 4)


def _profiles(lines: np.ndarray, normal: np.ndarray, shares: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """Return the grey levels across segments (n, 4) at `shares` (m,) of them about their middles, shape (n, m, k)."""
    middle, along = (lines[:, :2] + lines[:, 2:]) / 2, lines[:, 2:] - lines[:, :2]
    on_line = middle[:, None] + shares[:, None] * along[:, None]
    points = on_line[:, :, None] + _profile_offsets()[:, None] * normal[:, None, None]
    x, y = np.moveaxis(points.reshape(len(lines), -1, 2).astype(np.float32), -1, 0)
    levels = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(levels.reshape(points.shape[:3]))


def _profile_offsets() -> np.ndarray:
    """Return the distances from a segment of the grey levels of a profile, pixels, shape (k,)."""
    steps = round(EDGE_REACH_PX / PROFILE_STEP_PX)
    return PROFILE_STEP_PX * np.arange(-steps, steps + 1)


def _edge_centres(profiles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the grey levels of profiles (n, m, k) change, pixels, and the weight of each, both (n, m).

    Changes against the direction of most of them, of the other edge of a painted line, do not count.
    """
    changes = np.diff(profiles, axis=2)
    offsets = _profile_offsets()
    at = 0.5 * (offsets[1:] + offsets[:-1])
    changes = np.maximum(changes * np.sign(changes.sum(axis=(1, 2)))[:, None, None], 0.0)
    changes = changes * (1.0 - (at / EDGE_REACH_PX) ** 2)
    weights = changes.sum(axis=2)
    centres = changes @ at / np.maximum(weights, 1e-6)
    return centres, np.minimum(weights, np.median(weights, axis=1, keepdims=True))


def _robust_lines(
    shares: np.ndarray, centres: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit lines to centres (n, m) at `shares` (m,) with weights (n, m).

    Returns offset in the middle, slope, and the share of the profiles that the fit uses, each (n,).
    """
    robust = weights
    for _ in range(EDGE_FIT_REWEIGHTINGS):
        total = np.maximum(robust.sum(axis=1), 1e-9)
        share, centre = (robust @ shares) / total, (robust * centres).sum(axis=1) / total
        from_mean = shares - share[:, None]
        spread = np.maximum((robust * from_mean**2).sum(axis=1), 1e-9)
        slope = (robust * from_mean * (centres - centre[:, None])).sum(axis=1) / spread
        residuals = centres - centre[:, None] - slope[:, None] * from_mean
        sigma = np.maximum(MAD_TO_SIGMA * np.median(np.abs(residuals), axis=1), MIN_EDGE_SIGMA_PX)
        scaled = residuals / (EDGE_REJECTION_SIGMAS * sigma[:, None])
        robust = weights * np.maximum(1.0 - scaled**2, 0.0) ** 2
    return centre - slope * share, slope, np.asarray((robust > 0.25 * np.maximum(weights, 1e-9)).mean(axis=1))

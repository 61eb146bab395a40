"""Matches of SIFT descriptors that are clearly more similar than the second best (Lowe 2004, section 7.1)."""

from __future__ import annotations

import cv2
import numpy as np

LOWE_RATIO = 0.75
"""Largest ratio of the distances of the best and the second-best match. Lowe takes 0.8: fewer wrong ones here."""


def distinctive_matches(descriptors: np.ndarray, others: np.ndarray, ratio: float = LOWE_RATIO) -> np.ndarray:
    """Return indices (n, 2) into float32 descriptors (a, d) and others (b, d), at most one match for each of the first.

    None with fewer than two others: a best match needs a second best.
    """
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors, others, k=2) if len(others) > 1 else []
    good = [(best.queryIdx, best.trainIdx) for best, second in pairs if best.distance < ratio * second.distance]
    return np.array(good, int).reshape(-1, 2)

"""Find landmarks in a background, and register the landmarks of one recording to those of another."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from autocalib_ros.evidence.landmarks import DESCRIPTOR_BYTES, Landmarks
from autocalib_ros.perception.background_motion import AGREEMENT_PX, MIN_CORNERS, cells_of, rank_in_cell
from autocalib_ros.perception.ratio_test import distinctive_matches

LANDMARK_CELLS = (8, 6)
"""Columns and rows of the grid over which landmarks are spread."""
LANDMARKS_PER_CELL = 8
"""Most landmarks of a cell: 384 in all, 50 kB."""
MIN_LANDMARK_CELLS = 6
"""Least cells with matches that agree, an eighth of all: shadow and changed light leave more, a parked lorry or a
burnt-in line of text covers fewer. Judgement."""


@dataclass(frozen=True)
class Registration:
    """Where the picture of one recording lies in that of another."""

    matrix: np.ndarray
    """Similarity (2, 3) that takes pixels of the one to pixels of the other."""
    displacement_px: float
    """Root mean square displacement over the picture."""
    matches: int
    """Landmarks that agree."""


def find_landmarks(grey: np.ndarray, excluded: np.ndarray | None) -> Landmarks:
    """Find SIFT keypoints in a background, uint8 (H, W), spread over it, where the mask `excluded` (H, W) is 0."""
    mask = None if excluded is None else np.where(excluded > 0, 0, 255).astype(np.uint8)
    found, descriptors = cv2.SIFT_create().detectAndCompute(grey, mask)  # type: ignore[attr-defined]  # OpenCV 4.5
    if descriptors is None:
        return Landmarks()
    order = np.argsort([-keypoint.response for keypoint in found], kind='stable')
    points = np.array([found[index].pt for index in order], float)
    keep = rank_in_cell(cells_of(points, grey.shape, LANDMARK_CELLS)) < LANDMARKS_PER_CELL
    return Landmarks(points[keep], np.clip(np.rint(descriptors[order[keep]]), 0, 255).astype(np.uint8))


def register(landmarks: Landmarks, reference: Landmarks, size: tuple[int, int]) -> Registration | None:
    """Return where the picture of landmarks lies in that of a reference, images of `size`; None for another view.

    Two matches fix a similarity, and a further one of unrelated views agrees with it by chance once in 100,000: those
    of one view are many and lie all over it.
    """
    starts, ends = _mutual_matches(landmarks, reference)
    if len(starts) < MIN_CORNERS:
        return None
    matrix, agreed = cv2.estimateAffinePartial2D(
        starts, ends, method=cv2.RANSAC, ransacReprojThreshold=_agreement_px(size), maxIters=5000, confidence=0.999
    )
    if matrix is None:
        return None
    inside = agreed.ravel() > 0
    spread = len(np.unique(cells_of(ends[inside], size[::-1], LANDMARK_CELLS)))
    if inside.sum() < MIN_CORNERS or spread < MIN_LANDMARK_CELLS:
        return None
    return Registration(matrix, _displacement_px(matrix, size), int(inside.sum()))


def _agreement_px(size: tuple[int, int]) -> float:
    """Return the distance within which landmarks agree: keypoints of large images are as sharp relative to them."""
    return max(AGREEMENT_PX, AGREEMENT_PX * size[0] / 640)


def _mutual_matches(landmarks: Landmarks, reference: Landmarks) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 2) of both that are each other's most similar ones, clearly so."""
    if min(len(landmarks), len(reference)) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    one, other = (
        found.descriptors.astype(np.float32).reshape(-1, DESCRIPTOR_BYTES) for found in (landmarks, reference)
    )
    pairs = distinctive_matches(one, other)
    back = np.array([match.trainIdx for (match,) in cv2.BFMatcher(cv2.NORM_L2).knnMatch(other, one, k=1)])
    pairs = pairs[back[pairs[:, 1]] == pairs[:, 0]]
    return landmarks.points_px[pairs[:, 0]], reference.points_px[pairs[:, 1]]


def _displacement_px(matrix: np.ndarray, size: tuple[int, int]) -> float:
    """Return the root mean square displacement by a similarity over an image of `size`."""
    grid = np.stack(np.meshgrid(np.linspace(0, size[0] - 1, 9), np.linspace(0, size[1] - 1, 9)), axis=-1).reshape(-1, 2)
    moved = grid @ matrix[:, :2].T + matrix[:, 2]
    return float(np.sqrt(((moved - grid) ** 2).sum(axis=1).mean()))

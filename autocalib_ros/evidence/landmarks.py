"""Landmarks of the still scene: by them two recordings of one camera recognise each other, without images."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

DESCRIPTOR_BYTES = 128
"""Numbers of a SIFT descriptor (Lowe 2004), each in one byte."""


@dataclass(frozen=True)
class Landmarks:
    """Keypoints of the background."""

    points_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """Pixels of the full image, shape (n, 2)."""
    descriptors: np.ndarray = field(default_factory=lambda: np.zeros((0, DESCRIPTOR_BYTES), np.uint8))
    """SIFT descriptors, uint8, shape (n, DESCRIPTOR_BYTES)."""

    def __len__(self) -> int:
        return len(self.points_px)

    def require_consistent(self) -> None:
        """Raise ValueError unless shapes and types are those of landmarks."""
        rows = len(self.points_px)
        if self.points_px.shape != (rows, 2) or not np.isfinite(self.points_px).all():
            raise ValueError('landmarks_px is not an array of n finite points')
        if self.descriptors.shape != (rows, DESCRIPTOR_BYTES) or self.descriptors.dtype != np.uint8:
            raise ValueError(f'landmark_descriptors is not uint8 of {rows} x {DESCRIPTOR_BYTES}')

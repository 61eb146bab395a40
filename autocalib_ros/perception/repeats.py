"""Repeated images, exact or through a codec, recognised by what new images of the stream change.

Two things that a new image shows and a repeat lacks:

- Motion. Traffic that moved from image to image until now cannot stop all at once, so the cells of the image that kept
  changing change again. Which cells, and how much, is known from the images before. Traffic at the border can leave
  the picture from one image to the next and is no evidence.
- Noise. Where most of the picture has sensor noise in each image, an image without any is a repeat.

Without either, as on an empty road behind a codec that leaves out what does not change, images are new.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

CELL_PX = 8
"""Side of a cell, pixels of the reduced image: at half size a macroblock, the unit in which codecs skip."""
MIN_CELL_CHANGE = 1.0
"""Least mean change, grey levels, of a cell with motion: the quantum of the images."""
MOTION_TO_NOISE = 5.0
"""Ratio of the change of a cell with motion to the median over the cells, which is noise."""
KEYFRAME_TO_NOISE = 2.0
"""Change, in medians over the cells, that counts for no motion: cells change by up to twice the median when a codec
encodes the whole picture anew.
"""
MOTION_MEMORY = 4
"""New images over which motion must persist in a cell or beside it. Longer than a flash, shorter than a codec's
interval between whole pictures.
"""
REPEATED_MOTION = 1 / 3
"""Largest change of a repeat, fraction of the last change by motion. Codecs refine a repeated image by a few percent,
by a third where they save most; a new image changes less only if it was taken within a third of the usual interval.
"""
BORDER = 0.1
"""Width of the border, fraction of the image width, in which traffic can leave the picture from one image to the next:
two steps of 5 % of the width, an overtaking car next to the camera.
"""
NOISE_MEMORY, MIN_NOISE_MEMORY = 64, 16
"""Most and least number of new images from which the noise is known."""
LOW_QUANTILE = 0.1
"""Quantile of the noise of new images with which a repeat is compared: they have less noise in the dark or after a
keyframe.
"""
REPEATED_NOISE = 0.25
"""Largest median change of a repeat, fraction of the noise. Noise of new images varies by less than half of it."""
MIN_NOISE_LEVELS = 0.25
"""Least noise, median change in grey levels, that can be told from none: one in four pixels changes by one level."""
MAX_REPEAT_S = 2.0
"""Longest run of repeats, seconds. Then the stream has changed, whatever it was before, and is learned anew: no
camera in operation freezes for longer, and points are no longer followed.
"""


@dataclass(frozen=True)
class _Change:
    """Change from one image to a later one, by cells (h, w)."""

    levels: np.ndarray
    """Mean absolute change, grey levels."""
    noise: float
    """Median over the cells."""
    moving: np.ndarray
    """Whether the change is more than noise, bool."""

    def motion(self, cells: np.ndarray) -> float:
        """Return the sum of the change beyond noise over a mask of cells."""
        return float(np.maximum(self.levels - KEYFRAME_TO_NOISE * self.noise, 0.0)[cells].sum())


@dataclass(frozen=True)
class _Learned:
    """What new images changed of late."""

    evidence: np.ndarray | None = None
    """Mask of the cells where motion persisted and has to go on."""
    evidence_motion: float = 0.0
    """Change by motion in them from the last image but one to the last."""
    moving: tuple[np.ndarray, ...] = ()
    motions: tuple[float, ...] = ()
    noises: tuple[float, ...] = ()

    def after(self, change: _Change) -> _Learned:
        """Return what is known after one more new image."""
        evidence = np.zeros_like(change.moving)
        if self.moving:
            evidence = change.moving & _dilated(np.logical_or.reduce(self.moving)) & ~_may_leave(change.moving)
        return _Learned(
            evidence=evidence,
            evidence_motion=change.motion(evidence),
            moving=(*self.moving, change.moving)[-MOTION_MEMORY:],
            motions=(*self.motions, change.motion(change.moving))[-MOTION_MEMORY:],
            noises=(*self.noises, change.noise)[-NOISE_MEMORY:],
        )

    def lacks_motion(self, change: _Change) -> bool | None:
        """Return whether motion stopped all at once; None if none had to go on."""
        if self.evidence is None or self.evidence_motion <= 0:
            return None
        # after lost images the last change is larger than usual
        usual = min(self.evidence_motion, float(np.median(self.motions)))
        return change.motion(change.moving | _dilated(self.evidence)) < REPEATED_MOTION * usual

    @property
    def identity_tells(self) -> bool:
        """Whether an identical image is a repeat: every new image changed most of the picture, or none is known.

        Behind a codec that leaves out what does not change, new images of an empty road are identical.
        """
        return not self.noises or min(self.noises) > 0

    def lacks_noise(self, change: _Change) -> bool:
        """Return whether the image lacks the noise that new images have."""
        if len(self.noises) < MIN_NOISE_MEMORY:
            return False
        noise = float(np.quantile(self.noises, LOW_QUANTILE))
        return noise >= MIN_NOISE_LEVELS and change.noise < REPEATED_NOISE * noise and not change.moving.any()


@dataclass
class RepeatDetector:
    """Tells the repeats among the images of one stream; bounded in memory, and deterministic."""

    _learned: _Learned = field(default_factory=_Learned)
    _before: _Learned = field(default_factory=_Learned)
    _change: _Change | None = None
    _new_s: float = -np.inf
    _still_from_the_start: bool = False

    def is_repeat(self, last: np.ndarray, image: np.ndarray, time_s: float) -> bool:
        """Return whether a reduced grey image (h, w) uint8 repeats the last new one."""
        self._change = change = _change(last, image)
        lacks_motion, identical = self._learned.lacks_motion(change), not change.levels.any()
        if lacks_motion is None:
            by_identity = identical and self._learned.identity_tells and not self._still_from_the_start
            repeated = by_identity or self._learned.lacks_noise(change)
        else:
            repeated = lacks_motion
        if not repeated or time_s - self._new_s <= MAX_REPEAT_S:
            return repeated
        self._still_from_the_start = not self._learned.noises
        self._learned, self._change = _Learned(), None
        return False

    def accept(self, time_s: float) -> None:
        """Learn from the image that was compared last, or from the first image: it is new."""
        self._before, self._new_s = self._learned, time_s
        if self._change is not None:
            self._learned = self._learned.after(self._change)
            self._change = None

    def revoke(self) -> None:
        """Forget what was learned from the image accepted last: it is a repeat after all."""
        self._learned = self._before

    def restart(self) -> None:
        """Forget all: the grey levels are unrelated to those of earlier images."""
        self._learned, self._change = _Learned(), None


def _change(last: np.ndarray, image: np.ndarray) -> _Change:
    height, width = image.shape
    size = (max(1, width // CELL_PX), max(1, height // CELL_PX))
    levels = cv2.resize(cv2.absdiff(last, image).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    levels = levels.reshape(size[::-1])
    noise = float(np.median(levels))
    return _Change(levels, noise, levels > max(MIN_CELL_CHANGE, MOTION_TO_NOISE * noise))


def _may_leave(moving: np.ndarray) -> np.ndarray:
    """Return the mask of the moving cells (h, w) in the border whose region touches the edge of the picture."""
    _, regions = cv2.connectedComponents(moving.astype(np.uint8), connectivity=8)
    edge = np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]])
    width = max(1, round(BORDER * moving.shape[1]))
    border = np.ones_like(moving)
    border[width:-width, width:-width] = False
    return moving & border & np.isin(regions, edge)


def _dilated(mask: np.ndarray) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0

"""How still the camera stood: limits, sway, changes of the view, and the part of a recording that evidence is from."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from autocalib_ros.config import GateOptions

REFERENCE_WIDTH_PX = 1280
"""Image width for which `gate.max_drift_px` is given; it scales with the width, as an angle does."""
MIN_DRIFT_LIMIT_PX = 1.5
"""Least limit of a lasting displacement at any width, pixels: compressed video of 320 px scatters by up to 0.8 px, half
of it; cameras that really move begin at 6 px."""
MAX_SWAY_PX = 4.5
"""Largest distance from the rest position that is compensated at any width, pixels: masts in wind sway by 1 to 3 px,
and the rest position is known to half a pixel or so while they do."""
MAX_SWAY_FRACTION = 0.0035
"""The same as a fraction of the image width, for images wider than 1280 px. Until the lens is known it may show 30 to
120 degrees (focal length 1.87 to 0.29 widths), so that this is 0.1 to 0.7 degrees; masts sway by up to half a degree,
hands by more than one."""
MIN_STILL_PART_S = 10.0
"""Shortest still part of a recording with other parts, seconds: two periods of the slowest sway (0.2 Hz). A shorter
one does not distinguish a fixed camera from one that pauses."""
MIN_REPORTED_SWAY_PX = 0.25
"""Least sway that is reported and compensated, pixels: tracked points scatter by 0.3 px."""


def drift_limit_px(image_width: int, gate: GateOptions) -> float:
    """Return the lasting displacement of the background, in pixels, up to which a camera counts as stationary."""
    return max(MIN_DRIFT_LIMIT_PX, gate.max_drift_px * image_width / REFERENCE_WIDTH_PX)


def sway_limit_px(image_width: int, gate: GateOptions) -> float:
    """Return the largest sway about the rest position, in pixels, that is compensated; more is motion."""
    return max(MAX_SWAY_PX, MAX_SWAY_FRACTION * image_width, drift_limit_px(image_width, gate))


class ViewChangeKind(IntEnum):
    """What happened to the view of a camera."""

    CUT = 1
    """Another view: a cut, a title card, another camera."""
    ZOOM = 2
    """The same view at another magnification; the amount is the factor."""
    TURN = 3
    """The same scene elsewhere in the picture: a bump, a pan, a camera that is not fixed; the amount is in pixels."""
    DRIFT = 4
    """The picture moved slowly; the amount is in pixels."""
    MOTION = 5
    """The camera still moves, or shows no view for long enough; the amount is in pixels."""


@dataclass(frozen=True)
class ViewChange:
    """One change of the view."""

    kind: ViewChangeKind
    start_s: float
    """Seconds since the first image, as `end_s`."""
    end_s: float
    """When the new view was still; the time of the newest image if it is not."""
    amount: float = 0.0
    """Zoom factor, or displacement in pixels of the full image; 0 for a cut."""

    def enlarged(self, factor: float) -> ViewChange:
        """Return the same for an image of `factor` times the width."""
        return self if self.kind is ViewChangeKind.ZOOM else replace(self, amount=self.amount * factor)

    @property
    def displacement_px(self) -> float:
        """By how much the picture was displaced; infinite where nothing of it is as it was."""
        return math.inf if self.kind in (ViewChangeKind.CUT, ViewChangeKind.ZOOM) else self.amount

    def __str__(self) -> str:
        if self.kind is ViewChangeKind.CUT:
            return 'another view'
        return f'zoom {self.amount:.2f}' if self.kind is ViewChangeKind.ZOOM else f'the picture by {self.amount:.1f} px'


@dataclass(frozen=True)
class Stillness:
    """How still the camera stood, and which part of the recording the evidence is from; times since the first image."""

    start_s: float = 0.0
    end_s: float = 0.0
    recorded_s: float = 0.0
    """Time of the newest image of the recording so far."""
    sway_px: float = 0.0
    """Sway about the rest position: 95 % of the images lie within it, pixels of the full image. Compensated."""
    travel_px: float = 0.0
    """Span of the picture's motion in the whole recording, without cuts, pixels of the full image."""
    changes: tuple[ViewChange, ...] = ()
    """Changes of the view in the whole recording, oldest first."""

    @property
    def part_s(self) -> float:
        """Length of the still part, seconds."""
        return self.end_s - self.start_s

    @property
    def is_notable(self) -> bool:
        """Whether there was sway, or another view."""
        return self.sway_px > 0 or self.start_s > 0 or bool(self.changes)

    def enlarged(self, factor: float) -> Stillness:
        """Return the same for an image of `factor` times the width."""
        changes = tuple(change.enlarged(factor) for change in self.changes)
        return replace(self, sway_px=self.sway_px * factor, travel_px=self.travel_px * factor, changes=changes)

    def as_array(self) -> np.ndarray:
        """Return all values as one vector, for files."""
        rows = [(change.kind, change.start_s, change.end_s, change.amount) for change in self.changes]
        head = [self.start_s, self.end_s, self.recorded_s, self.sway_px, self.travel_px]
        return np.array([*head, *(value for row in rows for value in row)], float)

    @classmethod
    def from_array(cls, values: np.ndarray) -> Stillness:
        """Read the vector of `as_array`; ValueError if it is none."""
        if values.ndim != 1 or len(values) % 4 != 1 or len(values) < 5 or not np.isfinite(values).all():
            raise ValueError('stillness is not a vector of 5 + 4 n finite values')
        changes = tuple(
            ViewChange(ViewChangeKind(int(kind)), float(start), float(end), float(amount))
            for kind, start, end, amount in values[5:].reshape(-1, 4)
        )
        start_s, end_s, recorded_s, sway_px, travel_px = (float(value) for value in values[:5])
        return cls(start_s, end_s, recorded_s, sway_px, travel_px, changes)

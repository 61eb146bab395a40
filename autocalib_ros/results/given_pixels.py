"""Pixels that a user gave, known lengths, ignored regions and control points, followed as the camera turns.

They are places on the road in the view of the day when they were measured. After a turn of the camera the same places
lie elsewhere in the image, and a length between the old pixels would be another length. So the pixels are carried
along by the measured rotation through the lens; after a move that was not measured nothing is known of them. Ignored
regions may be private places, which move with the view, or text in the image, which does not: both are ignored.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from autocalib_ros.config import MIN_PIXEL_SEPARATION_SIGMAS, Options, Polygons
from autocalib_ros.errors import InputError
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.camera_move import CameraMove, rotation_angle_deg
from autocalib_ros.results.control_points import ControlPoints

OUTLINE_STEP_PX = 32.0
"""Longest piece of the outline of a region that is carried along as a straight one, pixels: a lens of 120 degrees bends
it by half a pixel."""
OUTLINE_SIGMAS, OUTLINE_MARGIN_PX = 3.0, 1.0
"""Standard deviations, and pixels for the pieces, by which a region that was carried along is made wider."""

MAX_POINTS_DISPLACED_PX = 1.0
"""Displacement of the picture up to which control points are used, pixels: a person clicks as exactly."""


@dataclass(frozen=True, eq=False)
class GivenPixels:
    """Pixels as they were given, and where the same places are in a view."""

    as_given: np.ndarray
    """Outlines of the ignored regions, both pixels of each known length, the control points, shape (n, 2)."""
    in_view: np.ndarray
    """Shape (n, 2), NaN where it is unknown."""
    sigma_px: float = 0.0
    """Standard deviation that the moves of the camera have added to each coordinate."""
    outlines: tuple[int, ...] = ()
    """Number of pixels of each ignored region."""
    displaced_px: float = 0.0
    """By how much the picture was displaced since, by turns that were not measured."""

    @classmethod
    def of(cls, options: Options, points: ControlPoints | None = None) -> GivenPixels:
        """Return the pixels that options and control points give, in the view in which they were measured."""
        lengths = [pixel for known in options.scale.known_distances for pixel in known.pixels]
        outlines = [_outline(np.array(polygon)) for polygon in options.ignored_polygons]
        ends = [] if points is None else [points.pixels]
        given = np.vstack([*outlines, np.array(lengths, float).reshape(-1, 2), *ends])
        return cls(given, given, outlines=tuple(map(len, outlines)))

    @property
    def is_complete(self) -> bool:
        """Whether all places are known in the view."""
        return bool(np.isfinite(self.in_view).all())

    def turned(self, result: Calibration, move: CameraMove) -> GivenPixels:
        """Return the pixels after a move of the camera with this calibration; unknown if the lens is another now."""
        if move.sigma_deg is None:
            return self.unknown()
        camera = result.camera
        now = replace(camera, focal_px=camera.focal_px * move.zoom)
        bearings, seen = camera.unproject(self.in_view)
        pixels, inside = now.project(bearings @ move.rotation.T)
        # through a lens that is not calibrated any more regions are followed well enough to cover them, lengths are not
        is_outline = np.arange(len(self.as_given)) < sum(self.outlines)
        used = seen & inside & (move.keeps_lens | is_outline)
        pixels = np.where(used[:, None], pixels, np.nan)
        focal = 0.0 if result.stddev.focal_px is None else result.stddev.focal_px / camera.focal_px
        turn_rad = np.radians(rotation_angle_deg(move.rotation))
        registration_rad = np.radians(np.linalg.norm(move.sigma_deg))
        added = camera.focal_px * float(np.hypot(registration_rad, focal * turn_rad))
        return replace(self, in_view=pixels, sigma_px=float(np.hypot(self.sigma_px, added)))

    def regions_in_view(self, options: Options) -> Polygons:
        """Return the ignored regions as they were given, then those places that lie elsewhere in the view."""
        followed: list[tuple[tuple[float, float], ...]] = []
        begin = 0
        for count in self.outlines:
            rows = slice(begin, begin + count)
            begin += count
            pixels = self.in_view[rows][np.isfinite(self.in_view[rows]).all(axis=1)]
            if len(pixels) < 3 or np.array_equal(pixels, self.as_given[rows]):
                continue
            wider = _wider(pixels, OUTLINE_SIGMAS * self.sigma_px + OUTLINE_MARGIN_PX)
            followed.append(tuple((float(u), float(v)) for u, v in wider))
        return (*options.ignored_polygons, *followed)

    def displaced(self, displacement_px: float) -> GivenPixels:
        """Return the pixels after a move that only the picture tells, by its displacement: so much less certain.

        Infinite where nothing is as it was.
        """
        if not math.isfinite(displacement_px):
            return self.unknown()
        return replace(self, displaced_px=self.displaced_px + displacement_px)

    def unknown(self) -> GivenPixels:
        """Return the pixels in a view of which nothing is known."""
        return replace(self, in_view=np.full_like(self.in_view, np.nan))

    def options_in_view(self, options: Options, image_size: tuple[int, int]) -> Options:
        """Return options with the known lengths where they are in the view; without those that cannot be used.

        That is where an end left the image, or its place is less certain than a tenth of the length.
        """
        scale = options.scale
        known = scale.known_distances
        first = sum(self.outlines)
        rows = slice(first, first + 2 * len(known))
        ends = self.in_view[rows].reshape(-1, 4)
        if not self.displaced_px and np.array_equal(ends, self.as_given[rows].reshape(-1, 4)):
            return options
        limit = np.tile(image_size, 2) - 0.5
        sigma_px = float(np.linalg.norm([scale.pixel_sigma_px, self.sigma_px, self.displaced_px]))
        apart = np.hypot(*(ends[:, 2:] - ends[:, :2]).T) > max(MIN_PIXEL_SEPARATION_SIGMAS * sigma_px, 1.0)
        usable = ((ends >= -0.5) & (ends <= limit)).all(axis=1) & apart
        texts = [
            f'{" ".join(f"{value:.2f}" for value in pixels)} {length.metres:g}'
            for length, pixels, seen in zip(known, ends, usable, strict=True)
            if seen
        ]
        moved = replace(
            scale,
            distance_px='',
            distance_m=0.0,
            distances='; '.join(texts),
            pixel_sigma_px=sigma_px,
        )
        # a scale that had to come from lengths alone has no source without them
        source = options.scale_from if texts or options.scale_from != 'distance' else 'all'
        return replace(options, scale=moved, scale_from=source)

    def points_in_view(self, points: ControlPoints) -> ControlPoints | None:
        """Return control points where they are in the view; None if that is unknown."""
        pixels = self.in_view[len(self.in_view) - len(points.pixels) :]
        is_known = np.isfinite(pixels).all() and self.displaced_px <= MAX_POINTS_DISPLACED_PX
        return replace(points, pixels=pixels) if is_known else None

    def document(self) -> dict[str, Any]:
        """Return this for a JSON file; a place that is unknown is null."""
        in_view = [pixel.tolist() if np.isfinite(pixel).all() else None for pixel in self.in_view]
        return {
            'as_given': self.as_given.tolist(),
            'in_view': in_view,
            'sigma_px': self.sigma_px,
            'outlines': list(self.outlines),
            'displaced_px': self.displaced_px,
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> GivenPixels:
        """Read what `document` returned; InputError if it is something else."""
        try:
            unknown = [np.nan, np.nan]
            found = cls(
                np.array(document['as_given'], float).reshape(-1, 2),
                np.array([unknown if pixel is None else pixel for pixel in document['in_view']], float).reshape(-1, 2),
                float(document['sigma_px']),
                tuple(int(count) for count in document.get('outlines', ())),
                float(document.get('displaced_px', 0.0)),
            )
        except (LookupError, TypeError, ValueError) as error:
            raise InputError(f'its given_pixels are damaged ({type(error).__name__}: {error})') from error
        counts = min(found.outlines, default=0) >= 0 and sum(found.outlines) <= len(found.as_given)
        finite = 0 <= found.sigma_px < np.inf and 0 <= found.displaced_px < np.inf
        if found.as_given.shape != found.in_view.shape or not finite or not counts:
            raise InputError('its given_pixels are damaged')
        return found


class FollowedPixels:
    """The pixels in the present view, and in that of the calibration in force; thread-safe."""

    def __init__(self, given: GivenPixels) -> None:
        self._lock = threading.Lock()
        self._present = self._in_force = given

    @property
    def present(self) -> GivenPixels:
        """The pixels in the view of the newest images."""
        return self._present

    def given_anew(self, given: GivenPixels) -> None:
        """Take pixels that the user gives now, for the present view."""
        with self._lock:
            self._present = self._in_force = given

    def resume(self, stored: GivenPixels | None) -> None:
        """Go on from a stored calibration, unless other pixels have been given since."""
        with self._lock:
            if stored is not None and np.array_equal(stored.as_given, self._present.as_given):
                self._present = self._in_force = stored

    def moved(self, result: Calibration | None, move: CameraMove) -> None:
        """Follow a move of the camera away from the view of the calibration in force."""
        with self._lock:
            before = self._in_force
            self._present = before.unknown() if result is None else before.turned(result, move)

    def displaced(self, displacement_px: float) -> None:
        """Note that the picture was displaced, by an unknown turn."""
        with self._lock:
            self._present = self._present.displaced(displacement_px)

    def is_back(self) -> None:
        """Note that the present view is that of the calibration in force."""
        with self._lock:
            self._present = self._in_force

    def adopt(self) -> None:
        """Note that the calibration in force is one of the present view from now on."""
        with self._lock:
            self._in_force = self._present


def _outline(polygon: np.ndarray) -> np.ndarray:
    """Return a closed polygon (n, 2) with further points on its sides, (m, 2)."""
    pieces = []
    for start, end in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        count = max(1, math.ceil(float(np.hypot(*(end - start))) / OUTLINE_STEP_PX))
        pieces.append(start + (end - start) * np.arange(count)[:, None] / count)
    return np.vstack(pieces)


def _wider(polygon: np.ndarray, margin_px: float) -> np.ndarray:
    """Return a polygon (n, 2) whose points are farther from their centre by a margin."""
    from_centre = polygon - polygon.mean(axis=0)
    return polygon + margin_px * from_centre / np.maximum(np.hypot(*from_centre.T), 1e-9)[:, None]

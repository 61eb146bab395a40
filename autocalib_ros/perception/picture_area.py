"""Pixels of the images that are no picture: bars, the corners of a fisheye, and text burnt in.

They do not move with the scene and hide it: corners there would hold a moving camera still, their edges are exactly
level or upright, and a running clock is a vehicle that stands.
"""

from __future__ import annotations

import cv2
import numpy as np

from autocalib_ros.config import Polygons
from autocalib_ros.evidence.picture import Picture
from autocalib_ros.perception.background import MIN_SAMPLES, Background, median
from autocalib_ros.perception.ignore_regions import ignored_mask
from autocalib_ros.perception.overlay_boxes import Box, find_boxes
from autocalib_ros.perception.overlay_text import MARGIN_HEIGHTS, find_text
from autocalib_ros.perception.picture_borders import find_circle, find_rectangle

MIN_PICTURE_SAMPLES = 3
"""Images that show what is constant: with two, one that is torn or lit by a lamp would decide."""
REPEAT_FACTOR, REPEAT_INTERVAL_S = 1.5, 3600.0
"""The next analysis is due at this factor of the age of the view at the last one, or after this interval: evidence
grows with time, and an analysis costs tenths of a second."""
OVERLAY_MEMORY = 8
"""Analyses over which it is averaged where overlays were seen: letters on bright vehicles are missed at times."""
MIN_OVERLAY_SHARE = 0.3
"""Least share of the analyses in which a pixel was overlaid; what was so once in eight times was chance."""
RAMP_LEVELS = (60.0, 200.0)
"""Grey levels of the ramp in ignored polygons: ten times what a constant strip may vary by, and no black."""
BOX_MARGIN_PX = 3.0
"""Margin of drawn rectangles, pixels of the analysed image: sides are found to one, and compression makes them ring."""
BORDER_MARGIN_PX = 2
"""Pixels of the tracked image inside the picture that are masked with its border, which compression makes ring."""


class PictureArea:
    """Finds the picture in the samples that a `Background` keeps, anew with each of them; holds no images."""

    def __init__(self, image_size: tuple[int, int], tracked_size: tuple[int, int], polygons: Polygons = ()) -> None:
        """`polygons` of the images are blacked out before they come: they tell nothing about the picture."""
        self._image_size, self._tracked_size, self._polygons = image_size, tracked_size, polygons
        self._newest_s, self._due_s, self._start_s = -np.inf, 0.0, 0.0
        self._overlay_share = np.zeros(tracked_size[::-1], np.float32)
        self._analyses = 0
        self.picture = Picture.whole(image_size)
        """The picture, in pixels of the full image; the whole image until something else is found."""
        self.mask: np.ndarray | None = None
        """1 where there is no picture, else 0, uint8 (h, w) of the tracked image; None if there is picture everywhere.
        """

    @property
    def is_known(self) -> bool:
        """Whether the picture was looked for: a view that has just begun says nothing."""
        return self._analyses > 0

    def update(self, background: Background) -> bool:
        """Look again if the background has a new sample and that is due; return whether the mask changed."""
        times = background.times_s
        if len(times) < MIN_PICTURE_SAMPLES or times[-1] <= self._newest_s or times[-1] < self._due_s:
            return False
        if not self._analyses:
            self._start_s = times[0]
        self._newest_s = times[-1]
        self._due_s = times[-1] + min((REPEAT_FACTOR - 1.0) * (times[-1] - self._start_s), REPEAT_INTERVAL_S)
        samples = background.reduced_samples()
        ignored = self._ignored(samples[0].shape[1::-1])
        samples = samples if ignored is None else [_with_ramp(sample, ignored) for sample in samples]
        height, width = samples[0].shape[:2]
        across, down = self._image_size[0] / width, self._image_size[1] / height
        grey = [cv2.cvtColor(sample, cv2.COLOR_BGR2GRAY) for sample in samples]
        self.picture = self._scaled(_find_picture(np.stack(grey)), across, down)
        self._see_overlays(_find_overlays(samples, grey, ignored), (width, height))
        before, self.mask = self.mask, self._mask()
        if before is None or self.mask is None:
            return before is not self.mask
        return not np.array_equal(before, self.mask)

    def _ignored(self, size: tuple[int, int]) -> np.ndarray | None:
        """Return the mask uint8 (H, W) of the ignored polygons and their borders in images of a size; None if none."""
        if not self._polygons:
            return None
        inside = ignored_mask(self._polygons, self._image_size).astype(np.uint8)
        return np.asarray(cv2.dilate(cv2.resize(inside, size, interpolation=cv2.INTER_NEAREST), np.ones((5, 5))))

    def _see_overlays(self, boxes: list[Box], analysed_size: tuple[int, int]) -> None:
        """Average over the last analyses where boxes lie."""
        (width, height), (analysed_width, analysed_height) = self._tracked_size, analysed_size
        across, down = width / analysed_width, height / analysed_height
        overlaid = np.zeros((height, width), np.float32)
        for x0, y0, x1, y1 in boxes:
            left, top = max(int(x0 * across), 0), max(int(y0 * down), 0)
            overlaid[top : int(np.ceil(y1 * down)), left : int(np.ceil(x1 * across))] = 1
        self._analyses += 1
        self._overlay_share += (overlaid - self._overlay_share) / min(self._analyses, OVERLAY_MEMORY)

    def _scaled(self, found: Picture, across: float, down: float) -> Picture:
        """Return the picture in whole pixels of the full image; a border that was not found is that of the image."""
        if found.fills_image:
            return Picture.whole(self._image_size)
        scaled = found.scaled(across, down, self._image_size)
        x0, y0, x1, y1 = (float(round(border)) for border in scaled.rectangle)
        return Picture(self._image_size, (x0, y0, x1, y1), scaled.circle)

    def _mask(self) -> np.ndarray | None:
        overlaid = (self._overlay_share >= MIN_OVERLAY_SHARE).astype(np.uint8)
        if self.picture.fills_image:
            return overlaid if overlaid.any() else None
        return cv2.bitwise_or(overlaid, outside_of(self.picture.in_images_of(self._tracked_size), BORDER_MARGIN_PX))


def _find_picture(grey: np.ndarray) -> Picture:
    """Find the picture in grey images (n, H, W) of one view."""
    height, width = grey.shape[1:]
    x0, y0, x1, y1 = find_rectangle(grey)
    circle = find_circle(grey[:, y0:y1, x0:x1])
    if circle is None:
        return Picture((width, height), (float(x0), float(y0), float(x1), float(y1)))
    x, y, radius = circle[0] + x0 + 0.5, circle[1] + y0 + 0.5, circle[2] + 0.5
    box = (max(x - radius, x0), max(y - radius, y0), min(x + radius, x1), min(y + radius, y1))
    return Picture((width, height), box, (x, y, radius))


def _with_ramp(image: np.ndarray, ignored: np.ndarray) -> np.ndarray:
    """Return a BGR image (H, W, 3) with a ramp where a mask (H, W) is not 0, neither constant nor with edges inside."""
    height, width = ignored.shape
    across, down = np.linspace(*RAMP_LEVELS, width), np.linspace(*RAMP_LEVELS, height)
    ramp = (0.5 * (across[None] + down[:, None])).astype(np.uint8)[..., None]
    return np.where(ignored[..., None] > 0, ramp, image)


def _find_overlays(samples: list[np.ndarray], grey: list[np.ndarray], ignored: np.ndarray | None) -> list[Box]:
    """Find text and rectangles that are drawn into images (H, W, 3) of one view, also in grey, with their margins.

    Rectangles at the mask `ignored` (H, W) have their sides from it, and those in few images are vehicles.
    """
    boxes = []
    for x0, y0, x1, y1 in find_boxes(median(grey)) if len(grey) >= MIN_SAMPLES else []:
        box = (x0 - BOX_MARGIN_PX, y0 - BOX_MARGIN_PX, x1 + BOX_MARGIN_PX, y1 + BOX_MARGIN_PX)
        left, top, right, bottom = (max(round(border), 0) for border in box)
        if ignored is None or not ignored[top:bottom, left:right].any():
            boxes.append(box)
    for text in find_text(samples):
        margin = MARGIN_HEIGHTS * text.height
        boxes.append((text.x0 - margin, text.y0 - margin, text.x1 + margin, text.y1 + margin))
    return boxes


def outside_of(picture: Picture, margin_px: float) -> np.ndarray:
    """Return the mask uint8 (H, W) of the pixels outside of a picture, or less than a margin inside a border of it.

    Sides of the picture at the side of the image have no margin.
    """
    width, height = picture.image_size
    x0, y0, x1, y1 = picture.rectangle
    mask = np.ones((height, width), np.uint8)
    left, top = (int(np.ceil(low + margin_px)) if low > 0 else 0 for low in (x0, y0))
    right = int(np.floor(x1 - margin_px)) if x1 < width else width
    bottom = int(np.floor(y1 - margin_px)) if y1 < height else height
    mask[top:bottom, left:right] = 0
    if picture.circle is not None:
        x, y, radius = picture.circle
        rows, columns = np.mgrid[:height, :width]
        mask[np.hypot(columns + 0.5 - x, rows + 0.5 - y) > radius - margin_px] = 1
    return mask

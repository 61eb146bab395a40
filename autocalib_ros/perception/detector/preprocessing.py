"""Image preprocessing for detectors: resizing, padding, channel order and normalisation."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

PAD_LEVEL = 114
"""Grey level of the padding with which the YOLO family is trained."""
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of red, green and blue, as fractions of white."""
SIZE_MULTIPLE_PX = 32
"""Input sizes of detectors are multiples of this."""


@dataclass(frozen=True)
class Placement:
    """Position of an image in the input of a model: input pixel = factor * image pixel + offset."""

    input_size: tuple[int, int]
    """Width and height."""
    image_size: tuple[int, int]
    """Size of the resized image in the input."""
    factor: tuple[float, float]
    offset: tuple[int, int]

    def to_image(self, edges_px: np.ndarray) -> np.ndarray:
        """Convert box edges (n, 4) from the input to the image."""
        return (edges_px - self.offset * 2) / (self.factor * 2)


def place_in_input(
    image_size: tuple[int, int], model_size: tuple[int | None, int | None], mode: str, longest: int
) -> Placement:
    """Place an image of (width, height); a model with dynamic size gets the size of the image, up to `longest`.

    Images are never enlarged: interpolation adds no detail, and blurred vehicles are missed.
    """
    width, height = image_size
    free = min(1.0, longest / max(image_size))
    room = [
        fixed or int(np.ceil(round(side * free) / SIZE_MULTIPLE_PX)) * SIZE_MULTIPLE_PX
        for side, fixed in zip(image_size, model_size, strict=True)
    ]
    factors = [
        min(1.0, space / side, 1.0 if fixed else free)
        for space, side, fixed in zip(room, image_size, model_size, strict=True)
    ]
    if mode != 'stretch':
        factors = [min(factors)] * 2
    size = (max(1, round(width * factors[0])), max(1, round(height * factors[1])))
    left, top = ((room[0] - size[0]) // 2, (room[1] - size[1]) // 2) if mode == 'centred' else (0, 0)
    return Placement((room[0], room[1]), size, (size[0] / width, size[1] / height), (left, top))


@dataclass(frozen=True)
class ColourFormat:
    """Colour format of the model input."""

    order: str
    """bgr or rgb."""
    white: float
    """Value of white, 255 or 1."""
    imagenet: bool
    """Normalised by mean and standard deviation of ImageNet."""


def tensor(
    image: np.ndarray, placement: Placement, colours: ColourFormat, kind: type[np.generic], *, channels_last: bool
) -> np.ndarray:
    """Return a grey (H, W) or BGR (H, W, 3) image, uint8, as the model input [1, 3, h, w] or [1, h, w, 3]."""
    if placement.image_size != (image.shape[1], image.shape[0]):
        image = cv2.resize(image, placement.image_size, interpolation=cv2.INTER_LINEAR)
    if image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    (left, top), (width, height) = placement.offset, placement.input_size
    right, bottom = width - left - image.shape[1], height - top - image.shape[0]
    if left or top or right or bottom:
        image = cv2.copyMakeBorder(image, top, bottom, left, right, cv2.BORDER_CONSTANT, value=(PAD_LEVEL,) * 3)
    if colours.order == 'rgb':
        image = image[:, :, ::-1]
    if kind == np.uint8:
        levels = image
    else:
        levels = image.astype(np.float32)
        if colours.imagenet:
            order = slice(None, None, 1 if colours.order == 'rgb' else -1)
            mean, spread = (np.array(part[order], np.float32) for part in (IMAGENET_MEAN, IMAGENET_STD))
            levels = (levels / 255.0 - mean) / spread * colours.white
        elif colours.white != 255:
            levels *= colours.white / 255.0
    levels = levels if channels_last else levels.transpose(2, 0, 1)
    return np.ascontiguousarray(levels[None], kind)

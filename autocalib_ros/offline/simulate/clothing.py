"""Textures of pedestrians and cyclists: legs, trunk, arms, head."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.offline.simulate import paint
from autocalib_ros.offline.simulate.palette import Palette

_Size = tuple[int, int]
"""Height and width in texels."""


@dataclass(frozen=True)
class FigureSizes:
    """Texture sizes (height, width) in texels of the parts of a figure."""

    leg: _Size
    trunk: _Size
    arm: _Size
    head: _Size


def figure_images(clothes: int, sizes: FigureSizes, palette: Palette, rng: np.random.Generator) -> list[np.ndarray]:
    """Return BGRA images of near leg, far leg, trunk, both arms and head.

    clothes: number that selects the colours of coat and legs.
    """
    coat = palette.clothes[clothes % len(palette.clothes)]
    legs = palette.clothes[(clothes * 3 + 1) % len(palette.clothes)]
    octaves = ((2.0, 6.0 * palette.texture), (8.0, 8.0 * palette.texture))
    images = []
    for colour, size in (
        (legs, sizes.leg),
        (paint.mix_colours(legs, palette.trim, 0.3), sizes.leg),
        (coat, sizes.trunk),
        (coat, sizes.arm),
        (coat, sizes.arm),
        (palette.skin, sizes.head),
    ):
        image = paint.filled_image(*size, colour)
        paint.add_noise(image, paint.octave_noise(*size, octaves, rng))
        images.append(image)
    return images

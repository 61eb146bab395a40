"""Colours (BGR, 0..255) of all materials, by daylight and for a thermal camera."""

from __future__ import annotations

from dataclasses import dataclass

Colour = tuple[int, int, int]


@dataclass(frozen=True)
class Palette:
    """Colours of all materials.

    texture: factor on the contrast of all texture noise.  engine: colour of the warm bonnet, thermal only.
    """

    asphalt: Colour
    marking: Colour
    kerb: Colour
    pavement: Colour
    grass: Colour
    sky_low: Colour
    sky_high: Colour
    walls: tuple[Colour, ...]
    window: Colour
    pole: Colour
    trunk: Colour
    foliage: Colour
    bodies: tuple[Colour, ...]
    glass: Colour
    tyre: Colour
    hub: Colour
    trim: Colour
    head_lamp: Colour
    tail_lamp: Colour
    ink: Colour
    clothes: tuple[Colour, ...]
    skin: Colour
    texture: float = 1.0
    engine: Colour | None = None


def _grey(level: int) -> Colour:
    return (level, level, level)


DAY = Palette(
    asphalt=(92, 90, 88),
    marking=(222, 226, 228),
    kerb=(168, 170, 172),
    pavement=(146, 150, 156),
    grass=(58, 112, 88),
    sky_low=(226, 218, 208),
    sky_high=(214, 172, 128),
    walls=((104, 128, 168), (158, 168, 178), (128, 148, 152), (92, 104, 138)),
    window=(86, 74, 62),
    pole=(84, 86, 84),
    trunk=(46, 60, 78),
    foliage=(44, 92, 62),
    bodies=(
        (226, 228, 228),
        (196, 198, 198),
        (58, 56, 54),
        (38, 34, 168),
        (150, 78, 34),
        (92, 94, 96),
        (232, 234, 230),
        (60, 128, 70),
        (40, 176, 220),
        (74, 52, 108),
    ),
    glass=(54, 46, 40),
    tyre=(28, 28, 28),
    hub=(158, 158, 158),
    trim=(36, 36, 36),
    head_lamp=(240, 246, 248),
    tail_lamp=(32, 26, 186),
    ink=(60, 40, 30),
    clothes=((110, 62, 40), (48, 48, 56), (60, 60, 170), (150, 150, 160), (90, 120, 60)),
    skin=(130, 160, 200),
)

THERMAL = Palette(
    asphalt=_grey(108),
    marking=_grey(102),
    kerb=_grey(112),
    pavement=_grey(116),
    grass=_grey(84),
    sky_low=_grey(40),
    sky_high=_grey(18),
    walls=(_grey(98), _grey(106), _grey(92), _grey(101)),
    window=_grey(72),
    pole=_grey(90),
    trunk=_grey(92),
    foliage=_grey(78),
    bodies=tuple(_grey(level) for level in (96, 100, 112, 104, 109, 102, 93, 106, 99, 111)),
    glass=_grey(70),
    tyre=_grey(172),
    hub=_grey(140),
    trim=_grey(118),
    head_lamp=_grey(132),
    tail_lamp=_grey(124),
    ink=_grey(90),
    clothes=tuple(_grey(level) for level in (178, 170, 186, 174, 182)),
    skin=_grey(222),
    texture=0.35,
    engine=_grey(168),
)


def palette_for(thermal: bool) -> Palette:
    """Return the palette of a daylight or thermal camera."""
    return THERMAL if thermal else DAY

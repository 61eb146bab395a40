"""Families of synthetic evidence that break an assumption of the solver without any sign beside the traffic itself.

A refusal is right, and so is a result whose stated standard deviations cover its error.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.families import (
    PRINCIPAL_POINT_SIGMA,
    WIDTH,
    Family,
    family_of,
    one_road,
    standard_junction,
)
from autocalib_ros.offline.synthetic.drives import drive_bend
from autocalib_ros.offline.synthetic.junction import HEADWAY_S, Junction, pose, synthetic_evidence

USUAL_ASPECTS = (12 / 11, 16 / 11, 10 / 11, 40 / 33, 3 / 4, 4 / 3, 2.0, 720 / 704, 720 / 640)
"""Pixel aspects of usual squeezes: PAL, NTSC, CIF, half widths, other widths of one picture."""
OTHER_ASPECTS = (0.88, 1.13)
"""Range of the pixel aspects of unusual squeezes."""
BAR_FRACTION = (0.05, 0.2)
"""Range of the fraction of the width that a bar on one side covers."""
WRONG_FOCAL_FACTOR = (1.06, 1.3)
"""Range of the ratio, or its inverse, of the focal length in a wrong lens file to the true one."""
BENT_RADIUS_M = (100.0, 800.0)
TURNED_DEG = (1.0, 6.0)
"""Range of the angle by which the camera turns in the middle of the recording."""
POINTS_PER_VEHICLE, TRACK_COUNT = 4, 240


def squeezed_pixels(generator: np.random.Generator) -> Junction:
    """Draw pixels that are not square, in half of the draws of a usual squeeze."""
    junction = _denser(standard_junction(generator))
    aspect = float(generator.choice(USUAL_ASPECTS) if generator.random() < 0.5 else generator.uniform(*OTHER_ASPECTS))
    focal_px = junction.camera.focal_px * max(aspect, 1.0)  # as wide a view as of square pixels
    return replace(junction, camera=replace(junction.camera, pixel_aspect=aspect, focal_px=float(focal_px)))


def one_sided_bar(generator: np.random.Generator) -> Junction:
    """Draw a picture of which a bar covers one side of the images: its centre is not theirs."""
    junction, covered = _denser(standard_junction(generator)), generator.uniform(*BAR_FRACTION)
    first, last = (covered * WIDTH, float(WIDTH)) if generator.random() < 0.5 else (0.0, (1.0 - covered) * WIDTH)
    cx = 0.5 * (first + last - 1.0) + generator.normal(scale=PRINCIPAL_POINT_SIGMA * WIDTH)
    camera = replace(junction.camera, principal_point_px=(float(cx), junction.camera.principal_point_px[1]))
    return replace(junction, camera=camera, visible_columns_px=(float(first), float(last)))


def bent_road(generator: np.random.Generator) -> Junction:
    """Draw a single road with a wide bend, which looks nearly straight."""
    radius_m, towards_rad = generator.uniform(*BENT_RADIUS_M), generator.uniform(0, 2 * np.pi)
    return replace(one_road(generator), drive=partial(drive_bend, radius_m=radius_m, towards_rad=towards_rad))


def mixed_views(generator: np.random.Generator) -> tuple[Junction, Evidence]:
    """Draw a camera that turns in the middle of the recording, unnoticed; the later view counts as the truth."""
    junction = _denser(standard_junction(generator))
    about = generator.normal(size=3)
    tilt, roll, heading = about / np.linalg.norm(about) * generator.uniform(*TURNED_DEG)
    turned = pose(tilt, roll, heading) @ pose(0.0, 0.0, 0.0).T
    middle_s = 0.5 * HEADWAY_S * TRACK_COUNT / POINTS_PER_VEHICLE

    def turns(times_s: np.ndarray) -> np.ndarray:
        return np.where((times_s < middle_s)[:, None, None], turned, np.eye(3))

    return junction, replace(synthetic_evidence(replace(junction, sway=turns), generator), drift_px=0.0)


def ordinary_junction(generator: np.random.Generator) -> Junction:
    """Draw an ordinary junction: its lens file is wrong, see `wrong_lens`."""
    return _denser(standard_junction(generator))


def wrong_lens(true: Camera, generator: np.random.Generator) -> Camera:
    """Return the lens of another camera or mode: another focal length, in a third of the draws equidistant."""
    factor = float(generator.uniform(*WRONG_FOCAL_FACTOR)) ** generator.choice([-1.0, 1.0])
    k = (0.0, 0.0, 0.0, 0.0) if generator.random() < 1 / 3 else true.k
    return replace(true, focal_px=float(true.focal_px * factor), k=k)


def _denser(junction: Junction) -> Junction:
    return replace(junction, tracks=TRACK_COUNT, points_per_vehicle=POINTS_PER_VEHICLE)


BROKEN: dict[str, Family] = {
    'squeezed_pixels': family_of(squeezed_pixels),
    'one_sided_bar': family_of(one_sided_bar),
    'wrong_lens_file': family_of(ordinary_junction),
    'bent_road': family_of(bent_road),
    'mixed_views': mixed_views,
}
"""Families by name."""
GIVEN_LENSES = {'wrong_lens_file': wrong_lens}
"""Lens files, as functions of the true lens, of the families that are solved with one."""

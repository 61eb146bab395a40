"""One-parameter lens family from equidistant to distortion-free, and where to look for its focal length.

The projection r = f tan(sqrt(kappa) theta) / sqrt(kappa) is distortion-free at kappa = 1, stereographic at 1/4 and
equidistant at 0. Straight paths show one number of it, the barrel (1 - kappa) / f^2, and no focal length: to second
order a pinhole picture of radius r_u is compressed to r_u (1 - barrel r_u^2 / 3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.config import JointOptions
from autocalib_ros.estimation.adjustment.lens_prior import DISTORTION_FREE, LensPrior
from autocalib_ros.estimation.single_road.told_focal import WRONG_TOLD
from autocalib_ros.lens.camera import Camera

MIN_KAPPA, MAX_KAPPA = -0.15, 1.05
"""Lenses from slightly beyond equidistant to slightly beyond distortion-free."""
USUAL_KAPPAS = {'distortion_free': (0.95, 0.15), 'equidistant': (0.0, 0.09)}
"""Mean and standard deviation of usual narrow and wide lenses, a third of all each; another third is spread evenly.
Those of wide lenses are the same as of the family near equidistant. Judgement."""
USUAL_VIEW_DEG, USUAL_VIEW_FACTOR = 45.0, 1.65
"""Median and spread (one standard deviation is this factor) of the horizontal field of view of roadside cameras: 26 to
86 degrees, median 38, on 18 measured ones (BrnoCompSpeed, Sochor et al. 2018), and wide-angle lenses besides."""
MIN_VIEW_DEG, MAX_VIEW_DEG = 18.0, 180.0
"""Fields of view that are tried: two standard deviations of the prior to the narrow side, and a fisheye's."""
LEAST_VIEW_DEG = 4.0
"""Least field of view that is tried where narrow ones are probable: long lenses over roads far away."""
TRIAL_KAPPAS, TRIAL_VIEWS_DEG = (1.0, 0.6, 0.3, 0.0), (50.0, 75.0, 100.0, 125.0, 150.0)
"""Curvatures with a given focal length, and fields of view of equidistant lenses, at which roads are looked for."""
FOCAL_NODES, KNOWN_FOCAL_NODES, KNOWN_FOCAL_SIGMAS = 32, 15, 2.8
"""Focal lengths that are tried, without and with a given one, and up to how many standard deviations from it."""


def barrel_coefficients(kappa: float) -> tuple[float, float, float, float]:
    """Return k1 to k4 of a lens: the Taylor series of tan(sqrt(kappa) theta) / sqrt(kappa)."""
    k1, k2, k3, k4 = (each * kappa ** (power + 1) for power, each in enumerate(DISTORTION_FREE))
    return k1, k2, k3, k4


@dataclass(frozen=True)
class LensChoice:
    """Lenses of the family that a prior allows, about its principal point."""

    prior: LensPrior
    options: JointOptions
    """Of the lens family: `lens_prior` and `k1_sigma`."""

    @property
    def known(self) -> bool:
        """Whether the lens is known."""
        return not len(self.prior.free)

    def focal_lengths(self) -> np.ndarray:
        """Return the focal lengths to try in ascending order, shape (n,)."""
        centre = self.prior.centre
        if self.known:
            return np.array([centre.focal_px])
        if self.prior.focal_known:
            reach = KNOWN_FOCAL_SIGMAS * max(float(self.prior.sigma[0]), 1e-3)
            low, high = centre.focal_px * np.exp([-reach, reach])
            if self.prior.view_deg > 0:  # the focal length of a field of view depends on the curvature
                low, high = (
                    self._focal_of_view(kappa) * np.exp(shift) for kappa, shift in ((0.0, -reach), (1.0, reach))
                )
            return np.geomspace(low, high, KNOWN_FOCAL_NODES)
        half = self._half_width
        shortest, longest = half / np.radians(MAX_VIEW_DEG / 2), half / np.tan(np.radians(MIN_VIEW_DEG / 2))
        return np.geomspace(shortest, longest, FOCAL_NODES)

    def longer_than(self, focals: np.ndarray) -> np.ndarray:
        """Return further focal lengths (m,) as far apart as `focals` (n,), up to those of the least field of view."""
        if self.prior.focal_known or len(focals) < 2:
            return focals[:0]
        longest = self._half_width / np.tan(np.radians(LEAST_VIEW_DEG / 2))
        ratio = focals[-1] / focals[-2]
        steps = int(np.ceil(np.log(max(longest / focals[-1], 1.0)) / np.log(ratio)))
        return np.asarray(focals[-1] * ratio ** np.arange(1.0, steps + 1.0))

    def trials(self) -> list[Camera]:
        """Return lenses through one of which a straight road looks about straight, in the order of their barrel."""
        centre = self.prior.centre
        if self.known:
            return [centre]
        if self.prior.focal_known:
            return [self.lens(centre.focal_px, kappa) for kappa in TRIAL_KAPPAS]
        half = self._half_width
        narrow = self.lens(half / np.tan(np.radians(USUAL_VIEW_DEG / 2)), 1.0)
        return [narrow, *(self.lens(half / np.radians(view / 2), 0.0) for view in TRIAL_VIEWS_DEG)]

    def lens(self, focal_px: float, kappa: float) -> Camera:
        """Return a lens of the family."""
        if self.known:
            return self.prior.centre
        return replace(self.prior.centre, focal_px=float(focal_px), k=barrel_coefficients(kappa))

    def log_prior(self, focal_px: float, kappa: float) -> float:
        """Return the log prior density of a lens, by log focal length and kappa."""
        of_kappa = float(np.log(self._kappa_density(kappa)))
        if self.prior.focal_known:
            away = np.log(focal_px / self.expected_focal_px(kappa)) / max(float(self.prior.sigma[0]), 1e-3)
        else:
            root = np.sqrt(max(kappa, 1e-6))
            view_deg = 2 * np.degrees(np.arctan(root * self._half_width / focal_px) / root)
            away = np.log(view_deg / USUAL_VIEW_DEG) / np.log(USUAL_VIEW_FACTOR)
        return of_kappa - 0.5 * float(away) ** 2

    def expected_focal_px(self, kappa: float) -> float:
        """Return the focal length that is given, or that follows from the given field of view."""
        return self._focal_of_view(kappa) if self.prior.view_deg > 0 else self.prior.centre.focal_px

    def _kappa_density(self, kappa: float) -> float:
        """Return the density of a curvature over the lens families that may be, each as probable as the others.

        A family that an option states may be wrong: straight traffic on one road hardly tells.
        """
        sigma = max(3.0 * self.options.k1_sigma, 1e-3)  # of kappa, which is three times k1
        peaks = {
            'auto': tuple(USUAL_KAPPAS.values()),
            'distortion_free': ((1.0, sigma),),
            'equidistant': ((0.0, sigma),),
            'kannala_brandt': (),
        }[self.options.lens_prior]
        densities = [
            float(np.exp(-0.5 * ((kappa - mean) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))) for mean, sigma in peaks
        ]
        if self.options.lens_prior in ('equidistant', 'distortion_free'):  # it may be wrong, as a told focal length
            return (1.0 - WRONG_TOLD) * densities[0] + WRONG_TOLD
        return float(np.mean([*densities, 1.0]))  # or anything in between

    @property
    def _half_width(self) -> float:
        """Half of the width of the image, in units of the height of a pixel."""
        return 0.5 * self.prior.centre.width * self.prior.centre.pixel_aspect

    def _focal_of_view(self, kappa: float) -> float:
        """Return the focal length at which a lens has the given field of view."""
        root, half_rad = np.sqrt(max(kappa, 1e-6)), np.radians(min(self.prior.view_deg, MAX_VIEW_DEG)) / 2
        return float(self._half_width * root / np.tan(min(root * half_rad, 1.5)))

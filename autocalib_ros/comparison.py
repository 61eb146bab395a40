"""How two calibrations of one camera differ, as values, and what that means.

Every difference is B's less A's, and counted in combined standard deviations where any are stated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

AGREES_SIGMAS = 3.0
"""Two calibrations of one camera are farther apart than this in one number out of 400."""
SAME_LENS_PX = 0.5
"""Two lenses that image every direction closer together than this serve every consumer alike."""
SAME_NUMBER = 1e-9
"""Numbers relatively closer than this are one number."""


@dataclass(frozen=True)
class Difference:
    """One number of A and of B, and one combined sigma of their difference, None where it cannot be told."""

    name: str
    unit: str
    first: float
    second: float
    sigma: float | None

    @property
    def difference(self) -> float:
        """B less A."""
        return self.second - self.first

    @property
    def sigmas(self) -> float | None:
        """How many combined sigmas that is."""
        return _in_sigmas(abs(self.difference), self.sigma, max(abs(self.first), abs(self.second)))


@dataclass(frozen=True)
class RayDifference:
    """Angles between the rays of equal pixels, over the whole image; sigma of the largest where it is."""

    mean_deg: float
    largest_deg: float
    at_px: tuple[float, float]
    sigma_deg: float | None

    @property
    def sigmas(self) -> float | None:
        """How many combined sigmas the largest is."""
        return _in_sigmas(self.largest_deg, self.sigma_deg, 1.0)


@dataclass(frozen=True)
class RoadDifference:
    """How far apart A and B place the pixel in which A sees the road straight ahead at a distance."""

    distance_m: float
    pixel: tuple[float, float]
    apart_m: float
    sigma_m: float | None

    @property
    def sigmas(self) -> float | None:
        """How many combined sigmas that is."""
        return _in_sigmas(self.apart_m, self.sigma_m, self.distance_m)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """All differences between A and B; what one of them does not hold is None or empty."""

    lens: tuple[Difference, ...]
    """Focal length, principal point x and y, and k1 and k2 where both are of one kind."""
    lens_px: float
    """Largest distance between the images of one direction in the two lenses."""
    rays: RayDifference
    rays_turned: RayDifference
    """After the best rotation between the two."""
    turned_deg: float
    """The angle of that rotation."""
    pose: tuple[Difference, ...] = ()
    """Tilt, roll, and height where both are in metres."""
    normal_deg: float | None = None
    """Angle between the two normals of the road in the camera."""
    road: tuple[RoadDifference, ...] = ()
    stated: tuple[bool, bool] = (True, True)
    """Whether A and B state standard deviations."""
    notes: tuple[str, ...] = ()
    """What was not compared, and why."""

    @property
    def same_lens(self) -> bool:
        """Whether the lenses serve every consumer alike, whatever their numbers."""
        return self.lens_px <= SAME_LENS_PX

    def judged(self) -> list[tuple[str, float | None]]:
        """Return what the verdict goes by, with how many sigmas each is; None where nothing tells."""
        lens = [*((item.name, item.sigmas) for item in self.lens)]
        if self.rays_turned.sigma_deg is not None:
            lens.append(('the shape of the lens', self.rays_turned.sigmas))
        return ([] if self.same_lens else lens) + [(item.name, item.sigmas) for item in self.pose] + [
            (f'the road {item.distance_m:g} m ahead', item.sigmas) for item in self.road if item.sigma_m is not None]

    @property
    def agrees(self) -> bool | None:
        """Whether everything is within AGREES_SIGMAS; None where nothing tells."""
        sigmas = [sigmas for _, sigmas in self.judged()]
        if any(value is not None and value > AGREES_SIGMAS for value in sigmas):
            return False
        return None if None in sigmas else True

    def verdict(self) -> str:
        """Say it in one sentence."""
        what = 'The calibrations' if self.pose else 'The lenses'
        if self.agrees is None:
            return (f'Whether {what.lower()} agree cannot be told: neither states standard deviations, and the lenses'
                    f' are up to {self.lens_px:.3g} px apart.')
        if self.agrees:
            largest, sigmas = max(self.judged(), key=lambda pair: pair[1], default=('', 0.0))
            far = f'; farthest apart is {largest}, {sigmas:.1f} sigmas' if largest else (
                f': up to {self.lens_px:.2g} px apart')
            return f'{what} agree within {AGREES_SIGMAS:g} combined sigmas{far}.'
        beyond = [f'{name} ({_sigmas_words(sigmas)})' for name, sigmas in self.judged()
                  if sigmas is not None and sigmas > AGREES_SIGMAS]
        return f'{what} differ in {_listed(beyond)}.'


def _in_sigmas(apart: float, sigma: float | None, size: float) -> float | None:
    if apart <= SAME_NUMBER * size:
        return 0.0
    if sigma is None:
        return None
    return apart / sigma if sigma > 0 else math.inf


def _sigmas_words(sigmas: float) -> str:
    return f'{sigmas:.1f} sigmas' if math.isfinite(sigmas) else 'both exact'


def _listed(parts: list[str]) -> str:
    return parts[0] if len(parts) == 1 else f'{", ".join(parts[:-1])} and {parts[-1]}'

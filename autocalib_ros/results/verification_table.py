"""The verification of a calibration as a table: what was checked, its value, its limit, and whether it passed.

A row is made by `verified`, which takes the kind, the value and the limit. A check that fails without a refusal has
cost something: it widened the standard deviations or lowered the grade, and the text of the kind says which.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class VerifiedQuantity:
    """One quantity that is compared with a limit."""

    name: str
    """What is compared, in words."""
    unit: str
    """'%' for a fraction, 'degrees', 'px', or 'sigma': standard deviations of a difference."""
    cost: str
    """What a failure costs."""
    at_least: bool = False
    """Whether the limit is the smallest value that passes, and not the largest."""


REFUSED = 'no calibration'
NO_PLANE = 'no ground plane'
CONTRADICTED = 'grade fair at most'
UNTESTED = 'no grade full'
DOUBTED = 'grade coarse at most'
WIDENED = 'wider standard deviations'

VERIFIED_QUANTITIES: dict[str, VerifiedQuantity] = {
    'focal_sigma': VerifiedQuantity('standard deviation of the focal length', '%', REFUSED),
    'plane_sigma': VerifiedQuantity('standard deviation of tilt or roll, the larger', 'degrees', NO_PLANE),
    'height_sigma': VerifiedQuantity('standard deviation of the camera height', '%', NO_PLANE),
    'given_focal': VerifiedQuantity(
        'given focal length or field of view against what the road shows', 'sigma', CONTRADICTED
    ),
    'known_lengths': VerifiedQuantity('known lengths against each other', 'sigma', CONTRADICTED),
    'dash_period': VerifiedQuantity('period of dashes far away against near ones', 'sigma', CONTRADICTED),
    'steady_speed': VerifiedQuantity('speed of the traffic far away against nearby', 'sigma', CONTRADICTED),
    'vehicle_size': VerifiedQuantity('size of the vehicles against the usual one', '%', DOUBTED),
    'usual_speed': VerifiedQuantity('median speed against the fastest usual one', '%', DOUBTED),
    'usual_lanes': VerifiedQuantity('width of the lanes below usual ones', '%', DOUBTED),
    'usual_dashes': VerifiedQuantity('period of dashes below usual ones', '%', DOUBTED),
    'below_horizon': VerifiedQuantity('tracked points below the horizon', '%', REFUSED, at_least=True),
    'straight_share': VerifiedQuantity('vehicles that follow the roads', '%', REFUSED, at_least=True),
    'k1_prior': VerifiedQuantity('k1 against its lens family', 'sigma', REFUSED),
    'lens_family': VerifiedQuantity(
        'vehicles that follow roads through a lens of another family, more than through the stated one',
        'sigma',
        REFUSED,
    ),
    'principal_point_prior': VerifiedQuantity(
        'principal point against the centre of the picture', 'sigma', CONTRADICTED
    ),
    'halves_share': VerifiedQuantity('share of vehicles on the roads, earlier against later traffic', 'sigma', REFUSED),
    'halves_roads': VerifiedQuantity(
        'share of vehicles on each road, earlier against later traffic', 'sigma', CONTRADICTED
    ),
    'halves_focal': VerifiedQuantity('focal length, earlier against later traffic', '%', REFUSED),
    'halves_normal': VerifiedQuantity('ground normal, earlier against later traffic', 'degrees', REFUSED),
    'halves_pose': VerifiedQuantity('focal length and rotation, earlier against later traffic', 'sigma', REFUSED),
    'tracklets': VerifiedQuantity('turning vehicles over seconds against between two instants', 'sigma', WIDENED),
    'lane_markings': VerifiedQuantity(
        'probability that traffic and lane markings are both right', '%', CONTRADICTED, at_least=True
    ),
    'markings_and_traffic_normal': VerifiedQuantity('ground normal, lane markings against traffic', 'degrees', REFUSED),
    'markings_and_traffic_road': VerifiedQuantity(
        'direction of the road, lane markings against traffic', 'degrees', REFUSED
    ),
    'single_road': VerifiedQuantity(
        'plane by further roads or turning traffic against by a single road', 'degrees', CONTRADICTED
    ),
    'edges_and_level': VerifiedQuantity('plane by vehicle edges against by a level camera', 'degrees', NO_PLANE),
    'lane_changes': VerifiedQuantity('plane by lane changes against the assumed plane', 'degrees', NO_PLANE),
    'pixel_aspect': VerifiedQuantity('pixel aspect against the one by the traffic', 'sigma', WIDENED),
    'given_lens_sigma': VerifiedQuantity(
        'standard deviation of the focal length by the traffic, which tests the given one', '%', UNTESTED
    ),
    'given_lens': VerifiedQuantity('given focal length against the one by the traffic', '%', CONTRADICTED),
    'given_curve': VerifiedQuantity(
        'given focal length against the one by the traffic with k1 free, too', '%', CONTRADICTED
    ),
}
"""Every quantity of a verification, by its kind."""


@dataclass(frozen=True)
class VerificationRow:
    """One check of a calibration."""

    kind: str
    """Key of `VERIFIED_QUANTITIES`, or of those of a newer version."""
    value: float | None
    """None if it cannot be computed; such a check has failed."""
    limit: float
    passed: bool

    @property
    def _quantity(self) -> VerifiedQuantity:
        return VERIFIED_QUANTITIES.get(self.kind, VerifiedQuantity(self.kind, '', ''))

    @property
    def name(self) -> str:
        """What is compared, in words."""
        return self._quantity.name

    @property
    def value_text(self) -> str:
        """The value with its unit."""
        return 'unknown' if self.value is None else _with_unit(self.value, self._quantity.unit)

    @property
    def limit_text(self) -> str:
        """The limit with its unit, and on which side of it a value passes."""
        side = 'at least' if self._quantity.at_least else 'at most'
        return f'{side} {_with_unit(self.limit, self._quantity.unit)}'

    @property
    def lowers_grade(self) -> bool:
        """Whether the check failed and thereby costs grade full."""
        return not self.passed and self._quantity.cost in (CONTRADICTED, UNTESTED, DOUBTED)

    @property
    def highest_grade(self) -> str:
        """The highest grade that the check leaves."""
        if not self.lowers_grade:
            return 'full'
        return 'coarse' if self._quantity.cost == DOUBTED else 'fair'

    @property
    def contradicts(self) -> bool:
        """Whether the check failed because two sources, or a source and its prior, contradict each other."""
        return not self.passed and self._quantity.cost in (CONTRADICTED, DOUBTED)

    @property
    def outcome(self) -> str:
        """'passed', or 'failed' with what that cost."""
        cost = self._quantity.cost
        return 'passed' if self.passed else f'failed: {cost}' if cost else 'failed'

    def __str__(self) -> str:
        return f'{self.name} {self.value_text} ({self.limit_text}): {self.outcome}'


def verified(kind: str, value: float, limit: float) -> VerificationRow:
    """Return the row of a comparison; a value that is not finite fails."""
    quantity, value, limit = VERIFIED_QUANTITIES[kind], float(value), float(limit)
    if not math.isfinite(value):
        return VerificationRow(kind, None, limit, False)
    return VerificationRow(kind, value, limit, value >= limit if quantity.at_least else value <= limit)


def summarise_verification(rows: Sequence[VerificationRow]) -> str:
    """Return how many checks passed and which failed, on one line; '' without any."""
    failed = [str(row) for row in rows if not row.passed]
    if not rows:
        return ''
    counts = f'{len(rows) - len(failed)} of {len(rows)} checks passed'
    return '; '.join([counts, *failed])


def _with_unit(value: float, unit: str) -> str:
    return f'{100.0 * value:.3g} %' if unit == '%' else f'{value:.3g} {unit}'.rstrip()

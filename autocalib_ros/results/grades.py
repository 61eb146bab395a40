"""The grade of a calibration: how certain lengths on the road are."""

from __future__ import annotations

from dataclasses import dataclass

GRADE_LIMITS = {'full': 0.03, 'fair': 0.10, 'coarse': 0.25}
"""Largest relative standard deviation of a length on the road, along or across the view, of each grade."""
GRADES = ('lens', 'unit_scale', 'assumed', *reversed(GRADE_LIMITS))
"""All grades in ascending order: no ground plane, a plane without metres, and metric planes by their certainty."""


@dataclass(frozen=True)
class GroundSigma:
    """Relative standard deviation of a short length on the road some way ahead of the camera."""

    along: float
    """Of a length along the direction of view."""
    across: float
    """Of a length across it."""

    @property
    def worst(self) -> float:
        """The larger of the two."""
        return max(self.along, self.across)

    @property
    def grade(self) -> str:
        """The grade that this certainty allows."""
        return next((grade for grade, limit in GRADE_LIMITS.items() if self.worst <= limit), 'assumed')

    def __str__(self) -> str:
        return f'lengths along the view ± {100 * self.along:.2g} %, across it ± {100 * self.across:.2g} %'


@dataclass(frozen=True)
class HelpfulMeasure:
    """The one further measure that would make lengths on the road most certain, with what to expect of it."""

    kind: str
    """Key of `MEASURES`."""
    expected: float
    """The larger relative standard deviation of lengths on the road with it."""

    @property
    def text(self) -> str:
        """The measure in words, with the certainty to expect."""
        return f'{MEASURES.get(self.kind, self.kind)} (lengths then ± {100 * self.expected:.2g} %)'


MEASURES = {
    'focal': 'the focal length or field of view of the lens to 5 % (--focal-px, --hfov-deg)',
    'height': 'the camera height to 2 % (--camera-height)',
    'length_along': 'a length of some metres along the view on the road to 2 % (--distance, or --dash-period)',
    'length_across': 'a length of some metres across the view on the road to 2 % (--distance, or --lane-width)',
    'roll': 'the roll of the camera to 1 degree (--roll-sigma-deg 1 for a level camera)',
}
"""Measures that a person can give, in words, by their kind."""


def rank_of(grade: str) -> int:
    """Return the rank of a grade, -1 for one that is not known."""
    return GRADES.index(grade) if grade in GRADES else -1

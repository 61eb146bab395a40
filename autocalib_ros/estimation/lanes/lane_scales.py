"""Sources of scale from the pattern of lane lines, for a width and a period that are told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.config import LaneOptions, ScaleOptions
from autocalib_ros.estimation.lanes.lane_dashes import LanePattern
from autocalib_ros.estimation.lanes.lane_spacing import LaneSpacing
from autocalib_ros.estimation.lanes.lane_standards import LANE_STANDARDS
from autocalib_ros.estimation.verification.scale import HeightFunction, Scale
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.statements import Value

TOLD_WIDTH_SIGMA, TOLD_PERIOD_SIGMA = 0.04, 0.02
"""Relative standard deviations of a lane width and of a dash period that are told without one, and of the periods that
countries prescribe: what is painted differs from what is ordered. Judgement."""
MIN_PERIOD_RATIO = 1.15
"""The prescribed period that fits best has to be nearer than the next one by this factor, or none is taken."""
DASH_SHARE_FACTORS = (0.7, 1.9)
"""Range of the measured length of a dash in units of the period over the prescribed one: bars end at half of their
contrast, and blur lengthens them: 1.0 to 1.1 times on two rendered roads and one real one. Where every other dash is
missed it is half of that; the lower bound is the geometric mean of 1 and a half. Where the period is halved, it is 2
or more."""
ANY_DASH_SHARES = (0.12, 0.8)
"""Range where no dash is prescribed: from 0.7 times 1 m of 6 m, to warning lines of 4 m of 6 m with blur. Less is a
multiple of the period, more is joints and seams."""


@dataclass(frozen=True)
class ToldLanes:
    """What is known of the lanes: by the user, or by his country."""

    width_m: float
    """0 if nothing is known."""
    width_sigma_m: float
    periods_m: tuple[float, ...]
    """Periods that may be; empty if nothing is known."""
    dash_shares: tuple[float, ...]
    """Length of a dash in units of each of these periods; empty if it is not known."""
    period_sigma: float
    """Relative standard deviation."""
    source: str
    """'given', or the country."""

    @classmethod
    def of(cls, options: LaneOptions) -> ToldLanes:
        """Return what the options say; what is given as a number replaces what the country prescribes."""
        standard = LANE_STANDARDS.get(options.country)
        width, sigma = options.width_m, options.width_sigma_m or TOLD_WIDTH_SIGMA * options.width_m
        if width <= 0 and standard is not None:
            width, sigma = standard.width_m, standard.width_sigma_m
        periods = () if standard is None else standard.periods_m
        shares = () if standard is None else tuple(np.divide(standard.dashes_m, standard.periods_m).tolist())
        relative = TOLD_PERIOD_SIGMA
        if options.dash_period_m > 0:
            periods, shares = (options.dash_period_m,), ()
            relative = options.dash_period_sigma_m / options.dash_period_m or TOLD_PERIOD_SIGMA
        numbers = options.width_m > 0 or options.dash_period_m > 0
        return cls(width, sigma, periods, shares, relative, 'given' if numbers else options.country)


def lane_scales(
    pattern: LanePattern | None, told: ToldLanes, camera: Camera, normal: np.ndarray, others: list[Scale]
) -> list[Scale]:
    """Return the scales that follow from the lanes; none without a pattern, or where nothing is told.

    Of several prescribed periods the one is taken that fits the `others` best, or else the width of the lanes. None is
    taken where the period found may be a multiple of the prescribed one by the length of the dashes, or where lines of
    a second period are about and nothing else tells which of the two is meant.
    """
    if pattern is None:
        return []
    found = [_of_width(pattern, told, camera, normal)] if pattern.has_width and told.width_m > 0 else []
    expected = [source.height(camera, normal) for source in (others or found)]
    period_m = _fitting(pattern, told, (camera, normal), expected)
    return found if period_m is None else [*found, _of_period(pattern, told, period_m, camera, normal)]


def spacing_scales(
    spacing: LaneSpacing | None, told: ToldLanes, options: ScaleOptions, camera: Camera, normal: np.ndarray
) -> list[Scale]:
    """Return the scale by lines or vehicles at equal spacing; none without them, or where no width is told.

    Points of vehicles are above the road, so that their spacing gives the height of the camera above them.
    """
    if spacing is None or told.width_m <= 0:
        return []
    above, above_sigma = (options.point_height_m, options.point_height_sigma_m) if spacing.raised else (0.0, 0.0)
    relative = float(np.hypot(told.width_sigma_m / told.width_m, spacing.sigma))
    over = told.width_m / spacing.width(camera, normal)
    values: dict[str, Value] = {
        'width_m': told.width_m,
        'width_sigma_m': told.width_sigma_m,
        'places': len(spacing.places_px),
        'source': told.source,
        'of': spacing.kind,
    }
    return [
        Scale(
            lambda lens, up: told.width_m / spacing.width(lens, up) + above,
            float(np.hypot(relative * over, above_sigma)),
            True,
            'scale_lanes',
            values,
            derived=True,
        )
    ]


def _fitting(
    pattern: LanePattern, told: ToldLanes, at: tuple[Camera, np.ndarray], heights: list[float]
) -> float | None:
    """Return the told period that fits the one measured best; None if another pair of the two fits about as well."""
    measured, share = pattern.period(*at), pattern.dash_share(*at)
    if not ANY_DASH_SHARES[0] < share < ANY_DASH_SHARES[1]:
        return None
    rivals = (1.0, pattern.rival) if pattern.rival else (1.0,)
    pairs = [(index, ratio) for index in range(len(told.periods_m)) for ratio in rivals]
    if not pairs or (len(pairs) > 1 and not heights):
        return None
    if len(pairs) > 1:
        height = float(np.exp(np.mean(np.log(heights))))
        off = [abs(float(np.log(told.periods_m[index] / (measured * ratio * height)))) for index, ratio in pairs]
        first, second = np.argsort(off)[:2].tolist()
        pairs = [pairs[first]] if off[second] - off[first] > np.log(MIN_PERIOD_RATIO) else []
    low, high = DASH_SHARE_FACTORS
    for index, ratio in pairs:
        if ratio == 1.0 and (not told.dash_shares or low < share / told.dash_shares[index] < high):
            return told.periods_m[index]
    return None


def _of_width(pattern: LanePattern, told: ToldLanes, camera: Camera, normal: np.ndarray) -> Scale:
    return _scale(
        'scale_lanes',
        lambda lens, up: told.width_m / pattern.width(lens, up),
        float(np.hypot(told.width_sigma_m / told.width_m, pattern.width_sigma)),
        (camera, normal),
        {
            'width_m': told.width_m,
            'width_sigma_m': told.width_sigma_m,
            'places': len(pattern.beside),
            'source': told.source,
        },
    )


def _of_period(pattern: LanePattern, told: ToldLanes, period_m: float, camera: Camera, normal: np.ndarray) -> Scale:
    return _scale(
        'scale_dashes',
        lambda lens, up: period_m / pattern.period(lens, up),
        float(np.hypot(told.period_sigma, pattern.period_sigma)),
        (camera, normal),
        {
            'period_m': period_m,
            'period_sigma_m': told.period_sigma * period_m,
            'spacings': pattern.spacings,
            'source': told.source,
        },
    )


def _scale(
    kind: str, height: HeightFunction, relative: float, at: tuple[Camera, np.ndarray], values: dict[str, Value]
) -> Scale:
    return Scale(height, relative * height(*at), True, kind, values, derived=True)

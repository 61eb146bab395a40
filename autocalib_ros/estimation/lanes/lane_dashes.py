"""Dashes of lane lines: those that repeat along the road, and how far it is from one to the next.

Bars on the road that point along it are followed from each to the next one ahead. A period repeats: a spacing counts
only if the one before or after it on its line is alike, and if nothing is painted between its ends. The stripes of two
crosswalks are as far apart in every column, but nothing follows them. If many of the spacings that are left are alike,
they are the period of the dashes; a plane in which they are alike near and far is the right one. The period is found
by a mixture of one spacing, its multiples where dashes are hidden, and any other ones, over all planes that the
uncertainty of the plane allows. A second period that is no multiple of the first is a rival.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.lanes.period_mixture import (
    MAX_GAP_HEIGHTS,
    MIN_PERIODIC_SPACINGS,
    PERIOD_PAINT_SIGMA,
    SAME_PERIOD,
    one_period,
)
from autocalib_ros.estimation.markings.road_segments import (
    MAX_DISTANCE_TO_TRAFFIC,
    all_within,
    sample_segments,
    traffic_cells,
)
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import ahead_direction, ground_points
from autocalib_ros.lens.camera import Camera

MIN_DASH_DEPRESSION_SINE = 0.03
"""Least sine of the depression angle of a dash, 33 camera heights away: beyond it a pixel is longer than a dash."""
MAX_DASH_SLOPE = 0.12
"""Largest slope of a bar against the road on the ground: a bend of 7 degrees, or the width of a short bar."""
MIN_GAP_LENGTHS = 0.7
"""Least spacing from a bar to the next, in units of the sum of their lengths: dashes do not touch. Judgement."""
MAX_ASIDE_HEIGHTS, MAX_ASIDE_SLOPE = 0.05, 0.03
"""Largest distance of the next bar from the line that a bar continues, camera heights, and per unit of the spacing:
the width of a line, and a bend within one spacing."""
MAX_REPEAT_CHANGE = 0.3
"""Largest difference of the logarithms of two spacings in a row that are one period: less than that of a spacing and
its double or half, 0.69, by a factor of two."""
REPEAT_SIGMAS = 2.0
"""As `MAX_REPEAT_CHANGE` beyond `SAME_PERIOD`, standard deviations of both spacings."""
MIN_STARTS, SAME_START = 3, 0.2
"""Fewest places along the road at which spacings begin, and distance of two places in units of the period: two
crosswalks and what is by chance behind them give two, however many stripes they have."""
MAX_LENGTH_RATIO, MAX_CONTRAST_RATIO = 2.2, 3.3
"""Largest ratio of length and of contrast of a dash and the next. Judgement."""
DASH_PLACE_SIGMA = 5.5e-4
"""Standard deviation of the place of a dash in the image, fraction of its width: 0.7 px of 1280."""
MIN_SPACING_SIGMA = 0.03
"""Least standard deviation of the logarithm of a spacing: dashes are repainted over older ones. Judgement."""
PITCH_STEP_RAD, PITCH_SIGMAS, MIN_PITCH_SIGMA_RAD = np.radians(0.25), 3.0, np.radians(0.5)
"""Planes that are tried: turned about the direction across the road in such steps, within so many standard deviations
of the plane, which is at least that of the grade along a road."""
MAX_PITCH_RAD = np.radians(6.0)
SLOPE_SIGMA = 0.03
"""Standard deviation of the change of a period by the logarithm of the distance that no spread shows: sag and crest of
the road. Judgement."""
MIN_DISTANCE_SPREAD = 0.15
"""Least standard deviation of the log distances of spacings that show a change with distance."""
LANE_RANGE = (0.15, 0.75)
"""Width of a lane in units of the period: 3 m of 18 m to 3.75 m of 6 m, and a fifth more."""
MIN_LANES_SEEN = 4
"""Fewest pairs of dashes side by side that measure the width. Judgement."""


@dataclass(frozen=True)
class MeanLog:
    """Weighted mean of logarithms, with its standard deviation for the given lens and plane."""

    mean: float
    sigma: float


@dataclass(frozen=True)
class LanePattern:
    """Dashes on the road, as a function of lens and plane; lengths are in camera heights."""

    along: np.ndarray
    """Direction of the road, camera frame, shape (3,)."""
    dashes_px: np.ndarray
    """Ends of the dashes x0, y0, x1, y1, shape (n, 4)."""
    successive: np.ndarray
    """Indices of a dash and of the next one along its line, shape (m, 2)."""
    spacing_weights: np.ndarray
    """Inverse variances of the log spacings, times the probability that they are one period, shape (m,)."""
    period_sigma: float
    """Standard deviation of the log period for exact lens and plane."""
    rival: float
    """Ratio of a second period, of other lines, to this one; 0 if there is none."""
    beside: np.ndarray
    """Indices of a dash and of the nearest one in the next line to its left, shape (k, 2); empty if it is not known."""
    beside_weights: np.ndarray
    """As `spacing_weights`, shape (k,)."""
    width_sigma: float
    """Standard deviation of the log width of a lane for exact lens and plane; infinite if it is not known."""

    @property
    def spacings(self) -> int:
        """Number of spacings that are one period."""
        return int(np.count_nonzero(self.spacing_weights * MIN_SPACING_SIGMA**2 > 0.05))

    @property
    def has_width(self) -> bool:
        """Whether the width of the lanes is known."""
        return len(self.beside) > 0

    def period(self, camera: Camera, normal: np.ndarray) -> float:
        """Return the period of the dashes, camera heights."""
        places = on_road(camera, normal, self.along, self.dashes_px)
        logs, _ = _spacings(places, self.successive)
        return float(np.exp(self.spacing_weights @ logs / self.spacing_weights.sum()))

    def dash_share(self, camera: Camera, normal: np.ndarray) -> float:
        """Return the length of a dash in units of the period; blur makes it too large by up to a half."""
        ways = np.diff(on_road(camera, normal, self.along, self.dashes_px), axis=1)[:, 0]
        lengths = np.log(np.maximum(np.hypot(*ways.T), 1e-6))[self.successive[:, 0]]
        return float(np.exp(_weighted(lengths, self.spacing_weights)) / self.period(camera, normal))

    def width(self, camera: Camera, normal: np.ndarray) -> float:
        """Return the width of a lane, camera heights."""
        offsets = _offsets(on_road(camera, normal, self.along, self.dashes_px), self.beside)
        logs = np.log(np.maximum(np.abs(offsets), 1e-6))
        return float(np.exp(self.beside_weights @ logs / self.beside_weights.sum()))

    def change_with_distance(self, camera: Camera, normal: np.ndarray) -> MeanLog | None:
        """Return the change of the log period by the log distance, which is 0; None if all dashes are equally far."""
        logs, distances = _spacings(on_road(camera, normal, self.along, self.dashes_px), self.successive)
        weights, away = self.spacing_weights, np.log(np.maximum(distances, 1e-6))
        total = weights.sum()
        away = away - weights @ away / total
        spread = weights @ (away * away)
        if spread / total < MIN_DISTANCE_SPREAD**2:
            return None
        return MeanLog(float(weights @ (away * logs) / spread), float(np.hypot(spread**-0.5, SLOPE_SIGMA)))


def measure_lanes(
    evidence: Evidence, camera: Camera, normal: np.ndarray, along: np.ndarray, sigma_rad: float
) -> LanePattern | None:
    """Measure the dashes on a road along `along` (3,) in the plane of upward normal (3,); None if there are none.

    `sigma_rad` is the standard deviation of the plane.
    """
    dashes = bars_near_traffic(evidence, camera, normal)
    places = on_road(camera, normal, along, dashes[:, :4])
    dashes, places = _sorted_along(dashes, places)
    pairs = _successive(places, dashes[:, 4])
    if len(pairs) < MIN_PERIODIC_SPACINGS:
        return None
    noise = _spacing_sigmas(evidence, camera, normal, along, dashes, pairs)
    repeated = _repeated(_spacings(places, pairs)[0], noise, pairs)
    pairs, noise = pairs[repeated], noise[repeated]
    if len(pairs) < MIN_PERIODIC_SPACINGS:
        return None
    ahead = along - (along @ normal) * normal
    ahead /= np.linalg.norm(ahead)
    reach = min(PITCH_SIGMAS * max(sigma_rad, MIN_PITCH_SIGMA_RAD), MAX_PITCH_RAD)
    pitches = PITCH_STEP_RAD * np.arange(-(reach // PITCH_STEP_RAD), reach // PITCH_STEP_RAD + 1)
    logs = np.array(
        [
            _spacings(on_road(camera, np.cos(turn) * normal + np.sin(turn) * ahead, along, dashes[:, :4]), pairs)[0]
            for turn in pitches.tolist()
        ]
    )
    prior = -0.5 * (pitches / max(sigma_rad, MIN_PITCH_SIGMA_RAD)) ** 2
    found = one_period(logs, noise, prior)
    if found is None:
        return None
    probable, sigma, rival = found
    period, periodic = np.exp(_weighted(logs[len(pitches) // 2], probable)), pairs[probable > 0.5]
    starts = np.sort(places[periodic[:, 0], 0, 0])
    if 1 + np.count_nonzero(np.diff(starts) > SAME_START * period) < MIN_STARTS:
        return None
    width = _lane_width(places, periodic, period)
    beside, beside_weights, width_sigma = width or (np.zeros((0, 2), int), np.zeros(0), np.inf)
    return LanePattern(
        along, dashes[:, :4], pairs, probable / noise**2, sigma, rival, beside, beside_weights, float(width_sigma)
    )


def _weighted(values: np.ndarray, weights: np.ndarray) -> float:
    return float(weights @ values / weights.sum())


def bars_near_traffic(evidence: Evidence, camera: Camera, normal: np.ndarray) -> np.ndarray:
    """Return the bars (n, STRIPE_COLUMNS) below the horizon and near traffic."""
    bars = evidence.stripes_px
    if not len(bars) or not len(evidence.points_px):
        return bars[:0]
    bearings, valid = camera.unproject(bars[:, :4].reshape(-1, 2))
    below = valid & (bearings @ normal < -MIN_DASH_DEPRESSION_SINE)
    bars = bars[below.reshape(-1, 2).all(axis=1)]
    reach = MAX_DISTANCE_TO_TRAFFIC * evidence.image_size[0]
    return bars[all_within(sample_segments(bars[:, :4]), traffic_cells(evidence), reach)] if len(bars) else bars


def on_road(camera: Camera, normal: np.ndarray, along: np.ndarray, ends_px: np.ndarray) -> np.ndarray:
    """Return the ends (n, 2, 2) of segments (n, 4) on the road: along it and to its left, camera heights."""
    places = ground_points(camera, normal, 1.0, ends_px.reshape(-1, 2))
    ahead = ahead_direction(normal)
    way = np.array([along @ ahead, along @ np.cross(normal, ahead)])
    way = way / np.linalg.norm(way) * (np.sign(way[0]) or 1.0)
    return np.column_stack([places @ way, places @ [-way[1], way[0]]]).reshape(-1, 2, 2)


def _sorted_along(dashes: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bars that point along the road, with the nearer end first."""
    swapped = places[:, 0, 0] > places[:, 1, 0]
    dashes, places = dashes.copy(), places.copy()
    dashes[swapped] = dashes[swapped][:, [2, 3, 0, 1, 4]]
    places[swapped] = places[swapped][:, ::-1]
    way = places[:, 1] - places[:, 0]
    along = (np.abs(way[:, 1]) < MAX_DASH_SLOPE * way[:, 0]) & (way[:, 0] < 0.5 * MAX_GAP_HEIGHTS)
    return dashes[along], places[along]


def _successive(places: np.ndarray, contrast: np.ndarray) -> np.ndarray:
    """Return the indices (m, 2) of each bar that has a next one along its line, and of that."""
    if not len(places):
        return np.zeros((0, 2), int)
    middle, way = places.mean(axis=1), places[:, 1] - places[:, 0]
    length, slope = np.hypot(*way.T), way[:, 1] / np.maximum(way[:, 0], 1e-6)
    gap = middle[:, 0] - middle[:, 0][:, None]
    aside = middle[:, 1] - middle[:, 1][:, None] - 0.5 * gap * (slope + slope[:, None])
    on_line = np.abs(aside) < MAX_ASIDE_HEIGHTS + MAX_ASIDE_SLOPE * np.abs(gap)
    next_one = on_line & (gap > MIN_GAP_LENGTHS * (length + length[:, None])) & (gap < MAX_GAP_HEIGHTS)
    next_one &= np.abs(np.log(length / length[:, None])) < np.log(MAX_LENGTH_RATIO)
    next_one &= np.abs(np.log(contrast / contrast[:, None])) < np.log(MAX_CONTRAST_RATIO)
    nearest = np.where(next_one, gap, np.inf).argmin(axis=1)
    has = next_one.any(axis=1)
    pairs = np.column_stack([np.flatnonzero(has), nearest[has]])
    one, other = pairs.T
    # another bar wholly between the two: a dash of other contrast or length, so that the spacing may be two periods
    between = (places[:, 0, 0] > places[one, 1, 0][:, None]) & (places[:, 1, 0] < places[other, 0, 0][:, None])
    return pairs[~(between & on_line[one] & on_line[:, other].T).any(axis=1)]


def _repeated(logs: np.ndarray, noise: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the mask (m,) of the spacings that a spacing alike follows or precedes on the same line."""
    one, next_one = np.nonzero(pairs[:, 1][:, None] == pairs[:, 0])
    limit = np.minimum(SAME_PERIOD + REPEAT_SIGMAS * np.hypot(noise[one], noise[next_one]), MAX_REPEAT_CHANGE)
    alike = np.abs(logs[one] - logs[next_one]) < limit
    return np.isin(np.arange(len(pairs)), np.concatenate([one[alike], next_one[alike]]))


def _spacings(places: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the log spacings (m,) of pairs of bars, and how far along the road they are (m,)."""
    middle = places.mean(axis=1)
    one, other = middle[pairs[:, 0]], middle[pairs[:, 1]]
    return np.log(np.maximum(np.hypot(*(other - one).T), 1e-6)), np.linalg.norm(0.5 * (one + other), axis=1)


def _spacing_sigmas(
    evidence: Evidence, camera: Camera, normal: np.ndarray, along: np.ndarray, dashes: np.ndarray, pairs: np.ndarray
) -> np.ndarray:
    """Return the standard deviations (m,) of the log spacings, from the place of the dashes in the image."""
    ends = dashes[:, :4]
    middle = on_road(camera, normal, along, ends).mean(axis=1)
    step = DASH_PLACE_SIGMA * evidence.image_size[0]
    way = ends[:, 2:] - ends[:, :2]
    moved = ends + np.tile(step * way / np.linalg.norm(way, axis=1, keepdims=True), 2)
    by_step = np.hypot(*(on_road(camera, normal, along, moved).mean(axis=1) - middle).T)
    spacing = np.hypot(*(middle[pairs[:, 1]] - middle[pairs[:, 0]]).T)
    return np.hypot(MIN_SPACING_SIGMA, np.hypot(by_step[pairs[:, 0]], by_step[pairs[:, 1]]) / spacing)


def _lane_width(places: np.ndarray, pairs: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Return pairs of dashes side by side (k, 2), their weights (k,) and the standard deviation of the log width.

    Of the dashes of `pairs`, whose spacing is one period. None if too few lie side by side at one distance.
    """
    dashes = np.unique(pairs)
    middle = places[dashes].mean(axis=1)
    gap = np.abs(middle[:, 0] - middle[:, 0][:, None])
    index = np.stack(np.meshgrid(dashes, dashes, indexing='ij'), axis=-1)
    offset = _offsets(places, index.reshape(-1, 2)).reshape(gap.shape)
    near = (gap < 0.6 * period) & (offset > LANE_RANGE[0] * period) & (offset < LANE_RANGE[1] * period)
    nearest = np.where(near, offset, np.inf).argmin(axis=1)
    has = near.any(axis=1)
    if np.count_nonzero(has) < MIN_LANES_SEEN:
        return None
    beside = np.column_stack([dashes[has], dashes[nearest[has]]])
    logs = np.log(offset[np.flatnonzero(has), nearest[has]])
    sigma = 2.0 * MIN_SPACING_SIGMA
    votes = np.exp(-0.5 * ((logs - logs[:, None]) / sigma) ** 2)
    alike = votes[np.argmax(votes.sum(axis=1))]
    if np.count_nonzero(alike > 0.3) < MIN_LANES_SEEN or alike.sum() < 0.5 * len(alike):
        return None
    return beside, alike / sigma**2, float(np.hypot(sigma / alike.sum() ** 0.5, PERIOD_PAINT_SIGMA))


def _offsets(places: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return how far to the left the second bar of each pair lies from the line of both directions, shape (n,)."""
    way = places[:, 1] - places[:, 0]
    middle = places.mean(axis=1)
    common = way[pairs[:, 0]] + way[pairs[:, 1]]
    common = common / np.maximum(np.linalg.norm(common, axis=1, keepdims=True), 1e-9)
    apart = middle[pairs[:, 1]] - middle[pairs[:, 0]]
    return np.asarray(common[:, 0] * apart[:, 1] - common[:, 1] * apart[:, 0])

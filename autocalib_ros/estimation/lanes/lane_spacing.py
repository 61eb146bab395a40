"""Lines along a road, or lanes of its vehicles, at equal spacing: the width of a lane where dashes do not show it.

A single distance between two lines may be a shoulder or a whole carriageway, and one between two rows of vehicles two
lanes. Only a spacing that repeats is a lane: lines, or rows of vehicles of one direction, are at multiples of one width
from each other, with places next to each other taken at least twice. The width is found by a mixture of such places and
of any other ones, over all widths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.lanes.lane_dashes import MAX_DASH_SLOPE, bars_near_traffic, on_road
from autocalib_ros.estimation.lanes.period_mixture import MIN_OTHER_NATS, MIN_PERIOD_NATS, SAME_PERIOD
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.lens.camera import Camera

TRIAL_WIDTHS = np.geomspace(0.1, 1.5, 190)
"""Widths that are tried, camera heights, 1.4 % apart: 2.5 m under a camera 25 m high to 3.75 m under one 2.5 m high."""
PHASES = np.arange(0.0, 1.0, 1.0 / 32)
"""Places of the first line or lane that are tried, in units of the width."""
PLACED_SHARE = 0.8
"""Share of lines or vehicles at multiples of the width; others are kerbs and barriers, or change lanes. Judgement."""
LINE_SCATTERS, VEHICLE_SCATTERS = (0.03, 0.06), (0.09, 0.14)
"""Standard deviations from these places that are tried, in units of the width: 0.1 to 0.2 m of lines, which are as wide
as that, and 0.3 to 0.5 m of vehicles, which keep to the middle of a lane to 0.3 m, seen at one side or at the roof."""
MIN_TAKEN, MIN_STEPS = {'lines': 2, 'vehicles': 3}, 2
"""Fewest bars or vehicles that make a line or a lane, and fewest pairs of neighbours at the spacing. Judgement."""
SPACING_SIGMAS = {'lines': 0.03, 'vehicles': 0.06}
"""Standard deviation of the log width that no scatter shows: paint, and border lines that stand aside; drivers who keep
to one side of their lane, by 0.2 m, and of whom the camera sees another side in each lane. Judgement."""
MIN_BETWEEN = 0.7
"""Least share of vehicles in the middle half between two lines: more than nine tenths drive there, and a half where the
lines are stripes of a crosswalk. Ten vehicles at random are so many in one of ten cases, thirty in one of fifty."""
NEARER_POINTS = 0.9
"""Distance of a point on the road over that at which it is seen, for points a tenth of the camera height above it."""
FARTHEST_LANES_HEIGHTS = 8.0
"""Farthest lines and vehicles, camera heights: farther away a lane is a few pixels wide."""
CROSS_SECTIONS = 12
"""Places along the road of which the one is taken that most vehicles pass."""


@dataclass(frozen=True)
class LaneSpacing:
    """Lines or vehicles at equal spacing across a road, as a function of lens and plane."""

    kind: str
    """'lines' or 'vehicles'."""
    along: np.ndarray
    """Direction of the road, camera frame, shape (3,)."""
    places_px: np.ndarray
    """Where they are in the image, shape (n, 2)."""
    design: np.ndarray
    """What their distance across the road depends on: the number of the lane first, shape (n, p)."""
    sigma: float
    """Standard deviation of the log width for exact lens and plane."""

    @property
    def raised(self) -> bool:
        """Whether the places are of points above the road."""
        return self.kind == 'vehicles'

    def width(self, camera: Camera, normal: np.ndarray) -> float:
        """Return the width of a lane, camera heights; for vehicles heights over the tracked points."""
        offsets = _places(camera, normal, self.along, self.places_px)[:, 1]
        return float(abs(np.linalg.lstsq(self.design, offsets, rcond=None)[0][0]))


def measure_lane_spacing(
    evidence: Evidence, flow: TrackSet, camera: Camera, normal: np.ndarray, along: np.ndarray
) -> LaneSpacing | None:
    """Return lines along a road (3,), or else vehicles of `flow`, at equal spacing; None without either.

    In the plane of upward normal (3,). Vehicles have to drive between the lines.
    """
    passing = _passing(flow, camera, normal, along)
    if passing is None:
        return None
    pixels, sides = passing
    lines = _measure_lines(evidence, camera, normal, along)
    if lines is not None and _drive_between(
        lines, camera, normal, NEARER_POINTS * _places(camera, normal, along, pixels)
    ):
        return lines
    return _spacing('vehicles', along, pixels, _places(camera, normal, along, pixels), sides, VEHICLE_SCATTERS)


def _drive_between(lines: LaneSpacing, camera: Camera, normal: np.ndarray, vehicles: np.ndarray) -> bool:
    """Whether vehicles at places (n, 2) drive between lines, and not on them as on stripes of a crosswalk."""
    offsets = _places(camera, normal, lines.along, lines.places_px)[:, 1]
    width, start, slope = np.linalg.lstsq(lines.design, offsets, rcond=None)[0]
    lanes = (vehicles[:, 1] - start - slope * vehicles[:, 0]) / width
    numbers = lines.design[:, 0]
    lanes = lanes[(lanes > numbers.min()) & (lanes < numbers.max())]
    return len(lanes) > 0 and float(np.mean(np.abs(lanes % 1.0 - 0.5) < 0.25)) >= MIN_BETWEEN


def _measure_lines(evidence: Evidence, camera: Camera, normal: np.ndarray, along: np.ndarray) -> LaneSpacing | None:
    ends = bars_near_traffic(evidence, camera, normal)[:, :4]
    places = on_road(camera, normal, along, ends)
    way = places[:, 1] - places[:, 0]
    kept = (np.abs(way[:, 1]) < MAX_DASH_SLOPE * np.abs(way[:, 0])) & (
        np.abs(places[..., 0]).max(axis=1) < FARTHEST_LANES_HEIGHTS
    )
    middles_px = 0.5 * (ends[kept, :2] + ends[kept, 2:])
    middles = places[kept].mean(axis=1)
    return _spacing('lines', along, middles_px, middles, np.zeros(len(middles), int), LINE_SCATTERS)


def _passing(
    flow: TrackSet, camera: Camera, normal: np.ndarray, along: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return where vehicles pass one place along the road, pixels (n, 2), and their directions of travel (n,)."""
    ways = _places(camera, normal, along, flow.pixels.reshape(-1, 2))[:, 0].reshape(flow.pixels.shape[:2])
    first, last = ways.min(axis=1), ways.max(axis=1)
    near = last < FARTHEST_LANES_HEIGHTS
    if not near.any():
        return None
    sections = np.linspace(first[near].min(), last[near].max(), CROSS_SECTIONS + 2)[1:-1]
    passing = near & (first < sections[:, None]) & (last > sections[:, None])
    best = int(np.argmax(passing.sum(axis=1)))
    chosen = np.flatnonzero(passing[best])
    if not len(chosen):
        return None
    pixels = [_pixel_at(sections[best], ways[track], flow.pixels[track]) for track in chosen.tolist()]
    _, first_of, vehicle = np.unique(flow.vehicles[chosen], return_index=True, return_inverse=True)
    means = np.zeros((len(first_of), 2))
    np.add.at(means, vehicle, pixels)
    sides = (ways[chosen, -1] > ways[chosen, 0]).astype(int)
    return means / np.bincount(vehicle)[:, None], sides[first_of]


def _pixel_at(section: float, ways: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the pixel (2,) of a track (samples, 2) at a place along the road."""
    order = np.argsort(ways)
    return np.array([np.interp(section, ways[order], pixels[order, axis]) for axis in (0, 1)])


def _places(camera: Camera, normal: np.ndarray, along: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the places (n, 2) of pixels (n, 2) on the road: along it and to its left, camera heights."""
    return on_road(camera, normal, along, np.hstack([pixels, pixels]))[:, 0]


def _spacing(
    kind: str, along: np.ndarray, pixels: np.ndarray, places: np.ndarray, sides: np.ndarray, scatters: tuple[float, ...]
) -> LaneSpacing | None:
    """Return what is at equal spacing among `places` (n, 2), of carriageways `sides` (n,); None if nothing is."""
    if len(places) < MIN_TAKEN[kind] * (MIN_STEPS + 1):
        return None
    found = _best_width(places[:, 1], sides, scatters, MIN_TAKEN[kind])
    if found is None:
        return None
    lanes, kept = found
    columns = [lanes, *(sides == side for side in np.unique(sides[kept]))]
    if kind == 'lines':  # the direction of the road may be off by a little
        columns.append(places[:, 0])
    design = np.column_stack(columns).astype(float)[kept]
    solved, _, rank, _ = np.linalg.lstsq(design, places[kept, 1], rcond=None)
    freedom = len(design) - design.shape[1]
    if rank < design.shape[1] or freedom < 1:
        return None
    left = places[kept, 1] - design @ solved
    own = float(np.sqrt(left @ left / freedom * np.linalg.inv(design.T @ design)[0, 0]) / abs(solved[0]))
    return LaneSpacing(kind, along, pixels[kept], design, float(np.hypot(own, SPACING_SIGMAS[kind])))


def _best_width(
    offsets: np.ndarray, sides: np.ndarray, scatters: tuple[float, ...], least: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the lane (n,) of each offset (n,) and the mask (n,) of those at one; None if no width is probable."""
    tried = [_lanes_of(offsets, sides, width, scatter, least) for width in TRIAL_WIDTHS for scatter in scatters]
    every = np.array([each[0] for each in tried])
    best, nats = int(np.argmax(every)), every.reshape(len(TRIAL_WIDTHS), -1).max(axis=1)
    others = np.abs(np.log(TRIAL_WIDTHS / TRIAL_WIDTHS[best // len(scatters)])) > SAME_PERIOD
    if nats.max() < max(MIN_PERIOD_NATS, nats[others].max() + MIN_OTHER_NATS):
        return None
    return tried[best][1:]


def _lanes_of(
    offsets: np.ndarray, sides: np.ndarray, width: float, scatter: float, least: int
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return log likelihood over that of any places, lanes (n,) and the mask (n,) of a width; -inf if it never repeats.

    Places of each side are at multiples of the width from one of their own.
    """
    nats, steps = 0.0, 0
    lanes, kept = np.zeros(len(offsets), int), np.zeros(len(offsets), bool)
    for side in np.unique(sides):
        mine = np.flatnonzero(sides == side)
        off = offsets[mine] / width - PHASES[:, None]
        lane = np.round(off)
        peak = PLACED_SHARE / (scatter * np.sqrt(2 * np.pi)) * np.exp(-0.5 * ((off - lane) / scatter) ** 2)
        logs = np.log(1.0 - PLACED_SHARE + peak).sum(axis=1)
        phase = int(np.argmax(logs))
        nats += float(logs[phase]) - np.log(len(PHASES))
        lanes[mine], kept[mine] = lane[phase], peak[phase] > 1.0 - PLACED_SHARE
        numbers, counts = np.unique(lanes[mine][kept[mine]], return_counts=True)
        steps += int(np.count_nonzero(np.diff(numbers[counts >= least]) == 1))
    return (nats if steps >= MIN_STEPS else -np.inf), lanes, kept

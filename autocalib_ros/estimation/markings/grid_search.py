"""Road markings: segments on the road that are parallel to one of two perpendicular directions.

Most lane lines, stop lines, stripes of crosswalks, kerbs and slabs are. So lens and plane are those that align most
segments with two perpendicular directions in one plane, and with the vertical one of posts: a mixture of three peaks
and uniform outliers, as in `edge_mixture.py` for edges of vehicles. The residual of a segment from a direction is the
angle, on the unit sphere, between the segment and the great circle from its middle to the vanishing point. With lens
distortion a segment is the chord of an arc: at its middle both have the same direction.

Perpendicular markings are an assumption. Where the traffic constrains less than they do, both have to agree.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.markings.grid_mixture import MIN_DEPRESSION_SINE, MarkingGrid, annealed_costs, refine_grid
from autocalib_ros.estimation.markings.road_segments import RoadSegments, all_within, sample_segments, traffic_cells
from autocalib_ros.estimation.verification.cut_picture import CUT_LOG_ODDS
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.great_circles import unproject_rays
from autocalib_ros.lens.camera import Camera

MAX_DISTANCE_TO_TRAFFIC_HEIGHTS = 0.5
"""Largest distance from traffic on the plane, in camera heights: a lane, at the usual height."""
GRID_FOCAL_DIAGONALS = np.geomspace(0.3, 1.6, 10)
"""Initial focal lengths in image diagonals: annealing bridges half of the ratio between two."""
GRID_TILTS_DEG = (5.0, 10.0, 16.0, 23.0, 31.0, 40.0, 50.0, 62.0)
GRID_ROLLS_DEG = (-9.0, -4.5, 0.0, 4.5, 9.0)
GRID_HEADINGS_DEG = tuple(range(0, 90, 6))
"""Initial tilts and rolls of the plane, and headings of the grid: beyond 90 degrees the directions would swap."""
ANNEALING_WIDTHS_RAD = (np.radians(3.0), np.radians(1.5), np.radians(0.7), 0.0)
"""Widening of the peaks, in rounds: initial values several degrees off still reach the best solution."""
FOCAL_RETRY_RATIOS = (0.8, 0.87, 0.93, 1.07, 1.14, 1.22)
"""Focal lengths for further attempts, relative to the best solution: focal length and distortion are nearly
indistinguishable from segments, so there are several local minima, each held by a few groups."""
MAX_GRID_STARTS = 6
"""Most initial values that are refined."""
MIN_EVIDENCE_GAIN_NATS = 4.5
"""Log-evidence by which a less usual lens family must be better: 3 sigma. One of a picture that was cut off must be as
probable with its prior odds."""
MIN_START_LOG_FOCAL, MIN_START_NORMAL_RAD = 0.3, np.radians(8.0)
"""Initial values differ by at least this in log focal length, or in the normal."""


def find_grids(segments: RoadSegments, priors: list[LensPrior]) -> list[MarkingGrid]:
    """Find lenses and planes with segments along two perpendicular directions, the best first.

    Multi-start with the first lens family, and again around the best; then the other families from the best.
    """
    if not _is_determined(segments, priors[0]):
        return []
    grids = [
        refine_grid(segments, priors[0], *start, ANNEALING_WIDTHS_RAD) for start in _best_starts(segments, priors[0])
    ]
    if not grids:
        return []
    grids += _retry_focal_lengths(segments, _most_probable(grids))
    best = _most_probable(grids)
    for prior in priors[1:]:
        lens = replace(prior.start(best.camera.focal_px), principal_point_px=best.camera.principal_point_px)
        grids.append(refine_grid(segments, prior, lens, best.rotation, ANNEALING_WIDTHS_RAD))
    return sorted(grids, key=lambda grid: grid.negative_log_evidence + _needed_gain(grid.prior, priors[0]))


def _needed_gain(prior: LensPrior, usual: LensPrior) -> float:
    """Return the log-evidence by which a lens family must be better than the usual one, nats."""
    if prior is usual:
        return 0.0
    cut_off = bool((prior.sigma[1:3] > usual.sigma[1:3]).any())
    return MIN_EVIDENCE_GAIN_NATS - (CUT_LOG_ODDS if cut_off else 0.0)


def _most_probable(grids: list[MarkingGrid]) -> MarkingGrid:
    return min(grids, key=lambda grid: grid.negative_log_evidence)


def find_grids_near(segments: RoadSegments, prior: LensPrior, camera: Camera, normal: np.ndarray) -> list[MarkingGrid]:
    """Find grids near a given lens and normal (3,), the best first."""
    if not _is_determined(segments, prior):
        return []
    rotations = _start_rotations(normal)
    costs = annealed_costs(segments, camera, np.array(rotations), ANNEALING_WIDTHS_RAD[1])
    grid = refine_grid(segments, prior, camera, rotations[int(np.argmin(costs))], ANNEALING_WIDTHS_RAD[1:])
    return sorted([grid, *_retry_focal_lengths(segments, grid)], key=lambda grid: grid.negative_log_evidence)


def _retry_focal_lengths(segments: RoadSegments, best: MarkingGrid) -> list[MarkingGrid]:
    """Return solutions from other focal lengths than the best one, if it is free."""
    prior = best.prior
    if prior.focal_known or not len(prior.free):
        return []
    lenses = [prior.start(ratio * best.camera.focal_px) for ratio in FOCAL_RETRY_RATIOS]
    return [refine_grid(segments, prior, lens, best.rotation, ANNEALING_WIDTHS_RAD[-2:]) for lens in lenses]


def _is_determined(segments: RoadSegments, prior: LensPrior) -> bool:
    """Whether there are more segments than unknowns."""
    return len(segments) >= len(prior.free) + 4


def keep_segments_near_traffic(
    segments: RoadSegments, grid: MarkingGrid, evidence: Evidence
) -> tuple[RoadSegments, MarkingGrid] | None:
    """Keep the segments near traffic on the plane of a grid, and refine it with them; None if there are too few."""
    traffic, points = (
        _on_plane(grid, pixels) for pixels in (traffic_cells(evidence), sample_segments(segments.ends_px))
    )
    on_road = np.isfinite(points).all(axis=(1, 2))
    kept = on_road & all_within(
        np.where(on_road[:, None, None], points, 0.0),
        traffic[np.isfinite(traffic).all(axis=1)],
        MAX_DISTANCE_TO_TRAFFIC_HEIGHTS,
    )
    # vertical segments belong to posts, which may stand away from the traffic
    kept |= grid.responsibilities[2] > 0.5
    near = segments.subset(kept)
    if not _is_determined(near, grid.prior):
        return None
    return near, refine_grid(near, grid.prior, grid.camera, grid.rotation, ANNEALING_WIDTHS_RAD[-2:])


def _on_plane(grid: MarkingGrid, pixels: np.ndarray) -> np.ndarray:
    """Positions (..., 2) of pixels (..., 2) on the plane in camera heights, nan where they are too far away."""
    bearings = unproject_rays(grid.camera, pixels).bearings @ grid.rotation
    below = np.where(bearings[..., 2] < -MIN_DEPRESSION_SINE, -bearings[..., 2], np.nan)
    return bearings[..., :2] / below[..., None]


def _start_planes() -> np.ndarray:
    """Initial planes, camera_from_plane (n, 3, 3)."""
    found = []
    for tilt in np.radians(GRID_TILTS_DEG):
        for roll in np.radians(GRID_ROLLS_DEG):
            up = -np.array([np.sin(roll) * np.cos(tilt), np.cos(roll) * np.cos(tilt), np.sin(tilt)])
            found += _start_rotations(up)
    return np.array(found)


def _start_rotations(up: np.ndarray) -> list[np.ndarray]:
    """Rotations camera_from_plane (3, 3) of a plane with normal (3,) and several headings."""
    right = np.cross([0.0, 0.0, 1.0], up)
    right /= max(np.linalg.norm(right), 1e-9)
    ahead = np.cross(up, right)
    first = [np.cos(heading) * ahead + np.sin(heading) * right for heading in np.radians(GRID_HEADINGS_DEG)]
    return [np.column_stack([along, np.cross(up, along), up]) for along in first]


def _best_starts(segments: RoadSegments, prior: LensPrior) -> list[tuple[Camera, np.ndarray]]:
    """Initial lenses and planes with the lowest annealed cost, distinct."""
    planes = _start_planes()
    found: list[tuple[float, Camera, np.ndarray]] = []
    diagonal = prior.centre.diagonal_px
    for focal in [prior.centre.focal_px] if prior.focal_known else diagonal * GRID_FOCAL_DIAGONALS:
        camera = prior.start(focal)
        costs = annealed_costs(segments, camera, planes, ANNEALING_WIDTHS_RAD[0])
        found += [
            (costs[index], camera, planes[index]) for index in np.argsort(costs, kind='stable')[: 5 * MAX_GRID_STARTS]
        ]
    chosen: list[tuple[Camera, np.ndarray]] = []
    for _, camera, plane in sorted(found, key=lambda start: start[0]):
        if not any(
            abs(np.log(camera.focal_px / other.focal_px)) < MIN_START_LOG_FOCAL
            and plane[:, 2] @ elsewhere[:, 2] > np.cos(MIN_START_NORMAL_RAD)
            for other, elsewhere in chosen
        ):
            chosen.append((camera, plane))
        if len(chosen) == MAX_GRID_STARTS:
            break
    return chosen

"""Road markings: straight lines on the road that are parallel to one of two directions square to each other.

Lane lines, stop lines, the stripes of crosswalks, kerbs and slabs mostly are. So the lens and the plane are those that
bring as many lines as can be to two directions in one plane, a quarter of a turn apart, and to the upright one, of
posts: a mixture of three peaks and a uniform rest, as `edge_mixture.py` is of edges on vehicles. How an image line
misses a direction is the angle, on the sphere about the camera, between the line and the way from its middle to where
that direction vanishes. Lines are no more than chords of what the lens bends: in its middle a chord has the direction
of the arc.

That markings are square is an assumption. Where the traffic tells less than they do, it has to agree with them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.markings.grid_mixture import MIN_DEPRESSION_SINE, MarkingGrid, annealed_costs, refine_grid
from autocalib_ros.estimation.markings.road_segments import RoadSegments, all_within, sample_segments, traffic_cells
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.great_circles import unproject_rays
from autocalib_ros.lens.camera import Camera

MAX_DISTANCE_TO_TRAFFIC_HEIGHTS = 0.5
"""The same on the road, once the plane is known: a lane, for a camera as high as usual."""
GRID_FOCAL_DIAGONALS = np.geomspace(0.3, 1.6, 10)
"""Focal lengths to start from, in image diagonals: half of the ratio of two is bridged by the widened peaks."""
GRID_TILTS_DEG = (5.0, 10.0, 16.0, 23.0, 31.0, 40.0, 50.0, 62.0)
GRID_ROLLS_DEG = (-9.0, -4.5, 0.0, 4.5, 9.0)
GRID_HEADINGS_DEG = tuple(range(0, 90, 6))
ANNEALING_WIDTHS_RAD = (np.radians(3.0), np.radians(1.5), np.radians(0.7), 0.0)
"""The peaks are widened by this, round by round, so that a start some degrees off still reaches the best solution."""
FOCAL_RETRY_RATIOS = (0.8, 0.87, 0.93, 1.07, 1.14, 1.22)
"""Focal lengths to start from once more, in ones of the best solution: along focal length and distortion, which lines
hardly tell apart, there are several solutions that single groups of lines hold in place."""
MAX_GRID_STARTS = 6
MIN_EVIDENCE_GAIN_NATS = 4.5
"""A rarer family of lenses is chosen when that makes the lines so much more probable: the logarithm, three sigmas."""
MIN_START_LOG_FOCAL, MIN_START_NORMAL_RAD = 0.3, np.radians(8.0)
"""Starts differ by so much in the logarithm of the focal length, or in the normal."""


def find_grids(lines: RoadSegments, priors: list[LensPrior]) -> list[MarkingGrid]:
    """Find lenses and planes under which lines are parallel to two directions square to each other, the best first.

    From many starts with the first family of lenses, and from beside the best; the best of these with the others.
    """
    if not _is_determined(lines, priors[0]):
        return []
    grids = [refine_grid(lines, priors[0], *start, ANNEALING_WIDTHS_RAD) for start in _best_starts(lines, priors[0])]
    best = min(grids, key=lambda grid: grid.negative_log_evidence, default=None)
    if best:
        grids += _retry_focal_lengths(lines, best)
        best = min(grids, key=lambda grid: grid.negative_log_evidence)
    rarer = []
    for prior in priors[1:] if best else []:
        near = replace(prior.start(best.camera.focal_px), principal_point_px=best.camera.principal_point_px)
        rarer.append(refine_grid(lines, prior, near, best.rotation, ANNEALING_WIDTHS_RAD))
    return sorted(
        [*grids, *rarer],
        key=lambda grid: grid.negative_log_evidence + (MIN_EVIDENCE_GAIN_NATS if grid.prior is not priors[0] else 0.0),
    )


def find_grids_near(lines: RoadSegments, prior: LensPrior, camera: Camera, normal: np.ndarray) -> list[MarkingGrid]:
    """Find those near a lens and a normal (3,), the best first."""
    if not _is_determined(lines, prior):
        return []
    headings = _start_rotations(normal)
    costs = annealed_costs(lines, camera, np.array(headings), ANNEALING_WIDTHS_RAD[1])
    near = refine_grid(lines, prior, camera, headings[int(np.argmin(costs))], ANNEALING_WIDTHS_RAD[1:])
    return sorted([near, *_retry_focal_lengths(lines, near)], key=lambda grid: grid.negative_log_evidence)


def _retry_focal_lengths(lines: RoadSegments, best: MarkingGrid) -> list[MarkingGrid]:
    """Solutions from other focal lengths than that of the best, if it is free."""
    prior = best.prior
    return (
        []
        if prior.focal_known or not len(prior.free)
        else [
            refine_grid(
                lines, prior, prior.start(ratio * best.camera.focal_px), best.rotation, ANNEALING_WIDTHS_RAD[-2:]
            )
            for ratio in FOCAL_RETRY_RATIOS
        ]
    )


def _is_determined(lines: RoadSegments, prior: LensPrior) -> bool:
    """Whether there are more lines than unknowns."""
    return len(lines) >= len(prior.free) + 4


def keep_lines_near_traffic(
    lines: RoadSegments, grid: MarkingGrid, evidence: Evidence
) -> tuple[RoadSegments, MarkingGrid] | None:
    """Keep the lines that are beside traffic on the plane of a grid, and settle it with them; None where few are."""
    places, points = (_on_plane(grid, pixels) for pixels in (traffic_cells(evidence), sample_segments(lines.ends_px)))
    there = np.isfinite(points).all(axis=(1, 2))
    kept = there & all_within(
        np.where(there[:, None, None], points, 0.0),
        places[np.isfinite(places).all(axis=1)],
        MAX_DISTANCE_TO_TRAFFIC_HEIGHTS,
    )
    # posts stand anywhere
    kept |= grid.responsibilities[2] > 0.5
    if not _is_determined(lines.subset(kept), grid.prior):
        return None
    near = lines.subset(kept)
    return near, refine_grid(near, grid.prior, grid.camera, grid.rotation, ANNEALING_WIDTHS_RAD[-2:])


def _on_plane(grid: MarkingGrid, pixels: np.ndarray) -> np.ndarray:
    """Places (..., 2) of pixels (..., 2) on the plane in heights of the camera, nan where they are too far away."""
    bearings = unproject_rays(grid.camera, pixels).bearings @ grid.rotation
    below = np.where(bearings[..., 2] < -MIN_DEPRESSION_SINE, -bearings[..., 2], np.nan)
    return bearings[..., :2] / below[..., None]


def _start_planes() -> np.ndarray:
    """camera_from_plane (n, 3, 3) of the planes to start from."""
    found = []
    for tilt in np.radians(GRID_TILTS_DEG):
        for roll in np.radians(GRID_ROLLS_DEG):
            up = -np.array([np.sin(roll) * np.cos(tilt), np.cos(roll) * np.cos(tilt), np.sin(tilt)])
            found += _start_rotations(up)
    return np.array(found)


def _start_rotations(up: np.ndarray) -> list[np.ndarray]:
    """camera_from_plane (3, 3) of planes with a normal (3,), turned about it."""
    right = np.cross([0.0, 0.0, 1.0], up)
    right /= max(np.linalg.norm(right), 1e-9)
    ahead = np.cross(up, right)
    first = [np.cos(heading) * ahead + np.sin(heading) * right for heading in np.radians(GRID_HEADINGS_DEG)]
    return [np.column_stack([along, np.cross(up, along), up]) for along in first]


def _best_starts(lines: RoadSegments, prior: LensPrior) -> list[tuple[Camera, np.ndarray]]:
    """Lenses and planes whose widened peaks hold most, distinct."""
    planes, found = _start_planes(), []
    diagonal = np.hypot(prior.centre.width, prior.centre.height)
    for focal in [prior.centre.focal_px] if prior.focal_known else diagonal * GRID_FOCAL_DIAGONALS:
        camera = prior.start(focal)
        costs = annealed_costs(lines, camera, planes, ANNEALING_WIDTHS_RAD[0])
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

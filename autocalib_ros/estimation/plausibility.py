"""Plausibility of a result: vehicles, speeds, lanes and dashes are about as usual, or it is doubted, or refused.

Nothing here is used by the estimators, so it also tests what they took for granted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.estimation.lanes.lane_dashes import LanePattern
from autocalib_ros.estimation.verification.vehicle_size import (
    MAX_BORNE_SIZE_SIGMAS,
    MAX_SIZE_SIGMAS,
    MIN_SPEED_FRACTION,
    MIN_VEHICLES,
    measure_vehicle_size,
)
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import ground_points
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.results.grades import rank_of
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import Statement, check
from autocalib_ros.results.verification_table import VerificationRow, verified

MAX_USUAL_EXCESS = float(np.log(1.25))
"""How far the logarithm of a quantity may lie beyond usual ones before it casts a doubt: a quarter."""
MAX_BORNE_EXCESS = MAX_BORNE_SIZE_SIGMAS / MAX_SIZE_SIGMAS
"""Times this limit, at which a result is refused: half as large again."""
USUAL_SPEED_KM_H = 130.0
"""Fastest usual median speed: the limit of most motorways. Without a low end: traffic jams."""
USUAL_LANES_M = (2.75, 3.75)
"""Usual widths of lanes, from streets in towns to motorways. Without a high end: a line that is worn or hidden leaves
the width of several lanes."""
USUAL_PERIODS_M = (3.0, 18.0)
"""Usual periods of dashes, from guide lines at junctions (1.5 m and 1.5 m) to motorways (6 m and 12 m). Without a high
end: dashes that are worn or hidden leave a multiple of the period."""
MAX_SPEED_DISTANCE_HEIGHTS = 10.0
"""Farthest points whose speed counts, camera heights: farther ones are as uncertain as the horizon."""
MIN_SPEED_TRACK_S = 0.5
"""Shortest track that has a speed."""
MEAN_POINT_HEIGHT_M = 0.75
"""Height of tracked points above the road, about half the height of a car."""
KM_H_PER_M_S = 3.6
SCALE_OF_VEHICLES = 'scale_vehicles'
"""Assumption by which the size of the vehicles is usual, so that it tests nothing."""
PLAUSIBILITY_KINDS = ('vehicle_size', 'usual_speed', 'usual_lanes', 'usual_dashes')
"""Rows whose failure is a doubt, and a refusal if they fail by far."""


def with_usual_lanes(result: Calibration, lanes: LanePattern | None) -> Calibration:
    """Add the comparison of lanes and dashes with usual ones; what is implausible lowers the grade."""
    ground = result.ground
    if lanes is None or ground is None or not ground.metric:
        return result
    at = result.camera, ground.normal_in_camera
    period_m = ground.height_m * lanes.period(*at)
    found = [_compared('usual_dashes', 'period_m', period_m, USUAL_PERIODS_M)]
    if lanes.has_width:
        found.append(_compared('usual_lanes', 'width_m', ground.height_m * lanes.width(*at), USUAL_LANES_M))
    return _with(result, found)


def with_usual_vehicles(result: Calibration, vehicles: Evidence) -> Calibration:
    """Add the comparison of sizes and speeds of the vehicles with usual ones; what is implausible lowers the grade."""
    ground = result.ground
    if ground is None or not ground.metric:
        return result
    at = result.camera, ground.normal_in_camera, ground.height_m
    found: list[tuple[VerificationRow, Statement | None]] = []
    if all(statement.kind != SCALE_OF_VEHICLES for statement in result.assumptions):
        size = measure_vehicle_size(vehicles, *at)
        found += [] if size is None else [(size.row, size.statement(ground.height_m))]
    speed = median_speed_km_h(vehicles, *at)
    if speed is not None:
        row = verified('usual_speed', max(float(np.log(speed / USUAL_SPEED_KM_H)), 0.0), MAX_USUAL_EXCESS)
        said = None if row.passed else check('usual_speed', speed_km_h=speed, usual_km_h=USUAL_SPEED_KM_H)
        found.append((row, said))
    return _with(result, found)


def why_implausible(result: Calibration) -> Reason | None:
    """Return why a result is refused as implausible, in the words of the check that failed by far; None if none did."""
    for row in result.verification:
        far = row.value is not None and row.value > MAX_BORNE_EXCESS * row.limit
        if row.kind in PLAUSIBILITY_KINDS and not row.passed and far:
            said = next(each.text for each in result.checks if each.kind == row.kind)
            return reason('implausible', check=row.kind, said=said)
    return None


def median_speed_km_h(vehicles: Evidence, camera: Camera, normal: np.ndarray, height_m: float) -> float | None:
    """Return the median speed of the vehicles on their way; None if too few are seen long enough."""
    first, last = vehicles.track_starts[:-1], vehicles.track_starts[1:] - 1
    # points above the road move as if the camera were lower by their height
    height_m = max(height_m - MEAN_POINT_HEIGHT_M, 0.5 * height_m)
    ends = [ground_points(camera, normal, height_m, vehicles.points_px[at]) for at in (first, last)]
    seconds = vehicles.times_s[last] - vehicles.times_s[first]
    near = np.maximum(*(np.hypot(*each.T) for each in ends)) < MAX_SPEED_DISTANCE_HEIGHTS * height_m
    used = near & (seconds > MIN_SPEED_TRACK_S)
    speeds = np.hypot(*(ends[1] - ends[0])[used].T) / seconds[used]
    owners = vehicles.track_vehicles[used]
    each = np.array([np.median(speeds[owners == vehicle]) for vehicle in np.unique(owners)])
    driving = each[each > MIN_SPEED_FRACTION * np.median(each)] if len(each) else each
    return float(KM_H_PER_M_S * np.median(driving)) if len(driving) >= MIN_VEHICLES else None


def _compared(
    kind: str, name: str, value: float, usual: tuple[float, float]
) -> tuple[VerificationRow, Statement | None]:
    """Return the row of a quantity against the least usual one, and the doubt in words if it fails."""
    low, high = usual
    beyond = max(float(np.log(low / value)), 0.0)
    row = verified(kind, beyond, MAX_USUAL_EXCESS)
    return row, None if row.passed else check(kind, **{name: value, 'low_m': low, 'high_m': high})


def _with(result: Calibration, found: list[tuple[VerificationRow, Statement | None]]) -> Calibration:
    rows = [row for row, _ in found]
    said = [statement for _, statement in found if statement is not None]
    return replace(with_rows(result, *rows), checks=(*result.checks, *said))


def with_rows(result: Calibration, *rows: VerificationRow) -> Calibration:
    """Add rows to the verification table; those that failed lower the grade of a metric plane, if that is the cost."""
    highest = min((row.highest_grade for row in rows), key=rank_of, default='full')
    lowered = rank_of(highest) < rank_of(result.grade)
    return replace(result, grade=highest if lowered else result.grade, verification=(*result.verification, *rows))

"""Families of single roads for the accuracy benchmark: any lens and pose, with edges of vehicles and still lines.

What real scenes do not keep to is drawn too: bumpers and bodies lean alike on all vehicles, posts lean, the road has a
bank and a grade against the upright, its carriageways differ, and a part of the lines is at any angle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from autocalib_ros.estimation.single_road.barrel_lens import barrel_coefficients
from autocalib_ros.evidence.snapshot import Evidence, Track
from autocalib_ros.lens.camera import Camera, image_centre
from autocalib_ros.offline.synthetic.drives import drive_bend
from autocalib_ros.offline.synthetic.junction import Junction, pose, synthetic_evidence

SIZE = (1280, 720)
VIEW_DEG, TILT_DEG, YAW_DEG = (25.0, 110.0), (6.0, 35.0), (0.0, 70.0)
"""Ranges of the horizontal field of view, of the tilt, and of the angle between road and view."""
TELEPHOTO_VIEW_DEG, TELEPHOTO_YAW_DEG, TELEPHOTO_DISTANCE_M = (9.0, 18.0), (0.0, 15.0), (42.0, 55.0)
"""The same of long lenses, and the distance at which they look at the road: it seems straight, and a gentle bend like a
lens with distortion."""
TELEPHOTO_RADIUS_M = (150.0, 800.0)
CROSSING_YAW_DEG = (60.0, 88.0)
"""Of roads that cross the view: the turn about the road is then the tilt, and a level camera says nothing about it."""
VEHICLES = (20, 200)
ROLL_SIGMA_DEG = 2.0
COMMON_ACROSS_DEG, COMMON_UPRIGHT_DEG, GROUND_DEG = 0.75, 1.5, 1.2
"""Standard deviations of errors that all vehicles share, of bumpers and of bodies, and of bank and grade of the road
against the upright of the still scene."""
EDGE_SPREAD_DEG, LINE_SPREAD_DEG = 2.0, 1.0
"""Standard deviations of single edges and lines from their direction."""
CLUTTER = 0.3
"""Fraction of edges and lines at any angle."""
EDGES_PER_VEHICLE, LINES = 6, 120
END_PX = 0.5
"""Standard deviation of an end of a segment in the image."""
MIN_SEGMENT_PX = 10.0


def draw_lens(generator: np.random.Generator, view_deg: tuple[float, float] = VIEW_DEG) -> Camera:
    """Draw a lens: half of them nearly distortion-free, where the field of view allows it, the others anything."""
    view = np.radians(np.exp(generator.uniform(*np.log(view_deg))))
    narrow = generator.uniform() < 0.5 and view < np.radians(90.0)
    kappa = float(np.clip(generator.normal(0.95, 0.1), 0.6, 1.05) if narrow else generator.uniform(0.0, 1.0))
    kappa = min(kappa, float((0.8 * np.pi / view) ** 2))  # the picture stays inside the lens
    root = np.sqrt(max(kappa, 1e-9))
    focal_px = 0.5 * SIZE[0] / (np.tan(root * view / 2) / root)
    centre = np.array(image_centre(*SIZE)) + generator.normal(0.0, 0.01 * SIZE[0], 2)
    return Camera(*SIZE, float(focal_px), (float(centre[0]), float(centre[1])), barrel_coefficients(kappa))


def single_road(generator: np.random.Generator) -> tuple[Junction, Evidence]:
    """Draw one straight road with traffic, edges of vehicles and still lines."""
    junction = _road(generator)
    evidence = synthetic_evidence(junction, generator)
    return junction, _with_segments(junction, evidence, generator)


def single_road_jam(generator: np.random.Generator) -> tuple[Junction, Evidence]:
    """Draw the same with few vehicles of short tracks, and no still lines."""
    junction = replace(_road(generator), vehicles=int(generator.integers(12, 30)), points_per_vehicle=6)
    evidence = synthetic_evidence(junction, generator)
    return junction, replace(_with_segments(junction, evidence, generator), still_lines_px=np.zeros((0, 4)))


def single_road_bend(generator: np.random.Generator) -> tuple[Junction, Evidence]:
    """Draw a road that bends: there is no straight part."""
    radius_m, side = generator.uniform(80.0, 400.0), generator.choice([-1.0, 1.0])
    junction, middle_m = _bent(_road(generator), float(radius_m), float(side))
    evidence = synthetic_evidence(junction, generator)
    return junction, _with_segments(junction, evidence, generator, middle_m)


def single_road_telephoto(generator: np.random.Generator) -> tuple[Junction, Evidence]:
    """Draw a long lens that looks along a road: straight in half of the draws, a gentle bend in the others."""
    drawn, distance = _road(generator, view_deg=TELEPHOTO_VIEW_DEG), float(generator.uniform(*TELEPHOTO_DISTANCE_M))
    yaw = float(generator.choice([-1.0, 1.0]) * generator.uniform(*TELEPHOTO_YAW_DEG))
    tilt, roll = np.degrees(np.arctan2(drawn.height_m, distance)), generator.normal(0.0, ROLL_SIGMA_DEG)
    ahead = distance * np.array([np.cos(np.radians(yaw)), -np.sin(np.radians(yaw))])
    junction = replace(
        drawn, camera_from_ground=pose(float(tilt), float(roll), yaw), centre_m=(float(ahead[0]), float(ahead[1]))
    )
    radius_m, side, middle_m = generator.uniform(*TELEPHOTO_RADIUS_M), generator.choice([-1.0, 1.0]), None
    if generator.uniform() < 0.5:
        junction, middle_m = _bent(junction, float(radius_m), float(side))
    evidence = synthetic_evidence(junction, generator)
    return junction, _with_segments(junction, evidence, generator, middle_m)


def single_road_crossing(generator: np.random.Generator) -> tuple[Junction, Evidence]:
    """Draw a straight road that crosses the view."""
    junction = _road(generator, yaw_deg=CROSSING_YAW_DEG)
    evidence = synthetic_evidence(junction, generator)
    return junction, _with_segments(junction, evidence, generator)


def _bent(junction: Junction, radius_m: float, side: float) -> tuple[Junction, np.ndarray]:
    """Return the road with a bend to its left (`side` 1) or right (-1), and the middle of the bend (2,), metres."""
    curve = partial(drive_bend, radius_m=radius_m, towards_rad=side * np.pi / 2)
    return replace(junction, drive=curve), np.array(junction.centre_m) + [0.0, side * radius_m]


def _road(
    generator: np.random.Generator,
    view_deg: tuple[float, float] = VIEW_DEG,
    yaw_deg: tuple[float, float] = YAW_DEG,
) -> Junction:
    tilt, yaw = generator.uniform(*TILT_DEG), generator.choice([-1.0, 1.0]) * generator.uniform(*yaw_deg)
    height = generator.uniform(5.0, 12.0)
    reach = min(1.3 * height / np.tan(np.radians(tilt)), 40.0)
    beside = np.radians(-yaw)
    return Junction(
        camera=draw_lens(generator, view_deg),
        camera_from_ground=pose(float(tilt), float(generator.normal(0.0, ROLL_SIGMA_DEG)), float(yaw)),
        height_m=float(height),
        road_angles_deg=(0.0,),
        centre_m=(float(reach * np.cos(beside)), float(reach * np.sin(beside))),
        turning_fraction=0.0,
        lane_change_fraction=0.1,
        vehicles=int(generator.integers(*VEHICLES)),
        points_per_vehicle=3,
    )


@dataclass(frozen=True)
class _Leaning:
    """Directions of the segments of one kind: along, across and upright, columns of (3, 3), ground frame."""

    directions: np.ndarray

    @classmethod
    def drawn(cls, generator: np.random.Generator, across_deg: float, upright_deg: float, grade_deg: float) -> _Leaning:
        """Draw errors that all segments of a kind share."""
        across, lean, grade = np.radians(generator.normal(0.0, [across_deg, upright_deg, grade_deg]))
        columns = np.eye(3) + np.array([[0.0, 0.0, grade], [0.0, 0.0, lean], [0.0, across, 0.0]])
        return cls(columns / np.linalg.norm(columns, axis=0))

    def draw(self, headings_rad: np.ndarray, spread_deg: float, generator: np.random.Generator) -> np.ndarray:
        """Draw directions (n, 3) where the road has headings (n,): a third of each kind with a spread, some any."""
        count = len(headings_rad)
        chosen = self.directions.T[generator.integers(0, 3, count)]
        cosine, sine = np.cos(headings_rad), np.sin(headings_rad)
        x, y = chosen[:, 0], chosen[:, 1]
        chosen = np.column_stack([cosine * x - sine * y, sine * x + cosine * y, chosen[:, 2]])
        chosen = chosen + np.radians(spread_deg) * generator.normal(size=(count, 3))
        clutter = generator.uniform(size=count) < CLUTTER
        chosen[clutter] = generator.normal(size=(int(clutter.sum()), 3))
        return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)


def _with_segments(
    junction: Junction, evidence: Evidence, generator: np.random.Generator, middle_m: np.ndarray | None = None
) -> Evidence:
    """Add edges of vehicles and still lines to evidence of a straight road, or of a bend about `middle_m` (2,)."""
    bodies = _Leaning.drawn(generator, COMMON_ACROSS_DEG, COMMON_UPRIGHT_DEG, 0.0)
    scenery = _Leaning.drawn(generator, 0.0, GROUND_DEG, GROUND_DEG)
    ends, owners, times = [], [], []
    for track in evidence.tracks():
        sample = int(generator.integers(len(track.times_s)))
        place = _ground_place(junction, track, sample)
        if place is None:
            continue
        count = EDGES_PER_VEHICLE // 2
        starts = place + generator.uniform([-2.0, -0.9, 0.2], [2.0, 0.9, 1.4], (count, 3))
        headings = np.full(count, _heading_rad(place[None], middle_m)[0])
        found = _seen(junction, starts, 1.2 * bodies.draw(headings, EDGE_SPREAD_DEG, generator), generator)
        ends.append(found)
        owners.append(np.full(len(found), track.vehicle))
        times.append(np.full(len(found), track.times_s[sample]))
    height = junction.height_m
    near = np.column_stack([generator.uniform(1.0, 8.0, LINES), generator.uniform(-4.0, 4.0, LINES)]) * height
    starts = np.column_stack([near, np.zeros(LINES)])
    headings = _heading_rad(starts, middle_m)
    lines = _seen(junction, starts, 2.5 * scenery.draw(headings, LINE_SPREAD_DEG, generator), generator)
    return replace(
        evidence,
        edges_px=np.concatenate([np.zeros((0, 4)), *ends]),
        edge_vehicles=np.concatenate([np.zeros(0, int), *owners]),
        edge_times_s=np.concatenate([np.zeros(0), *times]),
        still_lines_px=lines,
    )


def _heading_rad(places_m: np.ndarray, middle_m: np.ndarray | None) -> np.ndarray:
    """Return the heading (n,) of a road along x, or of a bend about `middle_m` (2,), at places (n, 3)."""
    if middle_m is None:
        return np.zeros(len(places_m))
    away = places_m[:, :2] - middle_m
    return np.arctan(-away[:, 0] / away[:, 1])


def _ground_place(junction: Junction, track: Track, sample: int) -> np.ndarray | None:
    """Return where a tracked point is on the road (3,), metres from the camera's foot; None beyond 30 heights."""
    bearing, _ = junction.camera.unproject(track.points_px[sample])
    ray = bearing @ junction.camera_from_ground
    if ray[2] > -1 / 30:
        return None
    return np.append(junction.height_m * ray[:2] / -ray[2], 0.0)


def _seen(junction: Junction, starts: np.ndarray, steps: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return segments from points (n, 3) on the ground by steps (n, 3) in the image, those that are long enough."""
    pixels = []
    for points in (starts, starts + steps):
        seen, valid = junction.camera.project((points - [0.0, 0.0, junction.height_m]) @ junction.camera_from_ground.T)
        pixels.append(np.where(valid[:, None], seen + generator.normal(0.0, END_PX, seen.shape), np.nan))
    ends = np.hstack(pixels)
    inside = (ends >= 0).all(axis=1) & (ends <= np.tile(np.subtract(SIZE, 1), 2)).all(axis=1)
    return ends[inside & (np.hypot(*(ends[:, 2:] - ends[:, :2]).T) > MIN_SEGMENT_PX)]

"""Families of synthetic evidence for the accuracy benchmark; every run draws its own junction.

`DETERMINED` families contain enough information to calibrate; each varies one property of `standard`.
`UNDERDETERMINED` families contain too little or misleading information: a refusal is the correct result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from autocalib_ros.evidence.snapshot import Evidence, Track
from autocalib_ros.lens.camera import Camera, image_centre
from autocalib_ros.offline.benchmark.road_families import (
    single_road,
    single_road_bend,
    single_road_crossing,
    single_road_jam,
    single_road_telephoto,
)
from autocalib_ros.offline.simulate.junctions import junction as crossing
from autocalib_ros.offline.simulate.motorway import highway
from autocalib_ros.offline.simulate.network import Network
from autocalib_ros.offline.simulate.roundabout import RING_RADIUS_M
from autocalib_ros.offline.simulate.roundabout import roundabout as ring_roads
from autocalib_ros.offline.simulate.scenes import bend as road_bend
from autocalib_ros.offline.synthetic.disturbances import noisy_line, random_sway, random_walk
from autocalib_ros.offline.synthetic.drives import (
    INTERVAL_S,
    drive_arc,
    drive_bend,
    drive_ring,
    drive_route,
    walk_along_road,
)
from autocalib_ros.offline.synthetic.junction import HEADWAY_S, Junction, evidence_from_tracks, pose, synthetic_evidence

WIDTH, HEIGHT = 1280, 720
FOCAL_PX = (500.0, 640.0)
LONG_FOCAL_PX = (700.0, 1200.0)
"""Focal lengths of distortion-free lenses in pixels; such lenses are not built with a wider field of view."""
TANGENT_SERIES = (1 / 3, 2 / 15, 17 / 315, 62 / 2835)
"""Coefficients k1 to k4 of tan(theta) = theta (1 + k1 theta^2 + ...), in the model of Kannala & Brandt (2006)."""
MAX_K1 = 0.05
TURNING_K1 = 0.03
MAX_CENTRE_OFFSET_PX = 20.0
"""Largest offset of the principal point from the image centre along each axis."""
BUILT_DEG = 1.0
"""Standard deviation of the angle at which two roads cross from a right angle: junctions are built to about that."""
PRINCIPAL_POINT_SIGMA = 0.01
"""Standard deviation of the principal point, fraction of the image width: default joint.principal_point_sigma_px."""

Family = Callable[[np.random.Generator], tuple[Junction, Evidence]]
"""Draws the ground truth and evidence of it."""


def standard_junction(generator: np.random.Generator, heading_deg: tuple[float, float] = (25.0, 65.0)) -> Junction:
    """Draw the standard junction: 60 tracks, one per vehicle, on two roads that cross ahead at about a right angle."""
    tilt, roll, heading, height = generator.uniform([26, -2, heading_deg[0], 6], [38, 2, heading_deg[1], 10])
    reach = generator.uniform(1.1, 1.7) * height / np.tan(np.radians(tilt))
    bearing = np.radians(generator.uniform(-8, 8) - heading)
    crossing = 90.0 + generator.normal(scale=BUILT_DEG)
    return Junction(
        camera=draw_lens(generator),
        camera_from_ground=pose(tilt, roll, heading),
        height_m=float(height),
        road_angles_deg=(0.0, float(crossing)),
        centre_m=(float(reach * np.cos(bearing)), float(reach * np.sin(bearing))),
        tracks=60,
        points_per_vehicle=1,
    )


def draw_lens(generator: np.random.Generator) -> Camera:
    """Draw a nearly equidistant lens with its principal point off the image centre."""
    focal, k1, right, down = generator.uniform(
        [FOCAL_PX[0], -MAX_K1, -MAX_CENTRE_OFFSET_PX, -MAX_CENTRE_OFFSET_PX],
        [FOCAL_PX[1], MAX_K1, MAX_CENTRE_OFFSET_PX, MAX_CENTRE_OFFSET_PX],
    )
    cx, cy = image_centre(WIDTH, HEIGHT)
    return Camera(WIDTH, HEIGHT, float(focal), (float(cx + right), float(cy + down)), (float(k1), 0.0, 0.0, 0.0))


def draw_distortion_free_lens(generator: np.random.Generator) -> Camera:
    """Draw a lens without distortion: straight lines stay straight in the image."""
    return replace(draw_lens(generator), focal_px=float(generator.uniform(*LONG_FOCAL_PX)), k=TANGENT_SERIES)


def family_of(junction_of: Callable[[np.random.Generator], Junction]) -> Family:
    """Return the family that draws a junction and simulates traffic through it."""

    def family(generator: np.random.Generator) -> tuple[Junction, Evidence]:
        junction = junction_of(generator)
        return junction, synthetic_evidence(junction, generator)

    return family


def standard_with(**changes: Any) -> Family:
    """Return the family of standard junctions with the given fields changed."""
    return family_of(lambda generator: replace(standard_junction(generator), **changes))


def skew(generator: np.random.Generator) -> Junction:
    """Draw two roads that cross at 60 to 85 degrees."""
    crossing = generator.choice([-1.0, 1.0]) * generator.uniform(60.0, 85.0)
    return replace(standard_junction(generator), road_angles_deg=(0.0, float(crossing)))


def equidistant(generator: np.random.Generator) -> Junction:
    """Draw a centred equidistant lens: the mean of the solver's prior is the truth."""
    return replace(standard_junction(generator), camera=Camera.equidistant(WIDTH, HEIGHT, generator.uniform(*FOCAL_PX)))


def three_roads(generator: np.random.Generator) -> Junction:
    """Draw a third road at about 45 degrees to the two perpendicular ones."""
    return replace(standard_junction(generator), road_angles_deg=(0.0, 90.0, float(generator.uniform(35.0, 55.0))))


def one_road(generator: np.random.Generator) -> Junction:
    """Draw one straight road that passes beside the optical axis: only the lens is identifiable."""
    return replace(
        _random_track_count(standard_junction(generator, (40.0, 75.0)), generator),
        road_angles_deg=(0.0,),
        turning_fraction=0.0,
    )


def distortion_free(generator: np.random.Generator) -> Junction:
    """Draw a distortion-free lens over perpendicular roads: only the right angle constrains the focal length."""
    return replace(standard_junction(generator), camera=draw_distortion_free_lens(generator))


def radial(generator: np.random.Generator) -> Junction:
    """Draw one road straight ahead: radial tracks pass through the distortion centre and stay straight in any lens."""
    junction = _random_track_count(standard_junction(generator, (-1.0, 1.0)), generator)
    lanes = (0.0, float(generator.uniform(0.3, 1.5)))
    return replace(
        junction, centre_m=(junction.centre_m[0], 0.0), road_angles_deg=(0.0,), lanes_m=lanes, turning_fraction=0.0
    )


def bend(generator: np.random.Generator) -> Junction:
    """Draw curved traffic only: one bend of constant radius."""
    drive = partial(drive_bend, radius_m=generator.uniform(15.0, 60.0), towards_rad=generator.uniform(0, 2 * np.pi))
    return replace(_random_track_count(standard_junction(generator), generator), drive=drive)


def roundabout(generator: np.random.Generator) -> Junction:
    """Draw curved traffic only: the ring of a roundabout."""
    drive = partial(drive_ring, radius_m=generator.uniform(15.0, 30.0))
    return replace(_random_track_count(standard_junction(generator), generator), drive=drive)


def turning(generator: np.random.Generator) -> Junction:
    """Draw turning vehicles, each on its own arc, a fifth of them merged with a neighbour into one vehicle.

    The principal point is the image centre: turns constrain it less than the other parameters.
    """
    junction = _with_centred_lens(standard_junction(generator), generator)
    return replace(
        junction,
        drive=partial(drive_arc, radii_m=(12.0, 60.0)),
        tracks=None,
        vehicles=25,
        points_per_vehicle=8,
        merged_fraction=0.2,
    )


def turning_off_centre(generator: np.random.Generator) -> Junction:
    """Draw turning vehicles and a principal point off the image centre, distributed as in the solver's prior."""
    junction = turning(generator)
    point = np.array(junction.camera.principal_point_px) + generator.normal(0.0, PRINCIPAL_POINT_SIGMA * WIDTH, 2)
    return replace(junction, camera=replace(junction.camera, principal_point_px=(float(point[0]), float(point[1]))))


def motorway(generator: np.random.Generator) -> Junction:
    """Draw a motorway of three lanes one way, 30 % of the vehicles changing lanes: only the lens is identifiable."""
    return _with_traffic_on(standard_junction(generator, (40.0, 75.0)), highway(one_way=True, changing_fraction=0.3))


def long_bend(generator: np.random.Generator) -> Junction:
    """Draw a two-way road that bends by 80 degrees over 64 to 112 m: in view, mostly about a single centre."""
    junction = _with_centred_lens(standard_junction(generator), generator)
    return _with_traffic_on(
        junction,
        road_bend(one_way=False),
        rotation_rad=generator.uniform(0, 2 * np.pi),
        scale=generator.uniform(0.8, 1.4),
    )


def roundabout_arms(generator: np.random.Generator) -> Junction:
    """Draw a roundabout seen from outside, with vehicles that enter, circulate and leave."""
    junction = _with_centred_lens(standard_junction(generator), generator)
    scale = generator.uniform(0.8, 1.3)
    direction = np.array(junction.centre_m) / np.hypot(*junction.centre_m)
    x, y = (scale * RING_RADIUS_M + generator.uniform(6.0, 14.0)) * direction
    return _with_traffic_on(
        replace(junction, centre_m=(float(x), float(y))),
        ring_roads(turning_fraction=0.5),
        rotation_rad=generator.uniform(0, 2 * np.pi),
        scale=scale,
    )


def skew_turning(generator: np.random.Generator) -> Junction:
    """Draw two roads that cross at 60 to 70 degrees, 35 % of the vehicles turning."""
    network = crossing(np.radians(generator.uniform(60.0, 70.0)), turning_fraction=0.35)
    return _with_traffic_on(standard_junction(generator), network, rotation_rad=np.pi * generator.integers(2))


def tee(generator: np.random.Generator) -> Junction:
    """Draw a T-junction: all vehicles of the side road turn, and some of the main road."""
    network = crossing(np.pi / 2, turning_fraction=0.35, tee=True)
    return _with_traffic_on(standard_junction(generator), network, rotation_rad=np.pi / 2 * generator.integers(4))


def sparse(generator: np.random.Generator) -> Junction:
    """Draw a junction with a vehicle every twelve seconds, observed for two to four minutes."""
    junction = _with_traffic_on(standard_junction(generator), crossing(np.pi / 2, turning_fraction=0.3))
    return replace(junction, vehicles=int(generator.integers(10, 21)), headway_s=12.0)


def _with_traffic_on(
    junction: Junction, network: Network, *, rotation_rad: float = 0.0, scale: float = 1.0
) -> Junction:
    """Return the junction with 40 vehicles of eight points each on the routes of a network."""
    drive = partial(drive_route, network=network, rotation_rad=rotation_rad, scale=scale)
    return replace(junction, drive=drive, tracks=None, vehicles=40, points_per_vehicle=8)


def _with_centred_lens(junction: Junction, generator: np.random.Generator) -> Junction:
    """Return the junction with a lens closer to equidistant and its principal point at the image centre."""
    camera = replace(
        Camera.equidistant(WIDTH, HEIGHT, junction.camera.focal_px),
        k=(float(generator.uniform(-TURNING_K1, TURNING_K1)), 0.0, 0.0, 0.0),
    )
    return replace(junction, camera=camera)


def pedestrians(generator: np.random.Generator) -> Junction:
    """Draw pedestrians on pavements and no vehicles."""
    return replace(standard_junction(generator), drive=walk_along_road, tracks=int(generator.integers(60, 200)))


def short_piece(generator: np.random.Generator) -> Junction:
    """Draw one road from the side, of which only a short section is in view."""
    left = generator.uniform(0.2, 0.6) * WIDTH
    return replace(
        _random_track_count(standard_junction(generator, (75.0, 105.0)), generator),
        road_angles_deg=(0.0,),
        turning_fraction=0.0,
        visible_columns_px=(left, left + generator.uniform(0.15, 0.3) * WIDTH),
    )


def distortion_free_skew(generator: np.random.Generator) -> Junction:
    """Draw a distortion-free lens over skew roads: neither curvature nor a right angle constrains the focal length."""
    return replace(_random_track_count(skew(generator), generator), camera=draw_distortion_free_lens(generator))


def swaying_camera(generator: np.random.Generator) -> Junction:
    """Draw ordinary traffic in front of a swaying camera."""
    return replace(_random_track_count(standard_junction(generator), generator), sway=random_sway(generator))


def undetected_sway(generator: np.random.Generator) -> tuple[Junction, Evidence]:
    """Draw a swaying camera whose drift monitor reports no drift."""
    junction, evidence = family_of(swaying_camera)(generator)
    return junction, replace(evidence, drift_px=0.0)


def noise(generator: np.random.Generator) -> tuple[Junction, Evidence]:
    """Draw random walks and noisy lines in the image that belong to no road."""
    junction = standard_junction(generator)
    tracks = []
    for number in range(int(generator.integers(60, 240))):
        count = int(generator.integers(8, 33))
        draw = random_walk if generator.uniform() < 0.5 else noisy_line
        times = HEADWAY_S * number + INTERVAL_S * np.arange(count)
        tracks.append(Track(number, times, draw(count, junction.image_size, generator)))
    return junction, evidence_from_tracks(tracks, junction.image_size, float(tracks[-1].times_s[-1]))


def _random_track_count(junction: Junction, generator: np.random.Generator) -> Junction:
    """Return the junction with one to four points per vehicle: 60 to 240 tracks."""
    points = int(generator.integers(1, 5))
    return replace(junction, tracks=60 * points, points_per_vehicle=points)


# A family's name is part of the seed of its runs.
DETERMINED: dict[str, Family] = {
    'standard': standard_with(),
    'few': standard_with(tracks=40),
    'many': standard_with(tracks=400, points_per_vehicle=4),
    'noisy': standard_with(noise_px=1.5),
    'wander': standard_with(wander_m=0.25),
    'outliers': standard_with(outlier_fraction=0.2),
    'skew': family_of(skew),
    'equidistant': family_of(equidistant),
    'three_roads': family_of(three_roads),
    'lane_changes': standard_with(lane_change_fraction=0.3),
    'one_road': family_of(one_road),
    'distortion_free': family_of(distortion_free),
    'turning': family_of(turning),
    'turning_off_centre': family_of(turning_off_centre),
    'highway': family_of(motorway),
    'roundabout_arms': family_of(roundabout_arms),
    'skew_turning': family_of(skew_turning),
    'tee': family_of(tee),
    'sparse': family_of(sparse),
    'single_road': single_road,
    'single_road_jam': single_road_jam,
}
UNDERDETERMINED: dict[str, Family] = {
    'radial': family_of(radial),
    'bend': family_of(bend),
    'long_bend': family_of(long_bend),
    'roundabout': family_of(roundabout),
    'pedestrians': family_of(pedestrians),
    'noise': noise,
    'waved': family_of(swaying_camera),
    'waved_unseen': undetected_sway,
    'single_road_bend': single_road_bend,
    'single_road_telephoto': single_road_telephoto,
    'single_road_crossing': single_road_crossing,
    'short_piece': family_of(short_piece),
    'distortion_free_skew': family_of(distortion_free_skew),
}

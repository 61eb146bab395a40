"""The size of vehicles reveals a wrong scale: cars are about as large everywhere.

A silhouette of a moving vehicle is as wide as its length and its width appear from the camera. The median over all
vehicles, in units of a usual car, tests the given height, length or speed, and with it the plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autocalib_ros.estimation.observations.grouping import group_indices
from autocalib_ros.estimation.people.ground_positions import MAX_PERSON_DISTANCE_HEIGHTS
from autocalib_ros.estimation.people.metric_silhouettes import measure_silhouettes
from autocalib_ros.estimation.people.silhouette_headings import RoadDisplacements, are_whole
from autocalib_ros.estimation.verification.scale import Scale
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.robust_kernels import MAD_TO_SIGMA
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.statements import Statement, check
from autocalib_ros.results.verification_table import VerificationRow, verified

USUAL_CAR_M = (4.5, 1.8)
"""Length and width of a usual car. Cars of the United States are 5 % larger."""
SILHOUETTE_SHARE = 0.93
"""Width of a silhouette of a moving region over that of the vehicle: 0.75 to 1.08 on eleven rendered scenes, where
parts of bodies are missed, and 1.0 to 1.2 on three real ones, with shadows and blur."""
MIN_WHOLE_SILHOUETTES, MIN_VEHICLES = 3, 10
"""Whole silhouettes that measure a vehicle, and vehicles that measure the scale. Judgement."""
MIN_SPEED_FRACTION = 0.3
"""Objects slower than this fraction of the median speed are no vehicles on their way. Judgement."""
MIN_WIDTH_PX = 16.0
"""Narrower silhouettes are as uncertain as a pixel of the motion mask."""
USUAL_SIZE_SIGMA = 0.14
"""Standard deviation of the logarithm of the mean size: the spread of that share over these scenes, vans and lorries
among the cars, and the country."""
MAX_SIZE_SIGMAS, MAX_BORNE_SIZE_SIGMAS = 2.0, 3.5
"""Deviation from the usual size, in standard deviations, that casts a doubt (5 % of right scales), and that is refused
(0.05 %): a quarter, and more than half."""
MEDIAN_TO_MEAN_ERROR = 1.2533
"""Standard error of the median over that of the mean of a normal distribution, sqrt(pi / 2)."""


@dataclass(frozen=True)
class SeenVehicles:
    """Whole silhouettes of vehicles on their way, as a function of lens and plane."""

    outlines_px: np.ndarray
    """As `Evidence.outlines_px`, shape (n, OUTLINE_COLUMNS)."""
    usual_m: np.ndarray
    """Width in metres across the line of sight of a usual car that heads as these do, shape (n,)."""
    starts: np.ndarray
    """First silhouette of each vehicle, shape (vehicles,)."""

    def log_ratios(self, camera: Camera, normal: np.ndarray, height_m: float) -> np.ndarray:
        """Return the log size of each vehicle in units of the usual one, shape (vehicles,)."""
        widths = measure_silhouettes(self.outlines_px, camera, normal, height_m).width / self.usual_m
        return np.array([np.log(np.median(part) / SILHOUETTE_SHARE) for part in np.split(widths, self.starts[1:])])

    def ratio(self, camera: Camera, normal: np.ndarray, height_m: float) -> float:
        """Return the median size in units of the usual one."""
        return float(np.exp(np.median(self.log_ratios(camera, normal, height_m))))


@dataclass(frozen=True)
class VehicleSize:
    """The size of the vehicles in units of the usual one."""

    ratio: float
    error: float
    """Standard error of its logarithm, from the spread between vehicles."""
    vehicles: int
    seen: SeenVehicles

    @property
    def sigma(self) -> float:
        """Standard deviation of the logarithm of the ratio for a right scale."""
        return float(np.hypot(USUAL_SIZE_SIGMA, self.error))

    @property
    def row(self) -> VerificationRow:
        """The comparison with the usual size."""
        return verified('vehicle_size', abs(float(np.log(self.ratio))), MAX_SIZE_SIGMAS * self.sigma)

    @property
    def impossible(self) -> bool:
        """Whether the vehicles are so unusual that scale or plane must be wrong."""
        return abs(float(np.log(self.ratio))) > MAX_BORNE_SIZE_SIGMAS * self.sigma

    def scale(self, camera: Camera, normal: np.ndarray, height_m: float) -> Scale:
        """Return the scale by which the vehicles are as large as usual; measured at a height through lens and plane."""
        usual_m = height_m / self.ratio
        return Scale(
            lambda lens, up: height_m / self.seen.ratio(lens, up, height_m),
            usual_m * self.sigma,
            True,
            'scale_vehicles',
            {'vehicles': self.vehicles, 'car_m': USUAL_CAR_M[1], 'sigma': self.sigma},
            derived=True,
        )

    def statement(self, height_m: float) -> Statement:
        """Return the size in words, with the camera height by which it would be the usual one."""
        usual_m = height_m / self.ratio
        return check(
            'vehicle_size',
            vehicles=self.vehicles,
            ratio=self.ratio,
            width_m=self.ratio * USUAL_CAR_M[1],
            usual_width_m=USUAL_CAR_M[1],
            height_m=height_m,
            usual_height_m=usual_m,
            usual_height_sigma_m=usual_m * self.sigma,
        )


def measure_vehicle_size(evidence: Evidence, camera: Camera, normal: np.ndarray, height_m: float) -> VehicleSize | None:
    """Measure the vehicles below a camera, with ground normal (3,); None if too few are seen whole."""
    rows = np.flatnonzero(are_whole(evidence) & (np.ptp(evidence.outlines_px[:, :-1:2], axis=1) > MIN_WIDTH_PX))
    sizes = measure_silhouettes(evidence.outlines_px, camera, normal, height_m)
    rows = rows[sizes.distance[rows] < MAX_PERSON_DISTANCE_HEIGHTS * height_m]
    if len(rows) < MIN_WHOLE_SILHOUETTES * MIN_VEHICLES:  # as in all evidence without silhouettes
        return None
    moves = RoadDisplacements.of(evidence, camera, normal, height_m)
    measured, usual, speeds = [], [], []
    for group in group_indices(evidence.outline_vehicles[rows], MIN_WHOLE_SILHOUETTES):
        seen = rows[group]
        own = moves.of_vehicle(evidence.outline_vehicles[seen[0]])
        aspects = own.headings_at(evidence.outline_times_s[seen]) - sizes.azimuth[seen]
        length_m, width_m = USUAL_CAR_M
        usual_m = length_m * np.abs(np.sin(aspects)) + width_m * np.abs(np.cos(aspects))
        known = np.isfinite(usual_m)
        if np.count_nonzero(known) >= MIN_WHOLE_SILHOUETTES:
            measured.append(seen[known])
            usual.append(usual_m[known])
            speeds.append(float(np.median(np.hypot(*own.displacements_m.T))))
    if len(speeds) < MIN_VEHICLES:
        return None
    driving = np.flatnonzero(np.array(speeds) > MIN_SPEED_FRACTION * np.median(speeds))
    if len(driving) < MIN_VEHICLES:
        return None
    counts = [len(measured[each]) for each in driving]
    vehicles = SeenVehicles(
        evidence.outlines_px[np.concatenate([measured[each] for each in driving])],
        np.concatenate([usual[each] for each in driving]),
        np.cumsum([0, *counts[:-1]]),
    )
    logs = vehicles.log_ratios(camera, normal, height_m)
    middle = float(np.median(logs))
    error = MEDIAN_TO_MEAN_ERROR * MAD_TO_SIGMA * float(np.median(np.abs(logs - middle))) / np.sqrt(len(logs))
    return VehicleSize(float(np.exp(middle)), float(error), len(logs), vehicles)

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
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.robust_kernels import MAD_TO_SIGMA
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.statements import Statement, check
from autocalib_ros.results.verification_table import VerificationRow, verified

USUAL_CAR_M = (4.5, 1.8)
"""Length and width of a usual car. Cars of the United States are 5 % larger."""
SILHOUETTE_SHARE = 0.88
"""Width of a silhouette of a moving region over that of the vehicle: 0.84 to 0.92 on five rendered scenes."""
MIN_WHOLE_SILHOUETTES, MIN_VEHICLES = 3, 10
"""Whole silhouettes that measure a vehicle, and vehicles that measure the scale. Judgement."""
MIN_SPEED_FRACTION = 0.3
"""Objects slower than this fraction of the median speed are no vehicles on their way. Judgement."""
MIN_WIDTH_PX = 16.0
"""Narrower silhouettes are as uncertain as a pixel of the motion mask."""
USUAL_SIZE_SIGMA = 0.08
"""Standard deviation of the logarithm of the mean size: vans and lorries among the cars, the country, shadows.
Judgement."""
MAX_SIZE_SIGMAS = 3.0
"""Largest deviation from the usual size in standard deviations."""
MEDIAN_TO_MEAN_ERROR = 1.2533
"""Standard error of the median over that of the mean of a normal distribution, sqrt(pi / 2)."""


@dataclass(frozen=True)
class VehicleSize:
    """The size of the vehicles in units of the usual one."""

    ratio: float
    error: float
    """Standard error of its logarithm, from the spread between vehicles."""
    vehicles: int

    @property
    def sigma(self) -> float:
        """Standard deviation of the logarithm of the ratio for a right scale."""
        return float(np.hypot(USUAL_SIZE_SIGMA, self.error))

    @property
    def row(self) -> VerificationRow:
        """The comparison with the usual size."""
        return verified('vehicle_size', abs(float(np.log(self.ratio))), MAX_SIZE_SIGMAS * self.sigma)

    def statement(self, height_m: float) -> Statement:
        """Return the size in words, with the camera height by which it would be the usual one."""
        usual_m = height_m / self.ratio
        return check(
            'vehicle_size',
            vehicles=self.vehicles,
            ratio=self.ratio,
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
    ratios, speeds = [], []
    for group in group_indices(evidence.outline_vehicles[rows], MIN_WHOLE_SILHOUETTES):
        seen = rows[group]
        own = moves.of_vehicle(evidence.outline_vehicles[seen[0]])
        aspects = own.headings_at(evidence.outline_times_s[seen]) - sizes.azimuth[seen]
        length_m, width_m = USUAL_CAR_M
        usual_m = length_m * np.abs(np.sin(aspects)) + width_m * np.abs(np.cos(aspects))
        measured = (sizes.width[seen] / usual_m)[np.isfinite(usual_m)]
        if len(measured) >= MIN_WHOLE_SILHOUETTES:
            ratios.append(float(np.median(measured)))
            speeds.append(float(np.median(np.hypot(*own.displacements_m.T))))
    if not ratios:
        return None
    driving = np.array(speeds) > MIN_SPEED_FRACTION * np.median(speeds)
    logs = np.log(np.array(ratios)[driving] / SILHOUETTE_SHARE)
    if len(logs) < MIN_VEHICLES:
        return None
    middle = float(np.median(logs))
    error = MEDIAN_TO_MEAN_ERROR * MAD_TO_SIGMA * float(np.median(np.abs(logs - middle))) / np.sqrt(len(logs))
    return VehicleSize(float(np.exp(middle)), float(error), len(logs))

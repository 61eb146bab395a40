"""The scale of the ground plane: the camera height from the given measure, as a function of lens and plane.

The traffic determines lens and plane up to scale. In the estimated lens and plane, a length on the road or the speed
of the traffic is a multiple of the camera height; the given length or speed then gives the height. Its sigma combines
that of the multiple and that of the given measure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from autocalib_ros.config import GateOptions, KnownDistance, Options, ScaleOptions
from autocalib_ros.estimation.adjustment.noise_model import DEFAULT_CAMERA_HEIGHT_M
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.geometry.ground_plane import ground_points
from autocalib_ros.geometry.robust_kernels import MAD_TO_SIGMA
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import UNDETERMINED, Statement, Value, assumption

SIMILAR_HEIGHT_FACTOR = 1.25
"""Heights within this factor of the default weigh near and far points alike, so that nothing is estimated again."""
MIN_DEPRESSION_SCALE_SINE = 0.03
"""Least sine of the depression angle of a pixel whose position on the road is used: 33 camera heights away."""
MIN_SPEED_VEHICLES = 10
"""Fewer vehicles determine neither the mean speed nor its variation. Judgement."""
MIN_FLOW_SPEED_FRACTION = 0.4
"""Vehicles slower than this fraction of the median speed are pedestrians or waiting; flowing traffic varies by about a
fifth."""
TRIM_FRACTION = 0.25
"""Fraction of the slowest and of the fastest vehicles that is trimmed from the mean speed."""
MIN_HEIGHT_M = 1e-6
"""Least height that has a logarithm."""
MIN_SCALE_SIGMA = 1e-3
"""Least relative standard deviation of a source of scale: a height that is given as exact is not."""
STEP_PX = 1e-3
"""Step of the numerical derivative by the given pixels."""
M_S_PER_KM_H = 1 / 3.6

HeightFunction = Callable[[Camera, np.ndarray], float]
"""The height of the camera as a function of lens and upward normal (3,)."""


@dataclass(frozen=True)
class Scale:
    """Source of the scale, with the sigma of the height for exact lens and plane."""

    height: HeightFunction
    sigma: float
    """Standard deviation of the height without the part from lens and plane."""
    metric: bool
    """Whether the height is in metres."""
    kind: str = ''
    """Kind of the assumption that names the source; '' without a scale."""
    values: Mapping[str, Value] = field(default_factory=dict)
    """Numbers of that assumption."""
    derived: bool = False
    """Whether the height follows from lens and plane; otherwise it was given."""
    sources: tuple[Scale, ...] = ()
    """The sources that it combines; empty for one alone."""

    def assumption(self, height: float, sigma: float | None = None) -> tuple[Statement, ...]:
        """Return the source of the scale, with the height and its total standard deviation if they follow from it."""
        if not self.metric:
            return ()
        if self.sources:
            each = [assumption(source.kind, **source.values) for source in self.sources]
            count = len(self.sources)
            return (*each, assumption('scale_combined', sources=count, height_m=height, height_sigma_m=sigma))
        derived = {'height_m': height, 'height_sigma_m': sigma} if self.derived else {}
        return (assumption(self.kind, **self.values, **derived),)


UNIT_SCALE = Scale(lambda *_: 1.0, 0.0, False)
"""Lengths in camera heights."""


def known_scale(options: Options, camera: Camera, normal: np.ndarray, flow: TrackSet | None = None) -> Scale | Reason:
    """Return the scale that follows from all that the options give, or why there is none.

    `flow` holds straight tracks along the busiest road, for the scale from their speed.
    """
    return combined_scale(scale_sources(options, camera, normal, flow), options, camera, normal)


def combined_scale(
    sources: list[Scale] | Reason, options: Options, camera: Camera, normal: np.ndarray
) -> Scale | Reason:
    """Return the scale of all sources together; without any the unit scale if the options allow it, or a reason."""
    if isinstance(sources, Reason):
        return sources
    if sources:
        return sources[0] if len(sources) == 1 else _combined(sources, camera, normal)
    if options.allow_unit_scale:
        return UNIT_SCALE
    return reason('no_height')


def scale_sources(
    options: Options, camera: Camera, normal: np.ndarray, flow: TrackSet | None = None
) -> list[Scale] | Reason:
    """Return a scale for each height, distance and speed that the options give; a reason if one of them gives none."""
    given, found = options.scale, []
    height, sigma = options.camera_height, options.camera_height_sigma
    if height > 0:
        values = {'given_m': height, 'given_sigma_m': sigma}
        found.append(Scale(lambda *_: height, sigma, True, 'scale_height', values))
    for distance in given.known_distances:
        scale = _scale_from_distance(given, distance, camera, normal)
        if isinstance(scale, Reason):
            return scale
        found.append(scale)
    if given.speed_km_h > 0 and flow is not None:
        scale = _scale_from_speed(given, camera, normal, flow)
        if isinstance(scale, Scale):
            found.append(scale)
        elif not found:
            return scale
    return found


def relative_sigmas(sources: list[Scale], camera: Camera, normal: np.ndarray) -> np.ndarray:
    """Return the standard deviations of the sources alone, relative to their heights, shape (sources,)."""
    relative = [source.sigma / max(source.height(camera, normal), MIN_HEIGHT_M) for source in sources]
    return np.maximum(relative, MIN_SCALE_SIGMA)


def _combined(sources: list[Scale], camera: Camera, normal: np.ndarray) -> Scale:
    """Return the scale of several sources: the mean of their log heights, by their own variances."""
    sigmas = relative_sigmas(sources, camera, normal)
    weights = sigmas**-2 / float((sigmas**-2).sum())

    def height(lens: Camera, up: np.ndarray) -> float:
        return float(np.exp(weights @ np.log([source.height(lens, up) for source in sources])))

    relative = float((sigmas**-2).sum()) ** -0.5
    return Scale(height, relative * height(camera, normal), True, derived=True, sources=tuple(sources))


def check_scale(height: float, sigma: float, gate: GateOptions) -> Reason | None:
    """Check a height against its total standard deviation."""
    if sigma <= gate.max_sigma_height_rel * height:
        return None
    return reason(
        'scale_uncertain', height_m=height, sigma=min(sigma / height, UNDETERMINED), limit=gate.max_sigma_height_rel
    )


def is_unusual(height_m: float) -> bool:
    """Whether a height differs enough from the default for an unknown height to estimate again with it."""
    return abs(np.log(height_m / DEFAULT_CAMERA_HEIGHT_M)) > np.log(SIMILAR_HEIGHT_FACTOR)


def _scale_from_distance(
    given: ScaleOptions, distance: KnownDistance, camera: Camera, normal: np.ndarray
) -> Scale | Reason:
    """Return the scale from two pixels on the road and the metres between them."""
    pixels, metres = np.array(distance.pixels), distance.metres
    bearings, valid = camera.unproject(pixels)
    below = -(bearings @ normal)
    for (u, v), sine, there in zip(distance.pixels, below, valid, strict=True):
        if not there:
            return reason('scale_off_road', 'outside_lens', u=u, v=v)
        if sine < MIN_DEPRESSION_SCALE_SINE:
            degrees, needed = np.degrees(np.arcsin([sine, MIN_DEPRESSION_SCALE_SINE]))
            side = 'below' if degrees > 0 else 'above'
            return reason('scale_off_road', u=u, v=v, angle_deg=abs(degrees), side=side, limit_deg=needed)

    def length(lens: Camera, up: np.ndarray, at: np.ndarray = pixels) -> float:
        return float(np.hypot(*np.subtract(*ground_points(lens, up, 1.0, at))))

    heights = length(camera, normal)
    steps = STEP_PX * np.eye(4).reshape(4, 2, 2)
    slopes = np.array(
        [length(camera, normal, pixels + step) - length(camera, normal, pixels - step) for step in steps]
    ) / (2 * STEP_PX)
    relative = np.hypot(given.distance_sigma_m / metres, given.pixel_sigma_px * np.linalg.norm(slopes) / heights)
    return Scale(
        lambda lens, up: metres / length(lens, up),
        float(metres / heights * relative),
        True,
        'scale_distance',
        {
            'distance_m': metres,
            'distance_sigma_m': given.distance_sigma_m,
            'pixel_sigma_px': given.pixel_sigma_px,
            'pixels': ' and '.join(f'({u:g}, {v:g})' for u, v in distance.pixels),
        },
        derived=True,
    )


def _scale_from_speed(given: ScaleOptions, camera: Camera, normal: np.ndarray, flow: TrackSet) -> Scale | Reason:
    """Return the scale from the mean speed of the traffic.

    A point at h above the road appears where its ray meets the road, H / (H - h) times as far and as fast: v m/s look
    like v / (H - h) heights a second. So the speed of the evidence gives H - h, and h is added. The mean over vehicles
    that pass a spot and the mean over vehicles on a road differ by variance over mean (Wardrop 1952); the sigma
    includes this difference, which is large in stop-and-go traffic.
    """
    tracks = _flowing(camera, normal, flow)
    vehicles = len(np.unique(tracks.vehicles))
    if vehicles < MIN_SPEED_VEHICLES:
        return reason('too_few_vehicles', vehicles=vehicles, limit=MIN_SPEED_VEHICLES)
    speeds = _vehicle_speeds(camera, normal, tracks)
    mean, error = trimmed_mean(speeds)
    varying = _variation(speeds) / mean
    above = given.speed_km_h * M_S_PER_KM_H / mean
    relative = np.linalg.norm([given.speed_sigma_km_h / given.speed_km_h, error / mean, varying**2])
    return Scale(
        lambda lens, up: (
            given.speed_km_h * M_S_PER_KM_H / trimmed_mean(_vehicle_speeds(lens, up, tracks))[0] + given.point_height_m
        ),
        float(np.hypot(above * relative, given.point_height_sigma_m)),
        True,
        'scale_speed',
        {
            'speed_km_h': given.speed_km_h,
            'speed_sigma_km_h': given.speed_sigma_km_h,
            'vehicles': vehicles,
            'variation': varying,
            'point_height_m': given.point_height_m,
            'point_height_sigma_m': given.point_height_sigma_m,
        },
        derived=True,
    )


def _flowing(camera: Camera, normal: np.ndarray, flow: TrackSet) -> TrackSet:
    """Tracks of the vehicles that flow with the traffic."""
    if not len(flow):
        return flow
    speeds = _vehicle_speeds(camera, normal, flow)
    slow = np.unique(flow.vehicles)[speeds < MIN_FLOW_SPEED_FRACTION * np.median(speeds)]
    return flow.subset(~np.isin(flow.vehicles, slow))


def _vehicle_speeds(camera: Camera, normal: np.ndarray, tracks: TrackSet) -> np.ndarray:
    """Speed of each vehicle as if its points were on the road, heights a second, shape (vehicles,).

    The median of its tracks. Points are weighted by the inverse variance of their position along the road for a given
    pixel noise, so that far points hardly count.
    """
    places = ground_points(camera, normal, 1.0, tracks.pixels.reshape(-1, 2)).reshape(tracks.pixels.shape)
    # the length of road that a pixel covers grows with the square of the distance from the camera
    weights = (tracks.weights > 0) / (1.0 + (places * places).sum(axis=-1)) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    times = tracks.sample_times_s - (weights * tracks.sample_times_s).sum(axis=1, keepdims=True)
    seconds2 = np.maximum((weights * times * times).sum(axis=1), 1e-12)  # times of damaged evidence may stand still
    speeds = np.hypot(*((weights * times)[..., None] * places).sum(axis=1).T) / seconds2
    order = np.argsort(tracks.vehicles, kind='stable')
    edges = np.flatnonzero(np.diff(tracks.vehicles[order])) + 1
    return np.array([np.median(part) for part in np.split(speeds[order], edges)])


def speed_variation(camera: Camera, normal: np.ndarray, tracks: TrackSet) -> float:
    """Return the standard deviation of the speeds of vehicles, relative to their median."""
    speeds = _vehicle_speeds(camera, normal, tracks)
    return _variation(speeds) / max(float(np.median(speeds)), 1e-12)


def _variation(speeds: np.ndarray) -> float:
    return MAD_TO_SIGMA * float(np.median(np.abs(speeds - np.median(speeds))))


def trimmed_mean(values: np.ndarray) -> tuple[float, float]:
    """Return the trimmed mean of values (n,) and its standard deviation (Tukey & McLaughlin 1963)."""
    cut = int(TRIM_FRACTION * len(values))
    ordered = np.sort(values)
    low, high = ordered[cut], ordered[len(values) - 1 - cut]
    spread = np.clip(ordered, low, high).std(ddof=1)
    kept = len(values) - 2 * cut
    return float(ordered[cut : len(values) - cut].mean()), float(spread * np.sqrt(len(values)) / kept)

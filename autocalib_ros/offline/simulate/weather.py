"""Image effects that are not traffic: shadows, water, wet road, lit signals; rain, drops and clock by lens_effects."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from autocalib_ros.offline.simulate.faces import NO_MAP
from autocalib_ros.offline.simulate.ground_surface import edge_distance
from autocalib_ros.offline.simulate.lamps import vehicle_lamps
from autocalib_ros.offline.simulate.lens import CameraPose, KannalaBrandtLens
from autocalib_ros.offline.simulate.lens_effects import apply_drops, apply_rain, burn_in_clock, spawn_drops
from autocalib_ros.offline.simulate.network import Network
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.paint import octave_noise
from autocalib_ros.offline.simulate.palette import Colour
from autocalib_ros.offline.simulate.sensor import add_glow
from autocalib_ros.offline.simulate.vehicle_models import Vehicle, VehicleState

_GROUND_DEPTH_MARGIN_M = 0.4
"""A pixel nearer than the ground by more than this shows an object. Judgement."""
_SUN_RAD = math.radians(28.0)
_SHADOW_ATTENUATION = 0.5
_CLOUD_SPEED_MPS, _CLOUD_SIZE_M, _CLOUD_ATTENUATION = 7.0, 45.0, 0.4
_CLOUD_TEXELS = 256
_POND_SEMI_AXES_M = (5.0, 3.5)
_WAVE_COUNT = 10
_GRAVITY_MPS2 = 9.81
_PUDDLE_SIZE_M = 1.5
"""Size of the puddles and dry patches of a wet road."""
_REFLECTION_DEPTHS_M = (0.25, 0.45, 0.7, 1.0, 1.5)
"""Depths below the road at which a rough wet surface reflects a lamp 0.7 m above it."""
_SIGNAL_LAMP_SIZE_M = 0.12
_SIGNAL_HEAD_HEIGHT_M = 3.6
_MIN_SIGNAL_DISTANCE_M = 9.0
"""Minimum distance of a signal from the camera."""


@dataclass(frozen=True)
class GroundBuffer:
    """Ground intersection of each pixel's ray."""

    xy: np.ndarray
    """Position in metres (h, w, 2); far away in the sky."""
    distance_m: np.ndarray
    """Distance from the camera (h, w); infinite in the sky."""
    off_road_m: np.ndarray
    """Signed distance to the edge of the asphalt (h, w), negative on it."""

    @classmethod
    def of(cls, options: SimulationOptions, network: Network, pose: CameraPose) -> GroundBuffer:
        """Intersect every pixel's ray with the ground plane."""
        grid = np.stack(np.meshgrid(np.arange(options.width_px), np.arange(options.height_px)), -1)
        rays = options.lens.bearings(grid) @ pose.world_from_camera.T
        down = rays[..., 2] < -0.01
        distance = np.where(down, -pose.position_m[2] / np.minimum(rays[..., 2], -0.01), np.inf)
        reach = np.where(down, distance, 1e4)
        xy = pose.position_m[:2] + rays[..., :2] * reach[..., None]
        return cls(xy.astype(np.float32), distance.astype(np.float32), edge_distance(network, xy).astype(np.float32))

    def visible(self, depth_m: np.ndarray) -> np.ndarray:
        """Return the mask (h, w) of visible ground, given the depth map (h, w)."""
        return np.isfinite(self.distance_m) & (depth_m > self.distance_m - _GROUND_DEPTH_MARGIN_M)


@dataclass(frozen=True)
class FrameContext:
    """Input of the image effects of one frame."""

    image: np.ndarray
    depth_m: np.ndarray
    """Depth map (h, w)."""
    pose: CameraPose
    vehicles: list[tuple[Vehicle, VehicleState]]
    index: int
    time_s: float


class Weather:
    """Effects of one recording, drawn into rendered images; each frame depends only on its index."""

    def __init__(self, options: SimulationOptions, network: Network, poses: dict[bool, CameraPose]) -> None:
        self._options, self._network, self._troubles = options, network, options.troubles
        self._lens: KannalaBrandtLens = options.lens
        self._ground = (
            {bumped: GroundBuffer.of(options, network, pose) for bumped, pose in poses.items()}
            if self._troubles & {'shadows', 'water', 'wet'}
            else {}
        )
        rng = np.random.default_rng([options.seed, 11])
        self._sun_rad = float(rng.uniform(0, 2 * np.pi))
        wind = rng.uniform(0, 2 * np.pi)
        self._wind = np.array([math.cos(wind), math.sin(wind)])
        size = _CLOUD_TEXELS
        self._clouds = np.clip(0.5 + octave_noise(size, size, ((32.0, 0.5),), rng), 0, 1)
        self._puddles = np.clip(0.55 + octave_noise(size, size, ((2.0, 0.25), (6.0, 0.3)), rng), 0, 1)
        self._waves = _deep_water_waves(wind, rng)
        self._pond = self._pond_mask(rng) if 'water' in self._troubles else None
        self._drops = spawn_drops(options.width_px, options.height_px, rng)

    def apply_ground_effects(self, context: FrameContext, bumped: bool) -> None:
        """Apply the effects of daylight on the ground: shadows, water."""
        if 'water' in self._troubles:
            self._draw_waves(context, bumped)
        if 'shadows' in self._troubles:
            self._darken_shadows(context, bumped)

    def add_light_sources(self, context: FrameContext, bumped: bool) -> None:
        """Add light sources: reflected lamps, signals."""
        if 'wet' in self._troubles:
            self._add_lamp_reflections(context, bumped)
        if 'leds' in self._troubles:
            self._add_signal_lamps(context)

    def apply_lens_effects(self, context: FrameContext) -> np.ndarray:
        """Return the image with rain, drops on the lens and the clock of the recorder."""
        image = context.image
        if 'rain' in self._troubles:
            rng = np.random.default_rng([self._options.seed, 12, context.index])
            image = apply_rain(image, self._lens.focal_px, rng)
        if 'drops' in self._troubles:
            image = apply_drops(image, self._drops, context.time_s)
        if 'clock' in self._troubles:
            burn_in_clock(image, context.time_s)
        return image

    def _darken_shadows(self, context: FrameContext, bumped: bool) -> None:
        """Darken the ground in the shadows of moving clouds and of vehicles."""
        ground = self._ground[bumped]
        coarse = ground.xy[::8, ::8] - self._wind.astype(np.float32) * np.float32(_CLOUD_SPEED_MPS * context.time_s)
        texels = np.mod(coarse * (_CLOUD_TEXELS / (8 * _CLOUD_SIZE_M)), _CLOUD_TEXELS).astype(np.float32)
        cloud = cv2.remap(self._clouds, texels, NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        height, width = ground.distance_m.shape
        light = 1 - _CLOUD_ATTENUATION * cv2.resize(cloud, (width, height), interpolation=cv2.INTER_LINEAR)
        mask = np.zeros((height, width), np.uint8)
        for vehicle, state in context.vehicles:
            outline = self._shadow_outline(vehicle, state, context.pose)
            if outline is not None:
                cv2.fillConvexPoly(mask, outline, 255, cv2.LINE_AA, 4)
        shadow = cv2.GaussianBlur(mask, (0, 0), 1.0).astype(np.float32) / 255
        light *= 1 - _SHADOW_ATTENUATION * shadow
        light[~ground.visible(context.depth_m)] = 1.0
        context.image[:] = (context.image * light[..., None]).astype(np.uint8)

    def _shadow_outline(self, vehicle: Vehicle, state: VehicleState, pose: CameraPose) -> np.ndarray | None:
        """Return the outline (n, 2) of a cast shadow in 1/16 px, or None if it is not entirely in view."""
        shape = vehicle.shape
        base = box_corners(vehicle, state)[:4, :2]
        top = max(part.top_m for part in shape.parts)
        away = top / math.tan(_SUN_RAD) * np.array([math.cos(self._sun_rad), math.sin(self._sun_rad)])
        hull = cv2.convexHull(np.concatenate([base, base + away]).astype(np.float32))[:, 0]
        parts = np.linspace(0, 1, 6)[:-1, None]
        dense = np.concatenate([a + parts * (b - a) for a, b in zip(hull, np.roll(hull, -1, axis=0), strict=True)])
        pixels, valid = self._lens.project(pose.to_camera(np.pad(dense, ((0, 0), (0, 1)))))
        return np.round(pixels * 16).astype(np.int32) if valid.all() else None

    def _pond_mask(self, rng: np.random.Generator) -> dict[bool, tuple[np.ndarray, np.ndarray]]:
        """Place a pond beside the road; return its pixel rows and columns (n,) per camera pose."""
        ground = self._ground[False]
        fit = np.argwhere(
            (ground.off_road_m > _POND_SEMI_AXES_M[1] + 2.5)
            & (ground.off_road_m < _POND_SEMI_AXES_M[1] + 9.0)
            & (ground.distance_m < 40.0)
        )
        if not len(fit):
            return {}
        row, column = fit[int(rng.integers(len(fit)))]
        centre = ground.xy[row, column]
        masks: dict[bool, tuple[np.ndarray, np.ndarray]] = {}
        for bumped, buffer in self._ground.items():
            rows, columns = np.nonzero((((buffer.xy - centre) / _POND_SEMI_AXES_M) ** 2).sum(-1) < 1)
            masks[bumped] = rows, columns
        return masks

    def _draw_waves(self, context: FrameContext, bumped: bool) -> None:
        """Draw waves that travel with the wind, with sun glitter on their slopes."""
        if not self._pond:
            return
        rows, columns = self._pond[bumped]
        ground = self._ground[bumped]
        visible = ground.visible(context.depth_m)[rows, columns]
        rows, columns = rows[visible], columns[visible]
        numbers, rates, phases = self._waves
        slope = np.sin(ground.xy[rows, columns] @ numbers.T - rates * context.time_s + phases).sum(-1) / math.sqrt(
            _WAVE_COUNT
        )
        level = 70 + 28 * slope + 130 * (slope > 1.3)
        context.image[rows, columns] = np.clip(level[:, None] * (1.0, 0.95, 0.8), 0, 255).astype(np.uint8)

    def _add_lamp_reflections(self, context: FrameContext, bumped: bool) -> None:
        """Add the reflections of lamps in the wet road: mirror images below it, smeared by its roughness."""
        ground, camera = self._ground[bumped], context.pose.position_m
        height, width = ground.distance_m.shape
        for lamp in (lamp for vehicle, state in context.vehicles for lamp in vehicle_lamps(vehicle, state)):
            for depth in _REFLECTION_DEPTHS_M:
                below = np.array([*lamp.position_m[:2], -depth])
                to_camera = camera - below
                distance = float(np.linalg.norm(to_camera))
                turned = float(lamp.direction @ to_camera[:2]) / distance
                pixel, valid = self._lens.project(context.pose.to_camera(below))
                column, row = (round(float(c)) for c in pixel)
                if turned < 0.05 or not valid or not (0 <= row < height and 0 <= column < width):
                    continue
                if context.depth_m[row, column] < ground.distance_m[row, column] - _GROUND_DEPTH_MARGIN_M:
                    continue
                texel = (ground.xy[row, column] / _PUDDLE_SIZE_M * 6.0).astype(int) % _CLOUD_TEXELS
                # Schlick approximation: a film of water reflects more at grazing angles.
                reflectance = 0.05 + 0.95 * (1 - float(to_camera[2]) / distance) ** 5
                gain = 1.6 * reflectance * float(self._puddles[texel[1], texel[0]]) * min(1.0, 0.35 + turned)
                radius = max(1.2, 1.3 * lamp.size_m * self._lens.focal_px / distance)
                add_glow(context.image, pixel, radius, _scaled(lamp.colour, min(gain, 0.7)))

    def _add_signal_lamps(self, context: FrameContext) -> None:
        """Add lit signal lamps, whose LED pulses beat with the exposures."""
        stop_lines = self._network.stop_lines
        if not self._network.phases or stop_lines is None:
            return
        for number, road in enumerate(self._network.roads):
            for side in (1, -1):
                foot = road.at(side * stop_lines.stop_m, side * (road.half_width_m + 0.5))
                red = int(context.time_s / 12 + number) % 2
                lamp = np.array([*foot, _SIGNAL_HEAD_HEIGHT_M + 0.35 * red])
                pixel, valid = self._lens.project(context.pose.to_camera(lamp))
                column, row = (round(float(c)) for c in pixel)
                inside = 0 <= row < self._options.height_px and 0 <= column < self._options.width_px
                distance = float(np.linalg.norm(context.pose.position_m - lamp))
                if (
                    not valid
                    or not inside
                    or distance < _MIN_SIGNAL_DISTANCE_M
                    or context.depth_m[row, column] < distance - 1.0
                ):
                    continue
                beat = np.clip(
                    0.5 + 0.9 * math.sin(2 * np.pi * (3.1 + 0.7 * number) * context.time_s + side), 0.05, 1.0
                )
                colour = (60, 60, 255) if red else (190, 255, 60)
                add_glow(
                    context.image,
                    pixel,
                    max(1.5, _SIGNAL_LAMP_SIZE_M * self._lens.focal_px / distance * 1.5),
                    _scaled(colour, float(beat)),
                )


def box_corners(vehicle: Vehicle, state: VehicleState) -> np.ndarray:
    """Return the corners (8, 3) of a vehicle's bounding box, the four on the ground first."""
    shape = vehicle.shape
    c, s = math.cos(state.heading), math.sin(state.heading)
    length, width = shape.length_m / 2, shape.width_m / 2
    base = np.array([(length, width), (length, -width), (-length, -width), (-length, width)])
    base = base @ np.array([[c, s], [-s, c]]) + (state.x, state.y)
    top = max(part.top_m for part in shape.parts)
    return np.concatenate([np.pad(base, ((0, 0), (0, 1)), constant_values=z) for z in (0.0, top)])


def _scaled(colour: Colour, gain: float) -> Colour:
    blue, green, red = (round(c * gain) for c in colour)
    return blue, green, red


def _deep_water_waves(wind: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return wave vectors (n, 2) in rad/m, angular frequencies (n,) of deep-water waves, and phases (n,)."""
    length = np.exp(rng.uniform(math.log(0.4), math.log(2.5), _WAVE_COUNT))
    heading = wind + rng.normal(0, 0.5, _WAVE_COUNT)
    number = 2 * np.pi / length
    return (
        number[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1),
        np.sqrt(_GRAVITY_MPS2 * number),
        rng.uniform(0, 2 * np.pi, _WAVE_COUNT),
    )

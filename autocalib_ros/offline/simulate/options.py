"""Options of a simulated recording."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

from autocalib_ros.errors import UsageError
from autocalib_ros.offline.simulate.lens import KannalaBrandtLens

SCENES = ('junction', 'road', 'highway', 'bend', 'roundabout', 'skew', 'tee', 'sparse')
SQUARE_DEG = 90.0
"""Default angle between the roads of a junction."""
SKEW_DEG = 65.0
"""Default angle between the roads of scene skew."""
ONE_WAY_SCENES = ('junction', 'road', 'highway', 'bend')
STORAGES = ('sqlite3', 'mcap')
SHUTTER_SHOWS = ('frozen', 'flat')
TROUBLES = ('trees', 'flags', 'leds', 'drops', 'rain', 'water', 'shadows', 'wet', 'clock')


def _option(default: Any, help_text: str) -> Any:
    return field(default=default, metadata={'help': help_text})


@dataclass(frozen=True, kw_only=True)
class SimulationOptions:
    """All options of the simulator with their defaults.

    Valid by construction: an invalid value or combination raises `UsageError`.
    """

    scene: str = _option('junction', 'road network: ' + ' or '.join(SCENES))
    seed: int = _option(0, 'seed of the random generators')

    width_px: int = _option(1280, 'image width')
    height_px: int = _option(720, 'image height')
    rate_hz: float = _option(15.0, 'frames per second')
    duration_s: float = _option(60.0, 'length of the recording')

    focal_px: float = _option(560.0, 'focal length of the lens')
    k: tuple[float, float, float, float] = _option((0.01, 0.0, 0.0, 0.0), 'Kannala-Brandt coefficients k1..k4')
    principal_point_offset_px: tuple[float, float] = _option((6.0, -4.0), 'principal point minus image centre, x and y')

    camera_height_m: float = _option(8.0, 'height of the camera above the road')
    pitch_deg: float = _option(32.0, 'pitch of the optical axis below the horizontal')
    yaw_deg: float | None = _option(
        None, 'heading of the optical axis, counter-clockwise from the first road; default: towards the traffic'
    )
    roll_deg: float = _option(0.8, 'roll about the optical axis, clockwise as seen from behind the camera')
    position_m: tuple[float, float] | None = _option(None, 'ground point below the camera; default: beside the road')

    density: float = _option(9.0, 'vehicles per minute and lane; one fifteenth of it in scene sparse')
    turning_fraction: float = _option(0.18, 'fraction of the vehicles that turn or change lanes')
    road_angle_deg: float | None = _option(
        None,
        f'angle between the two roads of a junction; default {SQUARE_DEG:g}, in scene skew {SKEW_DEG:g}',
    )
    one_way: bool = _option(False, 'a single road with one-way traffic')
    wander_m: float = _option(0.1, 'standard deviation of the lateral wander within the lane')
    pedestrians: int = _option(10, 'pedestrians on the pavements')
    cyclists: int = _option(0, 'cyclists along the kerbs and on the pavements; none at a roundabout')
    empty: bool = _option(False, 'no vehicles, pedestrians or cyclists')

    noise_sigma: float = _option(2.0, 'standard deviation of the sensor noise in grey levels')
    night: bool = _option(False, 'night: darkness, head lamps, more noise')
    thermal: bool = _option(False, 'thermal camera: mono16 instead of bgr8')
    shutter_every_s: float | None = _option(
        None,
        'seconds between flat-field corrections of a thermal camera; each closes the shutter for 0.5 s and '
        'changes offset and fixed-pattern noise; default: never',
    )
    shutter_shows: str = _option(
        'frozen', 'what a thermal camera sends while its shutter is closed: the last image, or the flat shutter'
    )
    shake_px: float = _option(0.0, 'standard deviation of the camera shake in the image')
    trouble: str = _option('', 'disturbances that are not traffic, comma-separated: ' + ', '.join(TROUBLES))
    bump_at_s: float | None = _option(None, 'time at which the camera is bumped')
    bump_deg: float = _option(2.0, 'rotation angle of the bump; 25 is a camera that was aimed elsewhere')
    sway_deg: float = _option(0.0, 'largest angle of the sway of the mast in gusts of wind')
    sway_rate_hz: float = _option(0.7, 'swings of the mast per second')
    drift_deg: float = _option(0.0, 'angle by which the camera turns slowly in the whole recording')
    zoom_at_s: float | None = _option(None, 'time at which the lens is zoomed')
    zoom: float = _option(1.2, 'focal length after the zoom over that before')
    dusk: bool = _option(False, 'from daylight to a night without lamps in the course of the recording')

    topic: str = _option('/camera/image_raw', 'image topic')
    truth_topic: str = _option('/camera/truth/camera_info', 'topic of the true CameraInfo')
    frame_id: str = _option('camera_optical_frame', 'frame of the images')
    compressed: bool = _option(False, 'write CompressedImage on TOPIC/compressed')
    storage: str = _option('sqlite3', 'rosbag2 storage: ' + ' or '.join(STORAGES))
    zstd: bool = _option(False, 'compress every message with zstd')

    def __post_init__(self) -> None:
        self._check_names()
        for name, (low, high) in _RANGES.items():
            _check_range(name, getattr(self, name), low, high)
        self._check_combinations()
        self._check_lens()

    @property
    def frame_count(self) -> int:
        """Number of frames of the recording, at least one."""
        return max(1, round(self.duration_s * self.rate_hz))

    @property
    def troubles(self) -> frozenset[str]:
        """The disturbances that are not traffic."""
        return frozenset(filter(None, self.trouble.split(',')))

    @property
    def road_crossing_deg(self) -> float:
        """Angle between the two roads of a junction."""
        if self.road_angle_deg is not None:
            return self.road_angle_deg
        return SKEW_DEG if self.scene == 'skew' else SQUARE_DEG

    @property
    def lens(self) -> KannalaBrandtLens:
        """The true lens."""
        dx, dy = self.principal_point_offset_px
        centre = ((self.width_px - 1) / 2 + dx, (self.height_px - 1) / 2 + dy)
        return KannalaBrandtLens(self.focal_px, tuple(self.k), centre)

    def _check_names(self) -> None:
        for name, allowed in (('scene', SCENES), ('storage', STORAGES), ('shutter_shows', SHUTTER_SHOWS)):
            if getattr(self, name) not in allowed:
                raise UsageError(f'unknown {name} {getattr(self, name)!r}: choose {" or ".join(allowed)}')
        for name in sorted(self.troubles - frozenset(TROUBLES)):
            raise UsageError(f'unknown trouble {name!r}: choose from {", ".join(TROUBLES)}, separated by commas')
        for name in ('topic', 'truth_topic'):
            if not getattr(self, name).startswith('/'):
                raise UsageError(f'{name} {getattr(self, name)!r} is not absolute: start it with "/"')
        if self.topic == self.truth_topic:
            raise UsageError(f'topic and truth_topic are both {self.topic!r}: name two topics')

    def _check_combinations(self) -> None:
        if self.night and self.thermal:
            raise UsageError('night and thermal are mutually exclusive: choose one')
        if self.shutter_every_s is not None and not self.thermal:
            raise UsageError('shutter_every_s requires thermal: only thermal cameras have such a shutter')
        if self.troubles and self.thermal:
            raise UsageError('trouble is not available for thermal cameras: leave out trouble or thermal')
        if 'wet' in self.troubles and not self.night:
            raise UsageError('trouble wet needs night: it shows lamps reflected by the road')
        if self.one_way and self.scene not in ONE_WAY_SCENES:
            raise UsageError(f'scene {self.scene!r} has no one_way: choose {" or ".join(ONE_WAY_SCENES)}')
        if self.dusk and (self.night or self.thermal):
            raise UsageError('dusk is from day to night: leave out night and thermal')
        for name in ('bump_at_s', 'zoom_at_s'):
            at_s = getattr(self, name)
            if at_s is not None and not 0.0 < at_s < self.duration_s:
                raise UsageError(
                    f'{name} is {at_s:g}, outside the recording: choose a time between 0 and {self.duration_s:g} s'
                )

    def _check_lens(self) -> None:
        if len(self.k) != 4:
            raise UsageError(f'k has {len(self.k)} numbers, not four: give k1 k2 k3 k4')
        lens = self.lens
        corner_px = max(
            math.dist(lens.centre_px, (x, y)) for x in (0, self.width_px - 1) for y in (0, self.height_px - 1)
        )
        if corner_px > lens.radius_limit_px:
            raise UsageError(
                f'the lens model is invalid beyond {lens.radius_limit_px:.0f} px from the principal point, '
                f'but an image corner is {corner_px:.0f} px away: '
                'use a longer focal length, a smaller image or smaller coefficients'
            )


_RANGES = {
    'width_px': (64, 8192),
    'height_px': (64, 8192),
    'seed': (0, 2**63 - 1),
    'rate_hz': (0.1, 240.0),
    'duration_s': (0.01, 24 * 3600.0),
    'focal_px': (10.0, 1e5),
    'camera_height_m': (2.0, 100.0),
    'pitch_deg': (-10.0, 90.0),
    'yaw_deg': (-360.0, 360.0),
    'roll_deg': (-180.0, 180.0),
    'density': (0.0, 60.0),
    'turning_fraction': (0.0, 1.0),
    'road_angle_deg': (45.0, 135.0),
    'wander_m': (0.0, 1.0),
    'pedestrians': (0, 200),
    'cyclists': (0, 200),
    'noise_sigma': (0.0, 30.0),
    'shutter_every_s': (2.0, 3600.0),
    'shake_px': (0.0, 20.0),
    'bump_deg': (-30.0, 30.0),
    'sway_deg': (0.0, 5.0),
    'sway_rate_hz': (0.05, 5.0),
    'drift_deg': (-30.0, 30.0),
    'zoom': (0.5, 2.0),
}


def _check_range(name: str, value: float | None, low: float, high: float) -> None:
    if value is not None and not low <= value <= high:
        raise UsageError(f'{name} is {value:g}: choose a value between {low:g} and {high:g}')


def option_help() -> dict[str, str]:
    """Return the one-line explanation of every option, by field name."""
    return {f.name: f.metadata['help'] for f in fields(SimulationOptions)}

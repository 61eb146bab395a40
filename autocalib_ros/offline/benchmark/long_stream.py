"""Hours of images from a short recording: its images in the light and weather of days, as a camera on a mast sees them.

Only what the camera does and what the sky does is made up. Traffic is that of the recording, played to and fro; now and
then it stands as a jam, for minutes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from autocalib_ros.errors import InputError
from autocalib_ros.lens.camera import Camera, pixel_grid
from autocalib_ros.offline.ground_truth import read_truth, true_camera
from autocalib_ros.offline.move_log import GUESSED_FOCAL_WIDTHS
from autocalib_ros.offline.recordings.open import open_source
from autocalib_ros.offline.simulate.camera_motion import MOTION_GRID, resampled
from autocalib_ros.perception.background import median
from autocalib_ros.perception.view_registration import registered_image
from autocalib_ros.results.camera_move import rotation_from_turn

MAX_RECORDED = 450
"""Most images of a recording in memory: 104 MB at 640x360."""
BACKGROUND_IMAGES = 15
"""Images of the recording whose median is the road without its traffic."""
TRAFFIC_LEVELS = 20
"""Difference from that by which traffic is told, grey levels."""
GUST_AXES = np.array([0.8, 0.5, 0.33])
"""Pan, tilt and roll of the sway: pan most, since the arm twists."""
GUST_DEG, GUST_HZ, GUST_PERIODS_S = 0.15, 0.7, (23.0, 611.0)
"""Largest sway, its frequency, and the periods of the gusts and of the wind."""
NIGHT_LIGHT, DUSK_WIDTH = 0.07, 0.12
"""Light of the night over that of the day, and the sine of the sun's height within which one becomes the other."""
LAMPS, LAMP_LIGHT, LAMP_WIDTHS = 4, 0.45, 0.16
"""Street lamps, their light over that of the day, and the radius of a pool of light over the image width."""
GLARE_LEVELS = 130.0
"""Brightness of the glare of headlamps, grey levels."""
CLOUD_DEPTH, CLOUD_PX_PER_S = 0.4, 3.0
"""Part of the light that a cloud takes, and its speed in the image."""
SHADOW_DEPTH, SHADOW_DAY_WIDTHS, SHADOW_STEP_S = 0.35, 1.5, 60.0
"""Part of the light that shadows take, the image widths that they wander in a day, and the interval between steps."""
FLICKER, FLICKER_HZ = 0.03, 0.37
"""Relative amplitude and frequency of the beat between mains light and shutter."""
RAIN_PERIOD_S, RAIN_S, RAIN_LEVELS, HAZE = 9_000.0, 1_500.0, 35.0, 0.25
"""Interval between showers, their duration, the brightness of drops in grey levels, the contrast that haze takes."""
JAM_PERIOD_S, JAM_S = 1_700.0, (120.0, 240.0)
"""Interval between jams, and their least and most duration."""
NOISE_LEVELS, NIGHT_NOISE = 2.5, 2.0
"""Standard deviation of the noise by day in grey levels, and by how much it is larger by night."""
NOISE_FIELDS = 7
"""Fields of noise and of rain drops that are shifted at random."""
START_OF_DAY = 0.3
"""Part of a day that has passed at time 0, since sunrise: dusk comes a fifth of a day later."""


@dataclass(frozen=True)
class ShortRecording:
    """Grey images (H, W) of a still camera at a fixed rate, with its lens for images of that size."""

    name: str
    images: Sequence[np.ndarray]
    rate_hz: float
    camera: Camera


def read_short_recording(path: Path, width: int, rate_hz: float, most: int) -> ShortRecording:
    """Read at most `most` images at `rate_hz`, at most `width` pixels wide.

    A truth.json beside the recording gives its lens; without one, a lens of 95 degrees stands for it. InputError if
    the recording has no images.
    """
    source = open_source(path)
    images: list[np.ndarray] = []
    size, due_ns = (1, 1), -math.inf
    for frame in source.frames():
        if frame.stamp_ns >= due_ns and len(images) < most:
            due_ns = frame.stamp_ns + 1e9 / rate_hz - 1e6
            size = (frame.image.shape[1], frame.image.shape[0])
            across = min(width, size[0])
            images.append(registered_image(frame.image, (across, round(size[1] * across / size[0]))))
    if not images:
        raise InputError(f'{source.name} has no images')
    truth = path.parent / 'truth.json'
    lens = true_camera(read_truth(truth)).lens if truth.is_file() else None
    camera = lens if isinstance(lens, Camera) else Camera.equidistant(*size, GUESSED_FOCAL_WIDTHS * size[0])
    camera = camera.scaled_to(images[0].shape[1], images[0].shape[0])
    return ShortRecording(f'{path.parent.name}/{path.stem}', images, rate_hz, camera)


class LongStream:
    """Images of a recording at any time of days of `day_s` seconds, without a move of the camera.

    Sway in gusts, clouds, shadows that wander, showers, flicker, jams of minutes, nights with lamps and headlamps.
    """

    def __init__(self, recording: ShortRecording, day_s: float, seed: int = 0) -> None:
        images = recording.images
        self._images, self._rate_hz, self._day_s = images, recording.rate_hz, day_s
        self._generator = np.random.default_rng(seed)
        height, width = images[0].shape
        self.background = median(list(images[:: max(1, len(images) // BACKGROUND_IMAGES)][:BACKGROUND_IMAGES]))
        traffic = [cv2.absdiff(image, self.background) > TRAFFIC_LEVELS for image in images]
        busiest = max(range(len(images)), key=lambda index: int(np.count_nonzero(traffic[index])))
        jammed = cv2.dilate(traffic[busiest].astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
        self._jam = np.where(jammed, images[busiest], self.background)
        self._slopes = _slopes_of_turns(recording.camera)
        self._clouds = _soft_field(self._generator, (height // 4, width), height / 24.0)
        self._shadows = (_soft_field(self._generator, (height, 3 * width), height / 12.0) > 0).astype(np.float32)
        self._lamps = _pools_of_light(self._generator, (height // 4, width // 4))
        self._noise = [
            self._generator.normal(scale=NOISE_LEVELS, size=(height, width)).astype(np.float32)
            for _ in range(NOISE_FIELDS)
        ]
        self._drops = [_drops(self._generator, (height, width)) for _ in range(NOISE_FIELDS)]
        self._shade, self._shade_step = np.ones((height, width), np.float32), -1

    @property
    def period_s(self) -> float:
        """Time in which the traffic is played to and fro once, seconds."""
        return 2.0 * len(self._images) / self._rate_hz

    def daylight(self, time_s: float) -> float:
        """Return the share of daylight, 0 by night to 1."""
        height = math.sin(2.0 * math.pi * (time_s / self._day_s + START_OF_DAY))
        return float(np.clip(0.5 + 0.5 * height / DUSK_WIDTH, 0.0, 1.0))

    def is_jammed(self, time_s: float) -> bool:
        """Whether the vehicles stand."""
        number, since_s = divmod(time_s, JAM_PERIOD_S)
        least, most = JAM_S
        return since_s < least + (most - least) * ((number * 0.6180339887) % 1.0)

    def is_raining(self, time_s: float) -> bool:
        """Whether there is a shower."""
        return time_s % RAIN_PERIOD_S > RAIN_PERIOD_S - RAIN_S

    def sway_deg(self, time_s: float) -> np.ndarray:
        """Return pan, tilt and roll by the wind, degrees (3,)."""
        gust, wind = (0.5 + 0.5 * math.sin(2.0 * math.pi * time_s / period_s) for period_s in GUST_PERIODS_S)
        return GUST_DEG * gust * wind * math.sin(2.0 * math.pi * GUST_HZ * time_s) * GUST_AXES

    def image(self, time_s: float, *, traffic: bool = True) -> np.ndarray:
        """Return the grey image (H, W) of a time, uint8; without `traffic` there are only jams on the road."""
        day = self.daylight(time_s)
        image = self._scene(time_s, traffic)
        lit = cv2.multiply(image, self._light(time_s, day), dtype=cv2.CV_32F)
        if traffic and day < 0.5 and not self.is_jammed(time_s):
            lit = cv2.scaleAdd(self._glare(image), 1.0 - 2.0 * day, lit)
        if self.is_raining(time_s):
            lit = lit * (1.0 - HAZE) + HAZE * 110.0 * max(day, NIGHT_LIGHT) + self._shifted(self._drops)
        turned = self._turned(lit, self.sway_deg(time_s))
        turned += self._shifted(self._noise) * (1.0 + (NIGHT_NOISE - 1.0) * (1.0 - day))
        return cv2.convertScaleAbs(np.maximum(turned, 0.0))

    def _scene(self, time_s: float, traffic: bool) -> np.ndarray:
        if self.is_jammed(time_s):
            return self._jam
        if not traffic:
            return self.background
        count = len(self._images)
        place = int(time_s * self._rate_hz + 1e-6) % max(1, 2 * count - 2)
        return self._images[place if place < count else 2 * count - 2 - place]

    def _light(self, time_s: float, day: float) -> np.ndarray:
        """Return the factor (H, W) by which the picture is lit, float32."""
        height, width = self.background.shape
        begin = int(time_s * CLOUD_PX_PER_S / 4.0) % (self._clouds.shape[1] - width // 4)
        clouds = 1.0 - CLOUD_DEPTH * self._clouds[:, begin : begin + width // 4]
        flicker = 1.0 + FLICKER * math.sin(2.0 * math.pi * FLICKER_HZ * time_s)
        small = day * clouds + (1.0 - day) * (NIGHT_LIGHT + LAMP_LIGHT * self._lamps)
        light = cv2.resize((flicker * small).astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        step = int(time_s / SHADOW_STEP_S)
        if step != self._shade_step:
            self._shade_step = step
            moved = int(SHADOW_DAY_WIDTHS * width * ((step * SHADOW_STEP_S / self._day_s) % 1.0))
            self._shade = 1.0 - SHADOW_DEPTH * day * cv2.blur(self._shadows[:, moved : moved + width], (5, 5))
        return cv2.multiply(light, self._shade)

    def _glare(self, image: np.ndarray) -> np.ndarray:
        """Return what headlamps add, grey levels (H, W)."""
        moving = (cv2.absdiff(image, self.background) > TRAFFIC_LEVELS).astype(np.float32)
        small = cv2.resize(moving, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        glow = cv2.GaussianBlur(small, (0, 0), 3.0)
        return cv2.resize(GLARE_LEVELS * glow, image.shape[::-1], interpolation=cv2.INTER_LINEAR)

    def _shifted(self, fields: list[np.ndarray]) -> np.ndarray:
        """Return one of the fields (H, W), moved and mirrored at random."""
        field = fields[int(self._generator.integers(len(fields)))]
        down, across = (int(self._generator.integers(side)) for side in field.shape)
        field = np.roll(field, (down, across), axis=(0, 1))
        return field[:, ::-1] if down % 2 else field

    def _turned(self, image: np.ndarray, turn_deg: np.ndarray) -> np.ndarray:
        """Return an image (H, W) as a camera sees it that turned by a small angle."""
        start, slopes = self._slopes
        return resampled(image, start + np.tensordot(turn_deg, slopes, axes=1))


def _slopes_of_turns(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (rows, columns, 2) of a grid, and by what they move per degree of pan, tilt, roll (3, ...)."""
    columns, rows = MOTION_GRID
    bearings, _ = camera.unproject(pixel_grid(camera, columns, rows))
    start, _ = camera.project(bearings)
    step_deg = 0.1
    ends = [camera.project(bearings @ rotation_from_turn(np.radians(step)))[0] for step in step_deg * np.eye(3)]
    slopes = np.stack([(end - start) / step_deg for end in ends])
    return start.reshape(rows, columns, 2), slopes.reshape(3, rows, columns, 2)


def _soft_field(generator: np.random.Generator, shape: tuple[int, int], smooth_px: float) -> np.ndarray:
    """Return a random field (rows, columns) between 0 and 1 without hard edges, float32; its mean is a half or so."""
    field = cv2.GaussianBlur(generator.normal(size=shape).astype(np.float32), (0, 0), smooth_px)
    return ((np.tanh(2.0 * field / field.std()) + 1.0) / 2.0).astype(np.float32)


def _pools_of_light(generator: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Return the light of street lamps (rows, columns), 0 to 1 or so, float32."""
    rows, columns = np.indices(shape)
    light = np.zeros(shape)
    for index in range(LAMPS):
        x, y = (index + generator.uniform(0.2, 0.8)) / LAMPS * shape[1], generator.uniform(0.3, 0.9) * shape[0]
        light += np.exp(-0.5 * ((columns - x) ** 2 + (1.6 * (rows - y)) ** 2) / (LAMP_WIDTHS * shape[1]) ** 2)
    return light.astype(np.float32)


def _drops(generator: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Return a picture (H, W) of streaks of rain, grey levels."""
    drops = np.zeros(shape, np.float32)
    height, width = shape
    for _ in range(width // 2):
        x, y = int(generator.integers(width)), int(generator.integers(height))
        end = (x + int(generator.integers(-2, 3)), y + int(generator.integers(6, 22)))
        cv2.line(drops, (x, y), end, float(generator.uniform(0.3, 1.0)) * RAIN_LEVELS, 1, cv2.LINE_AA)
    return drops

"""Effects between scene and recorder: rain, drops on the front glass, burnt-in clock."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from autocalib_ros.offline.simulate.faces import NO_MAP

_DROP_COUNT = 9
_RAIN_STREAK_COUNT = 350
_RAIN_FALL_MPS, _EXPOSURE_S = 7.0, 1 / 60
"""Fall speed of drops and exposure time: their product is the length of a streak."""
_CLOCK_FONT = cv2.FONT_HERSHEY_DUPLEX


def apply_rain(image: np.ndarray, focal_px: float, rng: np.random.Generator) -> np.ndarray:
    """Return the image with motion-blurred streaks of near drops and a haze of distant ones."""
    height, width = image.shape[:2]
    distance = 1.0 + 12.0 * rng.uniform(size=_RAIN_STREAK_COUNT) ** 0.5
    length = _RAIN_FALL_MPS * _EXPOSURE_S * focal_px / distance
    start = rng.uniform((0, 0), (width, height), (_RAIN_STREAK_COUNT, 2))
    lean = 0.12 + rng.normal(0, 0.03, _RAIN_STREAK_COUNT)
    streaks = np.zeros((height, width), np.uint8)
    for (x, y), reach, slant, metres in zip(start, length, lean, distance, strict=True):
        first = round(16 * x), round(16 * y)
        last = round(16 * (x + slant * reach)), round(16 * (y + reach))
        cv2.line(streaks, first, last, int(np.clip(110 / metres + 12, 0, 90)), 1, cv2.LINE_AA, 4)
    blurred = cv2.GaussianBlur(streaks, (0, 0), 0.8)
    hazy = cv2.addWeighted(image, 0.85, np.full_like(image, 150), 0.08, 0)
    return cv2.add(hazy, cv2.cvtColor(blurred, cv2.COLOR_GRAY2BGR))


@dataclass(frozen=True)
class WaterDrop:
    """A defocused drop on the front glass: it appears, rests, runs down, and reappears."""

    x_px: float
    y_px: float
    radius_px: float
    appears_s: float
    rest_s: float
    run_px_per_s: float
    period_s: float

    def position(self, time_s: float, height_px: int) -> tuple[float, float] | None:
        """Return the position at a time, or None while absent."""
        age = (time_s - self.appears_s) % self.period_s
        running = max(0.0, age - self.rest_s)
        # It creeps, then runs faster, sticking to the glass intermittently.
        travelled = self.run_px_per_s * (running + 0.25 * math.sin(4 * running)) * min(1.0, running)
        y = self.y_px + travelled
        if y > height_px + self.radius_px:
            return None
        return self.x_px + 6 * math.sin(0.02 * travelled), y


def spawn_drops(width: int, height: int, rng: np.random.Generator) -> list[WaterDrop]:
    """Draw the drops on the front glass of an image of a size in pixels."""
    return [
        WaterDrop(
            float(rng.uniform(0, width)),
            float(rng.uniform(0, 0.8 * height)),
            float(rng.uniform(0.012, 0.035) * width),
            float(rng.uniform(0, 30)),
            float(rng.uniform(3, 20)),
            float(rng.uniform(0.1, 0.5) * height),
            float(rng.uniform(25, 40)),
        )
        for _ in range(_DROP_COUNT)
    ]


def apply_drops(image: np.ndarray, drops: list[WaterDrop], time_s: float) -> np.ndarray:
    """Blend in each drop: an inverted, blurred image of its surroundings."""
    height, width = image.shape[:2]
    small = cv2.resize(image, (width // 8, height // 8), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(small, (0, 0), 3.0)
    for drop in drops:
        position = drop.position(time_s, height)
        if position is None:
            continue
        x, y = position
        reach = 1.6 * drop.radius_px
        x0, x1 = (int(np.clip(c, 0, width)) for c in (x - reach, x + reach))
        y0, y1 = (int(np.clip(c, 0, height)) for c in (y - reach, y + reach))
        if x1 <= x0 or y1 <= y0:
            continue
        dx, dy = np.meshgrid(np.arange(x0, x1) - x, np.arange(y0, y1) - y)
        radius = np.hypot(dx, dy) / drop.radius_px
        alpha = 0.85 / (1 + np.exp((radius - 1) * 9))
        source = np.stack([(x - 4 * dx) / 8, (y - 4 * dy) / 8], -1).astype(np.float32)
        shown = cv2.remap(blurred, source, NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        patch = image[y0:y1, x0:x1]
        patch[:] = (patch + alpha[..., None] * (shown.astype(float) - patch)).astype(np.uint8)
    return image


def burn_in_clock(image: np.ndarray, time_s: float) -> None:
    """Burn date and time into the image, in place."""
    text = f'2024-05-17 08:{int(time_s) // 60:02d}:{int(time_s) % 60:02d}:{int(time_s * 100) % 100:02d}'
    scale = image.shape[1] / 1280
    (width, height), base = cv2.getTextSize(text, _CLOCK_FONT, scale, 2)
    x, y = round(20 * scale), round(20 * scale) + height
    cv2.rectangle(image, (x - 4, y - height - 6), (x + width + 4, y + base), (0, 0, 0), -1)
    cv2.putText(image, text, (x, y), _CLOCK_FONT, scale, (255, 255, 255), max(1, round(2 * scale)), cv2.LINE_AA)

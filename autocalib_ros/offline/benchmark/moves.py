"""Moves of the camera, applied to recordings through their known lens: when they are told, and how well measured.

The recording is played to and fro, its images turned and zoomed about the camera centre by known amounts, with sway,
clouds, noise and a jam on top.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from autocalib_ros.lens.camera import Camera, pixel_grid
from autocalib_ros.offline.benchmark.long_stream import read_short_recording
from autocalib_ros.offline.simulate.camera_motion import MOTION_GRID, resampled
from autocalib_ros.perception.background import median
from autocalib_ros.perception.view_registration import registered_image
from autocalib_ros.perception.view_watch import KnownView, ViewCondition, ViewWatch
from autocalib_ros.results.camera_move import CameraMove, rotation_angle_deg, rotation_from_turn

AXES = {'pan': (1.0, 0.0, 0.0), 'tilt': (0.0, 1.0, 0.0), 'roll': (0.0, 0.0, 1.0)}
TRUE_MOVES = (
    *(
        (f'{name} {size:g}', (size * pan, size * tilt, size * roll), 1.0)
        for size in (0.3, 1.0, 3.0)
        for name, (pan, tilt, roll) in AXES.items()
    ),
    ('pan 25', (25.0, 0.0, 0.0), 1.0),
    ('zoom 1.05', (0.0, 0.0, 0.0), 1.05),
    ('zoom 1.3', (0.0, 0.0, 0.0), 1.3),
)
"""Name, true pan, tilt and roll in degrees, and true zoom of each move."""
MOVE_AT_S, WATCHED_S = 60.0, 60.0
"""When the camera moves, and for how long it is watched after that, seconds."""
IMAGES_HZ, MAX_IMAGES = 3.0, 270
"""Images of the recording that are played, and the most of them."""
SWAY_DEG, SWAY_HZ = 0.1, 0.7
"""Amplitude and frequency of the sway."""
CLOUD_DEPTH, CLOUD_PX_PER_S = 0.5, 8.0
"""Part of the light that a cloud takes, and its speed in the image."""
NOISE_LEVELS = 3.0
"""Standard deviation of the noise, grey levels."""
REPORT_LIMIT_S = 30.0
"""Time within which a move is to be told."""
MOVES_HEADER = (
    f'{"recording":<28}{"move":<11}{"told after":>11}{"true pan, tilt, roll":>24}{"measured":>26}{"zoom":>8}'
    f'{"error":>8}{"60 s on":>9}'
)


@dataclass(frozen=True)
class MoveRun:
    """One move of one recording."""

    recording: str
    name: str
    turn_deg: tuple[float, float, float]
    zoom: float
    told_after_s: float | None
    """None: never."""
    measured: CameraMove | None
    rest_deg: float
    """Angle between the mended pose and the true one at the end of the run."""
    false_flags: int
    """Moves and faults told before the camera moved."""

    @property
    def error_deg(self) -> float:
        """Angle between the measured turn and the true one, degrees."""
        if self.measured is None:
            return math.inf
        return rotation_angle_deg(self.measured.rotation @ rotation_from_turn(np.radians(self.turn_deg)).T)

    @property
    def is_good(self) -> bool:
        """Whether the move was told in time and measured to 0.3 degrees, and nothing else was told."""
        told = self.told_after_s is not None and self.told_after_s <= REPORT_LIMIT_S
        return told and self.error_deg <= 0.3 and not self.false_flags


def measure_moves(recordings: Sequence[Path], width: int) -> Iterator[MoveRun]:
    """Yield the run of each move of each recording, at most `width` pixels wide.

    A truth.json beside a recording gives its lens; without one, a lens of 95 degrees stands for it. InputError if a
    recording has no images.
    """
    for path in recordings:
        recording = read_short_recording(path, width, IMAGES_HZ, MAX_IMAGES)
        for name, turn_deg, zoom in TRUE_MOVES:
            yield _run(recording.name, recording.images, recording.camera, (name, turn_deg, zoom))


def _run(
    recording: str, images: Sequence[np.ndarray], camera: Camera, move: tuple[str, tuple[float, float, float], float]
) -> MoveRun:
    """Watch one move."""
    name, turn_deg, zoom = move
    watch, disturbed = ViewWatch(), _Disturbances(images, camera)
    watch.begin([KnownView(registered_image(disturbed.background))], camera)
    time_s, told_after_s, measured, false_flags = 0.0, None, None, 0
    total = np.eye(3)
    while time_s < MOVE_AT_S + WATCHED_S:
        if not watch.is_due(time_s):
            time_s += 0.1
            continue
        moved = time_s >= MOVE_AT_S
        image = disturbed.image(time_s, turn_deg if moved else (0.0, 0.0, 0.0), zoom if moved else 1.0)
        report = watch.update(image, time_s)
        if report.condition in (ViewCondition.MOVED, ViewCondition.BLIND):
            false_flags += not moved
            if moved and told_after_s is None:
                told_after_s = time_s - MOVE_AT_S
            if report.move is not None and report.move.is_measured:
                measured = measured or report.move
                if report.move.keeps_lens:
                    total = report.move.rotation @ total
                    watch.rebase(report.move)
    rest_deg = rotation_angle_deg(total @ rotation_from_turn(np.radians(turn_deg)).T)
    return MoveRun(recording, name, turn_deg, zoom, told_after_s, measured, rest_deg, false_flags)


class _Disturbances:
    """Images with sway, clouds, noise and a jam, turned and zoomed through the lens."""

    def __init__(self, images: Sequence[np.ndarray], camera: Camera) -> None:
        self._images, self._camera = images, camera
        self._generator = np.random.default_rng(0)
        height, width = images[0].shape
        coarse = self._generator.normal(size=(height, 4 * width)).astype(np.float32)
        field = cv2.GaussianBlur(coarse, (0, 0), height / 6.0)
        self._clouds: np.ndarray = 1.0 - CLOUD_DEPTH * (np.tanh(2.0 * field / field.std()) + 1.0) / 2.0
        self.background = median(list(images[:: max(1, len(images) // 15)][:15]))
        traffic = [cv2.absdiff(image, self.background) > 20 for image in images]
        self._jam = images[int(np.argmax([mask.sum() for mask in traffic]))]
        busiest = max(traffic, key=np.count_nonzero).astype(np.uint8)
        self._jammed = cv2.dilate(busiest, np.ones((7, 7), np.uint8)) > 0

    def image(self, time_s: float, turn_deg: tuple[float, float, float], zoom: float) -> np.ndarray:
        """Return the image at a time."""
        count = len(self._images)
        place = int(time_s * IMAGES_HZ) % max(1, 2 * count - 2)
        image = self._images[place if place < count else 2 * count - 2 - place]
        if time_s % 80.0 >= 40.0:  # vehicles that stand for half of the time, also while the camera moves
            image = np.where(self._jammed, self._jam, image)
        sway = SWAY_DEG * math.sin(2 * math.pi * SWAY_HZ * time_s) * np.array([0.8, 0.5, 0.33])
        turned = self._turned(image, np.asarray(turn_deg) + sway, zoom)
        begin = int(time_s * CLOUD_PX_PER_S) % (3 * image.shape[1])
        lit = turned * self._clouds[:, begin : begin + image.shape[1]]
        noise = self._generator.normal(scale=NOISE_LEVELS, size=image.shape)
        return np.clip(lit + noise, 0, 255).astype(np.uint8)

    def _turned(self, image: np.ndarray, turn_deg: np.ndarray, zoom: float) -> np.ndarray:
        now = replace(self._camera, focal_px=self._camera.focal_px * zoom)
        columns, rows = MOTION_GRID
        bearings, _ = now.unproject(pixel_grid(now, columns, rows))
        places, _ = self._camera.project(bearings @ rotation_from_turn(np.radians(turn_deg)))
        return resampled(image, places.reshape(rows, columns, 2))


def format_move(run: MoveRun) -> str:
    """Return one line of the table."""
    told = 'never' if run.told_after_s is None else f'{run.told_after_s:.1f} s'
    true = ' '.join(f'{value:+.2f}' for value in run.turn_deg)
    found = run.measured
    measured = '-' if found is None else f'{found.pan_deg:+.2f} {found.tilt_deg:+.2f} {found.roll_deg:+.2f}'
    zoom = '-' if found is None else f'{found.zoom:.3f}'
    mended = '-' if run.zoom != 1.0 else f'{run.rest_deg:.3f}'
    flags = f'  {run.false_flags} false flags' if run.false_flags else ''
    flags += f'  shifted: {found.parallax_deg:.2f}' if found is not None and found.parallax_deg else ''
    return (
        f'{run.recording[-27:]:<28}{run.name:<11}{told:>11}{true:>24}{measured:>26}{zoom:>8}{run.error_deg:>8.3f}{mended:>9}'
        f'{flags}'
    )

"""Rendered scenes that are drawn at random, from pixels to result: `autocalib benchmark scenes`.

Each number draws a scene: layout, pose, lens, size of the images, light, traffic. The pictures are rendered,
compressed and given to the calibrator as a camera would. What it gathered can be kept in a folder, so that another
version of the solver is measured on the same evidence without rendering again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import Options
from autocalib_ros.errors import UsageError
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.offline.benchmark.monte_carlo import nan_if_none, pose_errors_deg
from autocalib_ros.offline.benchmark.processes import map_in_order
from autocalib_ros.offline.simulate.lens import look_rotation
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.scenes import build_network
from autocalib_ros.offline.simulate.simulation import Simulation
from autocalib_ros.perception.intensity_normalisation import IntensityNormaliser
from autocalib_ros.results.calibration import Calibration, Refusal

DRAWN_LAYOUTS = (
    'junction',
    'skew',
    'roundabout',
    'tee',
    'junction',
    'highway',
    'junction',
    'skew',
    'roundabout',
    'tee',
    'bend',
    'highway',
)
"""Layouts in turn: mostly those whose traffic determines a calibration, and some with one road."""
SIZES_PX = ((640, 360), (640, 480), (800, 450), (960, 540))
RATE_HZ = 15.0
DURATION_S = 75.0
DISTORTION_FREE = (1 / 3, 2 / 15, 17 / 315, 62 / 2835)
"""Coefficients k1 to k4 of a lens without distortion."""
DISTORTION_FREE_FRACTION = 0.2
"""Fraction of the scenes with a lens without distortion."""
NIGHT_FRACTION, THERMAL_FRACTION = 0.15, 0.15
"""Fractions of the scenes by night and of a thermal camera."""
MAX_K1, MAX_K2 = 0.04, 0.006
MAX_OFFSET_FRACTION = 0.02
"""Largest offset of the principal point along each axis, fraction of the image width."""
FOCAL_WIDTHS, DISTORTION_FREE_FOCAL_WIDTHS = (0.38, 0.58), (0.6, 0.95)
"""Ranges of the focal length in image widths."""
DRAWN_JPEG_QUALITY = (60, 95)
"""Range of the quality with which the pictures are compressed."""
FALSE_SIGMAS = 3.5
WRONG_FOCAL, WRONG_DEG = 0.05, 2.0
"""Errors that no answer of grade full may have."""


@dataclass(frozen=True)
class Scene:
    """A drawn scene."""

    number: int
    options: SimulationOptions
    jpeg_quality: int

    @property
    def kind(self) -> str:
        """Layout, light and lens in a word each."""
        options = self.options
        light = 'night' if options.night else 'thermal' if options.thermal else 'day'
        return f'{options.scene} {light}{" distortion-free" if options.k == DISTORTION_FREE else ""}'


@dataclass(frozen=True)
class SceneRun:
    """Errors of one scene's result; errors are relative for the focal length and in degrees for tilt and roll."""

    number: int
    kind: str
    verdict: str
    """Grade of the calibration, or code of the refusal."""
    accepted: bool = False
    focal: tuple[float, float] = (np.nan, np.nan)
    """Error of the focal length and its stated standard deviation, relative."""
    tilt_deg: tuple[float, float] = (np.nan, np.nan)
    roll_deg: tuple[float, float] = (np.nan, np.nan)
    normal_deg: float = np.nan

    @property
    def z(self) -> np.ndarray:
        """Errors of focal length, tilt and roll in their stated standard deviations, nan where there is none, (3,)."""
        return np.array(
            [error / sigma if sigma else np.nan for error, sigma in (self.focal, self.tilt_deg, self.roll_deg)]
        )

    @property
    def wrong(self) -> bool:
        """Whether the result is beyond what an answer of grade full may have."""
        return self.verdict == 'full' and bool(abs(self.focal[0]) > WRONG_FOCAL or self.normal_deg > WRONG_DEG)


def draw_scene(number: int, seed: int = 0) -> Scene:
    """Draw a scene; it depends on seed and number alone."""
    generator = np.random.default_rng(np.random.SeedSequence([seed, number, 71]))
    width, height = SIZES_PX[generator.integers(len(SIZES_PX))]
    distortion_free = generator.random() < DISTORTION_FREE_FRACTION
    light = generator.random()
    focal = width * generator.uniform(*(DISTORTION_FREE_FOCAL_WIDTHS if distortion_free else FOCAL_WIDTHS))
    k1, k2 = generator.uniform([-MAX_K1, -MAX_K2], [MAX_K1, MAX_K2])
    offset = width * generator.uniform(-MAX_OFFSET_FRACTION, MAX_OFFSET_FRACTION, 2)
    height_m, pitch, roll, turned = generator.uniform([6.0, 22.0, -2.5, -8.0], [11.0, 38.0, 2.5, 8.0])
    options = SimulationOptions(
        scene=DRAWN_LAYOUTS[number % len(DRAWN_LAYOUTS)],
        seed=int(generator.integers(2**31)),
        width_px=width,
        height_px=height,
        rate_hz=RATE_HZ,
        duration_s=DURATION_S,
        focal_px=float(focal),
        k=DISTORTION_FREE if distortion_free else (float(k1), float(k2), 0.0, 0.0),
        principal_point_offset_px=(float(offset[0]), float(offset[1])),
        camera_height_m=float(height_m),
        pitch_deg=float(pitch),
        roll_deg=float(roll),
        density=float(generator.uniform(8.0, 15.0)),
        turning_fraction=float(generator.uniform(0.15, 0.35)),
        noise_sigma=float(generator.uniform(1.0, 3.0)),
        night=bool(light < NIGHT_FRACTION),
        thermal=bool(light > 1.0 - THERMAL_FRACTION),
    )
    yaw = build_network(options).view_yaw_deg + turned
    return Scene(number, replace(options, yaw_deg=float(yaw)), int(generator.integers(*DRAWN_JPEG_QUALITY)))


def gather(scene: Scene) -> Evidence:
    """Render a scene and gather its evidence as from a camera."""
    simulation, calibrator, normaliser = Simulation(scene.options), AutoCalibrator(Options()), IntensityNormaliser()
    compression = [cv2.IMWRITE_JPEG_QUALITY, scene.jpeg_quality]
    for index in range(scene.options.frame_count):
        image = simulation.frame(index)
        if scene.options.thermal:
            image = normaliser.to_8_bit(image, 'mono16', simulation.time_s(index))
        stored = cv2.imencode('.jpg', image, compression)[1]
        calibrator.add_image(simulation.stamp_ns(index), np.asarray(cv2.imdecode(stored, cv2.IMREAD_UNCHANGED)))
    evidence = calibrator.snapshot()
    assert evidence is not None, 'a simulated recording has images'
    return evidence


def evidence_of(scene: Scene, folder: Path | None, seed: int) -> Evidence:
    """Return the evidence of a scene: from the folder if it is there, else gathered and stored there."""
    path = None if folder is None else folder / f'scene_{seed}_{scene.number:03d}.npz'
    if path is not None and path.exists():
        return Evidence.load(path)
    evidence = gather(scene)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        evidence.save(path)
        path.with_suffix('.json').write_text(json.dumps({'kind': scene.kind, 'options': vars(scene.options)}, indent=1))
    return evidence


@dataclass(frozen=True)
class SceneTask:
    """One scene to measure, and where its evidence is kept."""

    number: int
    seed: int
    folder: Path | None


def run_scene(task: SceneTask) -> SceneRun:
    """Draw a scene, gather its evidence, solve it with the true camera height, and compare with the truth."""
    scene = draw_scene(task.number, task.seed)
    evidence = evidence_of(scene, task.folder, task.seed)
    return compare_with_truth(scene, solve(evidence, Options(camera_height=scene.options.camera_height_m)))


def compare_with_truth(scene: Scene, result: Calibration | Refusal) -> SceneRun:
    """Return the errors of a result."""
    if isinstance(result, Refusal):
        return SceneRun(scene.number, scene.kind, result.code)
    true, sigma = scene.options, result.stddev
    up = look_rotation(true.yaw_deg or 0.0, true.pitch_deg, true.roll_deg)[2]
    tilt, roll, normal = pose_errors_deg(result.ground, up)
    return SceneRun(
        scene.number,
        scene.kind,
        result.grade,
        accepted=True,
        focal=(result.camera.focal_px / true.focal_px - 1.0, nan_if_none(sigma.focal_px) / true.focal_px),
        tilt_deg=(tilt, nan_if_none(sigma.tilt_deg)),
        roll_deg=(roll, nan_if_none(sigma.roll_deg)),
        normal_deg=normal,
    )


def measure_scenes(
    count: int, *, first: int = 0, seed: int = 0, jobs: int = 1, folder: Path | None = None
) -> Iterator[SceneRun]:
    """Yield the results of `count` drawn scenes from number `first` on. Raises UsageError for wrong arguments."""
    for name, value, least in (('count', count, 1), ('first', first, 0), ('seed', seed, 0), ('jobs', jobs, 1)):
        if value < least:
            raise UsageError(f'--{name} must be at least {least}; got {value}')
    yield from map_in_order(run_scene, [SceneTask(first + index, seed, folder) for index in range(count)], jobs)


SCENE_ROW_FORMAT = '{:>6}  {:<36}{:<22}{:>8}{:>8}{:>8}{:>8}{:>8}{:>8}{:>8}'
HEADER = SCENE_ROW_FORMAT.format(
    'scene', 'kind', 'verdict', 'f %', 'sigma', 'normal', 'sigma', 'z f', 'z tilt', 'z roll'
)


def format_run(run: SceneRun) -> str:
    """Return one row of the table."""
    cells = (
        100 * run.focal[0],
        100 * run.focal[1],
        run.normal_deg,
        float(np.hypot(run.tilt_deg[1], run.roll_deg[1])),
        *run.z,
    )
    texts = [
        '' if np.isnan(cell) else f'{cell:+.2f}' if index in (0, 4, 5, 6) else f'{cell:.2f}'
        for index, cell in enumerate(cells)
    ]
    return SCENE_ROW_FORMAT.format(run.number, run.kind, run.verdict, *texts).rstrip() + (
        '  WRONG' if run.wrong else ''
    )


def format_summary(runs: Sequence[SceneRun]) -> str:
    """Return what all scenes together say: acceptance by layout, errors in their sigmas, and the worst."""
    lines = []
    for layout in dict.fromkeys(DRAWN_LAYOUTS):
        of_layout = [run for run in runs if run.kind.split()[0] == layout]
        if of_layout:
            accepted = sum(run.accepted for run in of_layout)
            lines.append(f'{layout:<12}{accepted} of {len(of_layout)} accepted')
    z = np.array([run.z for run in runs if run.accepted]).reshape(-1, 3)
    for name, column in zip(('focal length', 'tilt', 'roll', 'all'), (*z.T, z.ravel()), strict=True):
        known = np.abs(column[np.isfinite(column)])
        if len(known):
            lines.append(
                f'{name:<14}rms {np.sqrt(np.mean(known**2)):.2f} sigma, '
                f'within 1.96: {100 * np.mean(known < 1.96):.0f} %, '
                f'beyond {FALSE_SIGMAS}: {np.sum(known > FALSE_SIGMAS)} of {len(known)}, worst {known.max():.1f}'
            )
    focal = np.array([abs(run.focal[0]) for run in runs if run.accepted])
    normal = np.array([run.normal_deg for run in runs if np.isfinite(run.normal_deg)])
    if len(focal) and len(normal):
        lines.append(
            f'errors        focal length median {100 * np.median(focal):.2f} %, worst {100 * focal.max():.2f} %; '
            f'normal median {np.median(normal):.2f}, worst {normal.max():.2f} degrees'
        )
    wrong = sum(run.wrong for run in runs)
    lines.append(f'wrong by more than {100 * WRONG_FOCAL:.0f} % or {WRONG_DEG:g} degrees at grade full: {wrong}')
    return '\n'.join(lines)

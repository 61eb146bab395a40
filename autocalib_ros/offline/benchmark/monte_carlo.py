"""Monte-Carlo benchmark of accuracy on synthetic evidence: `autocalib benchmark accuracy`.

Each run draws a lens, a pose and traffic of one evidence family, solves the evidence by each method and compares the
results with the ground truth. The evidence depends only on seed, family and run number: `draw_evidence` reproduces it.
"""

from __future__ import annotations

import csv
import math
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from autocalib_ros.comparison import best_rotation
from autocalib_ros.config import Options
from autocalib_ros.errors import InputError, UsageError
from autocalib_ros.estimation.estimate import solve
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import GroundPlane, angles_deg, tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera, pixel_grid
from autocalib_ros.offline.benchmark.broken_families import BROKEN, GIVEN_LENSES
from autocalib_ros.offline.benchmark.families import DETERMINED, UNDERDETERMINED, Family
from autocalib_ros.offline.benchmark.processes import map_in_order
from autocalib_ros.offline.ground_truth import MAX_COMPARED_RANGE_M, median_distance_error
from autocalib_ros.offline.synthetic.junction import Junction
from autocalib_ros.offline.terminal.progress import progress_bar
from autocalib_ros.pictures.views import ground_to_image, image_to_ground
from autocalib_ros.results.calibration import Calibration, Refusal

RAY_GRID = (49, 28)
"""Columns and rows of pixels at which rays are compared."""
GROUND_GRID = 5
"""Number of ranges, and of bearings, of the road points between which distances are compared."""
MAX_BEARING_DEG = 40.0
"""Largest bearing of those road points from the viewing direction, to either side."""
LENS_FILE = 1
"""Part of the seed of a lens file: it does not depend on how the traffic was drawn."""
NAN = math.nan


@dataclass(frozen=True, kw_only=True)
class Run:
    """Errors of one solution; nan for quantities that the result lacks."""

    family: str
    method: str
    run: int
    accepted: bool
    code: str
    """Refusal code, or '' if accepted."""
    grade: str = ''
    """Grade of the result, or of the candidate of a refusal; '' without either."""
    true_tilt_deg: float = NAN
    road_yaw_deg: float = NAN
    """Angle between the viewing direction and the first road, seen from above, 0 to 90 degrees."""
    focal_error: float = NAN
    """Focal length error relative to the true value; `focal_sigma` likewise."""
    focal_sigma: float = NAN
    rays_deg: float = NAN
    """Mean angle between estimated and true rays over the image, after the rotation that aligns them best."""
    normal_deg: float = NAN
    tilt_error_deg: float = NAN
    tilt_sigma_deg: float = NAN
    roll_error_deg: float = NAN
    roll_sigma_deg: float = NAN
    distance_error: float = NAN
    """Median relative error of distances between road points."""
    cpu_s: float = NAN
    """Processor time of the solution, seconds."""


@dataclass(frozen=True)
class Task:
    """One draw of evidence and the methods that solve it."""

    family: str
    seed: int
    run: int
    methods: tuple[str, ...]


def run_monte_carlo(
    names: Sequence[str],
    methods: Sequence[str],
    runs: int,
    *,
    seed: int = 0,
    jobs: int = 1,
    out: Path | None = None,
    quiet: bool = False,
) -> list[Run]:
    """Solve `runs` draws of each family by each method.

    Write one CSV row per run to `out` as results arrive. Raise UsageError for wrong arguments.
    """
    for name, value, least in (('runs', runs, 1), ('jobs', jobs, 1), ('seed', seed, 0)):
        if value < least:
            raise UsageError(f'--{name} must be at least {least}; got {value}')
    tasks = [Task(family, seed, run, tuple(methods)) for family in select_families(names) for run in range(runs)]
    done: list[Run] = []
    with open_csv(out) as write, progress_bar(len(tasks), 'draws', 'accuracy', quiet=quiet) as progress:
        for count, results in enumerate(map_in_order(run_task, tasks, jobs), 1):
            write(results)
            done += results
            progress.update_to(count, results[-1].family)
    return done


def families() -> dict[str, Family]:
    """Return all families by name: determined ones, underdetermined ones, and those that break an assumption."""
    return {**DETERMINED, **UNDERDETERMINED, **BROKEN}


def select_families(names: Sequence[str]) -> list[str]:
    """Return the names of the families, all families if `names` is empty, or raise UsageError."""
    every = list(families())
    for name in names:
        if name not in every:
            raise UsageError(f"unknown evidence family '{name}'; known families: {', '.join(every)}")
    return list(names) or every


def run_task(task: Task) -> list[Run]:
    """Draw the evidence of a task and solve it by each method."""
    junction, evidence = draw_evidence(task.family, task.seed, task.run)
    return [run_method(task, method, junction, evidence) for method in task.methods]


def draw_evidence(family: str, seed: int, run: int) -> tuple[Junction, Evidence]:
    """Draw the ground truth and the evidence of one run of a family."""
    return families()[family](_generator(family, seed, run))


def _generator(family: str, seed: int, run: int, *more: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(family.encode()), run, *more]))


def given_lens(task: Task, true: Camera) -> Camera | None:
    """Return the lens that the family of a task is solved with; None if it is solved without one."""
    draw = GIVEN_LENSES.get(task.family)
    return None if draw is None else draw(true, _generator(task.family, task.seed, task.run, LENS_FILE))


def run_method(task: Task, method: str, junction: Junction, evidence: Evidence) -> Run:
    """Solve with the true camera height; record an exception of the solver instead of stopping the benchmark."""
    began = time.process_time()
    try:
        options = Options(camera_height=junction.height_m, method=method)
        result = solve(evidence, options, lens=given_lens(task, junction.camera))
    except Exception as error:
        return Run(
            family=task.family, method=method, run=task.run, accepted=False, code=f'crash:{type(error).__name__}'
        )
    return compare_calibrations(task, method, result, junction, time.process_time() - began)


def compare_calibrations(
    task: Task, method: str, result: Calibration | Refusal, junction: Junction, cpu_s: float
) -> Run:
    """Return the errors of a result against the ground truth."""
    view = {
        'true_tilt_deg': float(tilt_and_roll_deg(junction.normal_in_camera)[0]),
        'road_yaw_deg': road_yaw_deg(junction),
    }
    if isinstance(result, Refusal):
        grade = '' if result.candidate is None else result.candidate.grade
        return Run(
            family=task.family,
            method=method,
            run=task.run,
            accepted=False,
            code=result.code,
            grade=grade,
            cpu_s=cpu_s,
            **view,
        )
    true, sigma = junction.camera, result.stddev
    tilt, roll, normal = pose_errors_deg(result.ground, junction.normal_in_camera)
    return Run(
        family=task.family,
        method=method,
        run=task.run,
        accepted=True,
        code='',
        grade=result.grade,
        focal_error=result.camera.focal_px / true.focal_px - 1,
        focal_sigma=nan_if_none(sigma.focal_px) / true.focal_px,
        rays_deg=mean_ray_error_deg(result.camera, true),
        normal_deg=normal,
        tilt_error_deg=tilt,
        tilt_sigma_deg=nan_if_none(sigma.tilt_deg),
        roll_error_deg=roll,
        roll_sigma_deg=nan_if_none(sigma.roll_deg),
        distance_error=distance_error(result.camera, result.ground, junction),
        cpu_s=cpu_s,
        **view,
    )


def road_yaw_deg(junction: Junction) -> float:
    """Return the angle between the viewing direction and the first road, seen from above, 0 to 90 degrees."""
    ahead = junction.camera_from_ground[2]
    turned = np.degrees(np.arctan2(ahead[1], ahead[0])) - junction.road_angles_deg[0]
    return float(abs((turned + 90.0) % 180.0 - 90.0))


def nan_if_none(value: float | None) -> float:
    """Return a number, nan if there is none."""
    return NAN if value is None else float(value)


def pose_errors_deg(ground: GroundPlane | None, true_normal: np.ndarray) -> tuple[float, float, float]:
    """Return the errors of tilt and roll, and the angle between the ground normals, in degrees."""
    if ground is None:
        return NAN, NAN, NAN
    normal = ground.normal_in_camera
    tilt, roll = tilt_and_roll_deg(normal) - tilt_and_roll_deg(true_normal)
    return float(tilt), float((roll + 180) % 360 - 180), float(angles_deg(normal, true_normal))


def mean_ray_error_deg(camera: Camera, true: Camera) -> float:
    """Return the mean angle between the rays of two lenses over the image, after the best-fitting rotation."""
    pixels = pixel_grid(true, *RAY_GRID)
    (found, valid), (wanted, there) = camera.unproject(pixels), true.unproject(pixels)
    found, wanted = found[valid & there], wanted[valid & there]
    return float(angles_deg(found @ best_rotation(wanted, found).T, wanted).mean()) if len(found) else NAN


def distance_error(camera: Camera, ground: GroundPlane | None, junction: Junction) -> float:
    """Return the median relative error of distances between road points in view up to `MAX_COMPARED_RANGE_M`."""
    if ground is None:
        return NAN
    true_m, pixels = _road_points(junction)
    return median_distance_error(true_m, image_to_ground(camera, ground, pixels))


def _road_points(junction: Junction) -> tuple[np.ndarray, np.ndarray]:
    """Return road points (n, 2) in front of the camera in metres, and their pixels (n, 2)."""
    ahead = junction.camera_from_ground[2]
    bearings = np.arctan2(ahead[1], ahead[0]) + np.radians(np.linspace(-MAX_BEARING_DEG, MAX_BEARING_DEG, GROUND_GRID))
    ranges, bearings = np.meshgrid(MAX_COMPARED_RANGE_M * np.arange(1, GROUND_GRID + 1) / GROUND_GRID, bearings)
    points = np.stack([ranges * np.cos(bearings), ranges * np.sin(bearings), np.zeros(ranges.shape)], -1).reshape(-1, 3)
    truth = GroundPlane(junction.camera_from_ground.T, junction.height_m)
    pixels = ground_to_image(junction.camera, truth, points)
    seen = (pixels >= 0).all(axis=1) & (pixels < junction.image_size).all(axis=1)
    return points[seen, :2], pixels[seen]


@contextmanager
def open_csv(path: Path | None) -> Iterator[Callable[[Sequence[Run]], None]]:
    """Open a CSV file and yield a function that appends runs to it; without a path, the function does nothing."""
    if path is None:
        yield lambda runs: None
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream = path.open('w', newline='', encoding='utf-8')
    except OSError as error:
        raise InputError(f'cannot write {path}: {error.strerror or error}') from error
    with stream:
        writer = csv.DictWriter(stream, [item.name for item in fields(Run)])
        writer.writeheader()

        def write(runs: Sequence[Run]) -> None:
            writer.writerows(_row(run) for run in runs)
            stream.flush()  # finished runs survive an interruption

        yield write


def _row(run: Run) -> dict[str, object]:
    return {
        name: '' if isinstance(value, float) and math.isnan(value) else value for name, value in asdict(run).items()
    }

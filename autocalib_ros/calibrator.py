"""The method on one page: images in, a calibration or a refusal out. Live and replayed alike."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.errors import InputError
from autocalib_ros.estimation.adjustment.noise_model import DEFAULT_CAMERA_HEIGHT_M
from autocalib_ros.estimation.adjustment.residuals import collect_residuals
from autocalib_ros.estimation.estimate import Solution, find_solution
from autocalib_ros.estimation.observations.selection import drop_pedestrians
from autocalib_ros.estimation.observations.track_set import TrackSet, select_tracks
from autocalib_ros.estimation.paper.intrinsics import paper_intrinsics
from autocalib_ros.estimation.paper.published_method import solve_paper
from autocalib_ros.estimation.paper.vanishing_point_voting import segment_orientations
from autocalib_ros.estimation.people.pedestrians import people
from autocalib_ros.estimation.verification.ground_normal import PlaneEstimate
from autocalib_ros.estimation.verification.readiness import (
    check_readiness,
    check_steady,
    drift_limit_px,
    outlook,
    requirements,
)
from autocalib_ros.estimation.verification.scale import Scale, check_scale, is_unusual, known_scale
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.snapshot import Evidence, TrackKind
from autocalib_ros.geometry.ground_plane import ground_plane, ground_points, pixels_ahead, tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import ModelMisfit
from autocalib_ros.perception.detector.detector import VehicleDetector, open_detector
from autocalib_ros.perception.observer import Observer
from autocalib_ros.results.calibration import (
    GROUND_DISTANCES_M,
    Calibration,
    Figures,
    Reason,
    Refusal,
    StandardDeviations,
)

MAX_REORDERING_NS = 1_000_000_000
"""Images overtake each other by less than this on any transport; a longer step back is another time."""
CLOCK_JUMP_NS = 24 * 3600 * 1_000_000_000
"""No camera pauses for longer than a day: a longer step forward is a clock that was set."""
FORGET_PERIOD_S = 10.0
"""Seconds of recording between two looks for evidence that is old; each costs milliseconds."""
TRAIL_FRAMES = 16
"""Images through which the way of a point is shown: a second at 15 Hz."""


class ImageIntake(Enum):
    """What became of an image; all but `USED` and `LATE` begin the evidence anew."""

    FIRST = 'the first image'
    USED = 'used'
    LATE = 'late: its time stamp is not newer than that of an image before'
    TIME_JUMPED = 'the time stamps stepped'
    RESIZED = 'the image size changed'


@dataclass(frozen=True)
class CalibrationProgress:
    """How far the evidence has come: 0 to 100, what is missing and how long it will take, in an installer's words."""

    percent: float
    missing: tuple[str, ...]
    outlook: str = ''
    """'about 6 min more at this rate' say; '' where nothing can be foreseen."""

    def __str__(self) -> str:
        missing = ', '.join([*filter(None, ['; '.join(self.missing), self.outlook])])
        return f'{self.percent:.0f} %' + (f': {missing}' if missing else '')


class AutoCalibrator:
    """Gathers evidence frame by frame; bounded in memory on an endless stream; not thread-safe.

    A `detector` that is open already is used; else that of the options is opened, UsageError where that fails.
    """

    def __init__(self, options: Options, detector: VehicleDetector | None = None) -> None:
        self._options = options
        self._detector = detector or open_detector(options.detector)
        self._observer: Observer | None = None

    def add_image(self, stamp_ns: int, image: np.ndarray) -> ImageIntake:
        """Take one image: grey (H, W) or BGR (H, W, 3), uint8; it is not kept nor changed.

        An image whose stamp repeats or steps back by less than `MAX_REORDERING_NS` is late and left out; a stamp that
        steps back further (a clock that was set, a recording that begins again) or forward by `CLOCK_JUMP_NS`, or a new
        image size starts the evidence anew. UsageError where a pixel of scale.distance_px lies outside the image.
        """
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
            raise InputError(f'an image is grey (H, W) or BGR (H, W, 3) in 8 bits, got {image.dtype} {image.shape}')
        size = (image.shape[1], image.shape[0])
        frame_status = self._frame_status(stamp_ns, size)
        if frame_status is ImageIntake.LATE:
            return frame_status
        if frame_status is not ImageIntake.USED:
            self._restart(stamp_ns, size)
        time_s = (stamp_ns - self._first_stamp_ns) * 1e-9
        observed = self._observer.observe(image, time_s)
        for track in observed.tracks:
            self._buffer.add_track(track)
        self._tracks_seen += len(observed.tracks)
        if observed.segments is not None:
            self._buffer.add_segments(observed.segments)
        if observed.edges is not None:
            self._buffer.add_edges(observed.edges)
        if observed.outlines is not None:
            self._buffer.add_outlines(observed.outlines)
        if time_s >= self._forget_s:
            self._forget(time_s)
        self._newest_stamp_ns = stamp_ns
        self._frames += 1
        return frame_status

    def _frame_status(self, stamp_ns: int, size: tuple[int, int]) -> ImageIntake:
        if self._observer is None:
            return ImageIntake.FIRST
        if size != self._size:
            return ImageIntake.RESIZED
        step_ns = stamp_ns - self._newest_stamp_ns
        if not -MAX_REORDERING_NS < step_ns < CLOCK_JUMP_NS:
            return ImageIntake.TIME_JUMPED
        return ImageIntake.USED if step_ns > 0 else ImageIntake.LATE

    def change(self, options: Options) -> None:
        """Take other options, which may differ in what `config.is_reconfigurable` says; a solution is due at once."""
        self._options = options
        if self._observer is not None:
            self._reset_schedule()

    def _forget(self, time_s: float) -> None:
        """Drop old evidence that newer replaces, and all that is old once the camera has, or may have, moved.

        It counts as moved until nothing is held any more from before.
        """
        self._forget_s = time_s + FORGET_PERIOD_S
        memory_s = self._options.buffer.seconds
        if self._observer.drift_px > drift_limit_px(self._size[0], self._options.gate):
            self._moved_s = time_s
        self._moved_s = max(self._moved_s, self._observer.lost_s)
        self._observer.forget_view_before(self._moved_s)
        if time_s - self._moved_s <= memory_s:
            self._buffer.forget_before(time_s - memory_s)
        else:
            self._buffer.forget_replaced(time_s - memory_s)
        self._observer.compare_since(min(self._buffer.oldest_s, time_s - memory_s))

    def _restart(self, stamp_ns: int, size: tuple[int, int]) -> None:
        self._options.scale.require_inside(*size)
        self._observer = Observer(self._options, size, self._detector)
        self._buffer = EvidenceBuffer(self._options.buffer)
        self._size, self._first_stamp_ns, self._newest_stamp_ns = size, stamp_ns, stamp_ns - 1
        self._frames = 0
        self._tracks_seen = 0
        self._forget_s, self._moved_s = FORGET_PERIOD_S, -np.inf
        self._reset_schedule()

    def _reset_schedule(self) -> None:
        self._due_s, self._due_tracks = self._options.first_solve_s, float(self._options.gate.min_tracks)

    def snapshot_if_due(self) -> Evidence | None:
        """Return a snapshot when a new solution is worth trying now, else None.

        Depends on the images and their stamps alone, so that a live run and a replay solve the same evidence.
        """
        if self._observer is None:
            return None
        time_s = (self._newest_stamp_ns - self._first_stamp_ns) * 1e-9
        if time_s < self._due_s or self._tracks_seen < self._due_tracks:
            return None
        track_count = max(self._buffer.track_count, self._options.gate.min_tracks)
        self._due_tracks = self._tracks_seen + (self._options.solve_growth - 1.0) * track_count
        self._due_s = time_s + self._options.solve_interval_s
        return self.snapshot()

    def snapshot(self) -> Evidence | None:
        """Freeze the evidence so far; None before the first image."""
        evidence = self._buffered_evidence()
        return evidence and replace(evidence, still_lines_px=self._observer.still_lines())

    def _buffered_evidence(self) -> Evidence | None:
        """Freeze what the buffer holds."""
        if self._observer is None:
            return None
        return self._buffer.snapshot(
            image_size=self._size,
            first_stamp_ns=self._first_stamp_ns,
            newest_stamp_ns=self._newest_stamp_ns,
            frames=self._frames,
            drift_px=self._observer.drift_px,
            unfinished=self._observer.unfinished(),
        )

    def progress(self) -> CalibrationProgress:
        """Say how much of the evidence that a solution needs is there."""
        evidence, gate = self._buffered_evidence(), self._options.gate
        if evidence is None:
            return CalibrationProgress(0.0, ('no image yet',))
        evidence, _ = drop_pedestrians(evidence)
        needs = requirements(evidence, gate, self._options.first_solve_s)
        scarcest = min(need.fraction for need in needs)
        missing = [need.description for need in needs if need.fraction < 1.0]
        moving = check_steady(evidence, gate)
        if moving:
            return CalibrationProgress(100.0 * scarcest, (moving.message, *missing))
        return CalibrationProgress(100.0 * scarcest, tuple(missing), outlook(evidence, scarcest))

    def followed(self, steps: int = TRAIL_FRAMES) -> np.ndarray:
        """Return where the points followed now were in the last images, pixels (n, steps, 2), for people to look at."""
        return np.zeros((0, steps, 2)) if self._observer is None else self._observer.followed(steps)

    def background(self) -> np.ndarray | None:
        """Return the road without its traffic, BGR uint8 of the full size, for people to look at."""
        return None if self._observer is None else self._observer.background()


def solve(evidence: Evidence, options: Options, *, lens: Camera | None = None) -> Calibration | Refusal:
    """Estimate lens and ground plane from a snapshot; a pure function of its arguments.

    With a known `lens`, of the size of the images, only the pose is solved; the published method knows no such thing.
    UsageError where a pixel of scale.distance_px lies outside the image.
    """
    result = _solve(evidence, options, lens)
    return with_requested_model(result, options) if isinstance(result, Calibration) else result


def with_requested_model(result: Calibration, options: Options) -> Calibration | Refusal:
    """Have camera_info say the lens as the options ask for; a refusal where that would be too far from it.

    Nothing is published in another model then: who asked for one may read no other, and would not notice.
    """
    asked = replace(result, distortion_model=options.distortion_model, rectified_balance=options.rectified_balance)
    try:
        info = asked.camera_info
    except ModelMisfit as misfit:
        return Refusal.from_reason(
            Reason('distortion_model', misfit.message, misfit.remedy), result.method, result.evidence, result.figures
        )
    if info.distortion_model == 'equidistant':
        return asked
    return replace(
        asked,
        checks=(
            *result.checks,
            f'camera_info is {info.distortion_model}, off by at most {info.error_px:.2g} px anywhere in the image',
        ),
    )


def _solve(evidence: Evidence, options: Options, lens: Camera | None) -> Calibration | Refusal:
    options.scale.require_inside(*evidence.image_size)
    intrinsics = paper_intrinsics(evidence, options.paper)
    figures = Figures(
        track_labels=np.full(evidence.track_count, -1),
        focal_sweep_px=np.zeros((0, 2)) if intrinsics is None else intrinsics.sweep,
        paper_tracks=np.zeros(0, int) if intrinsics is None else intrinsics.tracks,
    )

    def refused(reason: Reason) -> Refusal:
        return Refusal.from_reason(reason, options.method, evidence.summary(), figures)

    traffic, kept = drop_pedestrians(evidence)
    reason = check_readiness(traffic, options.gate)
    if reason:
        return refused(reason)
    if options.method == 'paper':
        published = solve_paper(evidence, options, intrinsics, figures)
        return refused(published) if isinstance(published, Reason) else published

    def solved(traffic: Evidence, kept: np.ndarray) -> tuple[Calibration, bool] | Reason:
        """Solve the traffic, the tracks `kept` of the evidence; and whether lens and plane rest on it."""
        tracks = select_tracks(traffic, options.joint.max_tracks)
        solution = _solution(traffic, tracks, options, lens)
        if isinstance(solution, Reason):
            return solution
        return _calibration(
            options,
            solution,
            Calibration(
                method=options.method,
                grade='lens',
                assumptions=solution.assumptions,
                checks=solution.checks,
                camera=solution.fit.state.camera,
                ground=None,
                ground_refusal=solution.plane_refusal,
                road_directions=solution.fit.state.directions,
                stddev=_lens_stddev(solution),
                paper=None if intrinsics is None else intrinsics.report,
                evidence=evidence.summary(),
                newest_stamp_ns=evidence.newest_stamp_ns,
                figures=_figures(figures, solution, kept[tracks.indices], evidence, options),
            ),
        ), not solution.from_markings

    found = solved(traffic, kept)
    if isinstance(found, Reason):
        return refused(found)
    result, by_traffic = found
    told = _find_pedestrians(result, traffic)
    if len(told) and by_traffic:
        drive = np.flatnonzero(~np.isin(traffic.track_vehicles, told))
        vehicles_only = traffic.without_vehicles(told)
        again = check_readiness(vehicles_only, options.gate) or solved(vehicles_only, kept[drive])
        result = _choose_solution(result, again if isinstance(again, Reason) else again[0])
    return _count_pedestrians(result, len(told))


def _find_pedestrians(result: Calibration, evidence: Evidence) -> np.ndarray:
    """Numbers (n,) of who walks or cycles, where lens and plane tell them and no detector did."""
    ground = result.ground
    if ground is None:
        return np.zeros(0, int)
    height = ground.height_m if ground.metric else DEFAULT_CAMERA_HEIGHT_M
    unclassified = evidence.select_tracks(np.flatnonzero(evidence.track_kinds == TrackKind.UNKNOWN))
    return people(unclassified, result.camera, ground.normal_in_camera, height)


def _choose_solution(of_all: Calibration, of_vehicles_only: Calibration | Reason) -> Calibration:
    """Choose the solution of vehicles alone wherever it has a ground plane that is no lesser one.

    Where it has none, too few vehicles are left: that says nothing against the plane of all, on which people walk too
    and which was doubted like any other.
    """
    if isinstance(of_vehicles_only, Reason):
        lacking = of_vehicles_only.message
    elif of_vehicles_only.ground_refusal is not None:
        lacking = of_vehicles_only.ground_refusal.message
    elif of_all.grade == 'full' and of_vehicles_only.grade != 'full':
        lacking = f'the grade is {of_vehicles_only.grade}'
    else:
        return of_vehicles_only
    return replace(of_all, checks=(*of_all.checks, f'the plane is of people too: without them, {lacking}'))


def _count_pedestrians(result: Calibration, pedestrian_count: int) -> Calibration:
    """Count people apart from the vehicles."""
    seen = result.evidence
    return replace(
        result, evidence=replace(seen, vehicles=seen.vehicles - pedestrian_count, people=seen.people + pedestrian_count)
    )


def _solution(evidence: Evidence, tracks: TrackSet, options: Options, lens: Camera | None) -> Solution | Reason:
    """Solve; where the height follows from the solution and is unlike the usual one, solve with it once more."""

    def with_height(height_m: float) -> Solution | Reason:
        return find_solution(
            evidence,
            tracks,
            options.joint,
            options.gate,
            np.random.default_rng(options.random_seed),
            height_m=height_m,
            lens=lens,
        )

    solution = with_height(options.camera_height)
    if options.scale_from == 'height' or isinstance(solution, Reason) or solution.plane_refusal:
        return solution
    scale = _scale(options, solution)
    if isinstance(scale, Reason) or not is_unusual(scale.height(*solution.plane.lens_and_normal)):
        return solution
    return with_height(scale.height(*solution.plane.lens_and_normal))


def _scale(options: Options, solution: Solution) -> Scale | Reason:
    return known_scale(options, *solution.plane.lens_and_normal, solution.flow)


def _figures(
    figures: Figures, solution: Solution, indices: np.ndarray, evidence: Evidence, options: Options
) -> Figures:
    """Add what became of each track (n,) by its index, and the orientations of the segments in the solved lens."""
    labels = figures.track_labels.copy()
    labels[indices] = np.where(solution.fit.inliers(), solution.fit.labels, -2)
    found = segment_orientations(solution.fit.state.camera, evidence.segments_px, options.paper)
    return replace(
        figures,
        track_labels=labels,
        orientation_histogram=found.histogram,
        orientation_peaks_deg=found.peaks_deg,
        residuals=collect_residuals(solution.fit),
    )


def _lens_stddev(solution: Solution) -> StandardDeviations:
    focal, cx, cy, k1, k2 = solution.fit.sigma(
        lambda state: np.array([state.camera.focal_px, *state.camera.principal_point_px, *state.camera.k[:2]])
    )
    return StandardDeviations(
        focal_px=float(focal), principal_point_px=(float(cx), float(cy)), k1=float(k1), k2=float(k2)
    )


def _height_stddev(plane: PlaneEstimate, scale: Scale) -> float:
    """Standard deviation of the height: of what is given, and of the lens and plane by which it follows."""
    told = plane.sigma(lambda camera, normal: np.array([scale.height(camera, normal)]))
    return float(np.hypot(told[0], scale.sigma))


def _ground_point_stddev(plane: PlaneEstimate, scale: Scale) -> tuple[float | None, ...]:
    """Standard deviation in metres of road points ahead, None where they are not in the image."""
    camera, normal = plane.lens_and_normal
    height = scale.height(camera, normal)
    pixels = pixels_ahead(camera, normal, height, np.array(GROUND_DISTANCES_M))
    seen = np.isfinite(pixels).all(axis=1)
    if not seen.any():
        return (None,) * len(seen)

    def points(lens: Camera, up: np.ndarray) -> np.ndarray:
        return ground_points(lens, up, scale.height(lens, up), pixels[seen]).ravel()

    spread = np.hypot(plane.sigma(points), scale.sigma / height * points(camera, normal))
    sigmas = iter(np.hypot(*spread.reshape(-1, 2).T))
    return tuple(float(next(sigmas)) if lens_and_normal else None for lens_and_normal in seen)


def _covariance(plane: PlaneEstimate, scale: Scale) -> np.ndarray:
    """Covariance (10, 10) of lens, tilt, roll and height, in the order of COVARIANCE_OF."""

    def published(camera: Camera, normal: np.ndarray) -> np.ndarray:
        return np.array(
            [
                camera.focal_px,
                *camera.principal_point_px,
                *camera.k,
                *tilt_and_roll_deg(normal),
                scale.height(camera, normal),
            ]
        )

    covariance = plane.covariance(published)
    covariance[-1, -1] += scale.sigma**2
    return covariance


def _calibration(options: Options, solution: Solution, lens: Calibration) -> Calibration:
    """Add the ground plane to a lens where the traffic and what tells the scale give one."""
    plane, scale = solution.plane, solution.plane_refusal or _scale(options, solution)
    if isinstance(scale, Reason):
        return replace(lens, ground_refusal=scale)
    height, height_sigma = scale.height(*plane.lens_and_normal), _height_stddev(plane, scale)
    implausible = check_scale(height, height_sigma, options.gate)
    if implausible:
        return replace(lens, ground_refusal=implausible)
    normal = plane.normal(plane.fit.state)
    tilt, roll = plane.sigma(lambda _, normal: tilt_and_roll_deg(normal))
    grade = 'unit_scale' if not scale.metric else 'assumed' if solution.assumed else 'full'
    return replace(
        lens,
        grade=grade,
        ground=ground_plane(normal, solution.along, height, metric=scale.metric),
        assumptions=(*lens.assumptions, *scale.assumption(height, height_sigma)),
        covariance=_covariance(plane, scale) if scale.metric else None,
        stddev=replace(
            lens.stddev,
            tilt_deg=float(tilt),
            roll_deg=float(roll),
            height_m=height_sigma if scale.metric and height_sigma > 0 else None,
            ground_point_m=_ground_point_stddev(plane, scale) if scale.metric else (),
        ),
    )

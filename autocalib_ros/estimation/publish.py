"""From a solution to a calibration: scale, grade, standard deviations, covariance and figures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.estimation.adjustment.noise_model import DEFAULT_CAMERA_HEIGHT_M
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.estimation.adjustment.residuals import collect_residuals
from autocalib_ros.estimation.certainty import certainty_of_lengths
from autocalib_ros.estimation.known_lengths import scale_of
from autocalib_ros.estimation.paper.intrinsics import PaperIntrinsics
from autocalib_ros.estimation.paper.vanishing_point_voting import segment_orientations
from autocalib_ros.estimation.people.pedestrians import people
from autocalib_ros.estimation.plausibility import why_implausible, with_usual_lanes
from autocalib_ros.estimation.solution import Solution
from autocalib_ros.estimation.verification.ground_normal import PlaneEstimate
from autocalib_ros.estimation.verification.readiness import stillness_checks
from autocalib_ros.estimation.verification.scale import Scale, check_scale
from autocalib_ros.evidence.snapshot import Evidence, TrackKind
from autocalib_ros.geometry.ground_plane import ground_plane, ground_points, pixels_ahead, tilt_and_roll_deg
from autocalib_ros.lens.camera import Camera
from autocalib_ros.lens.camera_info import EXACT_MODELS, ModelMisfit
from autocalib_ros.results.calibration import (
    GROUND_DISTANCES_M,
    Calibration,
    Figures,
    Refusal,
    StandardDeviations,
)
from autocalib_ros.results.grades import GRADE_LIMITS, GroundSigma, rank_of
from autocalib_ros.results.refusals import SECOND_ROAD, TELL_LENS, Reason, reason
from autocalib_ros.results.statements import check
from autocalib_ros.results.verification_table import verified

MAX_CERTAINTY_LOST = 2.0
"""Factor by which lengths may be less certain without pedestrians; half of the tracks make 1.4. Judgement."""


@dataclass(frozen=True)
class ResultDraft:
    """What every result of one evidence has in common, whatever the solution is."""

    evidence: Evidence
    options: Options
    intrinsics: PaperIntrinsics | None
    """Intrinsic stage of the published method; None if no track fills an interval."""
    figures: Figures

    @classmethod
    def begin(cls, evidence: Evidence, options: Options, intrinsics: PaperIntrinsics | None) -> ResultDraft:
        """Start the results of evidence; no track is labelled yet."""
        figures = Figures(
            track_labels=np.full(evidence.track_count, -1),
            focal_sweep_px=np.zeros((0, 2)) if intrinsics is None else intrinsics.sweep,
            paper_tracks=np.zeros(0, int) if intrinsics is None else intrinsics.tracks,
        )
        return cls(evidence, options, intrinsics, figures)

    def refusal(self, why: Reason) -> Refusal:
        """Return a refusal."""
        return Refusal.from_reason(why, self.options.method, self.evidence.summary(), self.figures)

    def calibration(self, solution: Solution, tracks: np.ndarray) -> Calibration:
        """Return a solution, whose tracks have these indices (n,) in the evidence, with its scale, if there is one."""
        lens = Calibration(
            method=self.options.method,
            grade='lens',
            assumptions=solution.assumptions,
            checks=(*stillness_checks(self.evidence), *solution.checks),
            verification=solution.comparisons,
            camera=solution.fit.state.camera,
            ground=None,
            ground_refusal=solution.plane_refusal,
            road_directions=solution.fit.state.directions,
            stddev=_lens_stddev(solution),
            paper=None if self.intrinsics is None else self.intrinsics.report,
            evidence=self.evidence.summary(),
            newest_stamp_ns=self.evidence.newest_stamp_ns,
            figures=self._figures(solution, tracks),
        )
        return with_usual_lanes(_with_ground(lens, solution, self.options), solution.lanes)

    def _figures(self, solution: Solution, tracks: np.ndarray) -> Figures:
        """Add the label of each track, the residuals, and the orientations of the segments in the estimated lens."""
        labels = self.figures.track_labels.copy()
        labels[tracks] = np.where(solution.fit.inliers(), solution.fit.labels, -2)
        found = segment_orientations(solution.fit.state.camera, self.evidence.segments_px, self.options.paper)
        return replace(
            self.figures,
            track_labels=labels,
            orientation_histogram=found.histogram,
            orientation_peaks_deg=found.peaks_deg,
            residuals=collect_residuals(solution.fit),
        )


def with_requested_model(result: Calibration, options: Options) -> Calibration | Refusal:
    """Return the result in the requested distortion model; a refusal if that model cannot represent the lens.

    No other model is published instead: a consumer that reads only the requested one would not notice.
    """
    requested = replace(result, distortion_model=options.distortion_model, rectified_balance=options.rectified_balance)
    try:
        info = requested.camera_info
    except ModelMisfit as misfit:
        why = reason('distortion_model', 'misfit', misfit=misfit.message, instead=misfit.remedy)
        return Refusal.from_reason(why, result.method, result.evidence, result.figures)
    if info.distortion_model in EXACT_MODELS:
        return requested
    statement = check('distortion_model', model=info.distortion_model, error_px=info.error_px)
    return replace(requested, checks=(*result.checks, statement))


def find_pedestrians(result: Calibration, evidence: Evidence) -> np.ndarray:
    """Return the vehicle numbers (n,) of pedestrians and cyclists that no detector classified; none without a plane."""
    ground = result.ground
    if ground is None:
        return np.zeros(0, int)
    height_m = ground.height_m if ground.metric else DEFAULT_CAMERA_HEIGHT_M
    unclassified = evidence.select_tracks(np.flatnonzero(evidence.track_kinds == TrackKind.UNKNOWN))
    return people(unclassified, result.camera, ground.normal_in_camera, height_m)


def choose_solution(of_all: Calibration, of_vehicles: Calibration | Reason) -> Calibration:
    """Choose the solution of vehicles alone, unless it lacks a ground plane or is much less certain.

    If it lacks one, too few vehicles are left. That is no evidence against the plane of all tracks: pedestrians walk
    on it too, and it has passed the same gates.
    """
    if isinstance(of_vehicles, Reason):
        without = of_vehicles.message
    elif of_vehicles.ground_refusal is not None:
        without = of_vehicles.ground_refusal.message
    elif _certainty_lost(of_all, of_vehicles) > MAX_CERTAINTY_LOST:
        without = f'grade {of_vehicles.grade}'
    else:
        return of_vehicles
    return replace(of_all, checks=(*of_all.checks, check('pedestrians_kept', without=without)))


def _certainty_lost(of_all: Calibration, of_vehicles: Calibration) -> float:
    """Return the factor by which lengths on the road are less certain by vehicles alone."""
    whole, part = of_all.stddev.ground, of_vehicles.stddev.ground
    if whole is None or part is None:
        return 1.0 if whole is part else np.inf
    return part.worst / max(whole.worst, 1e-9)


def count_pedestrians(result: Calibration, pedestrians: int) -> Calibration:
    """Count pedestrians apart from the vehicles."""
    counts = result.evidence
    return replace(
        result,
        evidence=replace(counts, vehicles=counts.vehicles - pedestrians, people=counts.people + pedestrians),
    )


def _with_ground(lens: Calibration, solution: Solution, options: Options) -> Calibration:
    """Add the ground plane to a lens if the traffic gives one and the scale is known."""
    plane, scale = solution.plane, solution.plane_refusal or scale_of(solution, options)
    if isinstance(scale, Reason):
        return replace(lens, ground_refusal=scale)
    height_m, height_sigma_m = scale.height(*plane.lens_and_normal), _height_stddev(plane, scale)
    uncertain = check_scale(height_m, height_sigma_m, options.gate)
    if uncertain:
        return replace(lens, ground_refusal=uncertain)
    measured_height = scale.metric and height_sigma_m > 0
    height_row = verified('height_sigma', height_sigma_m / height_m, options.gate.max_sigma_height_rel)
    normal = plane.normal(plane.fit.state)
    tilt, roll = plane.sigma(lambda _, normal: tilt_and_roll_deg(normal))
    certainty = certainty_of_lengths(plane, scale)
    sigma = None if certainty is None else certainty.ground_sigma
    return replace(
        lens,
        verification=(*lens.verification, height_row) if measured_height else lens.verification,
        grade=_grade(sigma, solution) if scale.metric else 'unit_scale',
        helpful=None if certainty is None or not scale.metric else certainty.most_helpful(),
        ground=ground_plane(normal, solution.along, height_m, metric=scale.metric),
        assumptions=(*lens.assumptions, *scale.assumption(height_m, height_sigma_m)),
        covariance=_covariance(plane, scale) if scale.metric else None,
        stddev=replace(
            lens.stddev,
            tilt_deg=float(tilt),
            roll_deg=float(roll),
            height_m=height_sigma_m if measured_height else None,
            ground_point_m=_ground_point_stddev(plane, scale) if scale.metric else (),
            ground=sigma,
        ),
    )


def _grade(sigma: GroundSigma | None, solution: Solution) -> str:
    """Return the grade of a metric plane; one that rests on an assumption, or is contradicted, is fair at most."""
    grade = 'assumed' if sigma is None else sigma.grade
    return 'fair' if grade == 'full' and solution.assumed else grade


def require_grade(result: Calibration, least: str) -> Calibration | Refusal:
    """Return the result; if its grade is below `least`, the lens alone if that is certain, else a refusal.

    The refusal has the result as its candidate. An implausible result is refused whatever its grade.
    """
    implausible = why_implausible(result)
    if implausible:
        refused = Refusal.from_reason(implausible, result.method, result.evidence, result.figures)
        return replace(refused, candidate=result)
    sigma, helpful = result.stddev.ground, result.helpful
    ungraded = result.method == 'paper' or (result.grade == 'unit_scale' and sigma is None)
    grade = sigma.grade if result.grade == 'unit_scale' and sigma else result.grade
    if ungraded or rank_of(grade) >= rank_of(least):
        return result
    lens_certain = (result.stddev.focal_px or 0.0) <= GRADE_LIMITS['fair'] * result.camera.focal_px
    if result.grade == 'lens':
        if lens_certain:
            return result
        missing = result.ground_refusal
        cause, remedy = 'lens', TELL_LENS if missing is None else missing.remedy
    else:
        cause = '' if sigma else 'no_road_ahead'
        remedy = f'give one more number, {helpful.text}' if helpful else SECOND_ROAD
    why = reason(
        'grade_too_low',
        cause,
        grade=result.grade,
        least=least,
        limit=GRADE_LIMITS.get(least),
        along=sigma.along if sigma else None,
        across=sigma.across if sigma else None,
        focal=(result.stddev.focal_px or 0.0) / result.camera.focal_px,
        helpful=remedy,
    )
    if lens_certain:
        return _lens_of(result, why)
    refused = Refusal.from_reason(why, result.method, result.evidence, result.figures)
    return replace(refused, candidate=result)


def _lens_of(result: Calibration, why: Reason) -> Calibration:
    """Return the lens of a result alone, with the reason why its plane is not accepted."""
    sigma = StandardDeviations(
        focal_px=result.stddev.focal_px,
        principal_point_px=result.stddev.principal_point_px,
        k1=result.stddev.k1,
        k2=result.stddev.k2,
    )
    return replace(result, grade='lens', ground=None, ground_refusal=why, covariance=None, helpful=None, stddev=sigma)


def _lens_stddev(solution: Solution) -> StandardDeviations:
    aspect = solution.fit.state.camera.pixel_aspect

    def published(state: AdjustmentState) -> np.ndarray:
        camera = state.camera
        focal_x = camera.focal_px / camera.pixel_aspect * aspect
        return np.array([camera.focal_px, focal_x, *camera.principal_point_px, *camera.k[:2]])

    # of the less certain of the two focal lengths: they differ where the pixel aspect is uncertain
    down, across, cx, cy, k1, k2 = solution.fit.sigma(published)
    return StandardDeviations(
        focal_px=float(max(down, across)), principal_point_px=(float(cx), float(cy)), k1=float(k1), k2=float(k2)
    )


def _height_stddev(plane: PlaneEstimate, scale: Scale) -> float:
    """Standard deviation of the height: of the given scale, and of lens and plane."""
    of_solution = plane.sigma(lambda camera, normal: np.array([scale.height(camera, normal)]))
    return float(np.hypot(of_solution[0], scale.sigma))


def _ground_point_stddev(plane: PlaneEstimate, scale: Scale) -> tuple[float | None, ...]:
    """Standard deviation in metres of road points straight ahead, None if they are outside the image."""
    camera, normal = plane.lens_and_normal
    height = scale.height(camera, normal)
    pixels = pixels_ahead(camera, normal, height, np.array(GROUND_DISTANCES_M))
    visible = np.isfinite(pixels).all(axis=1)
    if not visible.any():
        return (None,) * len(visible)

    def points(lens: Camera, up: np.ndarray) -> np.ndarray:
        return ground_points(lens, up, scale.height(lens, up), pixels[visible]).ravel()

    spread = np.hypot(plane.sigma(points), scale.sigma / height * points(camera, normal))
    sigmas = iter(np.hypot(*spread.reshape(-1, 2).T))
    return tuple(float(next(sigmas)) if inside else None for inside in visible)


def _covariance(plane: PlaneEstimate, scale: Scale) -> np.ndarray:
    """Covariance (10, 10) of lens, tilt, roll and height, in the order of COVARIANCE_PARAMETERS."""

    def published(camera: Camera, normal: np.ndarray) -> np.ndarray:
        height = scale.height(camera, normal)
        return np.array([camera.focal_px, *camera.principal_point_px, *camera.k, *tilt_and_roll_deg(normal), height])

    covariance = plane.covariance(published)
    covariance[-1, -1] += scale.sigma**2
    return covariance

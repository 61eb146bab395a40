"""Method of Jain & Saunier (arXiv 2001.07243) as published: evidence to calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.estimation.paper.intrinsics import PaperIntrinsics
from autocalib_ros.estimation.paper.vanishing_point_voting import (
    SegmentOrientations,
    segment_orientations,
    vote_vanishing_points,
)
from autocalib_ros.estimation.verification.scale import known_scale
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.geometry.ground_plane import (
    focal_from_vanishing_points,
    ground_plane,
    orient_upward,
    paper_translation,
    rotation_from_vanishing_points,
)
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import Calibration, Figures, StandardDeviations
from autocalib_ros.results.refusals import Reason, reason
from autocalib_ros.results.statements import assumption

PAPER_ASSUMPTIONS = tuple(assumption(kind) for kind in ('paper_lens', 'paper_roads', 'paper_uncertainty'))


def solve_paper(
    evidence: Evidence, options: Options, intrinsics: PaperIntrinsics | None, figures: Figures
) -> Calibration | Reason:
    """Run the intrinsic and the extrinsic stage.

    A refusal instead where the intrinsic stage has no tracks; without an extrinsic result the calibration has grade
    'lens' and carries the refusal of its ground plane.
    """
    if intrinsics is None:
        paper = options.paper
        return reason(
            'too_few_tracks',
            'paper',
            lifetime=paper.min_lifetime,
            window_s=paper.window_s,
            path_ratio=paper.max_path_ratio,
        )
    aspect, centre_px = options.lens.pixel_aspect_or(evidence.pixel_aspect), evidence.picture.lens_centre_px
    camera = Camera(*evidence.image_size, intrinsics.report.focal_px, centre_px, pixel_aspect=aspect)
    found = segment_orientations(camera, evidence.segments_px, options.paper)
    figures = replace(figures, orientation_histogram=found.histogram, orientation_peaks_deg=found.peaks_deg)
    result = Calibration(
        method='paper',
        grade='lens',
        assumptions=PAPER_ASSUMPTIONS,
        camera=camera,
        ground=None,
        ground_refusal=None,
        road_directions=np.zeros((0, 3)),
        stddev=StandardDeviations(),
        paper=intrinsics.report,
        evidence=evidence.summary(),
        newest_stamp_ns=evidence.newest_stamp_ns,
        figures=figures,
    )
    return _with_ground(result, found, evidence, options)


def _with_ground(result: Calibration, found: SegmentOrientations, evidence: Evidence, options: Options) -> Calibration:
    """Return the calibration with the extrinsic stage, or with the refusal of its ground plane."""
    points = vote_vanishing_points(found, result.camera.focal_px, options.paper)
    if len(points) < 2:
        return replace(
            result,
            ground_refusal=reason('one_direction', 'paper', segments=len(evidence.segments_px), peaks=len(points)),
        )
    first, second = points
    focal = focal_from_vanishing_points(first, second)
    if focal is None or result.paper is None:
        return replace(
            result,
            ground_refusal=reason(
                'vanishing_points_disagree', first_deg=found.peaks_deg[0], second_deg=found.peaks_deg[1]
            ),
        )
    rotation = rotation_from_vanishing_points(first, second, focal)
    bearings, _ = result.camera.unproject(evidence.points_px)
    normal, _ = orient_upward(rotation[:, 2], bearings)
    report, roads = replace(result.paper, focal_from_vanishing_points_px=focal), rotation[:, :2].T
    scale = known_scale(options, result.camera, normal)
    if isinstance(scale, Reason):
        return replace(result, ground_refusal=scale, paper=report, road_directions=roads)
    height = scale.height(result.camera, normal)
    return replace(
        result,
        grade='full' if scale.metric else 'unit_scale',
        assumptions=(*result.assumptions, *scale.assumption(height)),
        ground=ground_plane(normal, rotation[:, 0], height, metric=scale.metric),
        road_directions=roads,
        paper=replace(report, translation_m=paper_translation(rotation, height)),
    )

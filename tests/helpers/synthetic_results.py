"""A small camera over a junction, exact traffic, and results of every kind built by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.config import BufferOptions
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.snapshot import Evidence, Segments, Track
from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.calibration import (
    Calibration,
    Figures,
    PaperReport,
    Refusal,
    Residuals,
    StandardDeviations,
)
from autocalib_ros.results.refusals import Reason
from autocalib_ros.results.statements import assumption

SPEED_M_S = 10.0
"""Of every vehicle."""


def look(down_deg: float = 40.0) -> np.ndarray:
    """Return ground_from_camera of a camera that looks down and along the ground's x and y alike."""
    down = np.radians(down_deg)
    forward = np.array([np.cos(down) * np.sqrt(0.5), np.cos(down) * np.sqrt(0.5), -np.sin(down)])
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def street_tracks(camera: Camera, ground: GroundPlane, above_m: float = 0.0) -> list[Track]:
    """Return straight tracks along x and along y that the camera sees, of points so far above the road."""
    along, tracks = np.linspace(-30, 30, 200), []
    for vehicle in range(24):
        points = np.full((len(along), 3), above_m)
        points[:, vehicle % 2], points[:, 1 - vehicle % 2] = 8 + along, 3 + vehicle / 2
        bearings = (points - ground.translation_m) @ ground.rotation
        pixels, valid = camera.project(bearings)
        seen = valid & (bearings[:, 2] > 0) & (pixels > 0).all(axis=1) & (pixels < [319, 179]).all(axis=1)
        if seen.sum() > 5:
            tracks.append(Track(vehicle, 3 + along[seen] / SPEED_M_S, pixels[seen]))
    return tracks


def junction_evidence(above_m: float = 0.0) -> Evidence:
    """Return exact tracks on two roads seen by a small camera."""
    camera, ground = Camera.equidistant(320, 180, 140.0), GroundPlane(look(), 8.0)
    buffer = EvidenceBuffer(BufferOptions())
    for track in street_tracks(camera, ground, above_m):
        buffer.add_track(track)
        buffer.add_segments(
            Segments(
                float(track.times_s[3]),
                np.array([track.vehicle]),
                np.concatenate([track.points_px[0], track.points_px[3]])[None],
            )
        )
    return buffer.snapshot(
        image_size=(320, 180), first_stamp_ns=0, newest_stamp_ns=60_000_000_000, frames=600, drift_px=0.0, unfinished=[]
    )


def full_result(evidence: Evidence) -> Calibration:
    """Return a calibration with everything that a report can show."""
    ground = GroundPlane(look(), 8.0)
    trials = np.linspace(80, 300, 50)
    labels = evidence.track_vehicles % 2
    labels[:2] = -1, -2
    figures = Figures(
        focal_sweep_px=np.stack([trials, 1 + (trials / 140 - 1) ** 2], axis=1),
        track_labels=labels,
        orientation_histogram=np.stack([np.arange(0.5, 180), np.arange(180) % 30], axis=1),
        orientation_peaks_deg=(30.0, 135.0),
        paper_tracks=np.arange(3),
        residuals=Residuals(
            evidence.points_px,
            np.full(len(evidence.points_px), 0.3),
            np.repeat(labels, np.diff(evidence.track_starts)).clip(-1),
        ),
    )
    sigmas = np.array([1.5, 1.0, 1.0, 0.01, 1e-6, 1e-6, 1e-6, 0.2, 0.1, 0.05])
    return Calibration(
        method='joint',
        grade='full',
        assumptions=(assumption('paper_roads'),),
        camera=Camera.equidistant(320, 180, 140.0),
        ground=ground,
        ground_refusal=None,
        road_directions=ground.rotation[:2],
        newest_stamp_ns=evidence.newest_stamp_ns,
        evidence=evidence.summary(),
        stddev=StandardDeviations(focal_px=1.5, tilt_deg=0.2, roll_deg=0.1, height_m=0.05),
        figures=figures,
        covariance=np.diag(sigmas**2),
        paper=PaperReport(focal_px=150.0, polynomial_k=(0.3, 0.0, 0.0), straightness_px2=(4.0, 0.5)),
    )


def lens_result(full: Calibration) -> Calibration:
    """Return a calibration without a ground plane."""
    why = Reason(code='one_direction', message='one direction only', remedy='Aim at a crossing.')
    return replace(
        full, grade='lens', ground=None, ground_refusal=why, covariance=None, road_directions=full.road_directions[:1]
    )


def refusal(evidence: Evidence) -> Refusal:
    """Return a refusal of evidence."""
    return Refusal(
        code='too_few_tracks',
        message='only 12 of 40 tracks were seen',
        method='joint',
        remedy='Record at a busier time.',
        evidence=evidence.summary(),
    )


def grey_road() -> np.ndarray:
    """Return an image of the road without its traffic."""
    return np.random.default_rng(0).integers(90, 160, (180, 320, 3)).astype(np.uint8)

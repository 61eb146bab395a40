"""Figures of vehicle speeds on the ground plane, a plausibility check of plane and scale."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from autocalib_ros.pictures.drawing import INK
from autocalib_ros.pictures.views import MAX_DISTANCE_HEIGHTS, TopView, image_to_ground, round_length
from autocalib_ros.report.canvas import BAR_ROOM_IN, chart, colour_bar, draw_legend, label_colour
from autocalib_ros.report.road_figures import TOP_VIEW_PX, ground_axes
from autocalib_ros.report.scene import NOT_USED, ReportScene

KM_H = 3.6
CHORD_S = 0.5
"""Duration of the chord over which speed is measured: noise hardly lengthens it, a bend hardly shortens it."""
MIN_TRACK_S = 1.0
"""Least duration on the road of a track with a speed, seconds."""
SCALE_QUANTILE = 0.98
"""Quantile of chords and vehicles at which the scales end."""
MIN_BINS = 15
"""Least number of bins of the speed histogram."""


@dataclass(frozen=True)
class TrackPieces:
    """Tracks on the ground plane, cut into chords of `CHORD_S`."""

    points: list[np.ndarray]
    """Points of each piece, shape (n, 2), metres or camera heights."""
    lengths: np.ndarray
    """Shape (pieces,)."""
    speeds: np.ndarray
    """Km/h or camera heights per second, shape (pieces,)."""
    tracks: np.ndarray
    """Index of the track in the evidence, shape (pieces,)."""


def point_height(scene: ReportScene) -> float:
    """Return the assumed height of tracked points as a fraction of the camera height."""
    ground = scene.ground
    return min(scene.options.scale.point_height_m / ground.height_m, 0.5) if ground.metric else 0.0


def track_pieces_on_road(scene: ReportScene) -> TrackPieces | None:
    """Project the tracks to the plane of the tracked points and measure their speeds; None if there are none."""
    if not scene.has_ground:
        return None
    camera, ground = scene.calibrated.camera, scene.ground
    evidence, lower = scene.evidence, 1.0 - point_height(scene)
    everywhere = lower * image_to_ground(camera, ground, evidence.points_px)
    points, times, tracks = [], [], []
    for index in range(evidence.track_count):
        part = slice(evidence.track_starts[index], evidence.track_starts[index + 1])
        near = np.hypot(*everywhere[part].T) < MAX_DISTANCE_HEIGHTS * ground.height_m
        way, times_s = everywhere[part][near], evidence.times_s[part][near]
        if len(way) < 2 or times_s[-1] - times_s[0] < MIN_TRACK_S:
            continue
        ends = np.linspace(times_s[0], times_s[-1], int((times_s[-1] - times_s[0]) / CHORD_S) + 1)
        at = np.unique(np.searchsorted(times_s, ends).clip(max=len(way) - 1))
        for begin, end in pairwise(at):
            points.append(way[begin : end + 1])
            times.append(times_s[end] - times_s[begin])
            tracks.append(index)
    if not points:
        return None
    lengths = np.array([np.hypot(*(piece[-1] - piece[0])) for piece in points])
    speeds = lengths / np.array(times) * (KM_H if ground.metric else 1.0)
    return TrackPieces(points, lengths, speeds, np.array(tracks))


def vehicle_speeds(scene: ReportScene, pieces: TrackPieces) -> tuple[np.ndarray, np.ndarray]:
    """Return the speed (vehicles,) of each vehicle and the road (vehicles,) of the majority of its tracks.

    Speeds are weighted by distance, so stopped vehicles do not count.
    """
    vehicles, owner = np.unique(scene.evidence.track_vehicles[pieces.tracks], return_inverse=True)
    way = np.bincount(owner, pieces.lengths)
    speeds = np.bincount(owner, pieces.lengths * pieces.speeds) / np.maximum(way, 1e-9)
    labels, roads = scene.labels[pieces.tracks], np.full(len(vehicles), NOT_USED)
    if scene.roads:
        used = labels >= 0
        counts = np.zeros((len(vehicles), len(scene.roads)), int)
        np.add.at(counts, (owner[used], labels[used]), 1)
        roads = np.where(counts.any(axis=1), counts.argmax(axis=1), NOT_USED)
    return speeds, roads


def speeds_above(scene: ReportScene) -> Figure | None:
    """Draw the tracks in the top view, coloured by speed."""
    pieces = track_pieces_on_road(scene)
    if pieces is None:
        return None
    ground = scene.ground
    view = TopView.around(np.concatenate(pieces.points), ground, TOP_VIEW_PX)
    if view is None:
        return None
    figure, axes = ground_axes(view, ground, below_in=BAR_ROOM_IN)
    lines = LineCollection(
        pieces.points,
        array=pieces.speeds,
        cmap='viridis',
        linewidths=0.9,
        alpha=0.8,
        norm=Normalize(0, max(np.quantile(pieces.speeds, SCALE_QUANTILE), 1e-3)),
    )
    axes.add_collection(lines, autolim=False)
    colour_bar(figure, lines, f'speed, {speed_unit(scene)}', exceeded=True)
    return figure


def speed_histogram(scene: ReportScene) -> Figure | None:
    """Draw the histogram of vehicle speeds on each road."""
    pieces = track_pieces_on_road(scene)
    if pieces is None:
        return None
    speeds, roads = vehicle_speeds(scene, pieces)
    named = scene.roads if scene.result.method == 'joint' else range(0)  # the published method does not separate roads
    roads = roads if named else np.full(len(roads), NOT_USED)
    figure, (axes,) = chart(3.2)
    fastest = max(1.2 * np.quantile(speeds, SCALE_QUANTILE), 1e-3)
    bin_width = round_length(fastest / MIN_BINS)
    edges = bin_width * np.arange(np.ceil(fastest / bin_width) + 1)
    digits = 0 if scene.ground.metric else 2
    most = 1
    for label in (*named, NOT_USED):
        own = speeds[roads == label]
        if len(own):
            name = scene.road_name(label) if label != NOT_USED else 'on no road' if named else 'all'
            counts = np.histogram(own, edges)[0]
            most = max(most, int(counts.max()))
            axes.stairs(
                counts,
                edges,
                linewidth=1.8,
                color=label_colour(label),
                label=f'{name}: {len(own)} road users, median {np.median(own):.{digits}f} {speed_unit(scene)}',
            )
    axes.set(xlim=(0, edges[-1]), ylim=(0, 1.4 * most))  # room for the legend
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(f'mean speed of a road user, weighted by distance, {speed_unit(scene)}', color=INK)
    axes.set_ylabel('road users', color=INK)
    draw_legend(axes)
    return figure


def speed_unit(scene: ReportScene) -> str:
    """Return the unit of speeds."""
    return 'km/h' if scene.ground.metric else 'camera heights per second'


def speed_note(scene: ReportScene) -> str:
    """Describe the assumptions behind the speeds."""
    ground, given = scene.ground, scene.options.scale
    if not ground.metric:
        return (
            'Tracked points are on vehicles, above the road, which overestimates all speeds by one factor, about'
            ' 10 % for a camera 8 m high.'
        )
    spread = 100 * given.point_height_sigma_m / (ground.height_m - given.point_height_m)
    return (
        f'Tracked points are on vehicles: their height above the road is assumed to be {given.point_height_m:g} ±'
        f' {given.point_height_sigma_m:g} m, which makes the speeds uncertain by {spread:.0f} %; speeds of lorries'
        ' are overestimated.'
    )

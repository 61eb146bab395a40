"""How fast vehicles go on the ground plane: what everybody can check."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from autocalib_ros.pictures.views import MAX_DISTANCE_HEIGHTS, TopView, image_to_ground, round_length
from autocalib_ros.report.canvas import BAR_ROOM_IN, INK, chart, colour_bar, draw_legend, label_colour
from autocalib_ros.report.road_figures import TOP_VIEW_PX, ground_axes
from autocalib_ros.report.scene import NOT_USED, ReportScene

KM_H = 3.6
CHORD_S = 0.5
"""Speeds are of the chord over so long: noise hardly lengthens it, a bend hardly shortens it."""
MIN_TRACK_S = 1.0
"""A track that was seen on the road for a shorter time tells no speed."""
SCALE_QUANTILE = 0.98
"""Share of the pieces, and of the vehicles, that the scales reach to."""
MIN_BINS = 15


@dataclass(frozen=True)
class TrackPieces:
    """Tracks on the ground plane in pieces of `CHORD_S`."""

    points: list[np.ndarray]
    """Of each piece, shape (n, 2), metres, or heights of the camera."""
    lengths: np.ndarray
    """Shape (pieces,)."""
    speeds: np.ndarray
    """Km/h, or heights a second, shape (pieces,)."""
    tracks: np.ndarray
    """Index of the track in the evidence, shape (pieces,)."""


def point_height(scene: ReportScene) -> float:
    """Return the share of the camera's height at which tracked points are taken to be."""
    ground = scene.calibration.ground
    return min(scene.options.scale.point_height_m / ground.height_m, 0.5) if ground.metric else 0.0


def track_pieces_on_road(scene: ReportScene) -> TrackPieces | None:
    """Lay the tracks on the plane in which tracked points are, and tell their speeds; None where there are none."""
    if scene.calibration is None or scene.calibration.ground is None:
        return None
    camera, ground = scene.calibration.camera, scene.calibration.ground
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
        for begin, end in zip(at[:-1], at[1:], strict=True):
            points.append(way[begin : end + 1])
            times.append(times_s[end] - times_s[begin])
            tracks.append(index)
    if not points:
        return None
    lengths = np.array([np.hypot(*(piece[-1] - piece[0])) for piece in points])
    speeds = lengths / np.array(times) * (KM_H if ground.metric else 1.0)
    return TrackPieces(points, lengths, speeds, np.array(tracks))


def vehicle_speeds(scene: ReportScene, pieces: TrackPieces) -> tuple[np.ndarray, np.ndarray]:
    """Return the speed (vehicles,) of each vehicle, and the road (vehicles,) of most of its tracks.

    As loops along the way would count: each metre weighs alike, so that waiting does not count.
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
    """Draw the tracks from above, coloured by speed."""
    pieces = track_pieces_on_road(scene)
    if pieces is None:
        return None
    ground = scene.calibration.ground
    view = TopView.around(np.concatenate(pieces.points), ground, TOP_VIEW_PX)
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
    """Draw how many vehicles went how fast on each road."""
    pieces = track_pieces_on_road(scene)
    if pieces is None:
        return None
    speeds, roads = vehicle_speeds(scene, pieces)
    named = scene.roads if scene.result.method == 'joint' else range(0)  # the published method tells no roads apart
    roads = roads if named else np.full(len(roads), NOT_USED)
    figure, (axes,) = chart(3.2)
    fastest = max(1.2 * np.quantile(speeds, SCALE_QUANTILE), 1e-3)
    bin_width = round_length(fastest / MIN_BINS)
    edges = bin_width * np.arange(np.ceil(fastest / bin_width) + 1)
    digits = 0 if scene.calibration.ground.metric else 2
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
    axes.set_xlabel(f'speed of a road user, averaged over the way, {speed_unit(scene)}', color=INK)
    axes.set_ylabel('road users', color=INK)
    draw_legend(axes)
    return figure


def speed_unit(scene: ReportScene) -> str:
    """Return the unit of speeds."""
    return 'km/h' if scene.calibration.ground.metric else 'camera heights a second'


def speed_note(scene: ReportScene) -> str:
    """Say what the speeds rest on."""
    ground, given = scene.calibration.ground, scene.options.scale
    if not ground.metric:
        return (
            'Tracked points are on vehicles, above the road, so that all speeds look too high by one factor, some'
            ' 10 % under a camera 8 m high.'
        )
    spread = 100 * given.point_height_sigma_m / (ground.height_m - given.point_height_m)
    return (
        f'Tracked points are on vehicles, above the road: they are taken to be {given.point_height_m:g} ±'
        f' {given.point_height_sigma_m:g} m above it, which leaves the speeds unsure by {spread:.0f} %; a lorry'
        ' looks faster than it is.'
    )

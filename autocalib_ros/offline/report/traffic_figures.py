"""Where traffic was seen and what was kept of it."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from autocalib_ros.offline.report.canvas import (
    INK,
    MUTED,
    OTHER_LABELS,
    Scene,
    chart,
    draw_legend,
    draw_paths,
    image_axes,
    road_colour,
)


def all_tracks(scene: Scene) -> Figure | None:
    """Draw every trajectory over the road; the road alone where there is none."""
    if scene.background is None and not scene.evidence.track_count:
        return None
    figure, axes = image_axes(scene)
    paths = [track.points_px for track in scene.evidence.tracks()]
    draw_paths(axes, paths, '#3355bb', width=0.9, alpha=0.55)
    if paths:
        ends = np.array([path[-1] for path in paths])
        axes.plot(*ends.T, '.', color='#1b2f77', markersize=2.5)
    return figure


def kept_tracks(scene: Scene) -> Figure | None:
    """Draw the trajectories in the colour of their road direction; None when none was kept."""
    labels = scene.labels
    if not (labels >= 0).any():
        return None
    figure, axes = image_axes(scene)
    paths = [track.points_px for track in scene.evidence.tracks()]
    for label in sorted(set(labels.tolist())):
        chosen = [path for path, own in zip(paths, labels, strict=True) if own == label]
        name, colour = OTHER_LABELS.get(label, (f'road direction {label + 1}', road_colour(label)))
        draw_paths(axes, chosen, colour, f'{name}: {len(chosen)}', width=1.0 if label >= 0 else 0.7,
                   alpha=0.7 if label >= 0 else 0.5)
    draw_legend(axes)
    return figure


def orientation_histogram(scene: Scene) -> Figure | None:
    """Draw how many segments run in each orientation, and the two peaks."""
    counts = scene.result.figures.orientation_histogram
    if not len(counts):
        return None
    figure, axes = chart(3.4)
    axes.bar(counts[:, 0], counts[:, 1], width=np.median(np.diff(counts[:, 0])) if len(counts) > 1 else 1.0,
             color=MUTED)
    for index, peak in enumerate(scene.result.figures.orientation_peaks_deg):
        axes.axvline(peak, color=road_colour(index), linewidth=2, label=f'peak {index + 1}: {peak:.0f} degrees')
    axes.set_xlabel('orientation in the undistorted image, degrees', color=INK)
    axes.set_ylabel('segments', color=INK)
    draw_legend(axes, 'upper center')
    return figure

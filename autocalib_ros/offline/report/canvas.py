"""What all figures share: the scene they show, colours, the image underneath, PNG."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from autocalib_ros.calibration import Calibration, Refusal
from autocalib_ros.evidence import Evidence
from autocalib_ros.pictures.drawing import ROAD_COLOURS

WIDTH_IN, DPI = 9.0, 110
PNG_EFFORT = 3
"""More takes three times as long to save a tenth of the size."""
INK, MUTED, PAPER = '#1c2733', '#8a97a3', '#e9edf0'
OTHER_LABELS = {-1: ('not used', '#8a97a3'), -2: ('rejected', '#222222')}
MARGIN = 0.35
"""Share of the image shown around it where something lies outside."""


@dataclass(frozen=True)
class Scene:
    """What a report is about."""

    result: Calibration | Refusal
    evidence: Evidence
    background: np.ndarray | None
    """BGR or grey uint8 of the full size."""

    @property
    def calibration(self) -> Calibration | None:
        """The result where it is a calibration."""
        return self.result if isinstance(self.result, Calibration) else None

    @property
    def labels(self) -> np.ndarray:
        """For each track -1 not used, -2 rejected, else its road direction."""
        labels = np.asarray(self.result.figures.track_labels)
        return labels if len(labels) == self.evidence.track_count else np.full(self.evidence.track_count, -1)


def road_colour(index: int) -> str:
    """Return the colour of a road direction."""
    return ROAD_COLOURS[index % len(ROAD_COLOURS)]


def chart(height_in: float = 4.2) -> tuple[Figure, Axes]:
    """Return a figure with one pair of axes for a diagram."""
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout='constrained')
    axes = figure.add_subplot()
    axes.spines[['top', 'right']].set_visible(False)
    axes.grid(color=PAPER)
    axes.set_axisbelow(True)
    return figure, axes


def image_axes(scene: Scene, *, margin: float = 0.0, picture: np.ndarray | None = None,
               fade: float = 0.25) -> tuple[Figure, Axes]:
    """Return a figure that shows the road, lightened by `fade`, in pixel coordinates."""
    width, height = scene.evidence.image_size
    shown_w, shown_h = width * (1 + 2 * margin), height * (1 + 2 * margin)
    figure = Figure(figsize=(WIDTH_IN, WIDTH_IN * shown_h / shown_w), dpi=DPI)
    axes = figure.add_axes((0, 0, 1, 1))
    picture = scene.background if picture is None else picture
    axes.set_facecolor(PAPER)
    if picture is not None:
        axes.imshow(faded_rgb(picture, fade), interpolation='bilinear')
    axes.set(xlim=(-0.5 - margin * width, width - 0.5 + margin * width),
             ylim=(height - 0.5 + margin * height, -0.5 - margin * height), aspect='equal')
    axes.set_axis_off()
    if margin:
        figure.set_facecolor(PAPER)
    return figure, axes


def faded_rgb(picture: np.ndarray, fade: float) -> np.ndarray:
    """Return a BGR or grey picture as RGB, mixed with white so that lines stand out."""
    rgb = picture[..., ::-1] if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
    return (rgb * (1 - fade) + 255 * fade).astype(np.uint8)


def draw_paths(axes: Axes, paths: Sequence[np.ndarray], colour: str, label: str | None = None, *,
               width: float = 1.1, alpha: float = 0.8) -> None:
    """Draw polylines (n, 2), with one entry in the legend."""
    if len(paths):
        axes.add_collection(LineCollection(list(paths), colors=colour, linewidths=width, alpha=alpha, label=label),
                            autolim=False)


def draw_legend(axes: Axes, place: str = 'upper right') -> None:
    """Add a legend where there is something to explain."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc=place, fontsize=9, framealpha=0.9, edgecolor='none')


def png(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    stream = io.BytesIO()
    figure.savefig(stream, format='png', pil_kwargs={'compress_level': PNG_EFFORT})
    return stream.getvalue()

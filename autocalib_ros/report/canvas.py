"""Common elements of the figures: size, colours, image background, legend, colour bar and encoding."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import AbstractPathEffect, withStroke

from autocalib_ros.evidence.picture import Picture
from autocalib_ros.pictures.drawing import ROAD_COLOURS
from autocalib_ros.report.scene import NOT_USED, REJECTED, ReportScene

WIDTH_IN, DPI = 7.0, 160
"""Text stays legible on a phone that shows the figure at a third of its width."""
STYLE: dict[Any, Any] = {
    'font.size': 11.0,
    'axes.labelsize': 11.0,
    'legend.fontsize': 10.0,
    'xtick.labelsize': 10.0,
    'ytick.labelsize': 10.0,
}
LEFT_IN, BELOW_IN, EDGE_IN = 0.85, 0.6, 0.12
"""Margins of a diagram, inches: left and below for labels, and the other sides."""
BAR_IN, BAR_ROOM_IN = 0.16, 0.75
"""Height of a colour bar, and with its labels, inches."""
PNG_EFFORT, JPEG_QUALITY = 3, 85
"""A higher PNG compression level takes three times as long and saves a tenth of the size."""
MUTED_COLOUR, PANEL_COLOUR, WHITE = '#8a97a3', '#e9edf0', '#ffffff'
OTHER_COLOURS = {NOT_USED: '#8a97a3', REJECTED: '#222222'}
LEGEND_LINE = 2.5
"""Least width of lines in the legend, points."""
LegendPlace = Literal['best', 'lower right', 'upper right', 'upper left', 'upper center']
TURNING_COLOUR = '#7733aa'
"""Colour of turning vehicles."""
HALO: list[AbstractPathEffect] = [withStroke(linewidth=3, foreground=WHITE)]
"""White halo around text on images."""


def road_colour(index: int) -> str:
    """Return the colour of a road direction."""
    return ROAD_COLOURS[index % len(ROAD_COLOURS)]


def label_colour(label: int) -> str:
    """Return the colour of tracks with a label."""
    return OTHER_COLOURS[label] if label in OTHER_COLOURS else road_colour(label)


def chart(height_in: float = 3.6, rows: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure with stacked axes that share their x axis."""
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI)
    panels = list(np.atleast_1d(figure.subplots(rows, 1, sharex=True)))
    figure.subplots_adjust(
        left=LEFT_IN / WIDTH_IN,
        right=1 - EDGE_IN / WIDTH_IN,
        bottom=BELOW_IN / height_in,
        top=1 - EDGE_IN / height_in,
        hspace=0.12,
    )
    for axes in panels:
        axes.spines[['top', 'right']].set_visible(False)
        axes.grid(color=PANEL_COLOUR)
        axes.set_axisbelow(True)
    return figure, panels


def image_axes(
    scene: ReportScene, *, margin: float = 0.0, picture: np.ndarray | None = None, fade: float = 0.25
) -> tuple[Figure, Axes]:
    """Return a figure with axes in pixel coordinates over the background image, lightened by `fade`.

    `margin` is the width of the border shown around the image, fraction of its size.
    """
    width, height = scene.evidence.image_size
    shown_w, shown_h = width * (1 + 2 * margin), height * (1 + 2 * margin)
    figure = Figure(figsize=(WIDTH_IN, WIDTH_IN * shown_h / shown_w), dpi=DPI, facecolor=PANEL_COLOUR)
    axes = figure.add_axes((0, 0, 1, 1))
    picture = scene.background if picture is None else picture
    axes.set_facecolor(PANEL_COLOUR)
    if picture is not None:
        show_picture(axes, picture, fade, round(WIDTH_IN * DPI / (1 + 2 * margin)))
    elif margin:
        axes.plot(*np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]]).T - 0.5, color=MUTED_COLOUR)
    axes.set(
        xlim=(-0.5 - margin * width, width - 0.5 + margin * width),
        ylim=(height - 0.5 + margin * height, -0.5 - margin * height),
        aspect='equal',
    )
    axes.set_axis_off()
    _outline_picture(axes, scene.evidence.picture)
    return figure, axes


def _outline_picture(axes: Axes, picture: Picture) -> None:
    """Outline the picture inside the images, unless it fills them."""
    if picture.fills_image:
        return
    x0, y0, x1, y1 = picture.rectangle
    outline = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
    if picture.circle is not None:
        x, y, radius = picture.circle
        angles = np.linspace(0.0, 2 * np.pi, 181)
        outline = np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)])
    axes.plot(*outline.T - 0.5, color=MUTED_COLOUR, linewidth=1, linestyle='--')


def faded_rgb(picture: np.ndarray, fade: float) -> np.ndarray:
    """Return a BGR or grey image as RGB, blended with white so that lines are visible."""
    rgb = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB if picture.ndim == 3 else cv2.COLOR_GRAY2RGB)
    return np.asarray(cv2.convertScaleAbs(rgb, alpha=1 - fade, beta=255 * fade))


def show_picture(axes: Axes, picture: np.ndarray, fade: float, shown_px: int) -> None:
    """Draw a BGR or grey image under all else, in its pixel coordinates, lightened by `fade`.

    It is brought to the width in which it is shown beforehand: Matplotlib resamples more slowly, in RGBA.
    """
    height, width = picture.shape[:2]
    size = (shown_px, max(1, round(shown_px * height / width)))
    shrinks = shown_px < width
    shown = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    axes.imshow(
        faded_rgb(shown, fade), extent=(-0.5, width - 0.5, height - 0.5, -0.5), interpolation='nearest', zorder=0
    )


def mapped(function: Callable[[np.ndarray], np.ndarray], paths: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return paths, each (n, 2), of which a function maps the points: all at once, since there are thousands."""
    if not len(paths):
        return []
    return np.split(function(np.concatenate(paths)), np.cumsum([len(path) for path in paths[:-1]]))


def plot_paths(
    axes: Axes,
    paths: Sequence[np.ndarray],
    colour: str,
    label: str | None = None,
    *,
    width: float = 1.1,
    alpha: float = 0.8,
) -> None:
    """Draw polylines, each (n, 2), with one legend entry."""
    if len(paths):
        axes.add_collection(
            LineCollection(list(paths), colors=colour, linewidths=width, alpha=alpha, label=label), autolim=False
        )


def draw_legend(axes: Axes, place: LegendPlace = 'upper right') -> None:
    """Add a legend with wide lines, if there are labelled artists."""
    if not axes.get_legend_handles_labels()[0]:
        return
    legend = axes.legend(loc=place, framealpha=0.9, edgecolor='none')
    for handle in legend.legend_handles:
        if isinstance(handle, Line2D):
            handle.set(linewidth=max(handle.get_linewidth(), LEGEND_LINE), alpha=1)


def render_bgr(figure: Figure) -> np.ndarray:
    """Render a figure to a BGR image."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., 2::-1]


def png(picture: np.ndarray) -> bytes:
    """Encode an image as PNG."""
    return cv2.imencode('.png', picture, [cv2.IMWRITE_PNG_COMPRESSION, PNG_EFFORT])[1].tobytes()


def jpeg(picture: np.ndarray) -> bytes:
    """Encode an image as JPEG, much smaller than PNG for photographs."""
    return cv2.imencode('.jpg', picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def cell_map(scene: ReportScene, values: np.ma.MaskedArray, scale: Normalize, label: str) -> Figure:
    """Return a figure that shows values (rows, columns) of image cells as colours; masked cells stay clear."""
    width, height = scene.evidence.image_size
    height_in = WIDTH_IN * height / width + BAR_ROOM_IN
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI)
    axes = figure.add_axes((0, BAR_ROOM_IN / height_in, 1, 1 - BAR_ROOM_IN / height_in))
    axes.set_facecolor(PANEL_COLOUR)
    if scene.background is not None:
        show_picture(axes, scene.background, 0.25, round(WIDTH_IN * DPI))
    rows, columns = values.shape
    cells = axes.pcolormesh(
        np.linspace(0, width, columns + 1) - 0.5,
        np.linspace(0, height, rows + 1) - 0.5,
        values,
        norm=scale,
        cmap='viridis',
        alpha=0.6,
        edgecolors='none',
    )
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect='equal', xticks=[], yticks=[])
    bar = colour_bar(figure, cells, label, exceeded=bool(values.max() > scale.vmax))
    bar.xaxis.set_major_formatter('{x:g}')
    return figure


def colour_bar(figure: Figure, mapped: ScalarMappable, label: str, *, exceeded: bool) -> Axes:
    """Add a colour bar in the lowest `BAR_ROOM_IN` inches of a figure; return its axes."""
    height_in = figure.get_figheight()
    left, below = LEFT_IN / WIDTH_IN, (BAR_ROOM_IN - BAR_IN - 0.07) / height_in
    axes = figure.add_axes((left, below, 1 - left - 3 * EDGE_IN / WIDTH_IN, BAR_IN / height_in))
    figure.colorbar(mapped, cax=axes, orientation='horizontal', label=label, extend='max' if exceeded else 'neither')
    return axes

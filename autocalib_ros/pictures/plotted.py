"""Lines and words plotted once, smooth, and laid over pictures of one size: quick for each frame of a video.

For files; what a live image gets is drawn in `drawing`, which needs no matplotlib.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import matplotlib.patheffects
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from autocalib_ros.pictures.views import TopView, round_length

PLATE_COLOUR, WHITE = '#10171e', '#ffffff'
DPI = 100
PLOT_TEXT_FRACTION, MIN_PLOT_TEXT_PX = 0.022, 11
"""Height of letters as a share of the picture's shorter side, and at the least."""
MAX_SCALE_BAR_FRACTION = 0.25
"""Most that a scale bar takes of the picture's width."""
GRID_CELLS_ALONG = 8
"""About so many squares of a grid fit along the longer side of a view from above."""
POINTS_PER_PX = 72.0 / DPI
"""Points, in which matplotlib measures lines and letters, in a pixel."""


@dataclass(frozen=True)
class PlotOverlay:
    """A drawing that covers where its alpha says so."""

    colour: np.ndarray
    """BGR multiplied by alpha, (rows, columns, 3) uint16, 255 is 1."""
    rest: np.ndarray
    """1 - alpha, (rows, columns, 1) uint16, 255 is 1."""

    @classmethod
    def render(cls, columns: int, rows: int, draw: Callable[[Axes], None]) -> PlotOverlay:
        """Draw on axes whose units are pixels, (0, 0) the centre of the top-left one."""
        figure = Figure(figsize=(columns / DPI, rows / DPI), dpi=DPI, facecolor='none')
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
        axes.axis('off')
        draw(axes)
        canvas.draw()
        rgba = np.asarray(canvas.buffer_rgba()).astype(np.uint16)
        return cls(rgba[..., 2::-1] * rgba[..., 3:] // 255, 255 - rgba[..., 3:])

    def composite(self, picture: np.ndarray) -> np.ndarray:
        """Lay it over a picture of the same size, grey (H, W) or BGR (H, W, 3) uint8; return BGR uint8."""
        bgr = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR) if picture.ndim == 2 else picture
        return (bgr * self.rest // 255 + self.colour).astype(np.uint8)


def text_px(columns: int, rows: int) -> float:
    """Return the height of letters that suits a picture."""
    return max(PLOT_TEXT_FRACTION * min(columns, rows), MIN_PLOT_TEXT_PX)


def draw_outlined_text(axes: Axes, x: float, y: float, text: str, size_px: float, **how: object) -> None:
    """Write white words with a dark rim at a pixel."""
    rim = [
        matplotlib.patheffects.withStroke(linewidth=0.22 * size_px * POINTS_PER_PX, foreground=PLATE_COLOUR, alpha=0.75)
    ]
    axes.text(x, y, text, **{'color': WHITE, 'fontsize': size_px * POINTS_PER_PX, 'path_effects': rim, **how})


def draw_plate(axes: Axes, left: float, top: float, right: float, bottom: float) -> None:
    """Darken a rectangle, so that what is written on it can be read on any picture."""
    axes.add_patch(
        FancyBboxPatch(
            (left, top),
            right - left,
            bottom - top,
            facecolor=PLATE_COLOUR,
            alpha=0.72,
            linewidth=0,
            boxstyle='round,pad=0,rounding_size=4',
            mutation_aspect=1.0,
        )
    )


def draw_scale_bar(
    axes: Axes, view: TopView, length_unit: str, corner: tuple[float, float] | None = None, size_px: float | None = None
) -> None:
    """Draw a bar of a round length and write how long it is, above its corner (left, bottom) or in that of the view."""
    size = size_px or text_px(view.columns, view.rows)
    length = round_length(MAX_SCALE_BAR_FRACTION * view.columns / view.px_per_m)
    left, bottom = corner or (0.8 * size, view.rows - 0.8 * size)
    begin, level = left + 0.8 * size, bottom - 0.8 * size
    end = begin + length * view.px_per_m
    draw_plate(axes, left, level - 2.2 * size, end + 0.8 * size, bottom)
    for ends in (
        [[begin, level], [end, level]],
        *([[x, level - 0.35 * size], [x, level + 0.35 * size]] for x in (begin, end)),
    ):
        axes.plot(*np.transpose(ends), color=WHITE, linewidth=0.16 * size * POINTS_PER_PX, solid_capstyle='projecting')
    axes.text(
        (begin + end) / 2,
        level - 0.55 * size,
        f'{length:g} {length_unit}',
        color=WHITE,
        fontsize=size * POINTS_PER_PX,
        ha='center',
        va='bottom',
    )


def draw_metre_grid(axes: Axes, view: TopView, length_unit: str) -> None:
    """Draw lines at round metres over a view from above, and write their x above and their y at the right."""
    size = 0.8 * text_px(view.columns, view.rows)
    low, high = np.array(view.low_m), np.array(view.high_m)
    step = round_length(1.5 * float((high - low).max()) / GRID_CELLS_ALONG)
    for axis in (0, 1):
        for value in step * np.arange(np.ceil(low[axis] / step), np.floor(high[axis] / step) + 1):
            ends = np.array([low, high])
            ends[:, axis] = value
            x, y = view.pixels(ends)[0]
            axes.plot(*view.pixels(ends).T, color=WHITE, linewidth=POINTS_PER_PX, alpha=0.55)
            place = (x, 0.5 * size, 'center', 'top') if axis == 0 else (view.columns - 0.8 * size, y, 'right', 'center')
            draw_outlined_text(
                axes, place[0], place[1], f'{value + 0.0:g} {length_unit}', size, ha=place[2], va=place[3]
            )

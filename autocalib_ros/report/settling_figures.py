"""Figure of the convergence of intermediate solutions over time."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from autocalib_ros.pictures.drawing import INK
from autocalib_ros.report.canvas import MUTED_COLOUR, chart, draw_legend, road_colour
from autocalib_ros.report.scene import ReportScene, SolutionSnapshot


def settling(scene: ReportScene) -> Figure | None:
    """Draw focal length and tilt of the intermediate solutions with one sigma."""
    moments = scene.moments
    focal = [(one.seconds, one.focal_px, one.focal_sigma_px) for one in moments if one.focal_px is not None]
    if len(moments) < 2 or not focal:
        return None
    tilt = [(one.seconds, one.tilt_deg, one.tilt_sigma_deg) for one in moments if one.tilt_deg is not None]
    figure, panels = chart(4.4 if tilt else 2.8, 2 if tilt else 1)
    _draw(panels[0], focal, 'focal length, px', road_colour(0))
    if tilt:
        _draw(panels[1], tilt, 'tilt, degrees', road_colour(1))
    _draw_refusals(panels, scene.moments)
    panels[-1].set_xlabel('seconds since the first image', color=INK)
    return figure


def _draw(axes: Axes, rows: list[tuple[float, float, float | None]], label: str, colour: str) -> None:
    seconds, values, sigmas = zip(*rows, strict=True)
    known = np.array([np.nan if sigma is None else sigma for sigma in sigmas])
    axes.errorbar(
        seconds,
        values,
        np.nan_to_num(known),
        fmt='o-',
        color=colour,
        capsize=4,
        linewidth=1.2,
        label='accepted, ± 1 sigma' if np.isfinite(known).any() else 'accepted',
    )
    axes.axhline(values[-1], color=MUTED_COLOUR, linewidth=0.8)
    axes.set_ylabel(label, color=INK)


def _draw_refusals(panels: list[Axes], moments: tuple[SolutionSnapshot, ...]) -> None:
    refused = [moment.seconds for moment in moments if moment.focal_px is None]
    for axes in panels:
        axes.set_xlim(0, 1.05 * moments[-1].seconds)
        if refused:
            axes.plot(
                refused,
                np.full(len(refused), 0.04),
                'x',
                color=INK,
                transform=axes.get_xaxis_transform(),
                label='refused',
            )
    draw_legend(panels[0], 'best')

"""How the result settled while traffic went by."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from autocalib_ros.report.canvas import INK, MUTED_COLOUR, chart, draw_legend, road_colour
from autocalib_ros.report.scene import ReportScene, SolutionSnapshot


def settling(scene: ReportScene) -> Figure | None:
    """Draw focal length and tilt of the solutions that were tried on the way, with one sigma."""
    found = [moment for moment in scene.moments if moment.focal_px is not None]
    if len(scene.moments) < 2 or not found:
        return None
    tilted = [moment for moment in found if moment.tilt_deg is not None]
    figure, panels = chart(4.4 if tilted else 2.8, 2 if tilted else 1)
    _draw(panels[0], [(m.seconds, m.focal_px, m.focal_sigma_px) for m in found], 'focal length, px', road_colour(0))
    if tilted:
        _draw(panels[1], [(m.seconds, m.tilt_deg, m.tilt_sigma_deg) for m in tilted], 'tilt, degrees', road_colour(1))
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

"""The figure of a soak: what the process took, and what it answered, over a day and a night."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from autocalib_ros.offline.benchmark.soak import SoakSample
from autocalib_ros.pictures.drawing import INK
from autocalib_ros.report.canvas import PANEL_COLOUR, chart, road_colour

FIGURE_HEIGHT_IN = 8.6
HOURS_BETWEEN_TICKS = 3.0
NIGHT_BELOW = 0.5
"""Share of daylight below which the figure is shaded."""


def write_soak_figure(path: Path, samples: Sequence[SoakSample]) -> None:
    """Write the figure as SVG or PNG, by the name of the file."""
    hours = np.array([each.hour for each in samples])
    panels: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = (
        ('memory, MB', (('memory_mb', 'node'), ('solver_mb', 'solver'))),
        ('number', (('descriptors', 'descriptors'), ('threads', 'threads'))),
        ('lines of log', (('log_lines', 'all so far'),)),
        ('CPU per image, ms', (('ms_per_image', 'node, with snapshots and topics'),)),
        ('focal length, px', (('focal_px', '± 1 sigma'),)),
    )
    with matplotlib.rc_context({'svg.hashsalt': 'soak', 'svg.fonttype': 'none'}):
        figure, axes_of = chart(FIGURE_HEIGHT_IN, len(panels))
        for axes, (label, keys) in zip(axes_of, panels, strict=True):
            for number, (key, name) in enumerate(keys):
                values = np.array([getattr(each, key) for each in samples], float)
                axes.plot(hours, values, color=road_colour(number), linewidth=1.4, label=name)
                if key == 'focal_px':
                    sigma = np.array([each.focal_sigma_px for each in samples])
                    axes.fill_between(hours, values - sigma, values + sigma, color=road_colour(number), alpha=0.2)
                else:
                    axes.set_ylim(0.0, max(axes.get_ylim()[1], 1.3 * float(values.max())))
            _shade_nights(axes, hours, samples)
            axes.set_ylabel(label, color=INK)
            axes.legend(loc='upper right', frameon=False, ncols=2, labelcolor=INK)
        axes_of[-1].set_xlim(0.0, hours[-1])
        if hours[-1] > HOURS_BETWEEN_TICKS:
            axes_of[-1].set_xticks(np.arange(0.0, hours[-1] + 0.1, HOURS_BETWEEN_TICKS))
        axes_of[-1].set_xlabel('simulated hours; nights are grey', color=INK)
        figure.savefig(path, metadata={'Date': None} if path.suffix == '.svg' else None)


def _shade_nights(axes: Axes, hours: np.ndarray, samples: Sequence[SoakSample]) -> None:
    dark = [each.daylight < NIGHT_BELOW for each in samples]
    axes.fill_between(
        hours, 0, 1, where=dark, transform=axes.get_xaxis_transform(), color=PANEL_COLOUR, zorder=0, linewidth=0
    )

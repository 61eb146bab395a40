"""Traffic simulator: recordings of synthetic traffic seen through a known lens, with ground truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from autocalib_ros.offline.simulate.command import add_arguments, options_from, run
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.simulation import Simulation

__all__ = ['Simulation', 'SimulationOptions', 'add_arguments', 'options_from', 'run', 'write_bag']


def write_bag(
    path: Path | str,
    options: SimulationOptions,
    *,
    workers: int | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Simulate a recording and write it to a new bag folder; see `bag.write_bag`."""
    from autocalib_ros.offline.simulate.bag import write_bag as write  # imported here: nothing else needs rosbags

    return write(path, options, workers=workers, overwrite=overwrite, progress=progress)

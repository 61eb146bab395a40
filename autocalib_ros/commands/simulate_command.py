"""`autocalib simulate`: the simulator defines the arguments."""

from __future__ import annotations

import argparse

HELP = 'write a recording of simulated traffic with ground truth'
DESCRIPTION = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the simulator."""
    from autocalib_ros.offline import simulate

    simulate.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Write the simulated recording; return the exit status."""
    from autocalib_ros.offline import simulate

    return simulate.run(arguments)

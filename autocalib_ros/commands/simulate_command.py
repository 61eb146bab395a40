"""`autocalib simulate`: its options come with the simulator."""

from __future__ import annotations

import argparse

HELP = 'write a recording of simulated traffic with known truth'
DESCRIPTION = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what can be chosen about a simulation."""
    from autocalib_ros.offline import simulate

    simulate.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Write the recording."""
    from autocalib_ros.offline import simulate

    return simulate.run(arguments)

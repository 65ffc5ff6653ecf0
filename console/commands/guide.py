"""`armwright guide`."""

import argparse

from console.commands.connection import connected


def run(given: argparse.Namespace) -> int:
    """Open the motor circuits, somebody must hold the arm; or let the drives carry it."""
    connected(given).guide(given.weightless)
    return 0

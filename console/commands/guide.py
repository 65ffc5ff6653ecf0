"""`armwright guide`."""

import argparse

from console.commands.connection import connected


def run(given: argparse.Namespace) -> int:
    """Open the motor circuits: somebody must hold the arm."""
    connected(given).guide()
    return 0

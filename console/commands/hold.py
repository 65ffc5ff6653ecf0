"""`armwright hold`."""

import argparse

from console.commands.connection import connected


def run(given: argparse.Namespace) -> int:
    """End hand-guiding and hold."""
    connected(given).hold()
    return 0

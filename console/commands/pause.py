"""`armwright pause`."""

import argparse

from console.commands.connection import connected


def run(given: argparse.Namespace) -> int:
    """Slow to rest along the motion that runs, and hold on it."""
    connected(given).pause()
    return 0

"""`armwright stop`."""

import argparse

from console.commands.connection import connected


def run(given: argparse.Namespace) -> int:
    """Controlled stop, then hold."""
    connected(given).stop()
    return 0

"""`armwright resume`."""

import argparse

from console.commands.connection import connected


def run(given: argparse.Namespace) -> int:
    """Go on along the motion."""
    connected(given).resume()
    return 0

"""`armwright enable`."""

import argparse

from console.commands.connection import connected


def run(given: argparse.Namespace) -> int:
    """Drives on, holding where the arm stands."""
    connected(given).enable()
    return 0

"""`armwright home`."""

import argparse

from console.commands.connection import connected


def run(given: argparse.Namespace) -> int:
    """Find every joint's zero."""
    connected(given).home()
    return 0

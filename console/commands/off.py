"""`armwright off`."""

import argparse

from console.commands.connection import connected


def run(given: argparse.Namespace) -> int:
    """Stop, hold, lower on shorted windings, drives off."""
    connected(given).off(quit_runtime=given.quit)
    return 0

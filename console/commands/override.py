"""`armwright override F`: pace of motions."""

import argparse

from console.commands.connection import connected


def run(given: argparse.Namespace) -> int:
    """Set it, for the motion that runs and those to come."""
    connected(given).override(given.fraction)
    return 0

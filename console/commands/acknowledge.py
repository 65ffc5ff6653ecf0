"""`armwright acknowledge`."""

import argparse

from console.commands.connection import connected


def run(given: argparse.Namespace) -> int:
    """A human has seen the fault."""
    connected(given).acknowledge()
    return 0

"""`armwright wait [S]`: for some seconds, or until the arm has come to rest."""

import argparse

from console.commands.connection import connected
from control.errors import ArmError

LONGEST_S = 24 * 3600.0
RESTING = ("HOLDING", "BRAKED", "OFF", "GUIDING")


def run(given: argparse.Namespace) -> int:
    """Wait on the arm's clock."""
    client = connected(given)
    if given.seconds is None:
        client.arrive(LONGEST_S, RESTING)
        return 0
    if not 0.0 <= given.seconds <= LONGEST_S:
        raise ArmError(f"wait: expected 0 to {LONGEST_S:g} s, got {given.seconds:g}")
    client.wait(given.seconds)
    return 0

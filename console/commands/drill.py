"""`armwright drill`: one named fault on a mock arm, one in all its situations, or all of them, and what the arm did."""

import argparse
import sys

from control.errors import ArmError
from hil_mocks.firmware.boards import choose
from procedures.drills.catalogue import drills, drills_named
from procedures.drills.drill import header, in_words, listing, row, verdict


def run(given: argparse.Namespace) -> int:
    """Run the drills; exit status 1 if a promise was not kept."""
    if given.list:
        sys.stdout.write(listing(drills().values()) + "\n")
        return 0
    if not given.mock:
        raise ArmError("drills break things on purpose and run on a mock arm only: add --mock")
    choose(given.firmware)
    chosen = list(drills().values()) if given.name is None else drills_named(given.name)
    if len(chosen) == 1:
        outcome = chosen[0].run()
        sys.stdout.write(in_words(outcome) + "\n")
        return 1 if outcome.broken else 0
    outcomes = []
    sys.stdout.write(header() + "\n")
    for drill in chosen:
        outcomes.append(drill.run())
        sys.stdout.write(row(outcomes[-1]) + "\n")
        sys.stdout.flush()
    sys.stdout.write(verdict(outcomes) + "\n")
    return 1 if any(outcome.broken for outcome in outcomes) else 0

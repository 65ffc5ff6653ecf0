"""`armwright plan-contacts`: which contacts of two arms of a cell say most about both."""

import argparse
import sys
from pathlib import Path

from calib.closed_chain.pair_problem import DISTANCE_MOST_m
from calib.closed_chain.planning import pair_of, plan_contacts, plan_text, write_contacts
from calib.errors import CalibrationError
from console.commands.calibration.options import quantity
from control.errors import ArmError
from control.model.cell import load_cell
from procedures.folders import require_writable


def run(given: argparse.Namespace) -> int:
    """Plan, print what the contacts determine, write contacts.csv."""
    cell = load_cell(given.cell)
    names, distances_m = pair_of(cell, given.arms), _distances(given.distance or ["0mm"])
    if given.count < 1:
        raise CalibrationError(f"--count: expected a number of contacts from 1 on, got {given.count}")
    out = Path(given.out) if given.out else None
    if out is not None:
        if out.exists():
            raise ArmError(f"{out} exists already and is never overwritten: choose another --out")
        require_writable(out.parent)
    plan = plan_contacts(cell, names, distances_m, given.count)
    sys.stdout.write(plan_text(plan))
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_contacts(out, plan.chosen.contacts)
        sys.stdout.write(f"written: {out}\n")
    return 0


def _distances(texts: list[str]) -> list[float]:
    found = [quantity(text, "m", "--distance") for text in texts]
    for text, distance_m in zip(texts, found, strict=True):
        if not 0.0 <= distance_m <= DISTANCE_MOST_m:
            raise CalibrationError(f"--distance: expected 0 to {DISTANCE_MOST_m:g} m, got {text}")
    return found

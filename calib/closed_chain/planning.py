"""Which contacts of a cell's two arms to take: the D-optimal ones of those that are reachable and clear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arm_problem.frames import Frame
from calib.closed_chain.calibrate import PairPlan, choose_contacts
from calib.closed_chain.candidates import DRAWN, Candidates, base_of, contact_candidates
from calib.closed_chain.contacts import Contacts, contact_points
from calib.closed_chain.pair_problem import PairProblem
from calib.errors import CalibrationError
from calib.identify.determinability import Determinability, determinability
from calib.identify.open_combinations import open_in_words
from calib.points.writer import write_points
from control.errors import ArmError
from control.model.arm import Arm
from control.model.cell import Cell

NOISE_m = 2e-4  # of a contact, to compare what contacts say with what is known of the arms


@dataclass(frozen=True, slots=True)
class ContactPlan:
    """The chosen contacts, the most valuable first; what they determine; how many there were to choose from."""

    arms: tuple[Arm, Arm]
    chosen: Candidates
    known: Determinability
    candidates_count: int
    others: Candidates


def pair_of(cell: Cell, asked: Sequence[str] | None = None) -> tuple[str, str]:
    """The names of the two arms that are meant. ArmError if the cell has more and none are asked for."""
    names = asked or cell.names
    if len(names) != 2:
        raise ArmError(f"cell {cell.name!r} has {', '.join(names)}: name two of them with --arms")
    one, two = (cell.placed(name).name for name in names)
    if one == two:
        raise ArmError(f"--arms: expected two different arms, got {one} twice")
    return one, two


def plan_contacts(
    cell: Cell,
    names: tuple[str, str],
    distances_m: Sequence[float],
    count: int,
    plan: PairPlan | None = None,
    drawn: int = DRAWN,
) -> ContactPlan:
    """Plan `count` contacts. CalibrationError if the arms can meet at fewer places."""
    first, second = (cell.placed(name).arm for name in names)
    arms, base, plan = (first, second), base_of(cell, names), plan or PairPlan()
    found = contact_candidates(cell, names, distances_m, drawn)
    if len(found.contacts) < count:
        raise CalibrationError(
            f"{count} contacts were requested, but there are only {len(found.contacts)} places that both arms reach, clear of"
            f" each other by clearance_m and 0.03 m (only the last tool_length_m of an arm, {cell.tool_length_m:g} m"
            " here, may come near the other's)"
        )
    rows = choose_contacts(arms, found.contacts, plan, count, NOISE_m, base)
    rest = [row for row in range(len(found.contacts)) if row not in set(rows)]
    chosen = found.chosen(rows)
    known = what_they_determine(arms, chosen.contacts, base, plan)
    return ContactPlan(arms, chosen, known, len(found.contacts), found.chosen(rest))


def what_they_determine(
    arms: tuple[Arm, Arm], contacts: Contacts, base: Frame, plan: PairPlan
) -> Determinability:
    """Of the parameters of both arms and of the second base, by the arms' nominal models."""
    problem = PairProblem(
        arms, contacts, base, bounds=plan.bounds, fixed=plan.fixed, free_tools=plan.free_tools
    )
    return determinability(problem.sensitivity(np.zeros(len(problem.parameters))), problem.parameters)


def plan_text(plan: ContactPlan) -> str:
    """What the contacts determine, and what stays open."""
    count = len(plan.chosen.contacts)
    lines = [
        f"{count} of {plan.candidates_count} contacts that both arms reach, clear of each other (D-optimal).",
        f"They determine {plan.known.rank} of {plan.known.rank + _open_count(plan.known)} parameters"
        f" (condition number {plan.known.condition_number:.0f}).",
        *(f"{sentence}." for sentence in open_in_words(plan.known.undetermined)),
    ]
    return "\n".join(lines) + "\n"


def _open_count(known: Determinability) -> int:
    return len(known.basis) - known.rank


def write_contacts(path: Path, contacts: Contacts) -> None:
    """Write contacts.csv with the planned joint angles, the most valuable first. ArmError if the file exists."""
    if path.exists():
        raise ArmError(f"{path} exists already and is never overwritten: choose another name")
    q_rad = np.hstack((contacts.first_rad, contacts.second_rad))
    write_points(path, contact_points(contacts.setup, contacts.name, q_rad, contacts.distance_m.tolist()))

"""Which contacts of a cell's two arms to take: the D-optimal ones of those that are reachable and clear, and these candidates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.frames import Frame
from calib.arrays import Array, frozen
from calib.closed_chain.calibrate import PairPlan, choose_contacts
from calib.closed_chain.contacts import Contacts, contact_points
from calib.closed_chain.pair_problem import PairProblem
from calib.closed_chain.room import SharedRoom
from calib.design.candidates import (
    FREE_HEIGHT_M,
    Mask,
    body_points,
    is_above_floor,
    joint_box,
    postures,
    scaled_height_m,
    spread_poses,
)
from calib.errors import CalibrationError
from calib.identify.determinability import Determinability, determinability
from calib.identify.open_combinations import open_in_words
from calib.points.writer import write_points
from control.errors import ArmError
from control.model.arm import Arm
from control.model.cell import Cell, Placed
from control.motion.joint_limits import reach_m

# Places where the tips of two arms of a cell can meet: both reach them, clear of each other, of themselves and of the floor.

DRAWN = 6000  # poses of the first arm; one in ten gives a contact
STARTS = 12  # from which postures of the second arm are searched
LEVER = (
    0.12  # of the reach, per rad: least way of the tip; 3 % of the reach are then made up for within 0.25 rad
)
CAVITY, APART = "cavity", "apart"  # setups of contacts in one place, and at a distance
SEED = 0


@dataclass(frozen=True, slots=True)
class Candidates:
    """m contacts, and where each arm stands shortly before: (m, n1) and (m, n2) [rad]."""

    contacts: Contacts
    first_away_rad: Array
    second_away_rad: Array

    def chosen(self, rows: Sequence[int]) -> Candidates:
        """Some of them, by index."""
        keep = np.array(rows, dtype=np.intp)
        return Candidates(
            self.contacts.chosen(keep), frozen(self.first_away_rad[keep]), frozen(self.second_away_rad[keep])
        )


def base_of(cell: Cell, names: tuple[str, str]) -> Frame:
    """Where the second arm's base stands in the base frame of the first, by the cell's file."""
    one, two = (cell.placed(name) for name in names)
    turn = np.array(one.rotation).T @ np.array(two.rotation)
    return Frame(f"{two.name}_base", frozen(turn), frozen(np.array(one.in_base(two.origin_m))))


def contact_candidates(
    cell: Cell, names: tuple[str, str], distances_m: Sequence[float], drawn: int = DRAWN
) -> Candidates:
    """Contacts by the arms' own models: drawn poses of the first, and every posture of the second that reaches its tip.

    The distances [m] between the tips take turns; 0 is one place. For the distances, directions are drawn (seeded).
    """
    one, two = (cell.placed(name) for name in names)
    base, rng = base_of(cell, names), np.random.default_rng(SEED)
    first = spread_poses(joint_box(one.arm), drawn)
    first = first[_is_fit(one.arm, first)]
    tips = ArmModel(one.arm).tips(one.arm.dh, first)
    apart = np.resize(np.array(distances_m), len(first))
    way = rng.normal(size=tips.shape)
    way /= np.linalg.norm(way, axis=1)[:, None]
    goal = (tips + apart[:, None] * way - base.origin_m) @ base.rotation
    near = np.linalg.norm(goal, axis=1) < reach_m(two.arm)
    first, apart, goal = first[near], apart[near], goal[near]
    box = joint_box(two.arm)
    second, which = postures(ArmModel(two.arm), goal, spread_poses(box, STARTS), box)
    rows = _is_fit(two.arm, second)
    return _clear(cell, (one, two), first[which[rows]], second[rows], apart[which[rows]])


def _clear(cell: Cell, pair: tuple[Placed, Placed], first: Array, second: Array, apart: Array) -> Candidates:
    """The contacts that are clear, that both arms can back off from, and to which there is a way from their rest poses."""
    room = SharedRoom(cell, pair)
    kept: list[int] = []
    away: tuple[list[Sequence[float]], list[Sequence[float]]] = ([], [])
    for row, (q1, q2) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        if not room.is_clear(q1, q2):
            continue
        off = room.backed_off((q1, q2))
        if off is None or not room.is_clear(*off):
            continue
        if room.way(room.rest_rad, off) is not None:
            kept.append(row)
            away[0].append(off[0])
            away[1].append(off[1])
    contacts = Contacts(
        tuple(f"c{k + 1}" for k in range(len(kept))),
        tuple(CAVITY if apart[row] == 0.0 else APART for row in kept),
        frozen(first[kept]),
        frozen(second[kept]),
        frozen(apart[kept]),
    )
    return Candidates(
        contacts,
        frozen(np.reshape(away[0], (len(kept), first.shape[1]))),
        frozen(np.reshape(away[1], (len(kept), second.shape[1]))),
    )


def _is_fit(arm: Arm, q_rad: Array) -> Mask:
    """Poses of which no part is near the floor and the tip well above it, away from where the tip cannot be moved one way."""
    model = ArmModel(arm)
    by_q = model.slopes(model.nominal_dh, q_rad).by_dh[:, :, list(model.theta_places)]
    can_move = np.linalg.svd(by_q, compute_uv=False)[:, -1] >= LEVER * reach_m(arm)
    points = body_points(arm, q_rad)
    height_m = scaled_height_m(arm, FREE_HEIGHT_M)
    lowest_m = arm.limits.floor_z_m + arm.limits.floor_clearance_m + height_m
    return np.asarray(can_move & is_above_floor(arm, points).all(axis=1) & (points[:, -1, 2] >= lowest_m))


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

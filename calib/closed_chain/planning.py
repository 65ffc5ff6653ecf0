"""Which contacts of a cell's two arms to take: the D-optimal ones of those that both reach, clear of each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.observations import Frame
from calib.arrays import Array, frozen
from calib.closed_chain.calibrate import choose_contacts
from calib.closed_chain.pair_problem import Contacts, PairPlan, PairProblem, contact_points
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
from calib.identify.determinability import Determinability, determinability, open_in_words
from calib.points.writer import write_points
from control.errors import ArmError
from control.kinematics.inverse import InverseKinematics
from control.model.arm import Arm
from control.model.cell import Cell, Placed
from control.motion.joint_limits import reach_m, reaches_m
from control.safety.collision import ArmBody, least_gap, pairs_between

MARGIN_m = 0.03  # beyond the cell's clearance: tips of uncalibrated arms are some 2 cm off
AWAY_m = 0.04  # back along the last link, to where an arm moves before a hand brings its tip to the contact
STEP_m = 0.005  # two looks at a way are at least so far apart: no part comes nearer between them by more than half of it
AHEAD_m = 0.2  # gaps beyond it are not looked at closely
Poses = Sequence[Sequence[float]]
"""Joint angles of the first and of the second arm [rad]."""


class SharedRoom:
    """Whether two arms are clear of each other and of themselves, with a margin."""

    def __init__(self, cell: Cell, pair: tuple[Placed, Placed]) -> None:
        self.rest_rad: Poses = [placed.arm.rest_rad for placed in pair]
        self._bodies = tuple(ArmBody(placed, cell.tool_length_m) for placed in pair)
        self._pairs = pairs_between(*self._bodies)
        self._own_pairs = [_apart(body, q_rad) for body, q_rad in zip(self._bodies, self.rest_rad, strict=True)]
        self._least_m = cell.clearance_m + MARGIN_m
        self._backs = (_Back(pair[0].arm), _Back(pair[1].arm))
        self._levers_m = [np.array(reaches_m(placed.arm)) for placed in pair]

    def is_clear(self, first_rad: Sequence[float], second_rad: Sequence[float]) -> bool:
        """Of a pose of both."""
        return self._to_spare_m(first_rad, second_rad) >= 0.0

    def _to_spare_m(self, first_rad: Sequence[float], second_rad: Sequence[float]) -> float:
        """How much more than asked for the nearest parts are apart, AHEAD_m at most."""
        first, second = self._bodies[0].at(first_rad), self._bodies[1].at(second_rad)
        between_m = least_gap(first, second, self._pairs, self._least_m + AHEAD_m).gap_m - self._least_m
        own_m = [
            least_gap(at, at, pairs, MARGIN_m + AHEAD_m).gap_m - MARGIN_m
            for pairs, at in zip(self._own_pairs, (first, second), strict=True)
        ]
        return min(AHEAD_m, between_m, *own_m)

    def backed_off(self, poses_rad: Poses) -> Poses | None:
        """Both tips a little back along the last links; None if an arm cannot."""
        off = [back.off(q_rad) for back, q_rad in zip(self._backs, poses_rad, strict=True)]
        return None if off[0] is None or off[1] is None else [off[0], off[1]]

    def is_way_clear(self, start_rad: Poses, end_rad: Poses) -> bool:
        """Of a joint move of both, which begin and end together; the ends themselves are not looked at.

        By conservative advancement: parts that have a distance to spare cannot meet before they have moved that far.
        """
        start, end = ([np.array(q_rad) for q_rad in poses] for poses in (start_rad, end_rad))
        moved_m = sum(float(np.abs(b - a) @ levers) for a, b, levers in zip(start, end, self._levers_m, strict=True))
        share = STEP_m / max(moved_m, STEP_m)
        while share < 1.0:
            first, second = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            to_spare_m = self._to_spare_m(first.tolist(), second.tolist())
            if to_spare_m < 0.0:
                return False
            share += max(to_spare_m, STEP_m) / moved_m
        return True

    def way(self, start_rad: Poses, goal_rad: Poses) -> Sequence[Poses] | None:
        """Poses to move to in turn, both arms together, until `goal_rad`; None if no such way is clear.

        Straight there, else by way of the rest poses, where one arm may wait until the other has left.
        """
        for way in self._ways(start_rad, goal_rad):
            if not all(self.is_clear(*via) for via in way[:-1]):
                continue
            if all(self.is_way_clear(a, b) for a, b in pairwise((start_rad, *way))):
                return way
        return None

    def _ways(self, start_rad: Poses, goal_rad: Poses) -> Iterator[Sequence[Poses]]:
        yield (goal_rad,)
        rest = self.rest_rad
        leave = ((), ((rest[0], start_rad[1]),), ((start_rad[0], rest[1]),))
        arrive = ((), ((rest[0], goal_rad[1]),), ((goal_rad[0], rest[1]),))
        for first, last in product(leave, arrive):
            yield (*first, rest, *last, goal_rad)


def _apart(body: ArmBody, rest_rad: Sequence[float]) -> tuple[tuple[int, int], ...]:
    """Pairs of the arm's own links that the margin is for: those of a wrist whose axes meet always touch."""
    at = body.at(rest_rad)
    return tuple(pair for pair in body.own_pairs if least_gap(at, at, (pair,), MARGIN_m).gap_m >= MARGIN_m)


class _Back:
    """Poses with the tip a little back along the last link."""

    def __init__(self, arm: Arm) -> None:
        self._inverse, self._corners = InverseKinematics(arm), ArmBody(Placed(arm), 0.0)

    def off(self, q_rad: Sequence[float]) -> Sequence[float] | None:
        """Such a pose near `q_rad`; None if the arm cannot."""
        last = self._corners.at(q_rad)[-2]
        along = np.array([last.dx, last.dy, last.dz])
        tip = np.array([last.x, last.y, last.z]) + along
        back = tip - AWAY_m * along / np.linalg.norm(along)
        try:
            return self._inverse.nearest(back.tolist(), q_rad)
        except ArmError:
            return None


DRAWN = 6000  # poses of the first arm; one in ten gives a contact
STARTS = 12  # from which postures of the second arm are searched
LEVER = 0.12  # of the reach, per rad: least way of the tip; 3 % of the reach are then made up for within 0.25 rad
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
        return Candidates(self.contacts.chosen(keep), frozen(self.first_away_rad[keep]), frozen(self.second_away_rad[keep]))


def base_of(cell: Cell, names: tuple[str, str]) -> Frame:
    """Where the second arm's base stands in the base frame of the first, by the cell's file."""
    first, second = (cell.placed(name) for name in names)
    turn = np.array(first.rotation).T @ np.array(second.rotation)
    return Frame(f"{second.name}_base", frozen(turn), frozen(np.array(first.in_base(second.origin_m))))


def contact_candidates(cell: Cell, names: tuple[str, str], distances_m: Sequence[float], drawn: int = DRAWN) -> Candidates:
    """Contacts by the arms' own models: drawn poses of the first, and every posture of the second that reaches its tip.

    The distances [m] between the tips take turns; 0 is one place. For the distances, directions are drawn (seeded).
    """
    ours, theirs = (cell.placed(name) for name in names)
    base, rng = base_of(cell, names), np.random.default_rng(SEED)
    first = spread_poses(joint_box(ours.arm), drawn)
    first = first[_is_fit(ours.arm, first)]
    tips = ArmModel(ours.arm).tips(ours.arm.dh, first)
    apart = np.resize(np.array(distances_m), len(first))
    way = rng.normal(size=tips.shape)
    way /= np.linalg.norm(way, axis=1)[:, None]
    goal = (tips + apart[:, None] * way - base.origin_m) @ base.rotation
    near = np.linalg.norm(goal, axis=1) < reach_m(theirs.arm)
    first, apart, goal = first[near], apart[near], goal[near]
    box = joint_box(theirs.arm)
    second, which = postures(ArmModel(theirs.arm), goal, spread_poses(box, STARTS), box)
    rows = _is_fit(theirs.arm, second)
    return _clear(cell, (ours, theirs), first[which[rows]], second[rows], apart[which[rows]])


def _clear(cell: Cell, pair: tuple[Placed, Placed], first: Array, second: Array, apart: Array) -> Candidates:
    """The contacts that are clear, that both arms can back off from, and to which there is a way from their rest poses."""
    room = SharedRoom(cell, pair)
    clear: list[int] = []
    away: tuple[list[Sequence[float]], list[Sequence[float]]] = ([], [])
    for row, (q1, q2) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        if not room.is_clear(q1, q2):
            continue
        off = room.backed_off((q1, q2))
        if off is None or not room.is_clear(*off):
            continue
        if room.way(room.rest_rad, off) is not None:
            clear.append(row)
            away[0].append(off[0])
            away[1].append(off[1])
    contacts = Contacts(
        tuple(f"c{k + 1}" for k in range(len(clear))),
        tuple(CAVITY if apart[row] == 0.0 else APART for row in clear),
        frozen(first[clear]),
        frozen(second[clear]),
        frozen(apart[clear]),
    )
    return Candidates(
        contacts,
        frozen(np.reshape(away[0], (len(clear), first.shape[1]))),
        frozen(np.reshape(away[1], (len(clear), second.shape[1]))),
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
    first, second = (cell.placed(name).name for name in names)
    if first == second:
        raise ArmError(f"--arms: expected two different arms, got {first} twice")
    return first, second


def plan_contacts(
    cell: Cell, names: tuple[str, str], distances_m: Sequence[float], count: int, drawn: int = DRAWN
) -> ContactPlan:
    """Plan `count` contacts. CalibrationError if the arms can meet at fewer places."""
    first, second = (cell.placed(name).arm for name in names)
    arms, base, plan = (first, second), base_of(cell, names), PairPlan()
    offers = contact_candidates(cell, names, distances_m, drawn)
    if len(offers.contacts) < count:
        raise CalibrationError(
            f"{count} contacts were requested, but there are only {len(offers.contacts)} places that both arms reach, clear of"
            f" each other by clearance_m and 0.03 m (only the last tool_length_m of an arm, {cell.tool_length_m:g} m"
            " here, may come near the other's)"
        )
    rows = choose_contacts(PairProblem(arms, offers.contacts, base, plan), count, NOISE_m)
    rest = [row for row in range(len(offers.contacts)) if row not in set(rows)]
    chosen = offers.chosen(rows)
    known = what_they_determine(arms, chosen.contacts, base, plan)
    return ContactPlan(arms, chosen, known, len(offers.contacts), offers.chosen(rest))


def what_they_determine(arms: tuple[Arm, Arm], contacts: Contacts, base: Frame, plan: PairPlan) -> Determinability:
    """Of the parameters of both arms and of the second base, by the arms' nominal models."""
    problem = PairProblem(arms, contacts, base, plan)
    return determinability(problem.sensitivity(np.zeros(len(problem.parameters))), problem.parameters)


def plan_text(plan: ContactPlan) -> str:
    """What the contacts determine, and what stays open."""
    count = len(plan.chosen.contacts)
    lines = [
        f"{count} of {plan.candidates_count} contacts that both arms reach, clear of each other (D-optimal).",
        f"They determine {plan.known.rank} of {len(plan.known.basis)} parameters"
        f" (condition number {plan.known.condition_number:.0f}).",
        *(f"{sentence}." for sentence in open_in_words(plan.known.undetermined)),
    ]
    return "\n".join(lines) + "\n"


def write_contacts(path: Path, contacts: Contacts) -> None:
    """Write contacts.csv with the planned joint angles, the most valuable first. ArmError if the file exists."""
    if path.exists():
        raise ArmError(f"{path} exists already and is never overwritten: choose another name")
    q_rad = np.hstack((contacts.first_rad, contacts.second_rad))
    write_points(path, contact_points(contacts.setup, contacts.name, q_rad, contacts.distance_m.tolist()))

"""`armwright demo two-arms`: a mock pair calibrates itself where its tips touch, without a camera.

The run has no access to the hidden errors: contacts reach it as the joint angles of both arms in a file. Only the circle is
measured by the truth, as an outside camera would.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from itertools import combinations
from pathlib import Path

import numpy as np

from calib.arrays import Array, frozen, norms
from calib.closed_chain.calibrate import PairFound, PairPlan, calibrate_pair, contact_errors_m
from calib.closed_chain.conduct import conduct, contact_plan
from calib.closed_chain.contacts import Contacts, read_contacts
from calib.closed_chain.outcome import calibrated_cell, pair_text, write_pair
from calib.closed_chain.planning import (
    Candidates,
    ContactPlan,
    base_of,
    pair_of,
    plan_contacts,
    write_contacts,
)
from calib.closed_chain.room import Poses, SharedRoom
from calib.design.planning import short_path
from calib.errors import CalibrationError
from calib.inputs import input_file
from calib.session.conversation import Recorded, unattended
from calib.session.folder import POINTS, SessionFolder
from calib.validation.verify import Track, TrackPair
from control.files import write_whole
from control.kinematics.inverse import InverseKinematics
from control.model.cell import Cell, load_cell, save_cell
from control.model.description import load_arm
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import Waypoints
from control.progress import Advance
from hil_mocks.scenario import load_scenario
from procedures.mock import CellBench, as_bolted_down
from procedures.session.pair_station import MockPairHand, pair_station

BAR_m = 0.1  # known distance: a bar between the tips
FITTED, CHECKED = 40, 12  # contacts for the calibration, and others to judge it
CHECK_SEED = 0


@dataclass(frozen=True, slots=True)
class PairOutcome:
    """What was found. Errors [m] of contacts that were not used: as the files say, bases placed alone, calibrated."""

    cell: Cell
    plan: ContactPlan
    found: PairFound
    by_files_m: Array
    placed_m: Array
    calibrated_m: Array
    fitted: Contacts
    checked: Contacts
    circle: TrackPair
    files: dict[str, Path]


def run(cell: Cell, scenario_file: Path, out: Path, advance: Advance) -> PairOutcome:
    """Run everything on a mock of the cell; results are in the folder `out`."""
    names = pair_of(cell)
    scenario = load_scenario(scenario_file)
    advance("planning contacts", 0.0)
    plan = plan_contacts(cell, names, (0.0, BAR_m), FITTED)
    write_contacts(out / "planned.csv", plan.chosen.contacts)
    bench = CellBench(as_bolted_down(cell, scenario.seed), scenario, out / "log")
    try:
        advance("homing", 0.02)
        before = _circle(bench, cell, names, lambda: _take(cell, names, bench, plan, out, advance))
        advance("identification", 0.8)
        fitted, checked = (_read(out / name / POINTS, plan) for name in ("contacts", "check"))
        found = calibrate_pair(plan.arms, fitted, PairPlan())
        calibrated = _written(cell, names, plan, found, out)
        advance("circle, after", 0.9)
        after = _circle(bench, calibrated, names)
    finally:
        bench.close()
    circle = TrackPair(before.name, "", before, after)
    return _judged(cell, plan, found, fitted, checked, circle, out)


def _circle(
    bench: CellBench, cell: Cell, names: tuple[str, str], then: Callable[[], None] = lambda: None
) -> Track:
    """A runtime that knows `cell`: home, the circle of one tip beside the other, something else, to the rest poses, off."""
    bench.home(cell)
    track = circle_beside(cell, names, bench)
    then()
    rest(cell, names, bench)
    bench.stop()
    return track


def _judged(
    cell: Cell,
    plan: ContactPlan,
    found: PairFound,
    fitted: Contacts,
    checked: Contacts,
    circle: TrackPair,
    out: Path,
) -> PairOutcome:
    """The result on contacts that were not used: by the files, with the second base placed alone, and calibrated."""
    base = base_of(cell, (cell.names[0], cell.names[1]))
    placed = calibrate_pair(plan.arms, fitted, PairPlan(fixed=_geometry(found)))
    files = {
        "contacts": out / "contacts" / POINTS,
        "calibrated cell": out / "calibrated" / f"{cell.name}.cell.toml",
        "recordings": out / "log",
    }
    return PairOutcome(
        cell,
        plan,
        found,
        contact_errors_m(plan.arms, base, checked),
        contact_errors_m(placed.arms, placed.base, checked),
        contact_errors_m(found.arms, found.base, checked),
        fitted,
        checked,
        circle,
        files,
    )


def _take(
    cell: Cell, names: tuple[str, str], bench: CellBench, plan: ContactPlan, out: Path, advance: Advance
) -> None:
    """Record the planned contacts in one session, and some others, which the calibration does not get, in another."""
    rest = len(plan.others.contacts)
    rows = np.random.default_rng(CHECK_SEED).permutation(rest)[:CHECKED].tolist()
    hand, done = MockPairHand(cell, names, bench), 0
    for name, wanted in (("contacts", plan.chosen), ("check", plan.others.chosen(rows))):
        station = pair_station(cell, names, bench.clients, 1.0, 0.0, hand)
        ordered = wanted.contacts.chosen(in_order(wanted, station.room))
        with SessionFolder(out / name, contact_plan(names, "demo", ordered, "hand")) as folder:
            for saying in unattended(conduct(folder, station)):
                if isinstance(saying, Recorded):
                    done += 1
                    advance(f"contact {saying.record.point}", 0.1 + 0.7 * done / (FITTED + CHECKED))


def _read(file: Path, plan: ContactPlan) -> Contacts:
    return read_contacts(file, plan.arms)[0]


def _geometry(found: PairFound) -> list[str]:
    """The names of all parameters but the second base's."""
    return [one.parameter.name for one in found.estimates if one.parameter.has_bound]


def _written(cell: Cell, names: tuple[str, str], plan: ContactPlan, found: PairFound, out: Path) -> Cell:
    """Both arms, pair.json and the calibrated cell as files; the cell as loaded from them."""
    inputs = {"points.csv": input_file(out / "contacts" / POINTS, "contacts").sha256}
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    folder = out / "pair"
    folder.mkdir()
    write_pair(folder, plan.arms, found, "huber", inputs, date, f"armwright {version('armwright')}")
    write_whole(folder / "pair.txt", pair_text(plan.arms, found) + "\n")
    first, second = (load_arm(str(folder / f"{name}.toml")) for name in names)
    (out / "calibrated").mkdir()
    return load_cell(save_cell(calibrated_cell(cell, (first, second), found.base), out / "calibrated"))


# What the two arms of the demo do: touch each other at planned contacts, and draw a circle relative to the other's tip.
DETOUR_rad = 4.0  # what a way by the rest poses costs
RADIUS_m = 0.05
CENTRE_m = (
    0.0,
    -0.11,
    0.0,
)  # of the circle from the other tip, in the frame of the cell; it stands upright before that tip
WAYPOINTS = 16
SAMPLE_s = 0.01
TURNS = 20  # steps to the best turn
HELD_m = (0.4, 0.06, 0.4)  # where the first tip holds meanwhile, in the frame of the cell


def go(bench: CellBench, room: SharedRoom, names: tuple[str, str], goal_rad: Poses) -> bool:
    """Move both together on a way that is clear; False, and nothing moves, if there is none."""
    way = room.way(poses_now(bench, names), goal_rad)
    for poses in way or ():
        bench.together(dict(zip(names, poses, strict=True)))
    return way is not None


def rest(cell: Cell, names: tuple[str, str], bench: CellBench) -> None:
    """Move both to their rest poses, from which they hardly sink when the drives go off."""
    room = SharedRoom(cell, (cell.placed(names[0]), cell.placed(names[1])))
    go(bench, room, names, room.rest_rad)


def poses_now(bench: CellBench, names: tuple[str, str]) -> Poses:
    """Where the arms are."""
    return [bench.clients[name].status()["joint_rad"] for name in names]


def in_order(planned: Candidates, room: SharedRoom) -> list[int]:
    """The order of the contacts from the rest poses with little joint travel, and few detours."""
    here_rad = room.rest_rad
    both = np.hstack((planned.first_away_rad, planned.second_away_rad))
    places = [here_rad, *zip(planned.first_away_rad.tolist(), planned.second_away_rad.tolist(), strict=True)]
    q = np.vstack((np.concatenate(here_rad), both))
    ways = np.abs(q[:, None] - q[None, :]).max(axis=2)
    for i, j in combinations(range(len(q)), 2):
        if not room.is_way_clear(places[i], places[j]):
            ways[i, j] = ways[j, i] = ways[i, j] + DETOUR_rad
    return [k - 1 for k in short_path(ways)[1:]]


def circle_beside(cell: Cell, names: tuple[str, str], bench: CellBench) -> Track:
    """The second arm's tip on a circle relative to the first one's tip, planned by the arms' models, measured by the truth.

    Positions are of the second tip from the first, along the axes of the cell. Planned: the nearest place of the circle, so
    what is compared is its shape and place, not the time. No contact tells where the first arm's joint 1 is zero: measured
    positions are turned about the vertical as they fit best.
    """
    held, moved = names
    holding, moving = cell.placed(held), cell.placed(moved)
    here, there = poses_now(bench, names)
    inverse = InverseKinematics(holding.arm)
    q_held = inverse.nearest(holding.in_base(HELD_m), here)
    points = cell.beside_tip(moved, held, inverse.kinematics.tip(*q_held), _offsets())
    path = plan_path(moving.arm, Waypoints(points, None), q_near_rad=there)
    room = SharedRoom(cell, (holding, moving))
    if not go(bench, room, names, (q_held, path.q_start_rad)):
        raise CalibrationError("demo two-arms: no clear way to where the circle begins")
    seen = _turned(_run(bench, names, path))
    time_s = np.arange(len(seen)) * SAMPLE_s
    return Track("circle beside the other tip", frozen(time_s), frozen(_on_circle(seen)), frozen(seen))


def _run(bench: CellBench, names: tuple[str, str], path: PlannedPath) -> Array:
    """The true way (k, 3) of the second tip from the first."""
    held, moved = names
    bench.clients[moved].run_path(path.to_message(), waits=False)
    seen = []
    for _ in range(math.ceil(path.duration_s / SAMPLE_s)):
        seen.append(np.subtract(bench.tip_m(moved), bench.tip_m(held)))
        bench.wait(SAMPLE_s)
    bench.clients[moved].arrive(5.0)
    return np.array(seen)


def _offsets() -> list[list[float]]:
    turn = 2.0 * np.pi * np.arange(WAYPOINTS + 1) / WAYPOINTS
    ring = np.column_stack((np.cos(turn), np.zeros_like(turn), np.sin(turn)))
    return list((np.array(CENTRE_m) + RADIUS_m * ring).tolist())


def _turned(points_m: Array) -> Array:
    """Turned about z (through the first tip) so that they are nearest to the circle."""
    turn_rad = 0.0
    for _ in range(TURNS):
        cos, sin = math.cos(turn_rad), math.sin(turn_rad)
        here = points_m @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        goal = _on_circle(here)
        across = here[:, 0] * goal[:, 1] - here[:, 1] * goal[:, 0]
        turn_rad += math.atan2(float(across.sum()), float((here[:, :2] * goal[:, :2]).sum()))
    return np.asarray(here)


def _on_circle(points_m: Array) -> Array:
    """The nearest places of the circle."""
    flat = (points_m - CENTRE_m) * np.array([1.0, 0.0, 1.0])
    return np.asarray(CENTRE_m + RADIUS_m * flat / norms(flat)[:, None])

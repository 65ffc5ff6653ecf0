"""What the two arms of the demo do: touch each other at planned contacts, and draw a circle relative to the other's tip."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np

from calib.arrays import Array, frozen, norms
from calib.closed_chain.candidates import Candidates
from calib.closed_chain.room import Poses, SharedRoom
from calib.design.planning import short_path
from calib.errors import CalibrationError
from calib.validation.verify import Track
from control.kinematics.inverse import InverseKinematics
from control.model.cell import Cell
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import Waypoints
from procedures.mock import CellBench

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

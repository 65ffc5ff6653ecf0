"""`armwright together`: motions of several arms that begin and end together."""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from console.commands.connection import connected_arms, with_present_tool
from console.commands.moving import described
from console.commands.progress import shown
from console.options import finite
from control.errors import ArmError
from control.model.cell import Cell, load_cell
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.plan import PlannedPath, plan_beside, plan_path
from control.motion.setpoint import Motion
from control.motion.waypoints import Waypoints, read_waypoints
from control.server.client import ArmClient
from procedures.ports import move_together

KEEP = "keep"  # instead of a file of offsets
TO_START_SPEED = 0.5  # of the joints' limits, to the first way-points


def run(given: argparse.Namespace) -> int:
    """Plan for each arm, move to the first way-points, then begin all at once; returns when all have arrived."""
    targets, files = _targets(given), dict(given.run or ())
    besides = {name: (other, file) for name, other, file in given.beside or ()}
    names = tuple(name for name, *_ in (*(given.to or ()), *(given.run or ()), *(given.beside or ())))
    if len(names) < 2 or len(set(names)) < len(names):
        got = ", ".join(names) or "none"
        raise ArmError(
            f"together: expected one --to, --run or --beside for each of two arms or more, got {got}"
        )
    with connected_arms(given, names) as clients:
        cell = _with_tools(load_cell(given.cell), clients)
        paths = {name: _planned(cell, name, file, clients[name]) for name, file in files.items()}
        motions = {name: _joint_move(cell, name, q, given.speed, clients) for name, q in targets.items()}
        motions |= {name: path.joints for name, path in paths.items()}
        for name, (other, file) in besides.items():
            paths[name] = _beside(cell, name, other, file, motions, clients)
            motions[name] = paths[name].joints
        if paths:
            with shown(clients[names[0]], given, "together: to the first way-points"):
                _start(
                    clients, {name: _move(path.q_start_rad, TO_START_SPEED) for name, path in paths.items()}
                )
        moves = {name: _move(q_rad, given.speed) for name, q_rad in targets.items()}
        moves |= {
            name: {"path": path.to_message(), "tool": clients[name].status()["tool"]}
            for name, path in paths.items()
        }
        with shown(clients[names[0]], given):
            _start(clients, moves)
    return 0


def _with_tools(cell: Cell, clients: Mapping[str, ArmClient]) -> Cell:
    """The arms of the clients with the tools on that their runtimes have on."""
    return cell.with_arms(
        [with_present_tool(p.arm, clients[p.name]) if p.name in clients else p.arm for p in cell.arms]
    )


def _joint_move(
    cell: Cell, name: str, q_rad: tuple[float, ...], speed: float, clients: Mapping[str, ArmClient]
) -> Motion:
    """As the runtime will plan it from where the arm holds."""
    start = tuple(clients[name].status()["joint_set_rad"])
    return JointMove(start, q_rad, JointLimits.of(cell.placed(name).arm).scaled(speed))


def _beside(
    cell: Cell,
    name: str,
    other: str,
    file: str,
    motions: Mapping[str, Motion],
    clients: Mapping[str, ArmClient],
) -> PlannedPath:
    """A path relative to the tip of another arm, which moves meanwhile; prints how long both take."""
    if other == name or other not in motions:
        raise ArmError(
            f"together: --beside {name} {other}: expected another arm with --to, --run, or a --beside before it, got {other!r}"
        )
    offsets = read_waypoints(Path(file)) if file != KEEP else _present(cell, name, other, clients)
    found = plan_beside(cell, name, other, motions[other], offsets, clients[name].status()["joint_rad"])
    why = f", {found.slower:.2f} times as long as {other} alone{f': {found.limit}' if found.limit else ''}"
    sys.stdout.write(f"{name}: beside {other}, {found.path.duration_s:.2f} s{why}\n")
    sys.stdout.flush()
    return found.path


def _present(cell: Cell, name: str, other: str, clients: Mapping[str, ArmClient]) -> Waypoints:
    """The offset at which the tips are now."""
    tips = []
    for arm in (name, other):
        tip_m = clients[arm].status()["tip_set_m"]
        if tip_m is None:
            raise ArmError(f"together: --beside {name} {other} {KEEP}: arm {arm!r} is not homed")
        tips.append(cell.placed(arm).in_cell(tip_m))
    (x, y, z), (u, v, w) = tips
    return Waypoints(((x - u, y - v, z - w),), None)


def _start(clients: Mapping[str, ArmClient], moves: Mapping[str, Any]) -> None:
    """Begin and wait; a single arm on its way to its first way-point moves alone."""
    first = next(iter(moves))
    if len(moves) == 1:
        clients[first].move_joints(**moves[first])
        return
    move_together(clients, moves)


def _move(q_rad: tuple[float, ...], speed: float) -> dict[str, Any]:
    return {"q_rad": q_rad, "speed": speed}


def _planned(cell: Cell, name: str, file: str, client: ArmClient) -> PlannedPath:
    path = plan_path(
        cell.placed(name).arm, read_waypoints(Path(file)), q_near_rad=client.status()["joint_rad"]
    )
    sys.stdout.write(f"{name}: {described(path)}")
    sys.stdout.flush()
    return path


def _targets(given: argparse.Namespace) -> dict[str, tuple[float, ...]]:
    """The joint angles of each `--to`."""
    targets: dict[str, tuple[float, ...]] = {}
    for name, *angles in given.to or ():
        try:
            targets[name] = tuple(finite(angle) for angle in angles)
        except argparse.ArgumentTypeError as error:
            raise ArmError(f"together: --to {name}: joint angles in rad: {error}") from None
    return targets

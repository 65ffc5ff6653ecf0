"""`armwright together`: motions of several arms that begin and end together."""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from console.commands.cell.clients import connected_arms
from console.commands.connection import with_present_tool
from console.commands.moving import described
from console.options import finite
from console.waiting import shown
from control.errors import ArmError
from control.model.cell import load_cell
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import read_waypoints
from control.server.client import ArmClient

TO_START_SPEED = 0.5  # of the joints' limits, to the first way-points
MARGIN_S = 5.0


def run(given: argparse.Namespace) -> int:
    """Plan for each arm, move to the first way-points, then begin all at once; returns when all have arrived."""
    targets, files = _targets(given), dict(given.run or ())
    names = tuple(name for name, *_ in (*(given.to or ()), *(given.run or ())))
    if len(names) < 2 or len(set(names)) < len(names):
        got = ", ".join(names) or "none"
        raise ArmError(f"together: expected one --to or --run for each of two arms or more, got {got}")
    with connected_arms(given, names) as clients:
        paths = {name: _planned(given, name, file, clients[name]) for name, file in files.items()}
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


def _start(clients: Mapping[str, ArmClient], moves: Mapping[str, Any]) -> None:
    """Begin and wait; a single arm on its way to its first way-point moves alone."""
    first = next(iter(moves))
    if len(moves) == 1:
        clients[first].move_joints(**moves[first])
        return
    answer = clients[first].ask("move_together", moves=moves)
    for name in moves:
        clients[name].arrive(answer["duration_s"] + MARGIN_S)


def _move(q_rad: tuple[float, ...], speed: float) -> dict[str, Any]:
    return {"q_rad": q_rad, "speed": speed}


def _planned(given: argparse.Namespace, name: str, file: str, client: ArmClient) -> PlannedPath:
    arm = with_present_tool(load_cell(given.cell).placed(name).arm, client)
    path = plan_path(arm, read_waypoints(Path(file)), q_near_rad=client.status()["joint_rad"])
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

"""Commands that move the arm to angles, a named place, along way-points or by a step, and that save its pose."""

import argparse
import math
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from console.commands.connection import connected, with_present_tool
from console.places import find_place, save_place
from console.waiting import shown
from control.errors import ArmError
from control.files import read_text, write_whole
from control.model.description import load_arm
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import POSITION_COLUMNS, read_waypoints

HEADER = ",".join(POSITION_COLUMNS)
SAME_m = 1e-4  # closer way-points are duplicates


def run(given: argparse.Namespace) -> int:
    """Run the command of the given name; returns when the motion is complete."""
    return MOTIONS[given.command](given)


# ---- moves


def _move(given: argparse.Namespace) -> int:
    if (given.joints is None) == (given.tip is None):
        raise ArmError("move: give either --joints or --tip")
    return _joint_move(given, given.joints, given.tip)


def _go(given: argparse.Namespace) -> int:
    place = find_place(Path(given.places), given.name)
    return _joint_move(given, place.q_rad, place.tip_m)


def _joint_move(given: argparse.Namespace, q_rad: Any, tip_m: Any) -> int:
    """Move to joint angles, or to the nearest ones with the tip at a position."""
    client = connected(given)
    if q_rad is None:
        from control.kinematics.inverse import InverseKinematics

        arm = with_present_tool(load_arm(given.arm), client)
        q_rad = InverseKinematics(arm).nearest(tuple(tip_m), client.status()["joint_rad"])
    with shown(client, given):
        client.move_joints(tuple(q_rad), given.speed, waits=_waits(given))
    return 0


def _run(given: argparse.Namespace) -> int:
    """Run way-points through a Cartesian spline; everything is checked before anything moves."""
    arm = load_arm(given.arm)
    waypoints = read_waypoints(given.file)
    if given.plan_only:
        sys.stdout.write(described(plan_path(arm, waypoints, given.speed)))
        return 0
    client = connected(given)
    arm = with_present_tool(arm, client)
    path = plan_path(arm, waypoints, given.speed, q_near_rad=client.status()["joint_rad"])
    sys.stdout.write(described(path))
    sys.stdout.flush()
    with shown(client, given, "run: to the first way-point"):
        client.move_joints(path.q_start_rad, 0.5)
    with shown(client, given):
        client.run_path(path.to_message(), waits=_waits(given), tool=arm.tool.name)
    return 0


def _waits(given: argparse.Namespace) -> bool:
    """Whether to wait for the end; not for a script's line that ends with &."""
    return bool(getattr(given, "waits", True))


def described(path: PlannedPath) -> str:
    """The plan as text."""
    angles = ", ".join(f"{q:.4f}" for q in path.q_start_rad)
    lines = [
        f"{len(path.q_waypoints_rad)} way-points in {path.duration_s:.2f} s, {path.branch}; begins at {angles} rad",
        *map(str, path.slowdowns),
    ]
    return "\n".join(lines) + "\n"


def _jog(given: argparse.Namespace) -> int:
    """One step; exit status 1 if it could not be completed."""
    if (given.joint is None) == (given.axis is None):
        raise ArmError("jog: give either --joint or --axis")
    step: dict[str, Any] = {"axis": given.axis, "by_m": given.by}
    speed = "speed_m_s"
    if given.joint is not None:
        step, speed = {"joint": given.joint, "by_rad": given.by}, "speed_rad_s"
    if given.speed is not None:
        step[speed] = given.speed
    limited = connected(given).jog(**step)
    if limited:
        sys.stderr.write(f"armwright: {limited}\n")
    return 1 if limited and not limited.startswith("slower") else 0


# ---- saving the present pose


def _mark(given: argparse.Namespace) -> int:
    """Save the present pose as a named place."""
    status = connected(given).status()
    if not status["is_homed"]:
        raise ArmError("mark: the arm is not homed, so its joint angles are unknown: run `armwright home`")
    was_there = save_place(Path(given.places), given.name, status["joint_rad"])
    sys.stdout.write(f"{given.name} in {given.places}{', replacing another pose' if was_there else ''}\n")
    return 0


def _teach(given: argparse.Namespace) -> int:
    """Append the tip position to a way-point file, created if missing."""
    status = connected(given).status()
    if status["tip_m"] is None:
        raise ArmError("teach: the tip position is unknown: run `armwright home`")
    file = Path(given.file)
    lines = _way_points(file)
    point = tuple(round(float(x), 6) for x in status["tip_m"])
    if len(lines) > 1 and _distance_m(lines[-1], point) < SAME_m:
        raise ArmError(f"teach: the tip has not moved since the last way-point of {file}")
    row = ",".join(f"{x:.6f}" for x in point)
    write_whole(file, "\n".join([*lines, row]) + "\n")
    sys.stdout.write(f"way-point {len(lines)} in {file}: {row}\n")
    return 0


def _way_points(file: Path) -> list[str]:
    if not file.exists():
        return [HEADER]
    try:
        lines = [line for line in read_text(file).splitlines() if line.strip()]
    except UnicodeDecodeError as error:
        raise ArmError(f"teach: {file}: not UTF-8 text (byte {error.start}): give another file") from None
    if lines and lines[0].strip() != HEADER:
        raise ArmError(
            f"teach: {file}: expected the header {HEADER}, got {lines[0][:80]!r}: give another file"
        )
    return lines or [HEADER]


def _distance_m(line: str, point: tuple[float, ...]) -> float:
    try:
        return math.dist([float(x) for x in line.split(",")], point)
    except ValueError:
        return math.inf


MOTIONS: Mapping[str, Callable[[argparse.Namespace], int]] = {
    "go": _go,
    "jog": _jog,
    "mark": _mark,
    "move": _move,
    "run": _run,
    "teach": _teach,
}

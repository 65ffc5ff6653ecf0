"""Commands that move the arm to angles, a named place, along way-points or by a step, and that save its pose."""

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from console.commands.connection import connected, with_present_tool
from console.commands.progress import say, shown
from console.places import find_place, save_place
from control.errors import ArmError
from control.files import changing, read_text, write_whole
from control.model.arm import Arm
from control.model.cell import load_cell
from control.model.description import load_arm
from control.model.rules import ANGLE, STEP
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.plan import PlannedPath, plan_path
from control.motion.setpoint import at_rest
from control.motion.waypoints import ORIENTATION_COLUMNS, POSITION_COLUMNS, Waypoints, read_waypoints
from control.server.channel import RuntimeGone, SocketChannel, default_path
from control.server.client import ArmClient
from firmware_iface.mocap.bodies import RigidPose, compose

HEADER = ",".join(POSITION_COLUMNS)
FULL_HEADER = ",".join((*POSITION_COLUMNS, *ORIENTATION_COLUMNS))
TO_START_SPEED = 0.5  # of the joints' limits, to where a path begins
SAME_m = 1e-4  # closer way-points are duplicates
SAME_TURN = 1e-3  # of a quaternion's numbers: 2 mrad


def run(args: argparse.Namespace) -> int:
    """Run the command of the given name; returns when the motion is complete."""
    return MOTIONS[args.command](args)


def _move(args: argparse.Namespace) -> int:
    if (args.joints is None) == (args.tip is None):
        raise ArmError("move: give either --joints or --tip")
    if args.tip is None and (args.orientation is not None or args.frame != "base"):
        raise ArmError("move: --orientation and --frame need --tip")
    if args.joints is not None and len(args.joints) != (count := load_arm(args.arm).joint_count):
        raise ArmError(f"--joints: expected {count} joint angles in rad, got {len(args.joints)}")
    tip_m, orientation = args.tip, args.orientation
    if args.frame == "tracker":
        turned = (1.0, 0.0, 0.0, 0.0) if orientation is None else tuple(orientation)
        in_base = compose(tracker_place(load_arm(args.arm)), RigidPose(tuple(tip_m), turned))
        tip_m, orientation = in_base.position_m, None if orientation is None else in_base.quaternion
    return _joint_move(args, args.joints, tip_m, orientation)


def tracker_place(arm: Arm) -> RigidPose:
    """Where the frame of camera or tracker is in the arm's base frame, as `calibrate` found it. ArmError if it was not asked."""
    stream = arm.camera.stream if arm.camera is not None else None
    if stream is not None and stream.origin_m is not None:
        return RigidPose(stream.origin_m, stream.orientation)
    base_frame = next((effect.parameters for effect in arm.effects if effect.effect == "base_frame"), None)
    if base_frame is None:
        raise ArmError(
            f"move --frame tracker: {arm.path} does not say where the tracker's frame is: expected origin_m in [camera.stream] or"
            " an [[effect]] base_frame, as `armwright calibrate` writes them; in the arm's own frame leave --frame out"
        )
    x, y, z, *turn_rad = (base_frame.get(key, 0.0) for key in ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"))
    angle_rad = math.hypot(*turn_rad)
    share = 0.5 if angle_rad < 1e-9 else math.sin(0.5 * angle_rad) / angle_rad
    a, b, c = (share * turn for turn in turn_rad)
    return RigidPose((x, y, z), (math.cos(0.5 * angle_rad), a, b, c))


def _go(args: argparse.Namespace) -> int:
    rest = load_arm(args.arm).rest
    place = find_place(Path(args.places), args.name, rest.q_rad if rest else None)
    return _joint_move(args, place.q_rad, place.tip_m)


def _joint_move(args: argparse.Namespace, q_rad: Any, tip_m: Any, orientation: Any = None) -> int:
    """Move to joint angles, or to the nearest ones with the tip at a position, and turned as asked."""
    client = connected(args)
    if q_rad is None:
        arm = with_present_tool(load_arm(args.arm), client)
        q_rad = _nearest(arm, tip_m, orientation, client.status()["joint_rad"])
    with shown(client, args):
        client.move_joints(tuple(q_rad), args.speed, waits=_waits(args))
    return 0


def _nearest(arm: Arm, tip_m: Any, orientation: Any, q_near_rad: Any) -> tuple[float, ...]:
    if orientation is None:
        from control.kinematics.inverse import InverseKinematics

        return InverseKinematics(arm).nearest(tuple(tip_m), q_near_rad)
    from control.kinematics.pose_inverse import PoseInverse, TipPose

    return PoseInverse(arm).nearest(TipPose.of(tip_m, orientation), q_near_rad)


def _run(args: argparse.Namespace) -> int:
    """Run way-points through a Cartesian spline; everything is checked before anything moves."""
    arm = load_arm(args.arm)
    waypoints = read_waypoints(args.file)
    if args.relative_to is not None:
        waypoints = beside(args, arm, waypoints)
    client, near_rad, whence = _whence(args, arm)
    arm = arm if client is None else with_present_tool(arm, client)
    path = plan_path(arm, waypoints, args.speed, q_near_rad=near_rad)
    say(described(path))
    if near_rad is not None:
        _require_clear(arm, path, near_rad)
    if client is None or args.plan_only:
        say(f"planned from {whence}")
        return 0
    sys.stdout.flush()
    with shown(client, args, "run: to the first way-point"):
        client.move_joints(path.q_start_rad, TO_START_SPEED)
    with shown(client, args):
        client.run_path(path.to_message(), waits=_waits(args), tool=arm.tool.name)
    return 0


def _whence(args: argparse.Namespace, arm: Arm) -> tuple[ArmClient | None, Sequence[float] | None, str]:
    """The runtime, the pose that the motion begins at, and both in words; a plan alone needs neither."""
    try:
        client = connected(args)
        status = client.status()
        if status["is_homed"] or not args.plan_only:
            return client, status["joint_rad"], "where the arm is now"
        why = "the arm is not homed"
    except RuntimeGone:
        if not args.plan_only:
            raise
        client, why = None, "no runtime answers"
    rest = "[rest]" if arm.rest else "joint angles 0"
    return (client, None, f"{rest}, because {why}: `run` plans from where the arm is then, and may choose other joint angles")


def _require_clear(arm: Arm, path: PlannedPath, here_rad: Sequence[float]) -> None:
    """MotionError if the way to the path, or the path, meets something: as the runtime will look, before anything moves."""
    from control.motion.guard import Guard

    limits = JointLimits.of(arm)
    guard, start = Guard(arm, limits), at_rest(tuple(here_rad))
    move = JointMove(here_rad, path.q_start_rad, limits.scaled(TO_START_SPEED))
    guard.require_move(move, start, path.q_start_rad)
    guard.require_rising(move)
    guard.require_joint_path(path.joints)


def _waits(args: argparse.Namespace) -> bool:
    """Whether to wait for the end; not for a script's line that ends with &."""
    return bool(getattr(args, "waits", True))


def described(path: PlannedPath) -> str:
    """The plan as text."""
    angles = ", ".join(f"{q:z.4f}" for q in path.q_start_rad)
    branch = f", {path.branch}" if path.branch else ""
    lines = [
        f"{len(path.q_waypoints_rad)} way-points in {path.duration_s:.2f} s{branch}; begins at {angles} rad",
        *map(str, path.slowdowns),
    ]
    return "\n".join(lines)


def _jog(args: argparse.Namespace) -> int:
    """One step; exit status 1 if it could not be completed."""
    if (args.joint is None) == (args.axis is None):
        raise ArmError("jog: give either --joint or --axis")
    is_turn = args.axis is not None and args.axis.startswith("r")
    rule = STEP if args.axis is not None and not is_turn else ANGLE
    if not rule.holds(args.by):
        raise ArmError(f"jog: --by: expected {rule.expected}, got {args.by:g}{rule.doubt(args.by)}")
    step: dict[str, Any] = {"axis": args.axis, "by_rad" if is_turn else "by_m": args.by, "frame": args.frame}
    speed = "speed_rad_s" if is_turn else "speed_m_s"
    if args.joint is not None:
        step, speed = {"joint": args.joint, "by_rad": args.by}, "speed_rad_s"
    if args.speed is not None:
        step[speed] = args.speed
    client = connected(args)
    with shown(client, args):
        limited = client.jog(**step)
    if limited:
        sys.stderr.write(f"armwright: {limited}\n")
    return 1 if limited and not limited.startswith("slowed") else 0


def _mark(args: argparse.Namespace) -> int:
    """Save the present pose as a named place."""
    status = connected(args).status()
    if not status["is_homed"]:
        raise ArmError("mark: the arm is not homed, so its joint angles are unknown: run `armwright home`")
    _say_if_outside(args, status["joint_rad"])
    was_there = save_place(Path(args.places), args.name, status["joint_rad"])
    say(f"{args.name} in {args.places}{', replacing another pose' if was_there else ''}")
    return 0


def _say_if_outside(args: argparse.Namespace, q_rad: Sequence[float]) -> None:
    """Warn of a pose beyond the joints' limits: no motion goes there."""
    for number, (q, (lower, upper)) in enumerate(zip(q_rad, load_arm(args.arm).limits_rad, strict=True), 1):
        if not lower <= q <= upper:
            sys.stderr.write(
                f"armwright: {args.command}: joint {number} is at {q:.4f} rad, outside its limits ({lower:g} to {upper:g} rad):"
                " no motion goes back there\n"
            )


def _teach(args: argparse.Namespace) -> int:
    """Append the tip's position to a way-point file, created if missing, and its orientation if the file has such columns."""
    status = connected(args).status()
    if status["tip_m"] is None:
        raise ArmError("teach: the tip position is unknown: run `armwright home`")
    _say_if_outside(args, status["joint_rad"])
    file = Path(args.file)
    with changing(file):
        lines = _way_points(file, args.orientation)
        row = [*status["tip_m"], *(status["tip_orientation"] if lines[0].strip() == FULL_HEADER else ())]
        if len(lines) > 1 and _is_same(lines[-1], row):
            raise ArmError(f"teach: the tip has not moved since the last way-point of {file}")
        text = ",".join(f"{float(x):.6f}" for x in row)
        write_whole(file, "\n".join([*lines, text]) + "\n")
    say(f"way-point {len(lines)} in {file}: {text}")
    return 0


def _way_points(file: Path, has_orientation: bool) -> list[str]:
    wanted = FULL_HEADER if has_orientation else HEADER
    try:
        lines = [line for line in read_text(file).splitlines() if line.strip()]
    except UnicodeDecodeError as error:
        raise ArmError(f"teach: {file}: not UTF-8 text (byte {error.start}): give another file") from None
    headers = (FULL_HEADER,) if has_orientation else (HEADER, FULL_HEADER)
    if lines and lines[0].strip() not in headers:
        raise ArmError(f"teach: {file}: expected the header {' or '.join(headers)}, got {lines[0][:80]!r}: give another file")
    return lines or [wanted]


def _is_same(line: str, row: Sequence[float]) -> bool:
    try:
        last = [float(x) for x in line.split(",")]
    except ValueError:
        return False
    is_turned = any(abs(a - b) > SAME_TURN for a, b in zip(last[3:], row[3:], strict=False))
    return math.dist(last[:3], row[:3]) < SAME_m and not is_turned


MOTIONS: Mapping[str, Callable[[argparse.Namespace], int]] = {
    "go": _go,
    "jog": _jog,
    "mark": _mark,
    "move": _move,
    "run": _run,
    "teach": _teach,
}


# Way-points relative to the tip of another arm of the cell.
AT_REST = ("HOLDING", "OFF", "BRAKED", "HELD")


def beside(args: argparse.Namespace, arm: Arm, waypoints: Waypoints) -> Waypoints:
    """The way-points in the base frame of `arm`: as they are, offsets from the other arm's tip along the axes of the cell.

    ArmError unless the other arm is at rest, and homed.
    """
    cell = load_cell(args.cell)
    placed, leader = cell.placed(arm.name), cell.placed(args.relative_to)
    if placed.name == leader.name:
        raise ArmError(f"run: --relative-to: expected another arm than {placed.name!r}")
    if waypoints.orientations is not None:
        raise ArmError("run: --relative-to: expected way-points without orientation (qw,qx,qy,qz)")
    client = ArmClient(SocketChannel(default_path(leader.name)))
    try:
        client.require_arm(leader.arm, cell)
        status = client.status()
    finally:
        client.close()
    if status["tip_set_m"] is None or status["mode"] not in AT_REST:
        homed = "homed" if status["is_homed"] else "not homed"
        raise ArmError(
            f"run: --relative-to {leader.name}: expected the arm homed and at rest, since the path begins from where its tip is;"
            f" it is {status['mode']} and {homed}"
        )
    points = placed.beside_tip(leader, status["tip_set_m"], waypoints.points)
    return replace(waypoints, points=points)

"""`armwright together`: motions of several arms that begin and end together.
`armwright follow`: one arm follows another, which a hand guides or a program moves.
`armwright session --cell`: two arms of a cell are led to planned contacts, and the joint angles of both are recorded.
"""

import argparse
import hashlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calib.closed_chain.conduct import conduct, contact_plan
from calib.closed_chain.pair_problem import read_contacts
from calib.closed_chain.planning import pair_of
from calib.errors import SessionError
from calib.session.folder import PLAN, SessionFolder
from calib.session.plan import SessionPlan, fingerprint
from console.commands.connection import connected_arms, with_present_tool
from console.commands.moving import described
from console.commands.progress import has_line, say, shown
from console.options import finite
from control.errors import ArmError
from control.model.cell import Cell, load_cell
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.plan import PlannedPath, plan_beside, plan_path
from control.motion.setpoint import Motion
from control.motion.waypoints import Waypoints, read_waypoints
from control.server.client import ArmClient
from hil_mocks.scenario import load_scenario
from procedures import session_operator
from procedures.folders import require_writable
from procedures.guiding import Following, mirror_signs, require_alike
from procedures.mock_session import SCENARIO, MockPairHand, Names, mock_pair, pair_station
from procedures.ports import move_together

KEEP = "keep"  # instead of a file of offsets
TO_START_SPEED = 0.5  # of the joints' limits, to the first way-points


def run_together(args: argparse.Namespace) -> int:
    """Plan for each arm, move to the first way-points, then begin all at once; returns when all have arrived."""
    targets, files = _targets(args), dict(args.run or ())
    besides = {name: (leader, file) for name, leader, file in args.beside or ()}
    names = tuple(name for name, *_ in (*(args.to or ()), *(args.run or ()), *(args.beside or ())))
    if len(names) < 2 or len(set(names)) < len(names):
        got = ", ".join(names) or "none"
        raise ArmError(f"together: expected one --to, --run or --beside for each of two arms or more, got {got}")
    with connected_arms(args, names) as clients:
        cell = _with_tools(load_cell(args.cell), clients)
        paths = {name: _planned(cell, name, file, clients[name]) for name, file in files.items()}
        motions = {name: _joint_move(cell, name, q, args.speed, clients) for name, q in targets.items()}
        motions |= {name: path.joints for name, path in paths.items()}
        for name, (leader, file) in besides.items():
            paths[name] = _beside(cell, name, leader, file, motions, clients)
            motions[name] = paths[name].joints
        if paths:
            with shown(clients[names[0]], args, "together: to the first way-points"):
                _start(clients, {name: _move(path.q_start_rad, TO_START_SPEED) for name, path in paths.items()})
        moves = {name: _move(q_rad, args.speed) for name, q_rad in targets.items()}
        moves |= {name: {"path": path.to_message(), "tool": clients[name].status()["tool"]} for name, path in paths.items()}
        with shown(clients[names[0]], args):
            _start(clients, moves)
    return 0


def _with_tools(cell: Cell, clients: Mapping[str, ArmClient]) -> Cell:
    """The arms of the clients with the tools on that their runtimes have on."""
    return cell.with_arms([with_present_tool(p.arm, clients[p.name]) if p.name in clients else p.arm for p in cell.arms])


def _joint_move(cell: Cell, name: str, q_rad: tuple[float, ...], speed: float, clients: Mapping[str, ArmClient]) -> Motion:
    """As the runtime will plan it from where the arm holds."""
    start = tuple(clients[name].status()["joint_set_rad"])
    return JointMove(start, q_rad, JointLimits.of(cell.placed(name).arm).scaled(speed))


def _beside(
    cell: Cell, name: str, leader: str, file: str, motions: Mapping[str, Motion], clients: Mapping[str, ArmClient]
) -> PlannedPath:
    """A path relative to the tip of another arm, which moves meanwhile; prints how long both take."""
    if leader == name or leader not in motions:
        raise ArmError(
            f"together: --beside {name} {leader}: expected another arm with --to, --run, or a --beside before it, got {leader!r}"
        )
    offsets = read_waypoints(Path(file)) if file != KEEP else _present(cell, name, leader, clients)
    q_near_rad = clients[name].status()["joint_rad"]
    plan = plan_beside(cell.placed(name), cell.placed(leader), motions[leader], offsets, q_near_rad)
    why = f", {plan.slower:.2f} times as long as {leader} alone{f': {plan.limit}' if plan.limit else ''}"
    say(f"{name}: beside {leader}, {plan.path.duration_s:.2f} s{why}")
    sys.stdout.flush()
    return plan.path


def _present(cell: Cell, name: str, leader: str, clients: Mapping[str, ArmClient]) -> Waypoints:
    """The offset at which the tips are now."""
    tips = []
    for arm in (name, leader):
        tip_m = clients[arm].status()["tip_set_m"]
        if tip_m is None:
            raise ArmError(f"together: --beside {name} {leader} {KEEP}: arm {arm!r} is not homed")
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
    path = plan_path(cell.placed(name).arm, read_waypoints(Path(file)), q_near_rad=client.status()["joint_rad"])
    say(f"{name}: {described(path)}")
    sys.stdout.flush()
    return path


def _targets(args: argparse.Namespace) -> dict[str, tuple[float, ...]]:
    """The joint angles of each `--to`."""
    targets: dict[str, tuple[float, ...]] = {}
    for name, *angles in args.to or ():
        try:
            targets[name] = tuple(finite(angle) for angle in angles)
        except argparse.ArgumentTypeError as error:
            raise ArmError(f"together: --to {name}: joint angles in rad: {error}") from None
    return targets


def run_follow(args: argparse.Namespace) -> int:
    """Follow until Enter or Ctrl-C, or until the follower is stopped."""
    cell = load_cell(args.cell)
    leader, follower = cell.placed(args.leader), cell.placed(args.follower)
    if leader is follower:
        raise ArmError(f"follow: expected two arms, got {leader.name!r} twice")
    require_alike(leader, follower)
    signs = mirror_signs(leader, follower) if args.mirrored else (1.0,) * follower.arm.joint_count
    with connected_arms(args, (leader.name, follower.name)) as clients:
        following = Following(clients[leader.name], clients[follower.name], follower, signs)
        sys.stderr.write(
            f"arm {follower.name!r} follows arm {leader.name!r}: guide it by hand (`armwright guide --weightless --arm"
            f" {leader.name}`) or move it; {'Enter or ' if sys.stdin.isatty() else ''}Ctrl-C ends it\n"
        )
        following.run(_Steps(following).go_on)
    return 0


class _Steps:
    """Says what limits the follower, once each, and looks for Enter."""

    def __init__(self, following: Following) -> None:
        self._following = following
        self._said = ""

    def go_on(self) -> bool:
        """Whether nobody has pressed Enter."""
        limited = self._following.limited
        if limited and limited != self._said:
            sys.stderr.write(f"armwright: {limited}\n")
        self._said = limited
        return not has_line()


def session_of_contacts(args: argparse.Namespace) -> int:
    """Start or resume a session of contacts, and run it until the operator ends it or all are done."""
    cell = load_cell(args.cell)
    names = pair_of(cell, args.arms)
    identity, interface = _identity(cell, names), session_operator.Interface.of(args)
    wanted = _wanted(args, cell, names, identity)
    require_writable(Path(args.out))
    if args.mock:
        if args.scenario is not None:
            load_scenario(args.scenario)
        with _folder(args, wanted, identity) as folder:
            _introduce(folder, interface)
            with mock_pair(cell, folder, args.scenario) as bench:
                hand = MockPairHand(cell, names, bench) if folder.plan.seat == "hand" else None
                station = pair_station(cell, names, bench.clients, 1.0, session_operator.last_s(folder), hand)
                words = session_operator.ContactWords(folder.plan, names)
                interface.conduct(folder, words, conduct(folder, station), hand is not None)
    else:
        if (Path(args.out) / SCENARIO).exists():
            raise SessionError(f"{args.out}: this session belongs to mock arms: add --mock")
        with connected_arms(args, names) as clients:
            for client in clients.values():
                client.take_control()
            status = {name: session_operator.ready(clients[name], name) for name in names}[names[0]]
            with _folder(args, wanted, identity) as folder:
                _introduce(folder, interface)
                since_s = session_operator.since_start_s(folder, status)
                station = pair_station(cell, names, clients, session_operator.SPEED, since_s)
                words = session_operator.ContactWords(folder.plan, names)
                interface.conduct(folder, words, conduct(folder, station), may_auto=False)
    return 0


def _folder(args: argparse.Namespace, wanted: SessionPlan | None, identity: str) -> SessionFolder:
    folder = SessionFolder(Path(args.out), wanted)
    try:
        session_operator.require_same(folder, identity)
    except SessionError:
        folder.close()
        raise
    return folder


def _wanted(args: argparse.Namespace, cell: Cell, names: Names, identity: str) -> SessionPlan | None:
    """The plan of the options; None if none is given, which resumes the session."""
    if args.contacts is None:
        if (Path(args.out) / PLAN).exists() and args.seat is None:
            return None
        raise SessionError("--contacts: expected a file of planned contacts (`armwright plan-contacts --out FILE`)")
    arms = (cell.placed(names[0]).arm, cell.placed(names[1]).arm)
    planned, _ = read_contacts(Path(args.contacts), arms)
    plan = contact_plan(names, identity, planned, args.seat or "hand")
    plan.require_sound()
    return plan


def _identity(cell: Cell, names: Names) -> str:
    """Of both arms' parameters and their order."""
    return hashlib.sha256("".join(fingerprint(cell.placed(name).arm) for name in names).encode()).hexdigest()


def _introduce(folder: SessionFolder, interface: session_operator.Interface) -> None:
    plan = folder.plan
    interface.introduce(folder, f"contacts of {plan.arm}, tips brought together by {plan.seat}")

"""`armwright session`: step through the table's points, or two arms' contacts, and record; resumable at any time.

The command line's options make the session's plan.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from calib.errors import SessionError
from calib.points.points import FREE, STREAM_FRAME
from calib.session.conduct import Boards, Station, conduct
from calib.session.folder import SessionFolder
from calib.session.moves import chosen_free_poses, read_free_poses
from calib.session.plan import Board, PoseFrame, SessionPlan, Target, board_targets, fingerprint, free_targets
from console.commands import cell
from console.commands.connection import in_control_of
from control.model import table as tables
from control.model.arm import Arm, Camera, Table
from control.model.description import load_arm
from control.server.client import ArmClient
from control.tables import WHOLE_LARGEST, TableColumn, TableFormat, read_table
from hil_mocks.scenario import load_scenario
from procedures.folders import require_writable
from procedures.mock_session import SCENARIO, arm_station, mock_session
from procedures.ports import RuntimePort
from procedures.session_operator import SPEED, BoardWords, Interface, last_s, ready, require_same, since_start_s

OF_BOTH = ("seat",)  # options that both kinds of session have


def run(args: argparse.Namespace) -> int:
    """Start or resume a session, and run it until the operator ends it or all points are done."""
    if args.cell is not None:
        for name in (*(option for option in OPTIONS if option not in OF_BOTH), "socket"):
            if getattr(args, name) is not None:
                raise SessionError(f"--{name} is for one arm at a board: with --cell, the contacts are in --contacts")
        if args.has_arm:
            raise SessionError("--arm is for one arm at a board: the arms are those of --cell")
        return cell.session_of_contacts(args)
    for name in ("contacts", "arms"):
        if getattr(args, name) is not None:
            raise SessionError(f"--{name} is for two arms of a cell: add --cell")
    arm = load_arm(args.arm)
    interface = Interface.of(args)
    wanted = plan_from_options(args, arm)
    if wanted is not None:
        wanted.require_sound()  # errors are reported before a folder or a connection exists
        Boards(arm, wanted)
    require_writable(Path(args.out))
    if args.mock:
        _with_mock(args, arm, wanted, interface)
    else:
        _with_arm(args, arm, wanted, interface)
    return 0


def _with_mock(args: argparse.Namespace, arm: Arm, wanted: SessionPlan | None, interface: Interface) -> None:
    if args.scenario is not None:
        load_scenario(args.scenario)
    with SessionFolder(Path(args.out), wanted) as folder:
        require_same(folder, fingerprint(arm))
        boards = Boards(arm, folder.plan)
        _introduce(folder, interface)
        with mock_session(arm, folder, boards, args.scenario) as mock:
            hand = mock.hand if folder.plan.seat == "hand" else None
            port = _port(folder, mock.client, mock.speed)
            station = arm_station(arm, folder, boards, port, hand, last_s(folder))
            _conduct(arm, folder, boards, interface, station)


def _with_arm(args: argparse.Namespace, arm: Arm, wanted: SessionPlan | None, interface: Interface) -> None:
    if (Path(args.out) / SCENARIO).exists():
        raise SessionError(f"{args.out}: this session belongs to a mock arm: add --mock")
    client = in_control_of(args, arm)
    try:
        status = ready(client)
        with SessionFolder(Path(args.out), wanted) as folder:
            require_same(folder, fingerprint(arm))
            boards = Boards(arm, folder.plan)
            _introduce(folder, interface)
            port = _port(folder, client, SPEED)
            station = arm_station(arm, folder, boards, port, None, since_start_s(folder, status))
            _conduct(arm, folder, boards, interface, station)
    finally:
        client.close()


def _conduct(arm: Arm, folder: SessionFolder, boards: Boards, interface: Interface, station: Station) -> None:
    words = BoardWords(folder.plan, boards.cavities_m, arm.table)
    interface.conduct(folder, words, conduct(folder, station), station.hand is not None)


def _port(folder: SessionFolder, client: ArmClient, speed: float) -> RuntimePort:
    """The arm, which is told what its tip carries."""
    client.ask("payload", mass_kg=folder.plan.payload_kg)
    return RuntimePort(client, speed, in_own_frame=folder.plan.pose_frame == STREAM_FRAME)


def _introduce(folder: SessionFolder, interface: Interface) -> None:
    plan = folder.plan
    how = "pictures taken by you" if plan.has_pictures else f"board {plan.board}, tip seated by {plan.seat}"
    interface.introduce(folder, f"{how}, payload {plan.payload_kg:g} kg")


OPTIONS = ("setups", "points", "repeats", "approaches", "free", "plan", "payload", "seat", "board", "camera", "pictures", "seen")
MOST_FREE = 500
PLAN = TableFormat(
    "pose",
    (
        TableColumn("setup", "`free`, or the setup of a cavity", is_required=True, is_name=True),
        TableColumn("point", "name of the cavity or pose", is_required=True, is_name=True),
        TableColumn("repeat", "whole number; empty: 1", is_whole=True, lower=0.0, upper=WHOLE_LARGEST),
        TableColumn("q{}_rad", "where a free pose goes; the posture for a cavity"),
    ),
    unwarned=".*",
    is_padded=True,
)


def plan_from_options(args: argparse.Namespace, arm: Arm) -> SessionPlan | None:
    """The plan of the options; None if none is given, which resumes the session."""
    if all(getattr(args, name) is None for name in OPTIONS) and (Path(args.out) / "session.json").exists():
        return None
    targets = _from_file(Path(args.plan), args, arm) if args.plan else _from_options(args, arm)
    payload_kg = args.payload if args.payload is not None else 0.0
    if not (math.isfinite(payload_kg) and 0.0 <= payload_kg <= 100.0):
        raise SessionError(f"--payload: expected 0 to 100 kg, got {payload_kg:g}")
    return SessionPlan(
        arm.name,
        fingerprint(arm),
        arm.joint_count,
        targets,
        args.board or _board_of(arm.table),
        args.seat or "hand",
        bool(args.camera),
        payload_kg,
        _pose_frame(arm.camera) if args.camera else "",
        bool(args.pictures),
    )


def _pose_frame(camera: Camera | None) -> PoseFrame:
    """The frame of full poses."""
    if camera is None or not camera.measures_orientation:
        return ""
    return "stream" if camera.has_own_frame else "base"


def _board_of(table: Table | None) -> Board:
    return "known" if table is None or (table.known_pose and table.origin_m is not None) else "unknown"


def _from_options(args: argparse.Namespace, arm: Arm) -> tuple[Target, ...]:
    free = _free(args, arm)
    sees_no_board = args.pictures or arm.table is None or (arm.camera is not None and arm.camera.has_own_frame)
    if sees_no_board and free and args.setups is None and args.points is None:
        return free
    table = tables.table_of(arm)
    setups = _names(args.setups) if args.setups is not None else _setups_of(table)
    cavities = tables.board_cavities(table)
    points = _points(args.points, list(cavities)) if args.points is not None else list(cavities)
    repeats, approaches = _positive(args.repeats, "--repeats"), _positive(args.approaches, "--approaches")
    return (*board_targets(setups, points, repeats, approaches), *free)


def _free(args: argparse.Namespace, arm: Arm) -> tuple[Target, ...]:
    """Free poses: a number of them, or a file."""
    if args.free is None:
        return ()
    if args.free.isdecimal():
        count = int(args.free)
        if not 1 <= count <= MOST_FREE:
            raise SessionError(f"--free: expected 1 to {MOST_FREE} poses or a file, got {count}")
        poses = chosen_free_poses(arm, count, _seen_rad(args, arm))
    else:
        poses = read_free_poses(Path(args.free), arm.joint_count)
        for name, q_rad in poses.items():
            _require_inside(f"{args.free}, pose {name}", arm, q_rad)
    return free_targets(poses, _positive(args.repeats, "--repeats"))


def _seen_rad(args: argparse.Namespace, arm: Arm) -> list[float] | None:
    """The pose of --seen."""
    if args.seen is None:
        return None
    if len(args.seen) != arm.joint_count:
        raise SessionError(f"--seen: expected {arm.joint_count} joint angles in rad (`armwright status`), got {len(args.seen)}")
    _require_inside("--seen", arm, args.seen)
    return list(args.seen)


def _from_file(path: Path, args: argparse.Namespace, arm: Arm) -> tuple[Target, ...]:
    """Rows of setup and point, in the file's order; q1_rad ... where a free pose goes, or the posture for a cavity."""
    for name in ("setups", "points", "free", "repeats", "approaches"):
        if getattr(args, name) is not None:
            raise SessionError(f"--plan sets the points and repeats: omit --{name}")
    table = read_table(path, PLAN, SessionError, arm.joint_count)
    repeats = np.nan_to_num(table.number("repeat"), nan=1.0).astype(int).tolist()
    targets = []
    for row, q in enumerate(table.joints("q{}_rad").tolist()):
        setup, point = table.words("setup")[row], table.words("point")[row]
        q_rad = None if math.isnan(q[0]) else tuple(q)
        if q_rad is not None:
            _require_inside(table.place(row), arm, q_rad)
        elif setup == FREE:
            raise SessionError(f"{table.place(row)}: a free pose needs q1_rad to q{arm.joint_count}_rad")
        targets.append(Target(setup, point, repeats[row], 1, q_rad))
    return tuple(targets)


def _require_inside(where: str, arm: Arm, q_rad: Sequence[float]) -> None:
    for joint, (q, (lower, upper)) in enumerate(zip(q_rad, arm.limits_rad, strict=True), start=1):
        if not lower <= q <= upper:
            raise SessionError(f"{where}: joint {joint} at {q:g} rad is outside its range, {lower:g} to {upper:g} rad")


def _setups_of(table: Table) -> list[str]:
    """The tilts that the table has."""
    tilts = {"normal": True, "roll": bool(table.roll_tilt_rad), "pitch": bool(table.pitch_tilt_rad)}
    return [setup for setup in tables.SETUPS if tilts[setup]]


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _points(text: str, known: Sequence[str]) -> list[str]:
    """`1,2,5-9`: names and ranges of numbered ones."""
    points = [point for name in _names(text) for point in _range(name, known)]
    unknown = [point for point in points if point not in known]
    if unknown:
        some = ", ".join(known[:8])
        raise SessionError(f"--points: the table has no cavity {unknown[0]}; it has {some}, ... ({len(known)})")
    return points


def _range(name: str, known: Iterable[str]) -> list[str]:
    first, dash, last = name.partition("-")
    if name in known or not (dash and first.isdecimal() and last.isdecimal()):
        return [name]
    if int(first) > int(last):
        raise SessionError(f"--points: expected an ascending range, got {name}")
    return [str(number) for number in range(int(first), int(last) + 1)]


def _positive(number: int | None, option: str) -> int:
    if number is not None and not 1 <= number <= 100:
        raise SessionError(f"{option}: expected 1 to 100, got {number}")
    return number or 1

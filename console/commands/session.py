"""`armwright session`: step through the table's points and keep what is measured; resumable at any time."""

import argparse
import sys
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from calib.errors import SessionError
from calib.session.boards_known import Boards
from calib.session.conduct import Hand, Station, conduct
from calib.session.folder import POINTS, SessionFolder
from calib.session.geometry import ArmGeometry
from calib.session.state import Mark
from calib.session.take import SessionSettings
from calib.session.watch import ResidualWatch
from console.commands.connection import connected
from console.ports import RuntimePort
from console.session.mock_session import MockSession, mock_session
from console.session.operator import Operator
from console.session.planning import wanted_plan
from control.errors import ArmError
from control.loop.client import ArmClient, ArmFaulted, fault_text
from control.model.arm import Arm
from control.model.description import load_arm

SPEED = 0.5  # of the joints' limits, for moves near people


def run(given: argparse.Namespace) -> int:
    """Begin or resume, and carry on until the operator or the points end."""
    arm = load_arm(given.arm)
    lines = _replayed(Path(given.replay)) if given.replay else _typed()
    with SessionFolder(Path(given.out), wanted_plan(given, arm)) as folder:
        boards = Boards(arm, folder.plan)
        _require_same_arm(folder, arm)
        _introduce(folder)
        if given.mock:
            with mock_session(arm, folder, boards, given.scenario) as mock:
                _carry_on(arm, folder, boards, lines, _mock_station(arm, folder, boards, mock))
        else:
            _require_real(folder)
            client = connected(given)
            try:
                station = _real_station(arm, folder, boards, client)
                _carry_on(arm, folder, boards, lines, station)
            finally:
                client.close()
    return 0


def _carry_on(
    arm: Arm, folder: SessionFolder, boards: Boards, lines: Iterator[str], station: Station
) -> None:
    operator = Operator(folder, boards, lines, _say, arm.table, may_auto=station.hand is not None)
    operator.run(conduct(folder, station))
    done, left = folder.state.count(Mark.DONE), folder.state.count(Mark.LEFT)
    _say(f"{done} points recorded, {left} left: {folder.path / POINTS}")


def _station(
    arm: Arm,
    folder: SessionFolder,
    boards: Boards,
    client: ArmClient,
    speed: float,
    offset_s: float,
    hand: Hand | None,
) -> Station:
    port = RuntimePort(client, speed)
    client.ask("payload", mass_kg=folder.plan.payload_kg)
    return Station(
        arm=port,
        geometry=ArmGeometry(arm),
        boards=boards,
        watch=ResidualWatch(arm),
        hand=hand,
        camera=port if folder.plan.has_camera else None,
        settings=SessionSettings(payload_kg=folder.plan.payload_kg),
        clock_offset_s=offset_s,
    )


def _mock_station(arm: Arm, folder: SessionFolder, boards: Boards, mock: MockSession) -> Station:
    """Times go on after the last record: a mock arm's clock begins anew."""
    points = folder.points()
    last_s = float(points.t_s.max()) if points is not None else 0.0
    hand = mock.hand if folder.plan.seat == "hand" else None
    return _station(arm, folder, boards, mock.client, mock.speed, last_s, hand)


def _real_station(arm: Arm, folder: SessionFolder, boards: Boards, client: ArmClient) -> Station:
    """Times count from when the session was begun, by the host's calendar."""
    status = client.status()
    if status["mode"] == "FAULT":
        raise ArmFaulted(fault_text(status))
    if status["mode"] in ("GUIDING", "BRAKED"):
        client.hold()
    elif status["mode"] != "HOLDING":
        raise ArmError(f"the arm is {status['mode']}: `armwright enable`, then `armwright home`")
    if not status["is_homed"]:
        raise ArmError("the arm does not know its joint angles yet: `armwright home`")
    elapsed_s = time.time() - datetime.fromisoformat(folder.started).timestamp()
    return _station(arm, folder, boards, client, SPEED, elapsed_s - float(status["t_s"]), None)


def _introduce(folder: SessionFolder) -> None:
    plan, state = folder.plan, folder.state
    what = "resumed" if folder.is_resumed else "begun"
    _say(
        f"session {folder.path} {what}: {len(plan.targets)} points, {state.count(Mark.DONE)} recorded;"
        f" board {plan.board}, tip seated by {plan.seat}, payload {plan.payload_kg:g} kg; `help` lists the commands"
    )
    for warning in folder.warnings:
        _say(f"! {warning}")


def _require_same_arm(folder: SessionFolder, arm: Arm) -> None:
    """Also where no other option was given."""
    from calib.session.plan import fingerprint

    if folder.plan.arm_sha256 != fingerprint(arm):
        raise SessionError(
            f"{folder.path} is a session of arm {folder.plan.arm!r} as its file was then; --arm says another"
        )


def _require_real(folder: SessionFolder) -> None:
    from console.session.mock_session import SCENARIO

    if (folder.path / SCENARIO).exists():
        raise SessionError(f"{folder.path} is the session of a mock arm: add --mock")


def _typed() -> Iterator[str]:
    """Lines of the terminal or of a pipe."""
    while line := sys.stdin.readline():
        yield line


def _replayed(script: Path) -> Iterator[str]:
    """Lines of a script, said as they are answered; `#` begins a remark."""
    try:
        text = script.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise SessionError(f"{script}: not UTF-8 text (byte {error.start})") from None
    return (_echoed(line) for line in text.splitlines() if not line.lstrip().startswith("#"))


def _echoed(line: str) -> str:
    if line.strip():
        _say(f"  < {line.strip()}")
    return line


def _say(text: str) -> None:
    sys.stdout.write(text if text.endswith("\n") else f"{text}\n")
    sys.stdout.flush()

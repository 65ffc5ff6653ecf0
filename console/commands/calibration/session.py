"""`armwright session`: step through the table's points and record; resumable at any time."""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from calib.errors import SessionError
from calib.points.points import STREAM_FRAME
from calib.session.boards_known import Boards
from calib.session.conduct import Hand, Station, conduct
from calib.session.folder import POINTS, SessionFolder
from calib.session.moves.clear_paths import ClearPaths
from calib.session.moves.geometry import ArmGeometry
from calib.session.plan import SessionPlan, fingerprint
from calib.session.residual_watch import ResidualWatch
from calib.session.state import Mark
from calib.session.take import SessionSettings
from console.commands.connection import in_control_of
from control.errors import ArmError
from control.model.arm import Arm
from control.model.description import load_arm
from control.server.channel import Message
from control.server.client import ArmClient, ArmFaulted, fault_text
from hil_mocks.scenario import load_scenario
from procedures.folders import require_writable
from procedures.ports import RuntimePort
from procedures.session.mock_session import SCENARIO, MockSession, mock_session
from procedures.session.operator import Operator
from procedures.session.planning import plan_from_options
from procedures.session.reporter import Reporter, tell

SPEED = 0.5  # of the joints' limits, for moves near people


def run(given: argparse.Namespace) -> int:
    """Start or resume a session, and run it until the operator ends it or all points are done."""
    arm = load_arm(given.arm)
    say, operator = (tell, Reporter) if given.json else (_say, Operator)
    lines = _replayed(Path(given.replay), say) if given.replay else _typed()
    wanted = plan_from_options(given, arm)
    if wanted is not None:
        wanted.require_sound()  # errors are reported before a folder or a connection exists
        Boards(arm, wanted)
    require_writable(Path(given.out))
    interface = Interface(lines, say, operator)
    if given.mock:
        _with_mock(given, arm, wanted, interface)
    else:
        _with_arm(given, arm, wanted, interface)
    return 0


@dataclass(frozen=True, slots=True)
class Interface:
    """The operator's side: the source of answers, the output and its form."""

    lines: Iterator[str]
    say: Callable[[str], None]
    operator: type[Operator]


def _with_mock(given: argparse.Namespace, arm: Arm, wanted: SessionPlan | None, interface: Interface) -> None:
    if given.scenario is not None:
        load_scenario(given.scenario)
    with SessionFolder(Path(given.out), wanted) as folder:
        _require_same_arm(folder, arm)
        boards = Boards(arm, folder.plan)
        _introduce(folder, interface)
        with mock_session(arm, folder, boards, given.scenario) as mock:
            _conduct(arm, folder, boards, interface, _mock_station(arm, folder, boards, mock))


def _with_arm(given: argparse.Namespace, arm: Arm, wanted: SessionPlan | None, interface: Interface) -> None:
    if (Path(given.out) / SCENARIO).exists():
        raise SessionError(f"{given.out}: this session belongs to a mock arm: add --mock")
    client = in_control_of(given, arm)
    try:
        status = _ready(client)
        with SessionFolder(Path(given.out), wanted) as folder:
            _require_same_arm(folder, arm)
            boards = Boards(arm, folder.plan)
            _introduce(folder, interface)
            _conduct(arm, folder, boards, interface, _real_station(arm, folder, boards, client, status))
    finally:
        client.close()


def _conduct(arm: Arm, folder: SessionFolder, boards: Boards, interface: Interface, station: Station) -> None:
    operator = interface.operator(
        folder, boards, interface.lines, interface.say, arm.table, may_auto=station.hand is not None
    )
    operator.run(conduct(folder, station))
    done, left = folder.state.count(Mark.DONE), folder.state.count(Mark.LEFT)
    interface.say(f"{done} points recorded, {left} left: {folder.path / POINTS}")


def _station(
    arm: Arm,
    folder: SessionFolder,
    boards: Boards,
    client: ArmClient,
    speed: float,
    offset_s: float,
    hand: Hand | None,
) -> Station:
    is_unplaced = folder.plan.pose_frame == STREAM_FRAME
    port, geometry = RuntimePort(client, speed, in_own_frame=is_unplaced), ArmGeometry(arm)
    client.ask("payload", mass_kg=folder.plan.payload_kg)
    return Station(
        arm=port,
        geometry=geometry,
        boards=boards,
        watch=ResidualWatch(arm),
        hand=hand,
        camera=port if folder.plan.has_camera else None,
        ways=ClearPaths(arm, geometry),
        settings=SessionSettings(payload_kg=folder.plan.payload_kg),
        clock_offset_s=offset_s,
    )


def _mock_station(arm: Arm, folder: SessionFolder, boards: Boards, mock: MockSession) -> Station:
    """Times continue after the last record, because a mock arm's clock restarts."""
    points = folder.points()
    last_s = float(points.t_s.max()) if points is not None else 0.0
    hand = mock.hand if folder.plan.seat == "hand" else None
    return _station(arm, folder, boards, mock.client, mock.speed, last_s, hand)


def _ready(client: ArmClient) -> Message:
    """Status of the homed and holding arm. ArmFaulted or ArmError say what is missing."""
    status = client.status()
    if status["mode"] == "FAULT":
        raise ArmFaulted(fault_text(status))
    if not status["is_homed"]:
        raise ArmError(
            "the arm is not homed, so its joint angles are unknown: run `armwright enable`, then `armwright home`"
        )
    if status["mode"] in ("GUIDING", "BRAKED"):  # a session was killed during hand guiding
        client.hold()
    elif status["mode"] != "HOLDING":
        raise ArmError(f"the arm is {status['mode']}, expected HOLDING: run `armwright enable`")
    return status


def _real_station(
    arm: Arm, folder: SessionFolder, boards: Boards, client: ArmClient, status: Message
) -> Station:
    """Times count from the start of the session, by the host's clock."""
    elapsed_s = time.time() - datetime.fromisoformat(folder.started).timestamp()
    return _station(arm, folder, boards, client, SPEED, elapsed_s - float(status["t_s"]), None)


def _introduce(folder: SessionFolder, interface: Interface) -> None:
    plan, state = folder.plan, folder.state
    what = "resumed" if folder.is_resumed else "begun"
    interface.say(
        f"session {folder.path} {what}: {len(plan.targets)} points, {state.count(Mark.DONE)} recorded;"
        f" board {plan.board}, tip seated by {plan.seat}, payload {plan.payload_kg:g} kg; `help` lists the commands"
    )
    for warning in folder.warnings:
        interface.say(f"! {warning}")


def _require_same_arm(folder: SessionFolder, arm: Arm) -> None:
    """SessionError if the session belongs to another arm file."""
    if folder.plan.arm_sha256 != fingerprint(arm):
        raise SessionError(
            f"{folder.path}: this session was started with arm {folder.plan.arm!r} and another version of its file:"
            " give that file with --arm"
        )


def _typed() -> Iterator[str]:
    """Lines from a terminal or a pipe."""
    while line := sys.stdin.readline():
        yield line


def _replayed(script: Path, say: Callable[[str], None]) -> Iterator[str]:
    """Lines of a script, echoed as they are used; `#` starts a comment."""
    try:
        text = script.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise SessionError(f"{script}: not UTF-8 text (byte {error.start})") from None
    return (_echoed(line, say) for line in text.splitlines() if not line.lstrip().startswith("#"))


def _echoed(line: str, say: Callable[[str], None]) -> str:
    if line.strip():
        say(f"  < {line.strip()}")
    return line


def _say(text: str) -> None:
    sys.stdout.write(text if text.endswith("\n") else f"{text}\n")
    sys.stdout.flush()

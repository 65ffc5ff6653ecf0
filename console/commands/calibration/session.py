"""`armwright session`: step through the table's points, or two arms' contacts, and record; resumable at any time."""

import argparse
from pathlib import Path

from calib.errors import SessionError
from calib.points.points import STREAM_FRAME
from calib.session.conduct import Boards, Station, conduct
from calib.session.folder import SessionFolder
from calib.session.plan import SessionPlan, fingerprint
from console.commands import cell
from console.commands.connection import in_control_of
from control.model.arm import Arm
from control.model.description import load_arm
from control.server.client import ArmClient
from hil_mocks.scenario import load_scenario
from procedures.folders import require_writable
from procedures.ports import RuntimePort
from procedures.session.mock_session import SCENARIO, arm_station, mock_session
from procedures.session.operator import SPEED, BoardWords, Interface, last_s, ready, require_same, since_start_s
from procedures.session.planning import plan_from_options


def run(given: argparse.Namespace) -> int:
    """Start or resume a session, and run it until the operator ends it or all points are done."""
    if given.cell is not None:
        return cell.session_of_contacts(given)
    for name in ("contacts", "arms"):
        if getattr(given, name) is not None:
            raise SessionError(f"--{name} is for two arms of a cell: add --cell")
    arm = load_arm(given.arm)
    interface = Interface.of(given)
    wanted = plan_from_options(given, arm)
    if wanted is not None:
        wanted.require_sound()  # errors are reported before a folder or a connection exists
        Boards(arm, wanted)
    require_writable(Path(given.out))
    if given.mock:
        _with_mock(given, arm, wanted, interface)
    else:
        _with_arm(given, arm, wanted, interface)
    return 0


def _with_mock(given: argparse.Namespace, arm: Arm, wanted: SessionPlan | None, interface: Interface) -> None:
    if given.scenario is not None:
        load_scenario(given.scenario)
    with SessionFolder(Path(given.out), wanted) as folder:
        require_same(folder, fingerprint(arm))
        boards = Boards(arm, folder.plan)
        _introduce(folder, interface)
        with mock_session(arm, folder, boards, given.scenario) as mock:
            hand = mock.hand if folder.plan.seat == "hand" else None
            port = _port(folder, mock.client, mock.speed)
            station = arm_station(arm, folder, boards, port, hand, last_s(folder))
            _conduct(arm, folder, boards, interface, station)


def _with_arm(given: argparse.Namespace, arm: Arm, wanted: SessionPlan | None, interface: Interface) -> None:
    if (Path(given.out) / SCENARIO).exists():
        raise SessionError(f"{given.out}: this session belongs to a mock arm: add --mock")
    client = in_control_of(given, arm)
    try:
        status = ready(client)
        with SessionFolder(Path(given.out), wanted) as folder:
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

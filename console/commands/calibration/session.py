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


def run(args: argparse.Namespace) -> int:
    """Start or resume a session, and run it until the operator ends it or all points are done."""
    if args.cell is not None:
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

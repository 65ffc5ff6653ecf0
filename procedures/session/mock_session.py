"""A session with a stepped mock arm in this process: the bench, the hand, and its saved scenario."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from calib.errors import SessionError
from calib.session.boards_known import Boards
from calib.session.conduct import Hand
from calib.session.folder import SessionFolder
from control.files import write_whole
from control.model.arm import Arm
from control.server.client import ArmClient
from hil_mocks.scenario import load_scenario
from procedures.mock import SteppedBench, seeded_scenario
from procedures.ports import HandPort, MockHandSeat
from procedures.session.mock_board import hidden_place

SCENARIO = "mock_scenario.toml"
DEFAULT_SCENARIO = "demo"


@dataclass(frozen=True, slots=True)
class MockSession:
    """A homed and holding mock arm, and the hand that seats its tip."""

    client: ArmClient
    hand: Hand
    speed: float


@contextmanager
def mock_session(arm: Arm, folder: SessionFolder, boards: Boards, name: str | None) -> Iterator[MockSession]:
    """Start the mock arm of a session's folder; the scenario is saved there, so that a resumed session has the
    same arm. SessionError if it is resumed with another scenario, or belongs to a real arm.
    """
    scenario = saved_scenario(folder, name, was_homed=not arm.can_home)
    bench = SteppedBench(arm, scenario, free_log(folder.path))
    try:
        client = bench.start(arm)
        client.enable()
        client.home()
        bench.rig.set_payload(folder.plan.payload_kg)
        hidden = None
        if boards.kind != "known" and arm.table is not None:
            hidden = hidden_place(arm.table, load_scenario(scenario).seed)
        hand = MockHandSeat(HandPort(bench.rig.hand, bench.wait), hidden or boards.reference_m)
        yield MockSession(client, hand, bench.speed)
        if arm.rest is not None:
            client.move_joints(arm.rest.q_rad, bench.speed)
        bench.stop()
    finally:
        bench.close()


def saved_scenario(folder: SessionFolder, name: str | None, was_homed: bool) -> Path:
    """The scenario of a session's mock, saved in its folder. SessionError if another one is wanted, or the arm is real."""
    file = folder.path / SCENARIO
    if not file.exists():
        if folder.points() is not None:
            raise SessionError(f"{folder.path}: this session belongs to a real arm: omit --mock")
        write_whole(file, seeded_scenario(name or DEFAULT_SCENARIO, None, was_homed))
    elif name is not None and file.read_bytes() != seeded_scenario(name, None, was_homed):
        raise SessionError(
            f"{folder.path}: this session was started with another scenario ({file}): omit --scenario"
        )
    return file


def free_log(folder: Path) -> Path:
    """A new folder for this run's recording: none is overwritten."""
    number = 1
    while (folder / "log" / str(number)).exists():
        number += 1
    return folder / "log" / str(number)

"""What sessions work with, and sessions with a stepped mock in this process: one arm and the hand that seats its tip, or a cell.

The scenario is saved in the session's folder, so that a resumed session has the same arm.

"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.closed_chain.conduct import ContactWatch, PairHand, PairStation
from calib.closed_chain.planning import Poses, SharedRoom, base_of
from calib.design.candidates import OTHER_TILTS, tilted
from calib.errors import SessionError
from calib.session.conduct import AutomaticHand, Boards, Station
from calib.session.folder import SessionFolder
from calib.session.moves import ArmGeometry, ClearPaths, Vector
from calib.session.plan import Target
from calib.session.residual_watch import ResidualWatch
from calib.session.take import SessionSettings
from control.files import write_whole
from control.kinematics.kinematics import ForwardKinematics
from control.model import table as tables
from control.model.arm import Arm, Table
from control.model.cell import Cell
from control.server.client import ArmClient
from hil_mocks.scenario import load_scenario
from procedures.mock import CellBench, SteppedBench, as_bolted_down, seeded_scenario
from procedures.ports import HandPort, MockHandSeat, RuntimePort, move_together

ORIGIN_m = (0.5, 0.0, 0.0)  # if the file gives none: that of the reference arm
SHIFT_m, TURN_rad = 0.02, 0.03


def hidden_place(table: Table, seed: int) -> Callable[[Target], Vector]:
    """Cavities in the base frame of a board some centimetres and degrees off nominal, different by setup."""
    known = replace(table, known_pose=True, origin_m=table.origin_m or ORIGIN_m)
    cavities = tables.board_cavities(known)

    def place(target: Target) -> Vector:
        draw = random.Random(f"board {seed} {target.setup}")
        shift = np.array([draw.uniform(-SHIFT_m, SHIFT_m), draw.uniform(-SHIFT_m, SHIFT_m), draw.uniform(0.0, SHIFT_m)])
        ax, ay, az = (draw.uniform(-TURN_rad, TURN_rad) for _ in range(3))
        skew = np.array([[0.0, -az, ay], [az, 0.0, -ax], [-ay, ax, 0.0]])
        turn = np.linalg.solve(np.eye(3) - 0.5 * skew, np.eye(3) + 0.5 * skew)  # Cayley: a rotation
        setup = target.setup if target.setup in (*tables.SETUPS, *OTHER_TILTS) else "normal"
        place = tilted(known, setup) @ np.array(cavities[target.point])
        x, y, z = (turn @ place + np.array(known.origin_m) + shift).tolist()
        return x, y, z

    return place


SCENARIO = "mock_scenario.toml"
DEFAULT_SCENARIO = "demo"


@dataclass(frozen=True, slots=True)
class MockSession:
    """A homed and holding mock arm, and the hand that seats its tip."""

    client: ArmClient
    hand: AutomaticHand
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
        raise SessionError(f"{folder.path}: this session was started with another scenario ({file}): omit --scenario")
    return file


def free_log(folder: Path) -> Path:
    """A new folder for this run's recording: none is overwritten."""
    number = 1
    while (folder / "log" / str(number)).exists():
        number += 1
    return folder / "log" / str(number)


@contextmanager
def mock_pair(cell: Cell, folder: SessionFolder, scenario: str | None) -> Iterator[CellBench]:
    """All arms of the cell, homed and holding; the scenario is saved in the session's folder, so that a resumed one has the same.

    SessionError if it is resumed with another scenario, or belongs to real arms.
    """
    can_home = all(placed.arm.can_home for placed in cell.arms)
    hidden = load_scenario(saved_scenario(folder, scenario, was_homed=not can_home))
    bench = CellBench(as_bolted_down(cell, hidden.seed), hidden, free_log(folder.path))
    try:
        bench.home(cell)
        yield bench
        bench.stop()
    finally:
        bench.close()


def arm_station(
    arm: Arm,
    folder: SessionFolder,
    boards: Boards,
    port: RuntimePort,
    hand: AutomaticHand | None = None,
    clock_offset_s: float = 0.0,
) -> Station:
    """What a session of one arm works with, on a mock or a real one."""
    plan, geometry = folder.plan, ArmGeometry(arm)
    return Station(
        arm=port,
        geometry=geometry,
        boards=boards,
        watch=ResidualWatch(arm),
        hand=hand,
        camera=port if plan.has_camera else None,
        ways=ClearPaths(arm, geometry),
        settings=SessionSettings(payload_kg=plan.payload_kg, clock_offset_s=clock_offset_s),
    )


Names = tuple[str, str]


def pair_station(
    cell: Cell,
    names: Names,
    clients: Mapping[str, ArmClient],
    speed: float,
    clock_offset_s: float = 0.0,
    hand: PairHand | None = None,
) -> PairStation:
    """`speed`: fraction of the joints' limits."""
    first, second = (cell.placed(name) for name in names)

    def together(poses_rad: Poses, fraction: float) -> None:
        moves = {name: {"q_rad": list(q_rad), "speed": speed * fraction} for name, q_rad in zip(names, poses_rad, strict=True)}
        move_together(clients, moves)

    return PairStation(
        names,
        (RuntimePort(clients[names[0]], speed), RuntimePort(clients[names[1]], speed)),
        (ArmGeometry(first.arm), ArmGeometry(second.arm)),
        together,
        SharedRoom(cell, (first, second)),
        ContactWatch((first.arm, second.arm), base_of(cell, names)),
        hand,
        SessionSettings(clock_offset_s=clock_offset_s),
    )


class MockPairHand:
    """Hands that bring both tips to a contact. Its places are real: the ends of a bar are where the files say that they are."""

    def __init__(self, cell: Cell, names: Names, bench: CellBench) -> None:
        self._names, self._standing = names, bench.standing
        self._placed = [cell.placed(name) for name in names]
        self._models = [ForwardKinematics(placed.arm) for placed in self._placed]
        self._ports = [RuntimePort(bench.clients[name]) for name in names]
        self._hands = [HandPort(bench.hand(name), bench.wait) for name in names]

    def seat(self, target: Target) -> None:
        """One tip after the other, its drives off meanwhile; both then hold."""
        q_rad, count = target.q_rad or (), self._placed[0].arm.joint_count
        first, second = (
            np.array(placed.in_cell(model.tip(*q)))
            for placed, model, q in zip(self._placed, self._models, (q_rad[:count], q_rad[count:]), strict=True)
        )
        way = second - first
        places = (first, first + target.distance_m * way / max(float(np.linalg.norm(way)), 1e-9))
        for name, port, hand, place in zip(self._names, self._ports, self._hands, places, strict=True):
            port.release()
            hand.seat(self._standing.placed(name).in_base(place.tolist()))
            port.hold()

    def let_go(self) -> None:
        """Release both tips."""
        for hand in self._hands:
            hand.let_go()

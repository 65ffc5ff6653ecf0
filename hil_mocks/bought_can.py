"""The bought boards of a mock arm that are on its CAN bus: which joints they drive, and what their faults do."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from control.model.arm import Drive
from control.model.description import Arm
from firmware_iface.link import CanFormat
from hil_mocks.devices import cia402_drive, moteus, odrive, vesc
from hil_mocks.devices.cia402_drive import EPOS4, MAXON, Cia402Mock, Cia402Setup
from hil_mocks.devices.moteus import MoteusMock, MoteusSetup
from hil_mocks.devices.motor_inputs import Frame, Output
from hil_mocks.devices.odrive import OdriveMock, OdriveSetup
from hil_mocks.devices.vesc import VescMock, VescSetup
from hil_mocks.scenario import FaultTable
from hil_mocks.wiring import JointWiring


class PlantState(NamedTuple):
    """What the boards see of the plant, by joint: currents in the boards' own sense, supply, whether a bridge is at a limit."""

    currents_A: Sequence[float]
    supply_V: Sequence[float]
    is_clamped: Sequence[bool]
    joint_rad: Sequence[float]


Driven = tuple[int, Output, float]  # a joint, what its bridge puts out, and its current limit


class CanBoardMock(Protocol):
    """A board on the bus. `forced_error`: a persistent cause of an error, set by a fault of the scenario."""

    outgoing: list[Frame]
    forced_error: int
    is_home: bool
    output: Output

    @property
    def limit_A(self) -> float: ...
    def receive(self, can_id: int, payload: bytes, now_s: float) -> None: ...
    def tick(self, now_s: float, current_A: float, supply_V: float) -> None: ...
    def power_up(self, now_s: float | None) -> None: ...
    def switch_torque(self, is_on: bool, now_s: float) -> None: ...


@dataclass(frozen=True, slots=True)
class EncoderShaft:
    """An encoder as a board reads it: with the sense of its wires, or counting up with a positive voltage."""

    count: Callable[[], int]
    turns: Callable[[], float]
    own_count: Callable[[], int]


class CanKind(NamedTuple):
    """A kind of boards: the prefix of its names in faults, its frames, its mock, and the codes of its errors."""

    prefix: str
    carried: CanFormat
    mock: Callable[[int, int, Drive, EncoderShaft], Any]
    errors: Mapping[str, int]


def _cia402(node: int, joint: int, drive: Drive, shaft: EncoderShaft) -> Cia402Mock:
    """Every second joint has an EPOS4, the others a plain drive."""
    maker: dict[str, Any] = {"vendor": MAXON, "product": EPOS4} if joint % 2 == 1 else {}
    setup = Cia402Setup(
        node=node,
        serial_number=0xC402_0000 + joint,
        counts_per_turn=drive.encoder_counts_per_rev,
        torque_constant_Nm_A=drive.torque_constant_Nm_A,
        resistance_ohm=drive.resistance_ohm,
        current_limit_A=drive.current_limit_A,
        rotor_inertia_kg_m2=drive.rotor_inertia_kg_m2,
        **maker,
    )
    return Cia402Mock(setup, shaft.own_count)


def _vesc(number: int, joint: int, drive: Drive, shaft: EncoderShaft) -> VescMock:
    volts_per_turn_s = 2.0 * math.pi * drive.torque_constant_Nm_A
    setup = VescSetup(number, volts_per_turn_s, drive.current_limit_A, drive.resistance_ohm)
    return VescMock(setup, lambda: shaft.count() / vesc.TURN)


def _odrive(node: int, joint: int, drive: Drive, shaft: EncoderShaft) -> OdriveMock:
    # Its watchdog frees the motor, so it is on where the last command must not last (docs/odrive.md).
    watchdog_s = math.inf if drive.pid.mode == "position" else 0.1
    setup = OdriveSetup(node, drive.torque_constant_Nm_A, drive.current_limit_A, watchdog_s=watchdog_s)
    return OdriveMock(setup, shaft.turns)


def _moteus(number: int, joint: int, drive: Drive, shaft: EncoderShaft) -> MoteusMock:
    setup = MoteusSetup(number, drive.torque_constant_Nm_A, drive.current_limit_A, (0x4D5445, joint, 1))
    return MoteusMock(setup, shaft.turns)


KINDS = {
    "cia402": CanKind(
        "drive", CanFormat.STANDARD, _cia402,
        {"over_temperature": cia402_drive.OVER_HEATED, "over_current": cia402_drive.OVER_CURRENT},
    ),
    "moteus": CanKind(
        "moteus", CanFormat.FD, _moteus,
        {"over_temperature": moteus.OVER_HEATED, "over_current": moteus.DRIVER_FAULT},
    ),
    "odrive": CanKind(
        "odrive", CanFormat.STANDARD, _odrive,
        {"over_temperature": odrive.OVER_HEATED, "over_current": odrive.OVER_CURRENT},
    ),
    "vesc": CanKind(
        "vesc", CanFormat.EXTENDED, _vesc, {"over_temperature": vesc.OVER_HEATED, "over_current": vesc.OVER_CURRENT}
    ),
}  # fmt: skip


# Another program does so, unheard by the host.
SWITCHED: Mapping[str, bool] = {"switched_off": False, "switched_on": True}


class CanBoards:
    """The boards of one kind of an arm, by joint (0-based)."""

    def __init__(
        self, arm: Arm, wiring: Sequence[JointWiring], encoder_rad: Callable[[int], float], kind: str
    ) -> None:
        made = KINDS[kind]
        self.carried = made.carried
        self._wiring, self._errors = wiring, made.errors
        numbers = {board.name: board.address for board in arm.boards if board.kind == kind}
        self.joints = [j for j, drive in enumerate(arm.drives) if drive.board in numbers]
        on_them = [(j, arm.drives[j], numbers[arm.drives[j].board]) for j in self.joints]
        self.names = [f"{made.prefix}{number}" for _, _, number in on_them]
        self.mocks: list[CanBoardMock] = [
            made.mock(number, j, drive, _shaft(wiring[j], j, encoder_rad)) for j, drive, number in on_them
        ]

    def tick(self, now_s: float, seen: PlantState) -> list[Driven]:
        """Advance the boards."""
        outputs: list[Driven] = []
        for j, mock in zip(self.joints, self.mocks, strict=True):
            mock.is_home = self._wiring[j].is_at_switch(seen.joint_rad[j])
            mock.tick(now_s, seen.currents_A[j], seen.supply_V[j])
            outputs.append((j, mock.output, mock.limit_A))
        return outputs

    def switch(self, fault: FaultTable, is_on: bool, now_s: float) -> None:
        """Begin or end a fault of a board itself."""
        mock = self.mocks[self.names.index(fault.board)]
        if fault.kind in self._errors:
            mock.forced_error = self._errors[fault.kind] if is_on else 0
        elif fault.kind == "board_reset" and is_on:
            mock.power_up(now_s)
        elif fault.kind in SWITCHED and is_on:
            mock.switch_torque(SWITCHED[fault.kind], now_s)

    def joint(self, fault: FaultTable) -> int:
        """The joint of a fault's board."""
        return self.joints[self.names.index(fault.board)]


def _shaft(wired: JointWiring, joint: int, encoder_rad: Callable[[int], float]) -> EncoderShaft:
    turns_per_rad = wired.encoder_direction * wired.counts_per_rad / wired.counts_per_turn
    zero_turns = wired.zero_count / wired.counts_per_turn
    return EncoderShaft(
        lambda: wired.raw_count(encoder_rad(joint)),
        lambda: encoder_rad(joint) * turns_per_rad + zero_turns,
        lambda: wired.motor_count(encoder_rad(joint)),
    )

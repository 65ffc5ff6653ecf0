"""The bought boards of a mock arm, behind its plant: which joints they drive, and what their faults do.

RoboClaws and servos on serial lines; what is on the CAN bus is in `hil_mocks.bought_can`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

from control.model.arm import Drive
from control.model.description import Arm
from hil_mocks.bought_can import KINDS, SWITCHED, CanBoards, Driven, PlantState
from hil_mocks.devices import dynamixel
from hil_mocks.devices.dynamixel import DynamixelLineMock, DynamixelMock, ServoSetup
from hil_mocks.devices.dynamixel_table import CURRENT_BASED, EXTENDED, POSITION
from hil_mocks.devices.feetech import FeetechLineMock, FeetechMock, StsSetup
from hil_mocks.devices.motor_inputs import BRAKE, Output
from hil_mocks.devices.roboclaw import DRIVER_FAULT, E_STOP, FULL, OVER_HEATED, RoboClawLineMock, RoboClawMock
from hil_mocks.scenario import FaultTable
from hil_mocks.wiring import JointWiring


class AnsweringLine(Protocol):
    """A serial line whose boards answer; `outgoing` has bytes and when they arrive at the host."""

    outgoing: list[tuple[float, bytes]]

    def receive(self, received: bytes, now_s: float) -> None: ...


# Model number and unit of the current by the name in arm.toml; the XL430 has none. Where no servo is named: an XM430.
DYNAMIXELS = {"XL330-M288": (1200, 0.001), "XL430-W250": (1060, 0.0), "XM540-W270": (1120, 0.00269)}
XM430 = (1020, 0.00269)


def _dynamixel(number: int, drive: Drive, read_turns: Callable[[], float], grips: bool) -> DynamixelMock:
    model, unit_A = DYNAMIXELS.get(drive.servo, XM430)
    gripping = CURRENT_BASED if unit_A else EXTENDED
    setup = ServoSetup(
        number, _volts_per_rad_s(drive), model, unit_A, gripping if grips else POSITION, drive.supply_V
    )
    return DynamixelMock(setup, read_turns)


def _sts(number: int, drive: Drive, read_turns: Callable[[], float], grips: bool) -> FeetechMock:
    setup = StsSetup(number, _volts_per_rad_s(drive), supply_V=drive.supply_V, turns_on=grips)
    return FeetechMock(setup, read_turns)


def _volts_per_rad_s(drive: Drive) -> float:
    """At the output."""
    return drive.gear_ratio * drive.torque_constant_Nm_A


class ServoKind(NamedTuple):
    """How faults call a kind of smart servos, and its mocks. Both kinds have the same bits for heat and overload."""

    prefix: str
    mock: Callable[[int, Drive, Callable[[], float], bool], Any]  # the last: whether it drives a gripper
    line: Callable[[list[Any], int], AnsweringLine]


SERVO_KINDS = {
    "dynamixel": ServoKind("servo", _dynamixel, DynamixelLineMock),
    "feetech": ServoKind("feetech", _sts, FeetechLineMock),
}


class Servos:
    """The smart servos of one kind of an arm, by joint (0-based), on their lines."""

    def __init__(
        self, arm: Arm, wiring: Sequence[JointWiring], encoder_rad: Callable[[int], float], kind: str
    ) -> None:
        made = SERVO_KINDS[kind]
        described = {board.name: board for board in arm.boards if board.kind == kind}
        self.joints = [j for j, drive in enumerate(arm.drives) if drive.board in described]
        self.servos = [drive.servos for drive in arm.drives]
        boards = [described[arm.drives[j].board] for j in self.joints]
        self.names = [f"{made.prefix}{board.address}" for board in boards]
        self.ports = list(dict.fromkeys(board.port for board in boards))
        self.mocks = [
            made.mock(
                board.address,
                arm.drives[j],
                self._reader(wiring[j], j, encoder_rad),
                j >= arm.joint_count,
            )
            for j, board in zip(self.joints, boards, strict=True)
        ]
        self.lines = [
            made.line(
                [mock for mock, board in zip(self.mocks, boards, strict=True) if board.port == port],
                next(board.baud for board in boards if board.port == port),
            )
            for port in self.ports
        ]
        self.line_of = [self.ports.index(board.port) for board in boards]

    def tick(self, now_s: float, seen: PlantState) -> list[Driven]:
        """Advance the servos."""
        outputs: list[Driven] = []
        for j, mock in zip(self.joints, self.mocks, strict=True):
            mock.tick(now_s, seen.currents_A[j] / self.servos[j], seen.supply_V[j])
            outputs.append((j, mock.output, mock.limit_A * self.servos[j]))
        return outputs

    def switch(self, fault: FaultTable, is_on: bool, now_s: float) -> None:
        """Begin or end a fault of a servo itself."""
        mock = self.mocks[self.names.index(fault.board)]
        errors = {"over_temperature": dynamixel.OVER_HEATED, "over_current": dynamixel.OVERLOAD}
        if fault.kind in errors:
            mock.forced_error = errors[fault.kind] if is_on else 0
        elif fault.kind == "board_reset" and is_on:
            mock.power_up(now_s)
        elif fault.kind in SWITCHED and is_on:
            mock.switch_torque(SWITCHED[fault.kind], now_s)

    def joint(self, fault: FaultTable) -> int:
        """The joint of a fault's servo."""
        return self.joints[self.names.index(fault.board)]

    def _reader(self, wired: JointWiring, j: int, encoder_rad: Callable[[int], float]) -> Callable[[], float]:
        turns_per_rad = wired.encoder_direction * wired.counts_per_rad / dynamixel.COUNTS_PER_TURN
        zero_turns = wired.zero_count / dynamixel.COUNTS_PER_TURN
        return lambda: encoder_rad(j) * turns_per_rad + zero_turns


class RoboClaws:
    """All RoboClaw lines of an arm. Joints 0-based; serial lines in the order of `ports`."""

    def __init__(self, arm: Arm, wiring: Sequence[JointWiring], encoder_rad: Callable[[int], float]) -> None:
        self._wiring, self._encoder_rad = wiring, encoder_rad
        drawn = [board for board in arm.boards if board.kind == "roboclaw"]
        self.names = [f"roboclaw{i + 1}" for i in range(len(drawn))]
        self.ports = list(dict.fromkeys(board.port for board in drawn))
        self._joints = {board.name: self._channels_of(arm, board.name) for board in drawn}
        self._mocks = [RoboClawMock(board.address, self._reader(board.name)) for board in drawn]
        self._of_mock = [self._joints[board.name] for board in drawn]
        self.lines = [
            RoboClawLineMock(
                [mock for mock, board in zip(self._mocks, drawn, strict=True) if board.port == port],
                next(board.baud for board in drawn if board.port == port),
            )
            for port in self.ports
        ]
        self.line_of = [self.ports.index(board.port) for board in drawn]

    @property
    def joints(self) -> list[int]:
        """The joints that they drive."""
        return [joint for joints in self._of_mock for joint in joints.values()]

    def mock(self, name: str) -> RoboClawMock:
        """A board by its name in faults, `roboclaw1` ..."""
        return self._mocks[self.names.index(name)]

    def joint(self, fault: FaultTable) -> int | None:
        """The joint at the channel of a fault."""
        return self._of_mock[self.names.index(fault.board)].get(fault.channel)

    def tick(self, now_s: float, seen: PlantState) -> list[Driven]:
        """Advance the boards."""
        outputs: list[Driven] = []
        for mock, joints in zip(self._mocks, self._of_mock, strict=True):
            measured, limited, supply = [0.0, 0.0], [False, False], 24.0
            for channel, joint in joints.items():
                measured[channel], limited[channel] = seen.currents_A[joint], seen.is_clamped[joint]
                supply = seen.supply_V[joint]
                mock.are_switches_on[channel] = self._wiring[joint].is_at_switch(seen.joint_rad[joint])
            mock.tick(now_s, measured, supply, limited)
            for channel, joint in joints.items():
                volts = mock.duty[channel] / FULL * supply
                output = Output("voltage", volts) if volts else BRAKE
                outputs.append((joint, output, mock.current_limits_A[channel]))
        return outputs

    def switch(self, fault: FaultTable, is_on: bool, now_s: float) -> None:
        """Begin or end a fault of a board itself."""
        mock = self.mock(fault.board)
        errors = {
            "e_stop": E_STOP, "over_temperature": OVER_HEATED, "over_current": DRIVER_FAULT[fault.channel % 2]
        }  # fmt: skip
        if fault.kind in errors:
            bit = errors[fault.kind]
            mock.forced_errors = mock.forced_errors | bit if is_on else mock.forced_errors & ~bit
        elif fault.kind == "board_reset" and is_on:
            mock.power_up()
        elif fault.kind in SWITCHED and is_on:
            mock.movements = [{"u": FULL // 8 if SWITCHED[fault.kind] else 0} for _ in (0, 1)]
        elif fault.kind == "stuck_encoder":
            mock.stuck.pop(fault.channel, None)
            if is_on and (joint := self.joint(fault)) is not None:
                mock.stuck[fault.channel] = self._wiring[joint].raw_count(self._encoder_rad(joint))

    def _channels_of(self, arm: Arm, name: str) -> dict[int, int]:
        """The joint at each channel of a board."""
        return {d.board_channel - 1: j for j, d in enumerate(arm.drives) if d.board == name}

    def _reader(self, name: str) -> Callable[[int], int]:
        joints = self._joints[name]

        def read(channel: int) -> int:
            joint = joints.get(channel)
            return 0 if joint is None else self._wiring[joint].raw_count(self._encoder_rad(joint))

        return read


Owner = RoboClaws | Servos | CanBoards


class Bought:
    """All bought boards of an arm: serial lines in the order of `ports`, with the name of the first board on each."""

    def __init__(self, arm: Arm, wiring: Sequence[JointWiring], encoder_rad: Callable[[int], float]) -> None:
        claws = RoboClaws(arm, wiring, encoder_rad)
        servos = [Servos(arm, wiring, encoder_rad, kind) for kind in SERVO_KINDS]
        on_can = (CanBoards(arm, wiring, encoder_rad, kind) for kind in KINDS)
        self.on_can = [boards for boards in on_can if boards.joints]
        self._owners: tuple[Owner, ...] = (claws, *servos, *self.on_can)
        self.joints = [joint for owner in self._owners for joint in owner.joints]
        self.names = [name for owner in self._owners for name in owner.names]
        on_lines: tuple[RoboClaws | Servos, ...] = (claws, *servos)
        self.lines: list[AnsweringLine] = [line for owner in on_lines for line in owner.lines]
        self.ports = [port for owner in on_lines for port in owner.ports]
        self.line_names = [
            owner.names[owner.line_of.index(line)]
            for owner in on_lines
            for line in dict.fromkeys(owner.line_of)
        ]

    def tick(self, now_s: float, seen: PlantState) -> list[Driven]:
        """Advance all boards; what each joint is driven with."""
        return [driven for owner in self._owners if owner.joints for driven in owner.tick(now_s, seen)]

    def joint(self, fault: FaultTable) -> int | None:
        """The joint of a fault."""
        return self._owner(fault).joint(fault)

    def switch(self, fault: FaultTable, is_on: bool, now_s: float) -> None:
        """Begin or end a fault of a board itself."""
        self._owner(fault).switch(fault, is_on, now_s)

    def _owner(self, fault: FaultTable) -> Owner:
        return next(owner for owner in self._owners if fault.board in owner.names)

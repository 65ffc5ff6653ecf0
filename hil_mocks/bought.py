"""The bought boards of a mock arm, behind its plant, on serial lines and on CAN: which joints they drive, and their faults."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from control.model.arm import Arm, Drive
from firmware_iface.link import CanFormat
from hil_mocks.devices import cia402_drive, dynamixel, moteus, odrive, roboclaw, vesc
from hil_mocks.devices.cia402_drive import EPOS4, MAXON, Cia402Mock, Cia402Setup
from hil_mocks.devices.dynamixel import CURRENT_BASED, EXTENDED, POSITION, DynamixelLineMock, DynamixelMock, ServoSetup
from hil_mocks.devices.feetech import FeetechLineMock, FeetechMock, StsSetup
from hil_mocks.devices.moteus import MoteusMock, MoteusSetup
from hil_mocks.devices.motor_inputs import BRAKE, Frame, Output
from hil_mocks.devices.odrive import OdriveMock, OdriveSetup
from hil_mocks.devices.vesc import VescMock, VescSetup
from hil_mocks.scenario import FaultTable
from hil_mocks.wiring import OWN_INPUT, JointWiring, limit_switches


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
        "drive",
        CanFormat.STANDARD,
        _cia402,
        {"over_temperature": cia402_drive.OVER_HEATED, "over_current": cia402_drive.OVER_CURRENT},
    ),
    "moteus": CanKind(
        "moteus", CanFormat.FD, _moteus, {"over_temperature": moteus.OVER_HEATED, "over_current": moteus.DRIVER_FAULT}
    ),
    "odrive": CanKind(
        "odrive", CanFormat.STANDARD, _odrive, {"over_temperature": odrive.OVER_HEATED, "over_current": odrive.OVER_CURRENT}
    ),
    "vesc": CanKind("vesc", CanFormat.EXTENDED, _vesc, {"over_temperature": vesc.OVER_HEATED, "over_current": vesc.OVER_CURRENT}),
}


# Another program does so, unheard by the host.
SWITCHED: Mapping[str, bool] = {"switched_off": False, "switched_on": True}


class CanBoards:
    """The boards of one kind of an arm, by joint (0-based)."""

    def __init__(self, arm: Arm, wiring: Sequence[JointWiring], encoder_rad: Callable[[int], float], kind: str) -> None:
        made = KINDS[kind]
        self.carried = made.carried
        self._wiring, self._errors = wiring, made.errors
        self._limits = {j: _own_limits(drive) for j, drive in enumerate(arm.drives) if _own_limits(drive)}
        numbers = {board.name: board.address for board in arm.boards if board.kind == kind}
        self.joints = [j for j, drive in enumerate(arm.drives) if drive.board in numbers]
        on_them = [(j, arm.drives[j], numbers[arm.drives[j].board]) for j in self.joints]
        self.names = [f"{made.prefix}{number}" for _, _, number in on_them]
        self.mocks: list[CanBoardMock] = [
            made.mock(number, j, drive, _shaft(wiring[j], j, encoder_rad, _repeats(arm, drive))) for j, drive, number in on_them
        ]

    def tick(self, now_s: float, seen: PlantState) -> list[Driven]:
        """Advance the boards."""
        outputs: list[Driven] = []
        for j, mock in zip(self.joints, self.mocks, strict=True):
            mock.is_home = self._wiring[j].is_at_switch(seen.joint_rad[j])
            if j in self._limits and isinstance(mock, Cia402Mock):
                active = {direction: (seen.joint_rad[j] - at_rad) * side >= 0.0 for at_rad, side, direction in self._limits[j]}
                mock.at_limits = (active.get(-1.0, False), active.get(1.0, False))
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


def _own_limits(drive: Drive) -> list[tuple[float, float, float]]:
    """Of each limit switch at the drive's own inputs: where it changes, the side of the joint, and of the drive's encoder."""
    return [(at_rad, side, side * drive.encoder_direction) for pin, at_rad, side in limit_switches(drive) if pin == OWN_INPUT]


def _repeats(arm: Arm, drive: Drive) -> float:
    """Turns after which an absolute encoder repeats whose joint turns further, and has to home for that; 0 of others."""
    board = next(board for board in arm.boards if board.name == drive.board)
    return board.absolute_turns or 0.0 if board.absolute and drive.home is not None else 0.0


def _shaft(wired: JointWiring, joint: int, encoder_rad: Callable[[int], float], repeats_turns: float = 0.0) -> EncoderShaft:
    turns_per_rad = wired.encoder_direction * wired.counts_per_rad / wired.counts_per_turn
    zero_turns = wired.zero_count / wired.counts_per_turn
    unseen_turns: list[float] = []  # whole repeats, which the encoder does not know at power-up

    def turns() -> float:
        turned = encoder_rad(joint) * turns_per_rad + zero_turns
        if not unseen_turns:
            unseen_turns.append(repeats_turns * round(turned / repeats_turns) if repeats_turns else 0.0)
        return turned - unseen_turns[0]

    return EncoderShaft(lambda: wired.raw_count(encoder_rad(joint)), turns, lambda: wired.motor_count(encoder_rad(joint)))


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
    setup = ServoSetup(number, _volts_per_rad_s(drive), model, unit_A, gripping if grips else POSITION, drive.supply_V)
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

    def __init__(self, arm: Arm, wiring: Sequence[JointWiring], encoder_rad: Callable[[int], float], kind: str) -> None:
        made = SERVO_KINDS[kind]
        described = {board.name: board for board in arm.boards if board.kind == kind}
        self.joints = [j for j, drive in enumerate(arm.drives) if drive.board in described]
        self.servos = [drive.servos for drive in arm.drives]
        boards = [described[arm.drives[j].board] for j in self.joints]
        self.names = [f"{made.prefix}{board.address}" for board in boards]
        self.ports = list(dict.fromkeys(board.port for board in boards))
        self.mocks = [
            made.mock(board.address, arm.drives[j], self._reader(wiring[j], j, encoder_rad), j >= arm.joint_count)
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


LIMIT_PINS = {True: roboclaw.SWITCH_PIN | roboclaw.FORWARD_PIN, False: roboclaw.SWITCH_PIN | roboclaw.REVERSE_PIN}


class RoboClaws:
    """All RoboClaw lines of an arm. Joints 0-based; serial lines in the order of `ports`."""

    def __init__(self, arm: Arm, wiring: Sequence[JointWiring], encoder_rad: Callable[[int], float]) -> None:
        self._wiring, self._encoder_rad = wiring, encoder_rad
        drawn = [board for board in arm.boards if board.kind == "roboclaw"]
        self.names = [f"roboclaw{i + 1}" for i in range(len(drawn))]
        self.ports = list(dict.fromkeys(board.port for board in drawn))
        self._joints = {board.name: self._channels_of(arm, board.name) for board in drawn}
        self._mocks = [roboclaw.RoboClawMock(board.address, self._reader(board.name)) for board in drawn]
        self._of_mock = [self._joints[board.name] for board in drawn]
        self._limits = {j: _own_limits(drive) for j, drive in enumerate(arm.drives) if _own_limits(drive)}
        for mock, joints in zip(self._mocks, self._of_mock, strict=True):
            for channel, j in joints.items():
                for _, side, _ in self._limits.get(j, ()):
                    mode = LIMIT_PINS[side * arm.drives[j].motor_direction > 0.0]
                    pins = bytearray(mock.saved[roboclaw.PIN_MODES])
                    pins[1 + channel] = mode
                    mock.saved[roboclaw.PIN_MODES] = bytes(pins)
            mock.power_up()
        self.lines = [
            roboclaw.RoboClawLineMock(
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

    def mock(self, name: str) -> roboclaw.RoboClawMock:
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
                limits = self._limits.get(joint)
                mock.are_switches_on[channel] = (
                    any((seen.joint_rad[joint] - at_rad) * side >= 0.0 for at_rad, side, _ in limits)
                    if limits
                    else self._wiring[joint].is_at_switch(seen.joint_rad[joint])
                )
            mock.tick(now_s, measured, supply, limited)
            for channel, joint in joints.items():
                volts = mock.duty[channel] / roboclaw.FULL * supply
                output = Output("voltage", volts) if volts else BRAKE
                outputs.append((joint, output, mock.current_limits_A[channel]))
        return outputs

    def switch(self, fault: FaultTable, is_on: bool, now_s: float) -> None:
        """Begin or end a fault of a board itself."""
        mock = self.mock(fault.board)
        errors = {
            "e_stop": roboclaw.E_STOP,
            "over_temperature": roboclaw.OVER_HEATED,
            "over_current": roboclaw.DRIVER_FAULT[fault.channel % 2],
        }
        if fault.kind in errors:
            bit = errors[fault.kind]
            mock.forced_errors = mock.forced_errors | bit if is_on else mock.forced_errors & ~bit
        elif fault.kind == "board_reset" and is_on:
            mock.power_up()
        elif fault.kind in SWITCHED and is_on:
            mock.movements = [{"u": roboclaw.FULL // 8 if SWITCHED[fault.kind] else 0} for _ in (0, 1)]
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
        self.line_names = [owner.names[owner.line_of.index(line)] for owner in on_lines for line in dict.fromkeys(owner.line_of)]

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

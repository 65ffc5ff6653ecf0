"""Opens the links in arm.toml and checks that the right boards are connected; nothing moves. All devices are tried,
and one error names all that failed. What each kind of board offers is in `control.model.board_kinds`.

A CAN bus that several arms of a cell share is opened once and drained for all of them, also while the loop waits.
"""

import argparse
import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Protocol

from control.dynamics.gains import volt_gains_of
from control.errors import ArmError, MissingModel
from control.hardware.board_stop import board_stop, knows_motor
from control.hardware.boards import BoardHardware, Line, Opened, collect
from control.hardware.bought import cia402, moteus, odrive, roboclaw, vesc
from control.hardware.bought.smart_servo import DYNAMIXEL, FEETECH
from control.hardware.gripper import GripperBoard, gripper_of
from control.hardware.interface import EndBoards, GripperHardware, NamedPins, Wanted
from control.hardware.reference_boards import DriveWiring, ReferenceDrives, ReferenceEncoders, start_stream
from control.hardware.tip_camera import TipCamera, open_camera
from control.model.arm import Arm, Board, CanBus, EncoderBoardPort
from control.model.cell import Cell
from firmware_iface.can_link import open_can
from firmware_iface.clock import Clock
from firmware_iface.encoder.board import EncoderBoard
from firmware_iface.errors import ConnectionFailed, LinkError, Problems, WrongIdentity
from firmware_iface.motor.board import DigitalPins, MotorBoard
from firmware_iface.motor.bus import MotorBus
from firmware_iface.serial_link import open_serial


@dataclass(frozen=True, slots=True)
class LinkOptions:
    """Links from the command line, which replace those of arm.toml."""

    encoder_urls: tuple[str, ...] = ()
    can_interface: str | None = None
    can_channel: str | None = None
    can_options: Mapping[str, str | int] = field(default_factory=dict)


def link_options(args: argparse.Namespace) -> LinkOptions:
    """Of the command line."""
    options = dict(_option(text) for text in args.can_option or ())
    return LinkOptions(tuple(args.encoder or ()), args.can_interface, args.can_channel, options)


def _option(text: str) -> tuple[str, int | str]:
    key, equals, value = text.partition("=")
    if not (key and equals and value):
        raise ArmError(f"--can-option: expected KEY=VALUE, got {text!r}")
    return key, int(value) if value.lstrip("-").isdigit() else value


@dataclass(slots=True)
class Connection:
    """Open links and identified boards. Close it after the drives are off."""

    hardware: BoardHardware
    camera: TipCamera | None
    encoders: tuple[EncoderBoard, ...]
    motors: tuple[MotorBoard, ...]
    others: tuple[tuple[str, str], ...]  # boards of other kinds: where each is, and what it says of itself
    _closers: list[Callable[[], None]] = field(default_factory=list)

    def close(self) -> None:
        """Stop the streams and close all links."""
        for encoder in self.encoders:
            with contextlib.suppress(LinkError):
                encoder.stream(0.0)
        for close in self._closers:
            close()


def with_links(arm: Arm, options: LinkOptions) -> Arm:
    """The arm with its links replaced by those of the command line."""
    boards = arm.encoder_boards
    if options.encoder_urls:
        boards = tuple(
            replace(boards[i], port=url) if i < len(boards) else EncoderBoardPort(f"enc{i}", url)
            for i, url in enumerate(options.encoder_urls)
        )
    can = arm.can
    if options.can_interface or options.can_channel:
        can = CanBus(
            options.can_interface or (can.interface if can else "socketcan"),
            options.can_channel or (can.channel if can else "can0"),
            options=dict(options.can_options),
        )
    return replace(arm, encoder_boards=boards, can=can)


def connect(
    arm: Arm,
    clock: Clock,
    period_s: float,
    camera_port: int | None = None,
    shared_bus: Callable[[CanBus], MotorBus] | None = None,
) -> Connection:
    """Open the links, check the boards, and start the encoder streams for a cycle of `period_s`.

    `shared_bus`: opens the bus of the motor boards, or finds it open (control.hardware.connect).

    Raises:
        ConnectionFailed: names every missing port and every board that is silent or wrong.
        MissingModel: arm.toml does not describe the wiring.
    """
    _require_wiring(arm)
    opened = Opened(arm, clock, period_s)
    encoders = [board for port in arm.encoder_boards if (board := _encoder(port, opened)) is not None]
    problems = None if shared_bus is None else Problems()
    motors = _motors(opened, shared_bus, problems)
    open_boards(opened)
    end = _end_boards(motors, opened)
    camera: TipCamera | None = None
    if not opened.failures and camera_port is not None:
        with collect(opened.failures):
            camera = open_camera(arm.camera, camera_port, clock)
            opened.closers.append(camera.close)
    for encoder in encoders if not opened.failures else ():
        with collect(opened.failures):
            start_stream(encoder, period_s)
    if opened.failures:
        for close in opened.closers:
            close()
        raise ConnectionFailed(opened.failures)
    add_reference(encoders, motors, opened, problems)
    boards, others = tuple(motor for _, motor in motors), tuple(opened.identities)
    return Connection(BoardHardware(opened, end), camera, tuple(encoders), boards, others, opened.closers)


def add_reference(
    encoders: Sequence[EncoderBoard],
    motors: Sequence[tuple[MotorBus, MotorBoard]],
    opened: Opened,
    problems: list[LinkError] | None = None,
) -> None:
    """Put the reference boards before the others: what they have received waits in the kernel, and is read first.

    `encoders`: in the order of arm.toml; `motors`: in that of the drives; `problems`: of these motors alone, on a shared bus.
    """
    arm = opened.arm
    counters = [
        ReferenceEncoders(board, channels, opened.clock, opened.period_s, arm.limits.stale_s)
        for index, board in enumerate(encoders)
        if (channels := _channels(arm, index))
    ]
    opened.encoders[:0] = counters
    lines: list[Line] = [*counters]
    if motors:
        driven = [drive for drive in arm.drives if not drive.board]
        wiring = [
            DriveWiring(drive.joint - 1, motor, drive, volt_gains_of(arm, drive.joint))
            for drive, (_, motor) in zip(driven, motors, strict=True)
        ]
        drives = ReferenceDrives(opened, motors[0][0], wiring, problems)
        opened.drives.insert(0, drives)
        lines.append(drives)
    opened.lines[:0] = lines


def _channels(arm: Arm, board: int) -> dict[int, int]:
    """The channel of each joint (0-based) on an encoder board."""
    return {joint: drive.encoder_channel for joint, drive in enumerate(arm.drives) if drive.encoder_board == board}


def _require_wiring(arm: Arm) -> None:
    if len(arm.drives) != arm.joint_count:
        raise MissingModel(f"arm {arm.name}: {arm.joint_count} joints but {len(arm.drives)} [[drive]]: add the missing ones")
    if arm.can is None and not all(drive.board for drive in arm.drives):
        raise MissingModel(
            f"arm {arm.name}: no [can] bus for its motor boards: add it, or give --can-interface and --can-channel"
        )
    for drive in arm.drives:
        if drive.encoder_board >= len(arm.encoder_boards):
            raise MissingModel(
                f"arm {arm.name}: joint {drive.joint} is on encoder board {drive.encoder_board}, but there are"
                f" {len(arm.encoder_boards)}: add an [[encoder_board]], or give --encoder"
            )


def _encoder(port: EncoderBoardPort, opened: Opened) -> EncoderBoard | None:
    arm = opened.arm
    try:
        link = open_serial(port.port, port.baud)
        opened.closers.append(link.close)
        board = EncoderBoard(link, opened.clock, port.name)
        identity = board.identify(serial_number=port.serial_number)
        index = arm.encoder_boards.index(port)
        for drive in (d for d in arm.drives if d.encoder_board == index):
            if drive.encoder_channel >= identity.channels:
                raise WrongIdentity(
                    f"{board.where}: has {identity.channels} channels, but joint {drive.joint} is on channel"
                    f" {drive.encoder_channel}"
                )
            counts = identity.counts_per_turn[drive.encoder_channel]
            _compare(board.where, "counts per turn", drive.joint, drive.encoder_counts_per_rev, counts)
            _compare(board.where, "counter bits", drive.joint, drive.encoder_bits, identity.encoder_bits)
    except LinkError as error:
        opened.failures.append(error)
        return None
    return board


def _motors(
    opened: Opened, shared_bus: Callable[[CanBus], MotorBus] | None, problems: list[LinkError] | None
) -> list[tuple[MotorBus, MotorBoard]]:
    """The reference motor boards, in the order of their drives; on a shared bus with a list of `problems` of their own."""
    arm = opened.arm
    drives = [drive for drive in arm.drives if not drive.board]
    if arm.can is None or not drives:
        return []
    motors: list[tuple[MotorBus, MotorBoard]] = []
    with collect(opened.failures):
        bus = _own_bus(arm.can, opened) if shared_bus is None else shared_bus(arm.can)
        for drive in drives:
            with collect(opened.failures):
                board = MotorBoard(bus, drive.motor_node, f"joint {drive.joint}", problems)
                identity = board.identify(drive.motor_serial_number)
                if knows_motor(drive):
                    expected, counts = drive.at_motor.encoder_counts_per_rev, identity.encoder_counts_per_turn
                    _compare(board.where, "counts per turn", drive.joint, expected, counts)
                board.find_state()
                motors.append((bus, board))
    return motors


def _own_bus(can: CanBus, opened: Opened) -> MotorBus:
    link = open_can(can.interface, can.channel, can.bitrate, **can.options)
    opened.closers.append(link.close)
    return MotorBus(link, opened.clock)


def _end_boards(motors: Sequence[tuple[MotorBus, MotorBoard]], opened: Opened) -> EndBoards:
    """The gripper's board and the pins of all boards, checked against arm.toml."""
    arm = opened.arm
    gripper: GripperHardware | None = gripper_of(opened)
    if not motors:
        return EndBoards(gripper)
    bus, boards, failures = motors[0][0], {board.node: board for _, board in motors}, opened.failures
    if arm.gripper is not None and not arm.gripper.board:
        problems = Problems()
        board = MotorBoard(bus, arm.gripper.motor_node, "gripper", problems)
        with collect(failures):
            identity = board.identify(arm.gripper.motor_serial_number)
            expected, got = arm.gripper.encoder_counts_per_rev, identity.encoder_counts_per_turn
            if expected not in (0, got):
                raise WrongIdentity(
                    f"{board.where}: expected {expected} counts per motor turn (arm.toml, [gripper]), got {got}; correct"
                    " arm.toml, or the board's settings"
                )
            board.find_state()
            boards[board.node] = board
            stop = board_stop(arm, opened.period_s)
            gripper = GripperBoard(arm.gripper, board, problems, arm.limits.watchdog_s, stop)
    return EndBoards(gripper, _pins(arm, bus, boards, failures))


def _pins(arm: Arm, bus: MotorBus, boards: Mapping[int, MotorBoard], failures: list[LinkError]) -> NamedPins | None:
    """The pins; a board that was not found has failed already."""
    wanted = {pin.board for pin in arm.digital} & boards.keys()
    if not wanted:
        return None
    pins_of_node = {node: DigitalPins(bus, boards[node]) for node in sorted(wanted)}
    for node, pins in pins_of_node.items():
        with collect(failures):
            pins.require(1 + max(pin.pin for pin in arm.digital if pin.board == node))
    return NamedPins(arm.digital, pins_of_node)


def _compare(where: str, what: str, joint: int, expected: int, got: int) -> None:
    if expected != got:
        raise WrongIdentity(
            f"{where}: expected {expected} {what} (arm.toml, joint {joint}), got {got}; correct arm.toml, or the board's settings"
        )


Opener = Callable[[Sequence[Board], Opened], None]
"""Opens all boards of one kind; failures of single boards are collected. LinkError if there is no bus for any."""

OPENERS: Final[Mapping[str, Opener]] = {
    "roboclaw": roboclaw.open_boards,
    "cia402": cia402.open_boards,
    "dynamixel": DYNAMIXEL.open_boards,
    "feetech": FEETECH.open_boards,
    "moteus": moteus.open_boards,
    "odrive": odrive.open_boards,
    "vesc": vesc.open_boards,
}


def open_boards(opened: Opened) -> None:
    """Open every [[board]] that drives a joint, or the gripper as one joint more."""
    named = {drive.board for drive in opened.arm.motors}
    for kind, opener in OPENERS.items():
        boards = [board for board in opened.arm.boards if board.kind == kind and board.name in named]
        if boards:
            with collect(opened.failures):
                opener(boards, opened)


class SharedBuses:
    """The open buses of a cell, by interface and channel."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._open: dict[tuple[str, str], MotorBus] = {}
        self._failed: dict[tuple[str, str], LinkError] = {}
        self._closers: list[Callable[[], None]] = []

    def bus(self, can: CanBus) -> MotorBus:
        """The bus; opened at the first call. LinkError, the same one at each call."""
        key = (can.interface, can.channel)
        if key in self._failed:
            raise self._failed[key]
        if key not in self._open:
            try:
                link = open_can(can.interface, can.channel, can.bitrate, **can.options)
            except LinkError as error:
                self._failed[key] = error
                raise
            self._closers.append(link.close)
            self._open[key] = MotorBus(link, self._clock)
        return self._open[key]

    def close(self) -> None:
        """Close all."""
        for close in self._closers:
            close()


class CellConnection:
    """The open links of all arms, by the arms' names. Close it after the drives are off."""

    def __init__(self, of_arms: Mapping[str, Connection], buses: SharedBuses) -> None:
        self.of_arms, self._buses = of_arms, buses

    def leave_safely(self) -> None:
        """Brake if drives are still on, however the loop ended; their watchdogs would do it a little later.

        An arm that boards held when they were found, and that nobody has taken over, is left so.
        """
        for connection in self.of_arms.values():
            hardware = connection.hardware
            if hardware.is_any_enabled() and hardware.wanted is not Wanted.AS_FOUND:
                hardware.emergency_stop()
        self.close()

    def close(self) -> None:
        """Stop the streams and close all links."""
        for connection in self.of_arms.values():
            connection.close()
        self._buses.close()


def connect_cell(cell: Cell, clock: Clock, period_s: float, camera_ports: Mapping[str, int | None]) -> CellConnection:
    """Connect every arm, as `control.hardware.connect.connect` does. ConnectionFailed names what failed of any arm."""
    buses = SharedBuses(clock)
    opened: dict[str, Connection] = {}
    failures: list[LinkError] = []
    try:
        for placed in cell.arms:
            try:
                opened[placed.name] = connect(
                    placed.arm, clock, period_s, camera_ports.get(placed.name), buses.bus if len(cell.arms) > 1 else None
                )
            except ConnectionFailed as error:
                failures += error.failures
        if failures:
            raise ConnectionFailed(failures)
    except BaseException:
        CellConnection(opened, buses).close()
        raise
    return CellConnection(opened, buses)


# The loop's clock: while it waits for the next cycle, boards that speak only when they are asked are served.


class Attendant(Protocol):
    """Waits, and serves boards meanwhile: the hardware of an arm, or all arms of a loop."""

    def attend(self, until_s: float) -> None:
        """Wait until then."""
        ...


class AttendedClock:
    """A `firmware_iface.clock.Clock` whose waiting is done by an attendant."""

    def __init__(self, clock: Clock, attendant: Attendant) -> None:
        self.now_s = clock.now_s
        self.wait_until_s = attendant.attend

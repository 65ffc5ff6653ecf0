"""What fuzzers throw at bought boards: frames and packets of any content, while the host asks and while it commands."""

from __future__ import annotations

import contextlib
import struct
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from control.hardware.bought.can_node import CountingNode, NodeEncoder
from control.hardware.bought.smart_servo import ServoEncoder
from control.hardware.interface import Feedback
from firmware_iface import canopen_wire, dynamixel_wire, feetech_wire
from firmware_iface import roboclaw as claw_wire
from firmware_iface import vesc as vesc_wire
from firmware_iface.canopen import CanOpenBus, Cia402Drive
from firmware_iface.dynamixel import DynamixelLine, DynamixelServo
from firmware_iface.errors import ArmwrightError
from firmware_iface.feetech import FeetechLine, FeetechServo
from firmware_iface.moteus import Moteus, MoteusBus
from firmware_iface.motor.cia402 import DriveState
from firmware_iface.odrive import OdriveAxis, OdriveBus, OdriveCommand
from firmware_iface.roboclaw import PacketLine, RoboClaw
from firmware_iface.vesc import FILLS, TO_HOST, Packet, Vesc, VescBus

STEP_s = 0.02  # of time at each wait: a conversation ends after some dozen
NODE = 1
AT_ONCE = 3  # frames in a cycle
_COUNT = struct.Struct("<i")  # as the recording packs it
Frame = tuple[int, bytes]


class Time:
    """A clock that only waiting turns."""

    def __init__(self) -> None:
        self._now_s = 1.0

    def now_s(self) -> float:
        return self._now_s

    def wait_until_s(self, t: float) -> None:
        self._now_s = max(t, self._now_s + STEP_s)


class FrameLine:
    """A CAN bus on which frames wait."""

    name = "bus"

    def __init__(self, frames: Iterator[Frame]) -> None:
        self.waiting = deque(frames)

    def send(self, can_id: int, payload: bytes) -> None:
        assert 0 <= can_id < 1 << 29

    def receive(self) -> list[Frame]:
        return [self.waiting.popleft() for _ in range(min(AT_ONCE, len(self.waiting)))]

    def close(self) -> None:
        pass


def pieces(content: bytes, most: int) -> Iterator[tuple[int, bytes]]:
    """A number, a length and so many bytes, again and again."""
    at = 0
    while at + 2 <= len(content):
        end = at + 2 + content[at + 1] % (most + 1)
        yield content[at], content[at + 2 : end]
        at = end


def frames(content: bytes, ids: Sequence[int], most: int = 8) -> Iterator[Frame]:
    """The pieces as frames with these ids."""
    return ((ids[number % len(ids)], payload) for number, payload in pieces(content, most))


def packed(ids: Sequence[int], said: Sequence[Frame]) -> bytes:
    """Frames as bytes that `frames` unpacks."""
    return b"".join(bytes((ids.index(can_id), len(payload))) + payload for can_id, payload in said)


def _converse(steps: Sequence[Callable[[], object]]) -> None:
    """Each step of a conversation; one that fails says so in one of our errors."""
    for step in steps:
        with contextlib.suppress(ArmwrightError):
            step()


def _drain(line: FrameLine, update: Callable[[], object], node: CountingNode) -> None:
    """Cycles until nothing waits any more; a count always fits where the recording has it."""
    encoder, feedback = NodeEncoder(node, 0), Feedback(1)
    encoder.offset = 1 << 30
    for _ in range(len(line.waiting) + 1):
        with contextlib.suppress(ArmwrightError):
            update()
        encoder.take(feedback)
        _COUNT.pack(feedback.count[0])


MOTEUS_IDS = (NODE << 8, NODE << 8 | 2, 0x7FF)


def moteus(content: bytes) -> None:
    """Replies of a moteus."""
    line, clock = FrameLine(frames(content, MOTEUS_IDS, 64)), Time()
    bus = MoteusBus(line, clock)
    board = Moteus(bus, NODE, "x", 4096)
    _converse((lambda: board.identify(2), lambda: board.setting("motor.Kv"), board.reset_fault))
    _drain(line, bus.update, board)


ODRIVE_IDS = (*(NODE << 5 | command for command in OdriveCommand), NODE << 5 | 0x1F, 2 << 5)


def odrive(content: bytes) -> None:
    """Messages of an ODrive."""
    line, clock = FrameLine(frames(content, ODRIVE_IDS)), Time()
    bus = OdriveBus(line, clock)
    axis = OdriveAxis(bus, NODE, "x", 8192)
    _converse((axis.identify, axis.clear_errors))

    def cycle() -> None:
        axis.want_count(axis.count)
        bus.flush()
        bus.update()

    _drain(line, cycle, axis)


VESC_IDS = (*(packet << 8 | NODE for packet in Packet), *(packet << 8 | vesc_wire.HOST for packet in (*TO_HOST, *FILLS)), 0x1F01)


def vesc(content: bytes) -> None:
    """Messages of a VESC."""
    line, clock = FrameLine(frames(content, VESC_IDS)), Time()
    bus = VescBus(line, clock)
    board = Vesc(bus, NODE, "x")
    _converse((board.identify, lambda: board.is_well_within(STEP_s)))

    def cycle() -> None:
        bus.flush()
        bus.update()

    _drain(line, cycle, board)


CANOPEN_IDS = tuple(
    base + NODE
    for base in (
        canopen_wire.TPDO_1,
        canopen_wire.TPDO_2,
        canopen_wire.EMERGENCY,
        canopen_wire.SDO_ANSWER,
        canopen_wire.HEARTBEAT,
        canopen_wire.RPDO_1,
        canopen_wire.SDO_ANSWER + 1,
    )
)


def cia402(content: bytes) -> None:
    """Frames of a CiA 402 drive."""
    line, clock = FrameLine(frames(content, CANOPEN_IDS)), Time()
    bus = CanOpenBus(line, clock)
    drive = Cia402Drive(bus, NODE, "x")
    asked: tuple[Callable[[], object], ...] = (
        drive.identify,
        lambda: drive.set_up(0.004, 0.2),
        drive.await_count,
        lambda: drive.acknowledge_fault(STEP_s),
    )
    _converse(asked)

    def cycle() -> None:
        drive.limit_current(5.0, 100.0)
        drive.step_towards(DriveState.OPERATION_ENABLED)
        bus.flush()
        bus.update()

    _drain(line, cycle, drive)
    assert drive.error_text()


Sealed = Callable[[bytes, bytes], bytes]


class PacketBytes:
    """A serial line on which each request is answered by the next piece: as it is, or with a right checksum."""

    name, baud = "line", 1_000_000

    def __init__(self, content: bytes, sealed: Sealed) -> None:
        """`sealed(request, piece)` makes an answer of a piece."""
        self.waiting = deque(pieces(content, 127))
        self._sealed = sealed
        self._incoming = b""

    def read(self) -> bytes:
        received, self._incoming = self._incoming, b""
        return received

    def write(self, data: bytes) -> None:
        if self.waiting:
            how, piece = self.waiting.popleft()
            self._incoming = piece if how & 1 else self._sealed(data, piece)

    def close(self) -> None:
        pass


def _ask_all(line: PacketBytes, cycle: Callable[[], object]) -> None:
    for _ in range(len(line.waiting) + 1):
        with contextlib.suppress(ArmwrightError):
            cycle()


def _servo(kind: Any, line_of: Any, sealed: Sealed, content: bytes) -> None:
    wire, clock = PacketBytes(content, sealed), Time()
    line = line_of(wire, clock)
    servo = kind(line, NODE, "x")

    def cycle() -> None:
        servo.post_torque(True)
        line.post_cycle()
        line.update()
        line.attend()
        clock.wait_until_s(0.0)

    _converse((servo.identify, lambda: servo.set_up(0.1), servo.require_force_limit, servo.reboot))
    _ask_all(wire, cycle)
    encoder, feedback = ServoEncoder(servo, 0), Feedback(1)
    encoder.offset = 1 << 30
    encoder.take(feedback)
    _COUNT.pack(feedback.count[0])


def dynamixel(content: bytes) -> None:
    """Status packets of a Dynamixel."""
    _servo(DynamixelServo, DynamixelLine, lambda _, piece: dynamixel_wire.packet(NODE, 0x55, piece), content)


def feetech(content: bytes) -> None:
    """Status packets of a Feetech servo."""

    def sealed(_: bytes, piece: bytes) -> bytes:
        return feetech_wire.packet(NODE, piece[0] if piece else 0, piece[1:])

    _servo(FeetechServo, FeetechLine, sealed, content)


def roboclaw(content: bytes) -> None:
    """Answers of a RoboClaw."""

    def sealed(request: bytes, piece: bytes) -> bytes:
        return claw_wire.command_packet(request[0], request[1], piece)[2:]

    wire, clock = PacketBytes(content, sealed), Time()
    line = PacketLine(wire, clock)
    board = RoboClaw(line, 0x80, "x")

    def cycle() -> None:
        board.post_duties()
        board.post_cycle()
        line.update()
        line.attend()
        clock.wait_until_s(0.0)

    _converse(
        (
            board.identify,
            lambda: board.require_quadrature(1),
            lambda: board.require_home_switch(1),
            lambda: board.set_up(0.2, (8.0, 8.0)),
            board.read_counts,
            board.read_status,
            lambda: board.set_count(1, -1),
        )
    )
    _ask_all(wire, cycle)
    assert all(abs(count) <= 1 << 31 for count in board.counts)


BOUGHT: dict[str, Callable[[bytes], None]] = {
    "cia402": cia402,
    "dynamixel": dynamixel,
    "feetech": feetech,
    "moteus": moteus,
    "odrive": odrive,
    "roboclaw": roboclaw,
    "vesc": vesc,
}

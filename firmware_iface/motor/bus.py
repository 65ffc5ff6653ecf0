"""The CAN bus of the motor boards: drained once a cycle; frames are dispatched to the boards by id."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from firmware_iface.clock import Clock
from firmware_iface.errors import AnotherHost, LinkLost, MisuseError, Problems, ProtocolViolation
from firmware_iface.link import FrameLink
from firmware_iface.motor import wire
from firmware_iface.motor.wire import (
    MotorParameter,
    Operation,
    ParameterAnswer,
    ParameterRequest,
    ParameterResult,
)

FrameHandler = Callable[[bytes, float], None]
"""Takes a payload and the time it was read [s]. Appends to `MotorBus.problems`, never raises."""

_OF_HOSTS = (wire.COMMAND_ID, wire.PARAMETER_REQUEST_ID, wire.DIGITAL_COMMAND_ID)
_KEEP_EVERY_s = 0.05  # a quarter of the usual watchdog
_EMERGENCY_REPEATS = 3  # docs/motor_board.md: sent three times, so that one lost frame does not matter


class MotorBus:
    """One bus with its boards; the boards are created on it."""

    def __init__(self, link: FrameLink, clock: Clock) -> None:
        self.link = link
        self.clock = clock
        self.name = link.name
        self.nodes: list[int] = []
        self.strangers = 0
        """Frames from unknown nodes."""
        self.foreign_emergency_stops = 0
        self.problems = Problems()
        self.keepers: list[Callable[[], None]] = []
        """What a conversation with one board calls for each board now and then."""
        self._waited_until_s = self._kept_at_s = -math.inf
        self._handlers: dict[int, FrameHandler] = {}

    def add_node(self, node: int, take_reply: FrameHandler, take_answer: FrameHandler) -> None:
        """Dispatch the frames of `node` to its board from now on. Raises MisuseError."""
        if node not in wire.NODES:
            raise MisuseError(f"CAN bus {self.name}: node ids are 1 to 15, got {node}")
        if node in self.nodes:
            raise MisuseError(f"CAN bus {self.name}: node {node} is assigned to two motor boards")
        self.nodes.append(node)
        self._handlers[wire.REPLY_ID + node] = take_reply
        self._handlers[wire.PARAMETER_ANSWER_ID + node] = take_answer

    def add_digital(self, node: int, take_digital: FrameHandler) -> None:
        """Dispatch the DIGITAL_REPLYs of `node` from now on."""
        self._handlers[wire.DIGITAL_REPLY_ID + node] = take_digital

    def update(self) -> None:
        """Process everything received. Raises LinkLost, and once per event BoardReset or ProtocolViolation.

        The rest of what was received is processed even if this raises.
        """
        frames = self.link.receive()
        if frames:
            now_s = self.clock.now_s()
            for can_id, payload in frames:
                handler = self._handlers.get(can_id)
                if handler is not None:
                    handler(payload, now_s)
                else:
                    self._take_other(can_id, payload)
        if self.problems:
            raise self.problems.pop(0)

    def wait(self, until_s: float) -> None:
        """Let time pass in a conversation with one board, and process what arrives.

        The others hear nothing from the loop meanwhile: they are kept from their watchdogs.
        """
        now_s = self.clock.now_s()
        if now_s - self._waited_until_s > _KEEP_EVERY_s:
            self._kept_at_s = now_s  # a conversation begins
        elif now_s - self._kept_at_s >= _KEEP_EVERY_s:
            self._kept_at_s = now_s
            for keep in self.keepers:
                keep()
        self.clock.wait_until_s(until_s)
        self._waited_until_s = until_s
        self.update()

    def emergency_stop(self, reason: int = 0) -> None:
        """Make every board brake and go to FAULT immediately; may be repeated.

        `reason`: 0 operator, 1 fault of the host, 2 fault of another board.
        Raises LinkLost if it could not be sent.
        """
        payload = bytes((reason & 0xFF,))
        failures = Problems()
        for _ in range(_EMERGENCY_REPEATS):
            try:
                self.link.send(wire.EMERGENCY_STOP_ID, payload)
            except LinkLost as lost:
                failures.append(lost)
        if failures:
            raise failures.pop()

    def _take_other(self, can_id: int, payload: bytes) -> None:
        node = can_id & 0x7F
        if can_id == wire.EMERGENCY_STOP_ID:
            self.foreign_emergency_stops += 1
        elif node in self.nodes and can_id - node in _OF_HOSTS:
            violation = AnotherHost if can_id - node == wire.COMMAND_ID else ProtocolViolation
            self.problems.append(
                violation(
                    f"CAN bus {self.name}: another program commands node {node} (id {can_id:#05x}); "
                    "stop the other program",
                    payload,
                )
            )
        else:
            self.strangers += 1


ANSWER_WAIT_s = 0.06  # a board answers within 5 ms; hosts are late by tens of milliseconds at times
_STEP_s = 0.001
_SEQUENCE = 200  # far from the values where drivers start


@dataclass(slots=True)
class BusScan:
    """Result of a bus scan. Serial numbers by node; several if boards share a node id."""

    serial_numbers: dict[int, list[int]] = field(default_factory=dict)
    commanded: set[int] = field(default_factory=set)
    """Nodes that another host sends COMMANDs or requests to."""
    strangers: int = 0
    """Number of frames with ids that no motor board uses."""


def listen(link: FrameLink, clock: Clock, duration_s: float) -> BusScan:
    """Listen without sending, to detect other hosts on the bus. Raises LinkLost."""
    scan = BusScan()
    end_s = clock.now_s() + duration_s
    while clock.now_s() < end_s:
        clock.wait_until_s(clock.now_s() + _STEP_s)
        for can_id, payload in link.receive():
            _take(scan, can_id, payload)
    return scan


def scan_nodes(link: FrameLink, clock: Clock, wait_s: float = ANSWER_WAIT_s) -> BusScan:
    """Request the serial number of every node and collect the answers. Raises LinkLost."""
    link.receive()
    for node in wire.NODES:
        request = ParameterRequest(Operation.READ, MotorParameter.BOARD_SERIAL_NUMBER, _SEQUENCE, 0)
        link.send(wire.PARAMETER_REQUEST_ID + node, request.pack())
    return listen(link, clock, wait_s)


def _take(scan: BusScan, can_id: int, payload: bytes) -> None:
    node = can_id & 0x7F
    kind = can_id - node
    if node not in wire.NODES or kind not in _KINDS:
        scan.strangers += can_id != wire.EMERGENCY_STOP_ID
    elif kind in (wire.COMMAND_ID, wire.PARAMETER_REQUEST_ID):
        scan.commanded.add(node)
    elif kind == wire.PARAMETER_ANSWER_ID and len(payload) == 8:
        answer = ParameterAnswer.unpack(payload)
        is_ours = (answer.sequence, answer.index) == (_SEQUENCE, MotorParameter.BOARD_SERIAL_NUMBER)
        if is_ours and answer.result == ParameterResult.DONE:
            scan.serial_numbers.setdefault(node, []).append(answer.value & 0xFFFFFFFF)


_KINDS = (wire.COMMAND_ID, wire.REPLY_ID, wire.PARAMETER_REQUEST_ID, wire.PARAMETER_ANSWER_ID)

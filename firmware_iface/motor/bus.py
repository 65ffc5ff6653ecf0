"""The CAN bus of the motor boards: drained once a cycle; frames are dispatched to the boards by id.
A board's parameters are read and written by requests that wait for their answers.
"""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from firmware_iface.clock import Clock
from firmware_iface.errors import AnotherHost, BoardRefused, BoardSilent, LinkLost, MisuseError, Problems, ProtocolViolation
from firmware_iface.link import FrameLink
from firmware_iface.motor import wire
from firmware_iface.motor.wire import MotorParameter, Operation, ParameterAnswer, ParameterRequest, ParameterResult

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
                    f"CAN bus {self.name}: another program commands node {node} (id {can_id:#05x}); stop the other program",
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


def scan_nodes(link: FrameLink, clock: Clock) -> BusScan:
    """Request the serial number of every node and collect the answers. Raises LinkLost."""
    link.receive()
    for node in wire.NODES:
        request = ParameterRequest(Operation.READ, MotorParameter.BOARD_SERIAL_NUMBER, _SEQUENCE, 0)
        link.send(wire.PARAMETER_REQUEST_ID + node, request.pack())
    return listen(link, clock, ANSWER_WAIT_s)


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


ANSWER_TIMEOUT_s = 0.05  # the board answers within 5 ms; hosts are late by tens of milliseconds at times
ATTEMPTS = 3
_ANSWER_STEP_s = 0.001
_REMEDIES: dict[int, str] = {
    ParameterResult.UNKNOWN_INDEX: "; its firmware is older than this program: update it to one that has the parameters of"
    " docs/motor_board.md, without which the board could not stop and hold the arm by itself"
}
_SECOND_REPLY_WAIT_s = 0.003  # a second board with the same node id answers at most this much later


class ParameterChannel:
    """The parameters of one node. `where` names the board for messages."""

    def __init__(self, bus: MotorBus, node: int, where: Callable[[], str]) -> None:
        self._bus = bus
        self._request_id = wire.PARAMETER_REQUEST_ID + node
        self._where = where
        self._sequence = 0
        self._answer: ParameterAnswer | None = None

    def take(self, answer: ParameterAnswer) -> None:
        """Process an answer."""
        self._answer = answer

    def read(self, index: int) -> int:
        """Read the raw value. Raises RequestRefused, BoardSilent."""
        return self._ask(Operation.READ, index, 0)

    def begin_read(self, index: int) -> None:
        """Ask for the raw value without waiting; `taken` has it once it has come."""
        self._sequence = self._sequence % 255 + 1
        self._answer = None
        payload = ParameterRequest(Operation.READ, index, self._sequence, 0).pack()
        self._bus.link.send(self._request_id, payload)

    def taken(self, index: int) -> int | None:
        """The value that `begin_read` asked for, once; None if it has not come."""
        answer = self._answer_of(index)
        if answer is None or answer.result != ParameterResult.DONE:
            return None
        self._answer = None
        return answer.value

    def write(self, index: int, value: int) -> None:
        """Set the raw value. Raises RequestRefused, BoardSilent, ProtocolViolation if the board reports another."""
        stored = self._ask(Operation.WRITE, index, value)
        if stored != value and index != MotorParameter.POSITION_COUNT:  # the count is live and may have changed
            raise ProtocolViolation(f"{self._where()}: {_named(index)} is {stored} after {value} was written")

    def require_single_board(self, index: int) -> None:
        """Raises ProtocolViolation if the last request for `index` is answered a second time."""
        self._answer = None
        self._bus.wait(self._bus.clock.now_s() + _SECOND_REPLY_WAIT_s)
        if (second := self._answer_of(index)) is not None:
            raise ProtocolViolation(
                f"{self._where()}: two boards answer, the second with serial number "
                f"{second.value & 0xFFFFFFFF}; give each board a unique node id",
                second.pack(),
            )

    def _ask(self, operation: Operation, index: int, value: int) -> int:
        sequence = self._sequence % 255 + 1  # 0 marks an unsolicited answer
        try:
            payload = ParameterRequest(operation, index, sequence, value).pack()
        except struct.error as problem:
            raise MisuseError(f"{self._where()}: cannot ask for {index} := {value}: {problem}") from None
        self._sequence = sequence
        answer = self._answer_to(payload, index)
        if answer.result != ParameterResult.DONE:
            wanted = f" to {value}" if operation is Operation.WRITE else ""
            raise BoardRefused(
                f"{self._where()}: refused to {operation.name.lower()} {_named(index)}{wanted}: "
                f"{_result_name(answer.result)}{_REMEDIES.get(answer.result, '')}"
            )
        return answer.value

    def _answer_to(self, payload: bytes, index: int) -> ParameterAnswer:
        clock = self._bus.clock
        self._answer = None
        for _ in range(ATTEMPTS):
            self._bus.link.send(self._request_id, payload)
            deadline_s = clock.now_s() + ANSWER_TIMEOUT_s
            while (now_s := clock.now_s()) < deadline_s:
                self._bus.wait(now_s + _ANSWER_STEP_s)
                if (answer := self._answer_of(index)) is not None:
                    return answer
        raise BoardSilent(
            f"{self._where()}: no answer for {_named(index)} within {ANSWER_TIMEOUT_s:.3f} s, "
            f"asked {ATTEMPTS} times; check its supply, wiring and node id"
        )

    def _answer_of(self, index: int) -> ParameterAnswer | None:
        answer = self._answer  # answers to older requests have another sequence
        is_ours = answer is not None and (answer.sequence, answer.index) == (self._sequence, index)
        return answer if is_ours else None


def _named(index: int) -> str:
    known = index in set(MotorParameter)
    return f"parameter {index} ({MotorParameter(index).name})" if known else f"parameter {index}"


def _result_name(result: int) -> str:
    known = result in set(ParameterResult)
    return ParameterResult(result).name.replace("_", " ").lower() if known else f"result {result}"

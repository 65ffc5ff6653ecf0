"""Finds the motor boards on a CAN bus: reads the identity of every node. This neither moves nor enables anything."""

from dataclasses import dataclass, field

from firmware_iface.clock import Clock
from firmware_iface.link import FrameLink
from firmware_iface.motor import wire
from firmware_iface.motor.wire import (
    MotorParameter,
    Operation,
    ParameterAnswer,
    ParameterRequest,
    ParameterResult,
)

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

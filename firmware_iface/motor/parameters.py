"""Reading and writing a motor board's parameters: requests that wait for their answers."""

import struct
from collections.abc import Callable

from firmware_iface.errors import BoardRefused, BoardSilent, MisuseError, ProtocolViolation
from firmware_iface.motor import wire
from firmware_iface.motor.bus import MotorBus
from firmware_iface.motor.wire import (
    MotorParameter,
    Operation,
    ParameterAnswer,
    ParameterRequest,
    ParameterResult,
)

ANSWER_TIMEOUT_s = 0.05  # the board answers within 5 ms; hosts are late by tens of milliseconds at times
ATTEMPTS = 3
_STEP_s = 0.001
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
        if (
            stored != value and index != MotorParameter.POSITION_COUNT
        ):  # the count is live and may have changed
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
                self._bus.wait(now_s + _STEP_s)
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

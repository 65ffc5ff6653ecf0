"""A half-duplex line of smart servos: instructions and their status packets, one goal position for each servo a cycle."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Protocol

from firmware_iface.clock import Clock
from firmware_iface.errors import LinkError
from firmware_iface.link import ByteLink
from firmware_iface.polled_line import WRONG, PolledLine, Question, Unfinished

ANSWER_TIMEOUT_s = 0.01  # return delay 0.5 ms by default, and the latency of a USB adapter


class Instruction(IntEnum):
    """Instructions that are used here. Dynamixel's protocol 2.0 and Feetech's have one set of numbers."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class StatusPacket(NamedTuple):
    """A status packet: who, the error byte, and the parameters; and how many bytes it took."""

    servo: int
    error: int
    parameters: bytes
    length: int


@dataclass(frozen=True, slots=True, eq=False)
class ServoQuestion:
    """An instruction to one servo and its status packet; meets `firmware_iface.polled_line.Question`.

    `status_in` finds the packet in what was received: None if it is not complete, ValueError if it is damaged.
    """

    servo: int
    made: Callable[[], bytes]
    parameter_bytes: int
    taken: Callable[[bytes, float], None]
    status_in: Callable[[bytes], StatusPacket | None]
    overhead: int

    @property
    def answer_bytes(self) -> int:
        """The bytes of the status packet."""
        return self.overhead + self.parameter_bytes

    def packet(self) -> bytes:
        """The bytes to send."""
        return self.made()

    def answered(self, received: bytes) -> bytes | None:
        """Error byte and parameters. Raises Unfinished. An adapter's echo of the instruction is passed over."""
        status = self.status(received.removeprefix(self.made()))
        return WRONG if status is None else bytes((status.error,)) + status.parameters

    def status(self, received: bytes) -> StatusPacket | None:
        """The servo's status packet at the begin of what was received, None if it is not right. Raises Unfinished."""
        try:
            status = self.status_in(received)
        except ValueError:
            return None
        if status is None:
            raise Unfinished
        is_right = status.servo == self.servo and len(status.parameters) == self.parameter_bytes
        return status if is_right else None

    def take(self, data: bytes, sent_at_s: float) -> None:
        """Use the answer."""
        self.taken(data, sent_at_s)


class ForceLimit:
    """A limit that a servo keeps: written when it changes, and again until the servo has said that it has it."""

    def __init__(self, line: "ServoLine", written: Callable[[int, Callable[[], None]], ServoQuestion]) -> None:
        """`written`: the instruction that writes a value, and what to call when it is answered."""
        self._line, self._written = line, written
        self._wanted: tuple[int, ServoQuestion] | None = None
        self._has: int | None = None

    def keep(self, value: int) -> None:
        """Let the servo have this value; does not wait."""
        if self._wanted is None or self._wanted[0] != value:
            self._wanted = value, self._written(value, lambda: self._confirm(value))
        if self._has != value:
            self._line.post(self._wanted[1])

    def forget(self) -> None:
        """The servo may have lost it."""
        self._has = None

    def _confirm(self, value: int) -> None:
        self._has = value


class LineServo(Protocol):
    """A servo as its line sees it."""

    problems: list[LinkError]
    goal: int | None

    @property
    def values_question(self) -> ServoQuestion:
        """What it measures; asked alone where not all servos were heard at once."""
        ...

    @property
    def state_question(self) -> ServoQuestion:
        """Asked of one servo a cycle, in turn, if it is another question."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class GoalPositions:
    """One packet with all goal positions of a line; it has no answer."""

    made: Callable[[], bytes]
    answer_bytes: int = 0

    def packet(self) -> bytes:
        """The bytes to send."""
        return self.made()

    def answered(self, received: bytes) -> bytes | None:
        """There is no answer."""
        return b""

    def take(self, data: bytes, sent_at_s: float) -> None:
        """There is no answer."""


@dataclass(frozen=True, slots=True, eq=False)
class ValuesOfAll:
    """One instruction for the values of all servos of a line, which answer one after the other."""

    servos: Sequence[LineServo]
    made: Callable[[], bytes]

    @property
    def answer_bytes(self) -> int:
        """The bytes of all status packets."""
        return sum(servo.values_question.answer_bytes for servo in self.servos)

    def packet(self) -> bytes:
        """The bytes to send."""
        return self.made()

    def answered(self, received: bytes) -> bytes | None:
        """Error byte and parameters of each servo. Raises Unfinished, also if one of them does not answer."""
        if len(received) < self.answer_bytes:
            raise Unfinished
        received, answers = received.removeprefix(self.made()), b""
        for servo in self.servos:
            status = servo.values_question.status(received)
            if status is None:
                return WRONG
            answers += bytes((status.error,)) + status.parameters
            received = received[status.length :]
        return answers

    def take(self, data: bytes, sent_at_s: float) -> None:
        """Use the answers."""
        for servo in self.servos:
            end = 1 + servo.values_question.parameter_bytes
            servo.values_question.take(data[:end], sent_at_s)
            data = data[end:]


class ServoLine(PolledLine):
    """A line with servos. Their values are asked for together in the rest of each cycle."""

    def __init__(
        self, link: ByteLink, clock: Clock, servos: Sequence[LineServo], goals: Callable[[], bytes], values: Callable[[], bytes]
    ) -> None:
        """`servos`: may grow. `goals` makes the packet of the goals that are set, `values` the one that asks for values."""
        super().__init__(link, clock, ANSWER_TIMEOUT_s)
        self._servos = servos
        self._goals = GoalPositions(goals)
        self._values = ValuesOfAll(servos, values)
        self.keep_asking(self._values)
        self._turn = 0

    def post_cycle(self) -> None:
        """Queue the goal positions, if there are any, and one servo's state in turn if its values do not tell it."""
        if any(servo.goal is not None for servo in self._servos):
            self.post(self._goals)
        self.post_starved()
        servo = self._servos[self._turn]
        if servo.state_question is not servo.values_question:
            self.post(servo.state_question)
        self._turn = (self._turn + 1) % len(self._servos)

    def _miss(self, question: Question) -> None:
        """Where not all were heard together, each is asked alone: one that is silent must not silence the others."""
        if question is self._values:
            for servo in self._servos:
                self.post(servo.values_question)

    def ask(self, question: ServoQuestion, answers: list[bytes], where: str, what: str, remedy: str) -> bytes:
        """Ask outside of the cycle: the answer, which `question` puts into `answers`. Raises BoardSilent."""
        self.converse(question, lambda: bool(answers), f"{where}: no answer to {what}", remedy)
        return answers[0]

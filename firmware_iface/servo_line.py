"""A half-duplex line of smart servos: instructions and their status packets, one goal position for each servo a cycle."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from firmware_iface.clock import Clock
from firmware_iface.errors import LinkError
from firmware_iface.link import ByteLink
from firmware_iface.polled_line import WRONG, PolledLine, Unfinished

ANSWER_TIMEOUT_s = 0.01  # return delay 0.5 ms by default, and the latency of a USB adapter


class Status(NamedTuple):
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
    status_in: Callable[[bytes], Status | None]
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
        received = received.removeprefix(self.made())
        try:
            status = self.status_in(received)
        except ValueError:
            return WRONG
        if status is None:
            raise Unfinished
        if status.servo != self.servo or len(status.parameters) != self.parameter_bytes:
            return WRONG
        return bytes((status.error,)) + status.parameters

    def take(self, data: bytes, sent_at_s: float) -> None:
        """Use the answer."""
        self.taken(data, sent_at_s)


class ForceLimit:
    """A limit that a servo keeps: written when it changes, and again until the servo has said that it has it."""

    def __init__(
        self, line: "ServoLine", written: Callable[[int, Callable[[], None]], ServoQuestion]
    ) -> None:
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

    @property
    def state_question(self) -> ServoQuestion:
        """Asked of one servo a cycle, in turn."""
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


class ServoLine(PolledLine):
    """A line with servos."""

    def __init__(
        self, link: ByteLink, clock: Clock, servos: Sequence[LineServo], goals: Callable[[], bytes]
    ) -> None:
        """`servos`: may grow; `goals` makes the packet of their goal positions."""
        super().__init__(link, clock, ANSWER_TIMEOUT_s)
        self._servos = servos
        self._goals = GoalPositions(goals)
        self._turn = 0

    def post_cycle(self) -> None:
        """Queue the goal positions, and one servo's state in turn; the values are asked for in the rest of the cycle."""
        self.post(self._goals)
        self.post_starved()
        self.post(self._servos[self._turn].state_question)
        self._turn = (self._turn + 1) % len(self._servos)

    def ask(self, question: ServoQuestion, answers: list[bytes], where: str, what: str, remedy: str) -> bytes:
        """Ask outside of the cycle: parameters of the answer, which `question` puts into `answers`. Raises BoardSilent."""
        self.converse(question, lambda: bool(answers), f"{where}: no answer to {what}", remedy)
        return answers[0][1:]

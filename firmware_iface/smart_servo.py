"""Smart servos on a half-duplex line, seen from the host: what Dynamixel and Feetech servos have in common.

The line carries instructions and their status packets, one goal position for each servo a cycle.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Final, NamedTuple, Protocol

from firmware_iface.clock import Clock
from firmware_iface.errors import BoardRefused, BoardReset, BoardSilent, LinkError, MisuseError, Problems, WrongIdentity
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


class ServoWire(Protocol):
    """The instructions of a kind of servos: its `wire` module."""

    @property
    def IDS(self) -> range: ...
    @property
    def STATUS_OVERHEAD(self) -> int: ...
    def read(self, servo: int, address: int, count: int) -> bytes: ...
    def write(self, servo: int, address: int, data: bytes) -> bytes: ...
    def status_in(self, received: bytes) -> StatusPacket | None: ...
    def refusal(self, error: int) -> str | None: ...


EVERYWHERE: Final = range(-(1 << 31), 1 << 31)


class SmartServo(ABC):
    """Keeps the latest values of a servo and its goal; times are the host's, when the request was sent."""

    CALLED: ClassVar[str]
    WIRE: ClassVar[ServoWire]
    TORQUE: ClassVar[int]  # address of the switch
    DELAY: ClassVar[int]  # address of the return delay time
    FORCE: ClassVar[int]  # address of what limits the force, two bytes
    values_question: ServoQuestion
    state_question: ServoQuestion
    REMEDY: ClassVar[str] = ""  # what else to check if it does not answer
    ERRORS: ClassVar[Mapping[int, str]]  # bits of its hardware error

    def __init__(self, line: ServoLine, number: int, name: str) -> None:
        ids = self.WIRE.IDS
        if number not in ids:
            raise MisuseError(f'{self.CALLED} "{name}": ids are 0 to {ids.stop - 1}, got {number}')
        self.number, self.name = number, name
        self.position = 0
        self.goal: int | None = None
        """The goal position of the next cycle; None: it gets none, as every servo whose torque is not on."""
        self.current_A = 0.0
        """Not a number where it measures none: then `load`, the share of the supply that is on its motor, and its speed."""
        self.load = self.speed_rad_s = math.nan
        self.supply_V = math.nan
        self.temperature_degC = 0.0
        self.at_s = -math.inf
        self.late_s = 0.0  # by how much younger its values may be
        self.is_torque_on: bool | None = None
        self.hardware_error = self.frees_at = self.weakens_at = 0
        """The errors that it has; those at which it lets its joint go, and those at which it holds on with less torque, as stored
        in it. Both end with a restart. At any other it holds on as before.
        """
        self.model_name = ""
        self.bears_V = (0.0, math.inf)
        """Its supply, by the limits that are stored in it; 0 and 0 where none are."""
        self.return_delay_s = 0.0
        """By which it waits with each answer."""
        self.is_watchdog_expired = False
        self.resets = 0
        self.known = self.reached = EVERYWHERE  # counts: of the turn it knows at power-up; that its goals keep to
        self.problems: list[LinkError] = Problems()
        self._line = line
        self._force = ForceLimit(line, self._force_written)
        self._torque = {
            False: self._writing(self.TORQUE, lambda: b"\0", lambda: None),
            True: self._writing(self.TORQUE, self._switching_on, lambda: None),
        }

    @property
    def where(self) -> str:
        """Name in messages: `Dynamixel "elbow" (id 3) on /dev/ttyUSB0`."""
        return f'{self.CALLED} "{self.name}" (id {self.number}) on {self._line.name}'

    def _switching_on(self) -> bytes:
        """What is written at TORQUE to switch it on where the joint is."""
        return b"\x01"

    def post_torque(self, is_on: bool) -> None:
        """Queue switching the torque, if it is not so already; the opposite that still waits is withdrawn."""
        self._line.withdraw(self._torque[not is_on])
        if self.is_torque_on is not is_on:
            self._line.post(self._torque[is_on])
            self._line.post(self.state_question)

    @abstractmethod
    def identify(self) -> str:
        """Ask model, mode and what is stored of its position, and return them in words. Raises BoardSilent, WrongIdentity."""

    @abstractmethod
    def set_up(self, watchdog_s: float) -> None:
        """Set what a restart loses. Nothing is stored, and the torque stays as it is."""

    @abstractmethod
    def read_state(self) -> None:
        """Torque, errors, and all values as they are now."""

    @abstractmethod
    def reboot(self) -> None:
        """End a hardware error; its torque is off then."""

    @abstractmethod
    def require_force_limit(self) -> None:
        """Raise WrongIdentity if the servo is set up to keep none."""

    @property
    def _force_at(self) -> int:
        """Where its limit of the force is written."""
        return self.FORCE

    @abstractmethod
    def limit_force(self, current_A: float, share: float) -> None:
        """At most so much current, or `share` of the duty; does not wait."""

    def _force_written(self, value: int, confirm: Callable[[], None]) -> ServoQuestion:
        return self._writing(self._force_at, lambda: value.to_bytes(2, "little"), confirm)

    def _require_answers(self, expected: str, level: int, spare: int, tool: str) -> None:
        """WrongIdentity unless it answers writing although its level of answers says otherwise: `spare` is written as it is."""
        try:
            self._write(spare, self._read(spare, 1))
        except BoardSilent as silent:
            raise WrongIdentity(
                f"{self.where}: expected {expected}, so that writing is answered; it is {level}, and writing is not answered: set"
                f" it with {tool}"
            ) from silent

    def _read(self, address: int, count: int) -> bytes:
        return self._converse(lambda: self.WIRE.read(self.number, address, count), count, f"READ {address}")

    def _write(self, address: int, data: bytes) -> None:
        self._converse(lambda: self.WIRE.write(self.number, address, data), 0, f"WRITE {address}")

    def _converse(self, made: Callable[[], bytes], count: int, what: str) -> bytes:
        answers: list[bytes] = []
        question = self._question(made, count, lambda data, _: answers.append(data))
        remedy = f"check its supply, id {self.number}{self.REMEDY}"
        answer = self._line.ask(question, answers, self.where, what, remedy)
        if why := self.WIRE.refusal(answer[0]):
            raise self._refused(what, why)
        return answer[1:]

    def _refused(self, what: str, why: str) -> BoardRefused:
        return BoardRefused(f"{self.where}: refused {what}: {why}")

    def _writing(self, address: int, made: Callable[[], bytes], then: Callable[[], None]) -> ServoQuestion:
        """The instruction that writes in the cycle; `then` is called when it was obeyed. `made`: the bytes, when it is sent."""

        def taken(answer: bytes, _: float) -> None:
            if why := self.WIRE.refusal(answer[0]):
                self.problems.append(self._refused(f"WRITE {address} of {made().hex(' ')}", why))
            else:
                then()

        return self._question(lambda: self.WIRE.write(self.number, address, made()), 0, taken)

    def _question(self, made: Callable[[], bytes], parameter_bytes: int, take: Callable[[bytes, float], None]) -> ServoQuestion:
        wire = self.WIRE
        return ServoQuestion(self.number, made, parameter_bytes, take, wire.status_in, wire.STATUS_OVERHEAD)

    def _reading(self, span: tuple[int, int], take: Callable[[bytes, float], None]) -> ServoQuestion:
        """The question for the values at an address, of a length."""
        return self._question(lambda: self.WIRE.read(self.number, *span), span[1], take)

    def at_errors(self, how_weak: str = "") -> str:
        """What it does at each error, in words."""

        def named(bits: int) -> str:
            return ", ".join(name for bit, name in self.ERRORS.items() if bit & bits)

        weak, free = self.weakens_at, self.frees_at
        does = (("free at ", named(free), ""), ("weaker at ", named(weak), how_weak), ("holds on at ", named(~(free | weak)), ""))
        return "; ".join(what + names + how for what, names, how in does if names)

    def _note_restart(self) -> None:
        self.resets += 1
        self.problems.append(
            BoardReset(
                f"{self.where}: restarted by itself, or another program switched it off; its torque is off: check its supply and"
                " cable"
            )
        )

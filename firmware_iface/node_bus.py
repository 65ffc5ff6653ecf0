"""A CAN bus with bought boards of one kind, seen from the host: drained once a cycle, one command a board and cycle."""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from firmware_iface.clock import Clock
from firmware_iface.errors import MisuseError, Problems
from firmware_iface.link import FrameLink

_STEP_s = 0.0005
MANY = 20_000  # messages whose mean interval is the period
FIRST, GAP = (10, 4.0)  # messages after which so many periods without one, or without a look, say nothing of the period
LOST = 8  # messages that come while one is missing, after which it does not come any more
Frame = tuple[int, bytes]


class Commanded(Protocol):
    """A board on the bus."""

    def frames(self) -> Iterable[Frame]:
        """What is to be sent to it in this cycle."""
        ...


N = TypeVar("N", bound=Commanded)


class Dating:
    """When counts were made that come without a time: at `at_s` [s, host] at the earliest, and up to `late_s` later."""

    def __init__(self) -> None:
        self.at_s = -math.inf
        self.late_s = 0.0

    def forget(self) -> None:
        """There is none any more."""
        self._date(-math.inf, 0.0)

    def _date(self, at_s: float, late_s: float) -> None:
        self.at_s, self.late_s = at_s, late_s


class AnswersInTurn(Dating):
    """Of a board that measures when it is asked, and does not say which question it answers.

    Answers come in the order of the questions, but a busy host, adapter or drive may be late by more than a cycle. So each is of
    the oldest open question at the earliest, and of the newest one at the latest; dated by the newest, one that was late in the
    cycle before would look like twice the speed. Questions that stay open while `LOST` answers or questions come were lost, or
    their answers. As many answers too many show that those before were late nevertheless; further ones were not asked for.
    """

    def __init__(self) -> None:
        super().__init__()
        self._open_s: deque[float] = deque(maxlen=LOST)
        self._asked_s = -math.inf
        self._behind, self._fewest = 0, LOST  # answers in a row that left questions open, and the fewest that they left
        self._lost = 0  # questions whose answers may yet come

    def asked(self, now_s: float) -> None:
        """A question was sent."""
        self._open_s.append(now_s)
        self._asked_s = now_s

    def arrived(self, now_s: float) -> None:
        """One more answer."""
        open_s = self._open_s
        if not open_s:
            if self._lost:
                self._lost -= 1
                self._date(self.at_s, self.late_s + now_s - self._asked_s)
            return
        if len(open_s) > 1:
            self._behind, self._fewest = self._behind + 1, min(self._fewest, len(open_s) - 1)
            lost = len(open_s) - 1 if len(open_s) == LOST else self._fewest if self._behind == LOST else 0
            for _ in range(lost):
                open_s.popleft()
            self._lost = min(self._lost + lost, LOST)
        at_s = open_s.popleft()
        if not open_s or self._behind == LOST:
            self._behind, self._fewest = 0, LOST
        self._date(at_s, self._asked_s - at_s)


class SteadyMessages(Dating):
    """Of a board that sends at a rate of its own: each message is a period after the one before.

    One that was due before the last drain, which did not bring it, is late, or it is a later one and that was lost. After `LOST`
    messages in a row, or periods, the latter is so; else each came since the last drain. Dated by the drains alone, one message
    in a cycle after two in the one before would look like half the speed, and what was late like many times the speed.
    """

    def __init__(self) -> None:
        super().__init__()
        self._drained_s, self._period_s, self._messages = 0.0, 0.0, 0
        self._behind = 0  # messages in a row that were due before

    def arrived(self, drained_s: float, now_s: float) -> None:
        """One more, between two drains."""
        if self.at_s == -math.inf:
            self._date(now_s, 0.0)
        else:
            gap_s = now_s - min(self._drained_s, drained_s)
            is_known = self._messages >= FIRST
            if not is_known or gap_s < GAP * self._period_s:
                self._messages = min(self._messages + 1, MANY)
                self._period_s += (now_s - self._drained_s - self._period_s) / self._messages
            due_s, off_s = self.at_s + self._period_s, 0.5 * self._period_s
            is_behind = is_known and off_s < drained_s - due_s < LOST * self._period_s and self._behind < LOST
            self._behind = self._behind + 1 if is_behind else 0
            if is_behind:
                self._date(due_s, now_s - due_s)
            elif is_known and due_s - off_s > now_s:
                self._date(now_s, self.late_s + self._period_s)
            else:
                self._date(min(max(due_s, drained_s), now_s), 0.0)
        self._drained_s = now_s


class NodeBoard:
    """A board on such a bus: its number, and the latest of what it measures. Times are the host's."""

    make: ClassVar[str]
    numbered: ClassVar[str] = "id"
    numbers: ClassVar[range]

    def __init__(self, bus: "NodeBus[Any]", number: int, name: str) -> None:
        if number not in self.numbers:
            first, last = self.numbers.start, self.numbers.stop - 1
            raise MisuseError(f'{self.make} "{name}": {self.numbered}s are {first} to {last}, got {number}')
        self.number, self.name, self._name_of_bus = number, name, bus.name
        self.count = self.resets = 0
        self.current_A, self.supply_V, self.temperature_degC = 0.0, math.nan, 0.0
        self.is_switch_on = False
        bus.nodes[number] = self

    @property
    def where(self) -> str:
        """Name in messages: `VESC "elbow" (id 3) on socketcan:can0`."""
        return f'{self.make} "{self.name}" ({self.numbered.split()[0]} {self.number}) on {self._name_of_bus}'


class UnaskedBoard(NodeBoard):
    """One that sends unasked what it measures; `needed` are the messages without which it cannot be used."""

    def __init__(self, bus: "NodeBus[Any]", number: int, name: str, needed: Iterable[Any]) -> None:
        super().__init__(bus, number, name)
        self.counted = SteadyMessages()
        self._at_s: dict[Any, float] = dict.fromkeys(needed, -math.inf)

    @property
    def at_s(self) -> float:
        """When the oldest of the values came."""
        return min(self._at_s.values())


class NodeBus(ABC, Generic[N]):
    """One bus with its boards, which add themselves under their numbers."""

    def __init__(self, link: FrameLink, clock: Clock) -> None:
        """`link`: of the format that the boards use."""
        self.link, self.clock, self.name = link, clock, link.name
        self.nodes: dict[int, N] = {}
        self.drained_s = clock.now_s()
        """Until when all that had arrived was processed; what is processed now came later."""
        self.problems = Problems()

    @abstractmethod
    def _take(self, can_id: int, payload: bytes, now_s: float) -> None:
        """Hand a frame to its board."""

    def update(self) -> None:
        """Process everything received. Raises LinkLost, and once per event what the boards found."""
        frames = self.link.receive()
        now_s = self.clock.now_s()
        for can_id, payload in frames:
            self._take(can_id, payload, now_s)
        self.drained_s = now_s
        if self.problems:
            raise self.problems.pop(0)

    def flush(self) -> None:
        """Send every board its command. Raises LinkLost."""
        for node in self.nodes.values():
            for frame in node.frames():
                self.link.send(*frame)

    def send(self, frame: Frame) -> None:
        """Send one frame. Raises LinkLost."""
        self.link.send(*frame)

    def waits(self, is_so: Callable[[], bool], limit_s: float) -> bool:
        """Process what arrives until something is so; whether it is. Outside of the cycle. Raises LinkError."""
        clock = self.clock
        end_s = clock.now_s() + limit_s
        while not is_so() and clock.now_s() < end_s:
            clock.wait_until_s(clock.now_s() + _STEP_s)
            self.update()
        return is_so()

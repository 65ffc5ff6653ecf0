"""A CAN bus with bought boards of one kind, seen from the host: drained once a cycle, one command a board and cycle."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from firmware_iface.clock import Clock
from firmware_iface.errors import MisuseError, Problems
from firmware_iface.link import FrameLink

_STEP_s = 0.0005
MANY = 20_000  # messages whose mean interval is the period
FIRST, GAP = (10, 4.0)  # messages after which so many periods without one, or without a look, say nothing of the period
Frame = tuple[int, bytes]


class Commanded(Protocol):
    """A board on the bus."""

    def frames(self) -> Iterable[Frame]:
        """What is to be sent to it in this cycle."""
        ...


N = TypeVar("N", bound=Commanded)


class SteadyMessages:
    """When a board sent messages that carry no time: it sends them at a rate of its own, and each came since the last drain.

    Each is dated a period after the one before, as far as it then lies between the drains. Dated by the drains alone, one message
    in a cycle after two in the one before would look like half the speed. One that is lost shows at the next drain.
    """

    def __init__(self) -> None:
        self.at_s = -math.inf
        """The newest one [s, host]."""
        self._drained_s, self._period_s, self._messages = 0.0, 0.0, 0

    def arrived(self, drained_s: float, now_s: float) -> None:
        """One more, between two drains."""
        if self.at_s == -math.inf:
            self.at_s = now_s
        else:
            gap_s = now_s - min(self._drained_s, drained_s)
            if self._messages < FIRST or gap_s < GAP * self._period_s:
                self._messages = min(self._messages + 1, MANY)
                self._period_s += (now_s - self._drained_s - self._period_s) / self._messages
            self.at_s = min(max(self.at_s + self._period_s, drained_s), now_s)
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
        self._counted = SteadyMessages()
        self._at_s: dict[Any, float] = dict.fromkeys(needed, -math.inf)

    @property
    def counted_at_s(self) -> float:
        """When it sent the count; -inf: it has none."""
        return self._counted.at_s

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
        self.sent_at_s = clock.now_s()
        """When the last command was sent."""
        self.drained_s = self.sent_at_s
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
        self.sent_at_s = self.clock.now_s()
        for node in self.nodes.values():
            for frame in node.frames():
                self.link.send(*frame)

    def send(self, frame: Frame) -> None:
        """Send one frame. Raises LinkLost."""
        self.sent_at_s = self.clock.now_s()
        self.link.send(*frame)

    def waits(self, is_so: Callable[[], bool], limit_s: float) -> bool:
        """Process what arrives until something is so; whether it is. Outside of the cycle. Raises LinkError."""
        clock = self.clock
        end_s = clock.now_s() + limit_s
        while not is_so() and clock.now_s() < end_s:
            clock.wait_until_s(clock.now_s() + _STEP_s)
            self.update()
        return is_so()

"""A CAN bus with bought boards of one kind, seen from the host: drained once a cycle, one command a board and cycle."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Generic, Protocol, TypeVar

from firmware_iface.clock import Clock
from firmware_iface.errors import Problems
from firmware_iface.link import FrameLink

_STEP_s = 0.0005
MANY = 20_000  # messages whose mean interval is the period
FIRST, GAP = (
    10,
    4.0,
)  # messages after which so many periods without one, or without a look, say nothing of the period
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

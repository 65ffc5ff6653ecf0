"""A CAN bus with bought boards of one kind, seen from the host: drained once a cycle, one command a board and cycle."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Generic, Protocol, TypeVar

from firmware_iface.clock import Clock
from firmware_iface.errors import Problems
from firmware_iface.link import FrameLink

_STEP_s = 0.0005
Frame = tuple[int, bytes]


class Commanded(Protocol):
    """A board on the bus."""

    def frames(self) -> Iterable[Frame]:
        """What is to be sent to it in this cycle."""
        ...


N = TypeVar("N", bound=Commanded)


class NodeBus(ABC, Generic[N]):
    """One bus with its boards, which add themselves under their numbers."""

    def __init__(self, link: FrameLink, clock: Clock) -> None:
        """`link`: of the format that the boards use."""
        self.link, self.clock, self.name = link, clock, link.name
        self.nodes: dict[int, N] = {}
        self.sent_at_s = clock.now_s()
        """When the last command was sent."""
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

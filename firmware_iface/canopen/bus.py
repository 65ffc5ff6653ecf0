"""A CANopen bus, seen from the host: drained once a cycle; frames are dispatched to the nodes by id."""

import math
from collections.abc import Callable

from firmware_iface.canopen import wire
from firmware_iface.clock import Clock
from firmware_iface.errors import MisuseError, Problems
from firmware_iface.link import FrameLink

FrameHandler = Callable[[bytes, float], None]
HOST_NODE = 127  # the node id of our heartbeat


class CanOpenBus:
    """One bus with its nodes, which add themselves. `synced_at_s` is when the last SYNC was sent."""

    def __init__(self, link: FrameLink, clock: Clock, heartbeat_every_s: float = math.inf) -> None:
        """`heartbeat_every_s`: well within the time-out of the drives for it."""
        self.link = link
        self.clock = clock
        self.name = link.name
        self.problems = Problems()
        self.synced_at_s = clock.now_s()
        self._handlers: dict[int, FrameHandler] = {}
        self._heartbeat_every_s = heartbeat_every_s
        self._next_heartbeat_s = -math.inf

    def add(self, node: int, handlers: dict[int, FrameHandler]) -> None:
        """Dispatch frames with these base ids of a node. Raises MisuseError."""
        if node not in wire.NODES or node == HOST_NODE:
            raise MisuseError(f"CAN bus {self.name}: node ids are 1 to 126, got {node}")
        self._handlers.update({base + node: handler for base, handler in handlers.items()})

    def update(self) -> None:
        """Process everything received. Raises LinkLost, and once per event what the nodes found."""
        frames = self.link.receive()
        if frames:
            now_s = self.clock.now_s()
            for can_id, payload in frames:
                if (handler := self._handlers.get(can_id)) is not None:
                    handler(payload, now_s)
        if self.problems:
            raise self.problems.pop(0)

    def flush(self) -> None:
        """End a cycle: all drives have their set-points and take them over at once. Raises LinkLost."""
        if self.clock.now_s() >= self._next_heartbeat_s:
            self.heartbeat()
            self._next_heartbeat_s = self.clock.now_s() + self._heartbeat_every_s
        self.sync()

    def sync(self) -> None:
        """Send SYNC: the nodes take over their set-points, and answer with what they measured then. Raises LinkLost."""
        self.link.send(wire.SYNC, b"")
        self.synced_at_s = self.clock.now_s()

    def heartbeat(self) -> None:
        """Tell the nodes that the host lives."""
        self.link.send(wire.HEARTBEAT + HOST_NODE, b"\x05")

    def nmt(self, command: wire.NmtCommand, node: int) -> None:
        """Send an NMT command to a node, 0: to all."""
        self.link.send(wire.NMT, bytes((command, node)))

"""Wires within one process, for the stepped mock: no kernel between the host's drivers and the boards.

The host opens them as any other: `mock://NAME` is a URL that pyserial resolves, `armwright-mock` an interface of python-can. The
drivers, and the bytes, are the same as over a pty and python-can's virtual bus (tests/hil_mocks/test_in_process.py).

What one member of the CAN bus sends, all others find in their queues: no locks, no copies.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import can
import serial
from can.interfaces import BACKENDS

CAN_INTERFACE = "armwright-mock"


def register() -> None:
    """Let pyserial and python-can find the handlers of this package."""
    if __name__ not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(__name__)
    BACKENDS[CAN_INTERFACE] = (__name__, "MockCanBus")


_MEMBERS: dict[str, list[MockCanBus]] = {}
_QUEUE_FRAMES = 4096  # of a node that does not read; then its oldest are lost


class MockCanBus(can.BusABC):
    """A node of the bus `channel`. Messages are handed on as they are: nobody changes one that was sent."""

    def __init__(self, channel: str, **_: Any) -> None:
        super().__init__(channel=channel)
        self.channel_info = f"mock bus {channel}"
        self._queue: deque[can.Message] = deque(maxlen=_QUEUE_FRAMES)
        self._others = _MEMBERS.setdefault(channel, [])
        self._others.append(self)
        self._is_open = True

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send to all other nodes. CanOperationError if this one has left."""
        if not self._is_open:
            raise can.CanOperationError("closed")
        for member in self._others:
            if member is not self:
                member._queue.append(msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message, or None: nothing comes while one waits. CanOperationError if this node has left."""
        if not self._is_open:
            raise can.CanOperationError("closed")
        return self._queue.popleft() if self._queue else None

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        if self._is_open:
            self._is_open = False
            self._others.remove(self)

"""Wires within one process, for the stepped mock: no kernel between the host's drivers and the boards.

The host opens them as any other: `mock://NAME` is a URL that pyserial resolves, by the names of this module and its `Serial`;
`armwright-mock` an interface of python-can. The drivers, and the bytes, are the same as over a pty and python-can's virtual bus
(tests/hil_mocks/test_in_process.py).

A serial line has the board's end, `SerialLine`, and the host's, `Serial`. What one member of the CAN bus sends, all others find
in their queues: no locks, no copies.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import can
import serial
from can.interfaces import BACKENDS

from hil_mocks.wires import newest_frames

CAN_INTERFACE = "armwright-mock"


def register() -> None:
    """Let pyserial and python-can find the handlers of this module."""
    package = __name__.rpartition(".")[0]
    if package not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(package)
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


class Serial(serial.SerialBase):
    """A port on a line within this process. A line has no modem lines, and no bit rate that could be wrong."""

    _line: SerialLine | None = None

    def open(self) -> None:
        """Take the line; bytes from before are discarded, as at any port. SerialException if there is none or it is taken."""
        line = line_at(str(self.port))
        if line.is_taken:
            raise serial.SerialException(f"{self.port} is in use")
        line.is_taken = True
        line.to_host.clear()
        self._line, self.is_open = line, True

    def close(self) -> None:
        """Leave the line to others."""
        if self._line is not None:
            self._line.is_taken = False
        self._line, self.is_open = None, False

    def read(self, size: int = 1, /) -> bytes:
        """Return what is there, at most `size` bytes; never waits."""
        buffer = self._here().to_host
        received = bytes(buffer[:size])
        del buffer[:size]
        return received

    def write(self, content: Any, /) -> int:
        """Send all."""
        self._here().to_board += content
        return len(content)

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read."""
        return len(self._here().to_host)

    def _here(self) -> SerialLine:
        if self._line is None or not self._line.is_there:
            raise serial.PortNotOpenError() if self._line is None else serial.SerialException("unplugged")
        return self._line

    def _reconfigure_port(self, force_update: bool = False) -> None:
        """Nothing to configure."""


_LINES: dict[str, SerialLine] = {}
_ROOM_BYTES = 4095  # as a tty holds for a host that does not read


class SerialLine:
    """A serial line to one host at a time."""

    def __init__(self, name: str) -> None:
        self.path = f"mock://{name}"
        self.to_host, self.to_board = bytearray(), bytearray()
        self.is_there, self.is_taken = True, False
        _LINES[self.path] = self

    def read(self) -> bytes:
        """Read everything that the host has written."""
        if not self.to_board:
            return b""
        received = bytes(self.to_board)
        self.to_board.clear()
        return received

    def write(self, sent: bytes) -> None:
        """Send; if a host does not read, the oldest frames of a long wait are lost, and then bytes, as at a tty."""
        if self.is_there:
            self.to_host += newest_frames(sent)[: _ROOM_BYTES - len(self.to_host)]

    def settle(self) -> None:
        """What was sent is there at once."""

    def vanish(self) -> None:
        """Unplug the port: whoever has it open gets errors from now on."""
        self.is_there = False

    def plug_in(self) -> None:
        """Plug a port that has vanished in again."""
        self.is_there = True
        self.to_host.clear()
        self.to_board.clear()

    def close(self) -> None:
        """Remove the line."""
        self.is_there = False
        _LINES.pop(self.path, None)


def line_at(path: str) -> SerialLine:
    """The line of a URL. SerialException, as pyserial's ports raise it, if there is none."""
    line = _LINES.get(path)
    if line is None or not line.is_there:
        raise serial.SerialException(f"no mock serial line {path} in this process")
    return line

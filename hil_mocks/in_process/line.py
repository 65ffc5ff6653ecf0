"""The board's end of a serial line within this process. `mock://NAME` opens the other end while the line exists."""

from __future__ import annotations

import serial

from hil_mocks.wires import newest_frames

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

"""pyserial's handler of `mock://NAME`: the host's end of a `SerialLine`. pyserial asks for this module's name and class."""

from __future__ import annotations

from typing import Any

import serial

from hil_mocks.in_process.line import SerialLine, line_at


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

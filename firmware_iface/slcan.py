"""CAN adapters on a serial line that speak slcan (Lawicel): CANable with slcan firmware, CANUSB and alike.

python-can has this, too, but its reading waits a millisecond, ends at the adapter's acknowledgement of a frame that was sent
(so that replies pile up behind), and costs 6 us a byte. Lines end with CR; BELL says that a command failed.

    C, Sn, O            close, bit rate, open
    tiiildd..           a data frame: 11-bit id in three hex digits, length, bytes in hex. T, r, R: other sorts
"""

import re
from typing import Protocol

BITRATE_CODES = {
    10_000: "S0",
    20_000: "S1",
    50_000: "S2",
    100_000: "S3",
    125_000: "S4",
    250_000: "S5",
    500_000: "S6",
    800_000: "S7",
    1_000_000: "S8",
}
OPTIONS = ("tty_baudrate",)
_FRAME = re.compile(rb"t([0-7][0-9A-Fa-f]{2})([0-8])([0-9A-Fa-f]*)")
_OTHER_FRAMES = (b"T", b"r", b"R", b"d", b"D", b"b", b"B")
_ENDS = re.compile(rb"[\r\a]")
_LONGEST_LINE = 64  # a data frame has 26 characters with a time stamp


class Port(Protocol):
    """The serial line to the adapter."""

    @property
    def name(self) -> str: ...
    def read(self) -> bytes: ...
    def write(self, data: bytes) -> None: ...
    def close(self) -> None: ...


class SlcanLink:
    """A CAN bus behind an slcan adapter, which is opened here. `rejected` counts what is no classic data frame."""

    def __init__(self, port: Port, name: str, bitrate: int) -> None:
        """`bitrate` is one of BITRATE_CODES. Raises LinkLost."""
        self.name = name
        self.rejected = 0
        self._port = port
        self._rest = b""
        self._is_open = True
        port.write(f"\r\rC\r{BITRATE_CODES[bitrate]}\rO\r".encode())

    def send(self, can_id: int, payload: bytes) -> None:
        """Send one frame of 0 to 8 bytes. Raises LinkLost."""
        self._port.write(b"t%03X%d%s\r" % (can_id, len(payload), payload.hex().upper().encode()))

    def receive(self) -> list[tuple[int, bytes]]:
        """Return all frames received as (id, payload), oldest first; never blocks. Raises LinkLost."""
        *lines, self._rest = _ENDS.split(self._rest + self._port.read())
        if len(self._rest) > _LONGEST_LINE:
            self._rest = self._rest[-_LONGEST_LINE:]  # not an slcan adapter; the next CR begins anew
        return [frame for line in lines if (frame := self._frame(line)) is not None]

    def _frame(self, line: bytes) -> tuple[int, bytes] | None:
        found = _FRAME.match(line)
        if found is None:
            self.rejected += line.startswith(_OTHER_FRAMES) or line.startswith(b"t")
            return None
        digits = 2 * int(found[2])
        if len(found[3]) < digits:
            self.rejected += 1
            return None
        return int(found[1], 16), bytes.fromhex(found[3][:digits].decode())

    def close(self) -> None:
        """Leave the bus; idempotent."""
        if self._is_open:
            self._is_open = False
            try:
                self._port.write(b"C\r")
            finally:
                self._port.close()

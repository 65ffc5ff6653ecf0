"""The two kinds of link, and how they are opened. The only file that knows pyserial and python-can.

A link carries bytes (serial) or frames (CAN); what they mean is the boards' affair.
Neither kind ever blocks on reading.
"""

from typing import Protocol


class ByteLink(Protocol):
    """A full-duplex stream of bytes."""

    @property
    def name(self) -> str:
        """Where it goes, for messages: `/dev/ttyUSB0`."""
        ...

    @property
    def baud(self) -> int:
        """Bit rate [1/s]; a byte takes 10 bits. 0 where the link has none (a socket)."""
        ...

    def read(self) -> bytes:
        """All bytes that are there, b"" if none; never blocks. Raises LinkLost."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises LinkLost."""
        ...

    def close(self) -> None:
        """Close it; once closed, again does nothing."""
        ...


class FrameLink(Protocol):
    """A CAN bus: classic data frames with 11-bit ids. Frames are broadcast; one's own do not come back."""

    @property
    def name(self) -> str:
        """Where it goes, for messages: `socketcan:can0`."""
        ...

    def send(self, can_id: int, payload: bytes) -> None:
        """Send one frame of 0 to 8 bytes. Raises LinkLost."""
        ...

    def receive(self) -> list[tuple[int, bytes]]:
        """All frames that are there as (id, payload), oldest first; never blocks. Raises LinkLost."""
        ...

    def close(self) -> None:
        """Leave the bus; once closed, again does nothing."""
        ...

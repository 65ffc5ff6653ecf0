"""What a serial or a CAN link does, whatever opens it: it carries bytes or frames, and does not interpret them.

Reading never blocks; `ByteLink.wait` does, within its limit.
`Closing` is what a `with` closes: links, files, mock arms.
"""

from abc import ABC, abstractmethod
from enum import Enum
from typing import Protocol, Self


class CanFormat(Enum):
    """Which frames a link carries."""

    STANDARD = "classic frames with 11-bit ids"
    EXTENDED = "classic frames with 29-bit ids"
    FD = "CAN FD frames, with 29-bit ids where 11 bits do not suffice"


class ByteLink(Protocol):
    """A full-duplex stream of bytes."""

    @property
    def name(self) -> str:
        """Name in messages: `/dev/ttyUSB0`."""
        ...

    @property
    def baud(self) -> int:
        """Bit rate [1/s]; a byte takes 10 bits. 0 where the link has none (a socket)."""
        ...

    def read(self) -> bytes:
        """Return all bytes received, b"" if none; never blocks. Raises LinkLost."""
        ...

    def wait(self, limit_s: float) -> bool:
        """Whether there is something to `read`; waits for it, `limit_s` at most, where the link can. Never raises."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises LinkLost."""
        ...

    def close(self) -> None:
        """Close the port; idempotent."""
        ...


class FrameLink(Protocol):
    """A CAN bus: data frames of one CanFormat. Own frames are not received."""

    @property
    def name(self) -> str:
        """Name in messages: `socketcan:can0`."""
        ...

    def send(self, can_id: int, payload: bytes) -> None:
        """Send one frame of 0 to 8 bytes, or of a length that CAN FD has. Raises LinkLost."""
        ...

    def receive(self) -> list[tuple[int, bytes]]:
        """Return all frames received as (id, payload), oldest first; never blocks. Raises LinkLost."""
        ...

    def close(self) -> None:
        """Leave the bus; idempotent."""
        ...


class Closing(ABC):
    """`with` gives the thing itself, and closes it however the block ends."""

    __slots__ = ()

    @abstractmethod
    def close(self) -> None:
        """Give back what it holds."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

"""Links within one process, without ports or drivers: for tests and for boards simulated in step.

The same contract tests cover them and the real links (tests/contract).
"""

from firmware_iface.errors import LinkLost

_BUFFER_BYTES = 1 << 16


class MemoryByteLink:
    """One end of a wire; `byte_pair` makes both."""

    def __init__(self, name: str, baud: int) -> None:
        self.name = name
        self.baud = baud
        self._incoming = bytearray()
        self._peer: MemoryByteLink | None = None
        self._is_open = True

    def connect(self, peer: "MemoryByteLink") -> None:
        """Send our bytes to `peer`."""
        self._peer = peer

    def read(self) -> bytes:
        """Return all bytes received, including those that the peer sent before it closed."""
        if self._incoming:
            received = bytes(self._incoming)
            self._incoming.clear()
            return received
        if not self._is_open or (self._peer is not None and not self._peer._is_open):
            raise self._lost()
        return b""

    def wait(self, limit_s: float) -> bool:
        """Whether there is something to read now."""
        return bool(self._incoming)

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        if not self._is_open or self._peer is None or not self._peer._is_open:
            raise self._lost()
        self._peer._incoming += data
        # Nobody reads: like a driver's buffer, this one overflows and keeps the oldest bytes.
        del self._peer._incoming[_BUFFER_BYTES:]

    def close(self) -> None:
        """Close this end; the other end notices."""
        self._is_open = False
        self._incoming.clear()

    def _lost(self) -> LinkLost:
        return LinkLost(f"serial port {self.name}: lost: closed")


def byte_pair(name: str = "memory", baud: int = 1_000_000) -> tuple[MemoryByteLink, MemoryByteLink]:
    """Two ends of one wire."""
    ends = MemoryByteLink(name, baud), MemoryByteLink(name, baud)
    ends[0].connect(ends[1])
    ends[1].connect(ends[0])
    return ends


class MemoryBus:
    """A CAN bus; `join` it."""

    def __init__(self, name: str = "memory") -> None:
        self.name = name
        self.members: list[MemoryFrameLink] = []

    def join(self) -> "MemoryFrameLink":
        """Connect a new node; it receives what is sent from now on."""
        link = MemoryFrameLink(self)
        self.members.append(link)
        return link


class MemoryFrameLink:
    """One node of a MemoryBus."""

    def __init__(self, bus: MemoryBus) -> None:
        self.name = bus.name
        self._bus = bus
        self._frames: list[tuple[int, bytes]] = []

    def send(self, can_id: int, payload: bytes) -> None:
        """Send one frame to all others."""
        self._check_open()
        frame = (can_id, bytes(payload))
        for member in self._bus.members:
            if member is not self:
                member._frames.append(frame)

    def receive(self) -> list[tuple[int, bytes]]:
        """Return all frames received."""
        self._check_open()
        frames, self._frames = self._frames, []
        return frames

    def close(self) -> None:
        """Leave the bus."""
        if self in self._bus.members:
            self._bus.members.remove(self)

    def _check_open(self) -> None:
        if self not in self._bus.members:
            raise LinkLost(f"CAN bus {self.name}: lost: closed")

"""Cameras and motion capture systems over UDP: a port that is listened on without blocking; and the frames of docs/camera.md.

A camera sends one datagram per marker and image:

offset 0 magic b"AWCM", 4 version u8 = 1, 5 flags u8 (bit 0: visible), 6 source u16,
8 sequence u32, 12 time_s f64, 20 x_m, 28 y_m, 36 z_m f64; little endian, 44 bytes
"""

from __future__ import annotations

import math
import select
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Generic, TypeVar

from firmware_iface.errors import LinkLost, PortMissing

_LONGEST_DATAGRAM = 65536
Frame = TypeVar("Frame")


class UdpListener:
    """Datagrams of a port. `sender`: only those of this computer are passed on; empty: all."""

    def __init__(self, what: str, port: int, sender: str = "", interface: str = "", group: str = "") -> None:
        """Listen on `port` of the interface with this address (empty: all; a sender on loopback: loopback); 0: any free port.

        group: of multicast, joined where the sender is reached; others may listen, too. PortMissing if the port is taken,
        the sender's name is unknown, or the group cannot be joined.
        """
        self._what, self._socket = what, socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._arrivals = select.poll()
        self._arrivals.register(self._socket, select.POLLIN)
        try:
            self.sender = socket.gethostbyname(sender) if sender else ""
            is_local = self.sender.startswith("127.")
            host = interface or ("127.0.0.1" if is_local and not group else "")
            if group:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind((host, port))
            if group:
                joined = socket.inet_aton(group) + socket.inet_aton(_own_address_towards(self.sender))
                self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, joined)
        except (OSError, OverflowError, UnicodeError) as problem:
            self._socket.close()
            raise PortMissing(
                f"{what}: cannot listen on UDP port {port}{f' of {interface}' if interface else ''}"
                f"{f' for {sender}' if sender else ''}: {problem}; stop another running armwright, or choose another port"
            ) from None
        self.port: int = self._socket.getsockname()[1]
        self.name = f"udp://{host}:{self.port}"

    def datagrams(self) -> Sequence[bytes]:
        """All received so far, in order of arrival. LinkLost."""
        received: list[bytes] = []
        # Most cycles find none: to ask first costs a third of an empty read, which makes a buffer and an exception.
        while self._arrivals.poll(0):
            try:
                datagram, (address, _) = self._socket.recvfrom(_LONGEST_DATAGRAM)
            except BlockingIOError:
                break
            except OSError as problem:
                raise LinkLost(f"{self._what} on {self.name}: lost: {problem}") from None
            if not self.sender or address == self.sender:
                received.append(datagram)
        return received

    def send(self, datagram: bytes, port: int) -> None:
        """Send to a port of the sender. LinkLost."""
        try:
            self._socket.sendto(datagram, (self.sender, port))
        except BlockingIOError:
            return  # a full buffer loses a datagram, as a network does
        except OSError as problem:
            raise LinkLost(f"{self._what}: cannot send to {self.sender}: {problem}") from None

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


class FrameListener(Generic[Frame]):
    """Frames of one kind, a datagram each. Datagrams that are none are dropped and counted in `rejected`."""

    def __init__(self, listener: UdpListener, unpack: Callable[[bytes], Frame | None]) -> None:
        self._listener, self._unpack, self.rejected = listener, unpack, 0
        self.port, self.name = listener.port, listener.name

    def receive(self) -> list[Frame]:
        """All frames received so far, in order of arrival; never blocks. LinkLost."""
        frames = []
        for datagram in self._listener.datagrams():
            if (frame := self._unpack(datagram)) is None:
                self.rejected += 1
            else:
                frames.append(frame)
        return frames

    def close(self) -> None:
        """Stop listening."""
        self._listener.close()


def _own_address_towards(host: str) -> str:
    """Address of the interface from which a computer is reached; nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((host, 9))
        return str(probe.getsockname()[0])


DEFAULT_PORT = 47310
TIP_SOURCE = 0
_MAGIC = b"AWCM"
_VERSION = 1
_LAYOUT = Struct("<4sBBHIdddd")


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """Position of a marker in the base frame at `time_s` of the camera's own clock."""

    sequence: int
    time_s: float
    position_m: tuple[float, float, float]
    is_visible: bool = True
    source: int = TIP_SOURCE


def unpack(datagram: bytes) -> CameraFrame | None:
    """Return the frame in `datagram`, or None if it is not a camera frame."""
    if len(datagram) != _LAYOUT.size:
        return None
    magic, version, flags, source, sequence, time_s, x_m, y_m, z_m = _LAYOUT.unpack(datagram)
    if magic != _MAGIC or version != _VERSION or flags > 1:
        return None
    if not all(map(math.isfinite, (time_s, x_m, y_m, z_m))):
        return None
    return CameraFrame(sequence, time_s, (x_m, y_m, z_m), bool(flags), source)


class CameraReceiver(FrameListener[CameraFrame]):
    """Listens on a UDP port."""

    def __init__(self, port: int = DEFAULT_PORT, host: str = "127.0.0.1") -> None:
        """Listen on `port` of the interface with address `host`; port 0 takes any free one."""
        super().__init__(UdpListener("camera", port, interface=host), unpack)

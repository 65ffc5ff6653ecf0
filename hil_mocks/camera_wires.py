"""How a mock camera's packets reach the host: each transport is one class with the same methods. Nothing blocks."""

from __future__ import annotations

import contextlib
import socket
from typing import Protocol

from hil_mocks.devices.camera import Transport

_LONGEST_DATAGRAM = 65536
LOOPBACK = "127.0.0.1"


class CameraWire(Protocol):
    """port: on which the host listens, or to which it connects."""

    port: int

    def received(self) -> list[bytes]: ...
    def send(self, packet: bytes) -> None: ...
    def close(self) -> None: ...


class Datagrams:
    """Sends to a port of this machine, whether anybody listens or not."""

    def __init__(self) -> None:
        self.port = free_udp_port()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def received(self) -> list[bytes]:
        """Nothing: the host does not answer."""
        return []

    def send(self, packet: bytes) -> None:
        """Send; a full buffer loses a datagram, as a network does."""
        with contextlib.suppress(OSError):
            self._socket.sendto(packet, (LOOPBACK, self.port))

    def close(self) -> None:
        """Stop sending."""
        self._socket.close()


def camera_wire(transport: Transport) -> CameraWire:
    """The wire of a transport."""
    return Datagrams()


def free_udp_port() -> int:
    """A UDP port on loopback that is free at the moment."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])

"""How a mock camera's packets reach the host: each transport is one class with the same methods. Nothing blocks."""

from __future__ import annotations

import contextlib
import errno
import random
import socket
from collections.abc import Mapping
from typing import Protocol

from hil_mocks.devices.camera import Transport

_LONGEST_DATAGRAM = 65536
LOOPBACK = "127.0.0.1"

GIVEN_TO_NOBODY = (20_000, 32_768)  # ports below those of Linux for sockets that ask for none


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


class Commands:
    """A UDP port that is asked; answers and all else go to the client that asked last."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.bind((LOOPBACK, 0))
        self.port = int(self._socket.getsockname()[1])
        self._client: tuple[str, int] | None = None

    def received(self) -> list[bytes]:
        """What clients have asked."""
        found = []
        with contextlib.suppress(BlockingIOError):
            while True:
                request, self._client = self._socket.recvfrom(_LONGEST_DATAGRAM)
                found.append(request)
        return found

    def send(self, packet: bytes) -> None:
        """Send to the client, if there is one."""
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(packet, self._client)

    def close(self) -> None:
        """Close the port."""
        self._socket.close()


class OneClientServer:
    """A TCP server for one client at a time; its packets begin with their size, u32 little endian."""

    def __init__(self) -> None:
        self._listener = socket.create_server((LOOPBACK, 0))
        self._listener.setblocking(False)
        self.port = int(self._listener.getsockname()[1])
        self._client: socket.socket | None = None
        self._buffer = b""

    def received(self) -> list[bytes]:
        """Whole packets of the client; an empty one when a client has connected."""
        found = []
        with contextlib.suppress(BlockingIOError):
            client, _ = self._listener.accept()
            client.setblocking(False)
            self._hang_up()
            self._client = client
            found.append(b"")
        self._buffer += self._arrived()
        while len(self._buffer) >= 4:
            size = int.from_bytes(self._buffer[:4], "little")
            if size < 4 or len(self._buffer) < size:
                break
            found.append(self._buffer[:size])
            self._buffer = self._buffer[size:]
        return found

    def _arrived(self) -> bytes:
        if self._client is None:
            return b""
        try:
            arrived = self._client.recv(_LONGEST_DATAGRAM)
        except BlockingIOError:
            return b""
        except OSError:
            arrived = b""
        if not arrived:
            self._hang_up()
        return arrived

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client, self._buffer = None, b""

    def send(self, packet: bytes) -> None:
        """Send to the client; one that does not read is hung up on."""
        if self._client is None:
            return
        try:
            self._client.sendall(packet)
        except OSError:
            self._hang_up()

    def close(self) -> None:
        """Hang up, and close the port."""
        self._hang_up()
        self._listener.close()


_WIRES: Mapping[Transport, type[CameraWire]] = {
    "datagrams": Datagrams,
    "commands": Commands,
    "connection": OneClientServer,
}


def camera_wire(transport: Transport) -> CameraWire:
    """The wire of a transport."""
    return _WIRES[transport]()


def free_udp_port() -> int:
    """A UDP port on loopback that is free: none of those that a system gives away by itself, before this one is used."""
    while True:
        port = random.SystemRandom().randrange(*GIVEN_TO_NOBODY)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind((LOOPBACK, port))
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
            else:
                return port

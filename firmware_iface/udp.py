"""A UDP port that is listened on without blocking: of cameras and motion capture systems."""

from __future__ import annotations

import socket
from collections.abc import Iterator

from firmware_iface.errors import LinkLost, PortMissing

_LONGEST_DATAGRAM = 65536


class UdpListener:
    """Datagrams of a port. `sender`: only those of this address are passed on; empty: all."""

    def __init__(self, what: str, port: int, sender: str = "", interface: str = "") -> None:
        """Listen on `port` of the interface with this address (empty: all; a sender on loopback: loopback); 0: any free port.

        PortMissing if the port is taken, or the sender's name is unknown.
        """
        self._what, self._socket = what, socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._sender = socket.gethostbyname(sender) if sender else ""
            is_local = self._sender.startswith("127.")
            host = interface or ("127.0.0.1" if is_local else "")
            self._socket.bind((host, port))
        except (OSError, OverflowError, UnicodeError) as problem:
            self._socket.close()
            raise PortMissing(
                f"{what}: cannot listen on UDP port {port}{f' of {interface}' if interface else ''}"
                f"{f' for {sender}' if sender else ''}: {problem}; stop another running armwright, or choose another port"
            ) from None
        self.port: int = self._socket.getsockname()[1]
        self.name = f"udp://{host}:{self.port}"

    def datagrams(self) -> Iterator[bytes]:
        """All received so far, in order of arrival. LinkLost."""
        while True:
            try:
                datagram, (address, _) = self._socket.recvfrom(_LONGEST_DATAGRAM)
            except BlockingIOError:
                return
            except OSError as problem:
                raise LinkLost(f"{self._what} on {self.name}: lost: {problem}") from None
            if not self._sender or address == self._sender:
                yield datagram

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()

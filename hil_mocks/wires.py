"""The wires of a mock arm: ports for the serial boards, a CAN bus of python-can, datagrams of the camera.

The host opens the other ends with its ordinary drivers: a pty's path or a socket's URL, an interface and a channel, a UDP port.
"""

from __future__ import annotations

import contextlib
import os
import socket
import tty
from collections.abc import Sequence
from typing import Protocol

from firmware_iface.link import open_can
from hil_mocks.devices.motor_board import Frame

_ROOM_BYTES = 3500  # of the 4095 that a tty holds for a host that does not read


class OnWires(Protocol):
    """What the wires need of a robot."""

    can_outgoing: list[Frame]
    camera_outgoing: list[bytes]

    def from_host_serial(self, board: int, received: bytes) -> None: ...
    def from_host_can(self, can_id: int, payload: bytes) -> None: ...
    def serial_outgoing(self, board: int) -> bytes: ...


class Pty:
    """A pseudo terminal in raw mode; its other end stays open here, so that hosts may come and go."""

    def __init__(self) -> None:
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self.path = os.ttyname(self._theirs)

    def read(self) -> bytes:
        """All that the host has written."""
        received = b""
        try:
            # The kernel carries bytes through a pty in its own time; only an empty read has waited for all of them.
            while part := os.read(self._ours, 65536):
                received += part
        except BlockingIOError:
            return received
        return received

    def write(self, sent: bytes) -> None:
        """Send; of what a host that does not read has no room for, the oldest frames are lost."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._ours, newest(sent))

    def close(self) -> None:
        """Hang up."""
        os.close(self._ours)
        os.close(self._theirs)


class TcpPort:
    """A serial server on loopback, as pyserial opens it by `socket://`; one host at a time, the newest.

    The kernel has carried the bytes when `write` returns, which a pty leaves to a worker in its own time. So a stepped
    simulation is deterministic without waiting for it.
    """

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setblocking(False)
        self._host: socket.socket | None = None
        self.path = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"

    def read(self) -> bytes:
        """All that the host has written."""
        self._accept()
        if self._host is None:
            return b""
        try:
            received = self._host.recv(65536)
        except BlockingIOError:
            return b""
        except OSError:
            received = b""
        if not received:
            self._hang_up()
        return received

    def write(self, sent: bytes) -> None:
        """Send; of what a host that does not read has no room for, the oldest frames are lost."""
        if self._host is None:
            return
        try:
            self._host.send(newest(sent))
        except BlockingIOError:
            return
        except OSError:
            self._hang_up()

    def close(self) -> None:
        """Hang up."""
        self._hang_up()
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError):
            host, _ = self._listener.accept()
            host.setblocking(False)
            host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._hang_up()
            self._host = host

    def _hang_up(self) -> None:
        if self._host is not None:
            self._host.close()
            self._host = None


def newest(sent: bytes) -> bytes:
    """What of `sent` a serial driver would still hold for a host that has not read: whole frames, the newest ones."""
    if len(sent) <= _ROOM_BYTES:
        return sent
    kept = sent[-_ROOM_BYTES:]
    return kept[kept.index(0) + 1 :]


class Wires:
    """All wires of one robot. Nothing blocks."""

    def __init__(
        self,
        serial_ports: Sequence[Pty | TcpPort],
        can_interface: str,
        can_channel: str,
        camera_port: int = 0,
    ) -> None:
        self.serial_ports = tuple(serial_ports)
        # A port of its own: python-can listens to all groups of a port. No hops: frames stay on this machine.
        is_multicast = can_interface == "udp_multicast"
        self.can_options: dict[str, int] = {"port": free_udp_port(), "hop_limit": 0} if is_multicast else {}
        self._can = open_can(can_interface, can_channel, **self.can_options)
        self._camera = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._camera.setblocking(False)
        self.camera_port = camera_port or free_udp_port()

    def from_host(self, robot: OnWires) -> None:
        """Give the robot what the host has sent."""
        for i, port in enumerate(self.serial_ports):
            received = port.read()
            if received:
                robot.from_host_serial(i, received)
        for can_id, payload in self._can.receive():
            robot.from_host_can(can_id, payload)

    def to_host(self, robot: OnWires) -> None:
        """Give the host what the robot has sent by now; over a pty it may take a little to get there."""
        for i, port in enumerate(self.serial_ports):
            sent = robot.serial_outgoing(i)
            if sent:
                port.write(sent)
        if robot.can_outgoing:
            for can_id, payload in robot.can_outgoing:
                self._can.send(can_id, payload)
            robot.can_outgoing.clear()
        if robot.camera_outgoing:
            for datagram in robot.camera_outgoing:
                self._send_picture(datagram)
            robot.camera_outgoing.clear()

    def _send_picture(self, datagram: bytes) -> None:
        try:
            self._camera.sendto(datagram, ("127.0.0.1", self.camera_port))
        except OSError:
            return  # a full buffer loses a datagram, as a network does

    def close(self) -> None:
        """Take all wires away."""
        for port in self.serial_ports:
            port.close()
        self._can.close()
        self._camera.close()


def free_udp_port() -> int:
    """A UDP port on loopback that nobody has at the moment."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])

"""The wires of a mock arm: serial lines of the encoder boards, a CAN bus of python-can, datagrams of the camera.

The host opens the other ends with its ordinary drivers: a port's path, an interface and a channel, a UDP port.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import math
import os
import random
import select
import socket
import sys
import termios
import tty
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any, Protocol, cast
from unittest.mock import patch

import can

from firmware_iface.can_link import CanFrameLink, join_can
from firmware_iface.errors import LinkLost
from firmware_iface.link import CanFormat, FrameLink
from hil_mocks.devices.cameras import Transport
from hil_mocks.devices.motor_inputs import Frame

_BUS_OFF, _BIT_ERROR = 0x40, 0x88  # CAN_ERR_BUSOFF, CAN_ERR_BUSERROR | CAN_ERR_PROT of linux/can/error.h
_OF_BOARDS = 0x080  # set in REPLY and PARAMETER_ANSWER, not in what the host sends (docs/motor_board.md)
_MOST_LOOKS = 20_000  # some 10 ms
_ROOM_BYTES = 3500  # of the 4095 that a tty holds for a host that does not read


Picture = tuple[int, bytes]  # number of the camera, its datagram


class OnWires(Protocol):
    """The robot's interface for the wires."""

    outgoing: dict[CanFormat, list[Frame]]
    camera_outgoing: list[Picture]

    def from_host_serial(self, board: int, received: bytes) -> None: ...
    def from_host_can(self, can_id: int, payload: bytes, carried: CanFormat = ...) -> None: ...
    def from_host_camera(self, camera: int, request: bytes) -> None: ...
    def serial_outgoing(self, board: int, ahead_s: float = 0.0) -> bytes: ...


Arrived = tuple[float, CanFormat, Frame]
"""When the kernel had a frame of the host [seconds since 1970; 0 where nobody says], its format, and itself. Not named: each
cycle makes three."""


def newest_of_each(frames: Sequence[Frame]) -> list[Frame]:
    """The newest frame of each id: a controller that did not get onto the bus has a new value take an old one's place."""
    return list(dict(frames).items())


def newest_frames(sent: bytes) -> bytes:
    """The last whole frames that a tty holds for a host that does not read; frames end with 0."""
    if len(sent) <= _ROOM_BYTES:
        return sent
    newest = sent[-_ROOM_BYTES:]
    return newest[newest.index(0) + 1 :]


def _put_on(bus: FrameLink, sent: list[Frame]) -> None:
    """Send and forget frames; those that a full bus does not take are sent later, the newest of each id."""
    done = 0
    try:
        for can_id, payload in sent:
            bus.send(can_id, payload)
            done += 1
    except LinkLost:
        sent[:] = newest_of_each(sent[done:])
    else:
        sent.clear()


class SerialWire(Protocol):
    """The board's end of a serial line; the host opens `path`."""

    @property
    def path(self) -> str: ...
    def read(self) -> bytes: ...
    def write(self, sent: bytes) -> None: ...
    def settle(self) -> None: ...
    def vanish(self) -> None: ...
    def plug_in(self) -> None: ...
    def close(self) -> None: ...


class Pty:
    """A pseudo terminal in raw mode; its other end stays open here, so that hosts may reconnect."""

    def __init__(self) -> None:
        self._open()

    def _open(self) -> None:
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self._readable = select.poll()
        self._readable.register(self._theirs, select.POLLIN)
        self._expected_bytes = 0  # bytes that the host will find once the kernel has transferred all
        self.path = os.ttyname(self._theirs)
        self._is_here = True

    def read(self) -> bytes:
        """Read everything that the host has written."""
        received = b""
        if not self._is_here:
            return received
        try:
            # The kernel transfers bytes through a pty asynchronously; only an empty read ensures that all have arrived.
            while part := os.read(self._ours, 65536):
                received += part
        except BlockingIOError:
            return received
        return received

    def write(self, sent: bytes) -> None:
        """Send; if a host does not read, the oldest frames are lost."""
        if not self._is_here:
            return
        sent = newest_frames(sent)
        self._expected_bytes = min(self._unread() + len(sent), _ROOM_BYTES)
        with contextlib.suppress(BlockingIOError):
            os.write(self._ours, sent)

    def settle(self) -> None:
        """Return when the host can read what was sent, independent of the kernel's scheduling."""
        if not self._expected_bytes:
            return
        for _ in range(_MOST_LOOKS):
            self._readable.poll(0)  # of an empty tty: waits for pending bytes
            if self._unread() >= self._expected_bytes:
                break
        self._expected_bytes = 0

    def _unread(self) -> int:
        return int.from_bytes(fcntl.ioctl(self._theirs, termios.FIONREAD, b"\0\0\0\0"), sys.byteorder)

    def vanish(self) -> None:
        """Unplug the port: whoever has it open gets errors from now on."""
        self._is_here, self._expected_bytes = False, 0
        os.close(self._ours)

    def plug_in(self) -> None:
        """Plug a port that has vanished in again; its path is another one."""
        if not self._is_here:
            os.close(self._theirs)
            self._open()

    def close(self) -> None:
        """Close the pty."""
        if self._is_here:
            os.close(self._ours)
        os.close(self._theirs)


class Wires:
    """All wires of one robot. Nothing blocks."""

    def __init__(
        self,
        serial_wires: Sequence[SerialWire],
        can_interface: str,
        can_channel: str,
        cameras: Sequence[Transport] = ("datagrams",),
        can_formats: Collection[CanFormat] = (),
    ) -> None:
        """`can_formats`: which frames boards on the CAN bus use beside classic ones with 11-bit ids."""
        self.serial = tuple(serial_wires)
        # A separate port, because python-can receives all groups of a port. No hops: frames stay on this machine.
        is_multicast = can_interface == "udp_multicast"
        self.can_options: dict[str, Any] = {"port": free_udp_port(), "hop_limit": 0} if is_multicast else {}
        self._can_interface, self._can_channel = can_interface, can_channel
        self._buses = {
            carried: cast(CanFrameLink, join_can(can_interface, can_channel, carried=carried, **self.can_options))
            for carried in (CanFormat.STANDARD, *can_formats)
        }
        self._arrived: deque[Arrived] = deque()
        self._cameras = [camera_wire(transport) for transport in cameras]
        self.camera_ports = tuple(camera.port for camera in self._cameras)

    def from_host(self, robot: OnWires) -> None:
        """Pass the host's data to the robot."""
        for i, wire in enumerate(self.serial):
            received = wire.read()
            if received:
                robot.from_host_serial(i, received)
        for number, camera in enumerate(self._cameras):
            for request in camera.received():
                robot.from_host_camera(number, request)
        self.collect()
        self.pass_frames(robot)

    def collect(self) -> None:
        """Take the host's frames from the kernel, in their order."""
        arrivals: list[Arrived] = []
        with contextlib.suppress(LinkLost):  # a bus that is off for the host
            for carried, bus in self._buses.items():
                arrivals += [(at_s, carried, frame) for at_s, frame in bus.receive_timed()]
        if len(self._buses) > 1:
            arrivals.sort(key=itemgetter(0))
        self._arrived += arrivals

    def pass_frames(self, robot: OnWires, until_s: float = math.inf) -> None:
        """Pass collected frames that had come by then (seconds since 1970) to the robot."""
        while self._arrived and self._arrived[0][0] <= until_s:
            _, carried, (can_id, payload) = self._arrived.popleft()
            robot.from_host_can(can_id, payload, carried)

    def serial_to_host(self, robot: OnWires, ahead_s: float = 0.0) -> None:
        """Send the host the bytes that arrive by now, or within `ahead_s`."""
        for i, wire in enumerate(self.serial):
            sent = robot.serial_outgoing(i, ahead_s)
            if sent:
                wire.write(sent)

    def settle(self) -> None:
        """Return when the host can read all that was sent to it."""
        for wire in self.serial:
            wire.settle()

    def to_host(self, robot: OnWires, ahead_s: float = 0.0) -> None:
        """Send the host what the robot has sent by now, bytes by `ahead_s` later; a pty may delay it slightly."""
        self.serial_to_host(robot, ahead_s)
        for carried, bus in self._buses.items():
            if sent := robot.outgoing[carried]:
                _put_on(bus, sent)
        if robot.camera_outgoing:
            for camera, datagram in robot.camera_outgoing:
                self._cameras[camera].send(datagram)
            robot.camera_outgoing.clear()

    def plug_in(self) -> None:
        """Plug in again what has vanished, as a USB adapter comes back."""
        for wire in self.serial:
            wire.plug_in()

    def bus_off(self) -> None:
        """Tell the host's controller that it is off the bus, as SocketCAN does."""
        self._error_frame(_BUS_OFF)

    def bit_error(self) -> None:
        """Tell the host's controller of a violation on the bus, as a device at a wrong bit rate causes it."""
        self._error_frame(_BIT_ERROR)

    def _error_frame(self, kind: int) -> None:
        with can.Bus(interface=self._can_interface, channel=self._can_channel, ignore_config=True) as bus:
            bus.send(can.Message(arbitration_id=kind, is_error_frame=True, is_extended_id=False))

    def guest(self) -> FrameLink:
        """Another device on the CAN bus."""
        return join_can(self._can_interface, self._can_channel, **self.can_options)

    @contextlib.contextmanager
    def full_bus(self) -> Iterator[None]:
        """No frame of the host gets onto the bus: its transmit buffer is full, as SocketCAN says it."""
        with can.Bus(interface=self._can_interface, channel=self._can_channel, ignore_config=True) as bus:
            kind = type(bus)
        sends = kind.send

        def full(bus: can.BusABC, message: can.Message, timeout: float | None = None) -> None:
            if not (_OF_BOARDS & message.arbitration_id or message.is_error_frame):
                raise can.CanOperationError("Transmit buffer full")
            sends(bus, message, timeout)

        with patch.object(kind, "send", full):
            yield

    def close(self) -> None:
        """Close all wires."""
        for wire in self.serial:
            wire.close()
        for bus in self._buses.values():
            bus.close()
        for camera in self._cameras:
            camera.close()


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
        requests = []
        with contextlib.suppress(BlockingIOError):
            while True:
                request, self._client = self._socket.recvfrom(_LONGEST_DATAGRAM)
                requests.append(request)
        return requests

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
        packets = []
        with contextlib.suppress(BlockingIOError):
            client, _ = self._listener.accept()
            client.setblocking(False)
            self._hang_up()
            self._client = client
            packets.append(b"")
        self._buffer += self._arrived()
        while len(self._buffer) >= 4:
            size = int.from_bytes(self._buffer[:4], "little")
            if size < 4 or len(self._buffer) < size:
                break
            packets.append(self._buffer[:size])
            self._buffer = self._buffer[size:]
        return packets

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


_WIRES: Mapping[Transport, type[CameraWire]] = {"datagrams": Datagrams, "commands": Commands, "connection": OneClientServer}


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

"""Vicon Tracker's UDP object stream (Tracker user guide, "UDP object stream"); little endian, packed.

offset 0 frame number u32, 4 items in the block u8, then items: id u8, size of the data u16, data.
Item 0, 72 bytes: name 24 bytes (zero-padded), translation x, y, z f64 [mm], rotation x, y, z f64 [rad].

The rotation is Vicon's "Euler XYZ": about x, the new y, the new z; R = Rx Ry Rz turns the object's axes into the global ones.
Packets are as long as their items, or padded to 256, 512 or 1024 bytes. An object that is not tracked is left out, or all zero.
"""

from __future__ import annotations

import math
from struct import Struct

from firmware_iface.mocap.bodies import Body, BodyFrame, Pose, Quaternion, product
from firmware_iface.udp import UdpListener

DEFAULT_PORT = 51001
PADDED_bytes = (256, 512, 1024)
_HEADER = Struct("<IB")
_ITEM = Struct("<BH")
_OBJECT = Struct("<24s6d")
_OBJECT_ID = 0
_FARTHEST_m = 1000.0  # a larger coordinate is no capture volume
_MM = 1e-3


def unpack(datagram: bytes) -> BodyFrame | None:
    """The frame in a datagram, or None if it is not one of the object stream."""
    if len(datagram) < _HEADER.size:
        return None
    number, items = _HEADER.unpack_from(datagram)
    at, bodies = _HEADER.size, []
    for _ in range(items):
        if at + _ITEM.size > len(datagram):
            return None
        kind, size = _ITEM.unpack_from(datagram, at)
        at += _ITEM.size
        if at + size > len(datagram):
            return None
        if kind == _OBJECT_ID:
            if size != _OBJECT.size or (body := _body(datagram, at)) is None:
                return None
            bodies.append(body)
        at += size
    names = {body.name for body in bodies}
    if len(names) < len(bodies) or (at != len(datagram) and len(datagram) not in PADDED_bytes):
        return None
    return BodyFrame(number, tuple(bodies))


def _body(datagram: bytes, at: int) -> Body | None:
    raw, *numbers = _OBJECT.unpack_from(datagram, at)
    name = raw.split(b"\0", 1)[0]
    if not all(map(math.isfinite, numbers)):
        return None
    x, y, z = (_MM * value for value in numbers[:3])
    if max(abs(x), abs(y), abs(z)) > _FARTHEST_m or max(map(abs, numbers[3:])) > 2.0 * math.pi:
        return None
    try:
        text = name.decode()
    except UnicodeDecodeError:
        return None
    return Body(text, Pose((x, y, z), from_euler_xyz(*numbers[3:])), any(numbers)) if text else None


def from_euler_xyz(x_rad: float, y_rad: float, z_rad: float) -> Quaternion:
    """The quaternion of Rx Ry Rz."""
    about_x = (math.cos(x_rad / 2), math.sin(x_rad / 2), 0.0, 0.0)
    about_y = (math.cos(y_rad / 2), 0.0, math.sin(y_rad / 2), 0.0)
    about_z = (math.cos(z_rad / 2), 0.0, 0.0, math.sin(z_rad / 2))
    return product(about_x, product(about_y, about_z))


class ViconStream:
    """Meets BodyStream: listens for the packets of one computer (`host`), or of any (empty)."""

    def __init__(self, host: str, port: int) -> None:
        """PortMissing if the port is taken."""
        self.rejected = 0
        self._listener = UdpListener("Vicon", port, host)
        self.port, self.name = self._listener.port, self._listener.name

    def receive(self) -> list[BodyFrame]:
        """All frames received so far."""
        frames = []
        for datagram in self._listener.datagrams():
            if (frame := unpack(datagram)) is None:
                self.rejected += 1
            else:
                frames.append(frame)
        return frames

    def close(self) -> None:
        """Stop listening."""
        self._listener.close()

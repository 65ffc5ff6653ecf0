"""Vicon Tracker's UDP object stream (Tracker user guide, "UDP object stream"); little endian, packed.

offset 0 frame number u32, 4 items in the block u8, then items: id u8, size of the data u16, data.
Item 0, 72 bytes: name 24 bytes (zero-padded), translation x, y, z f64 [mm], rotation x, y, z f64 [rad].

The rotation is Vicon's "Euler XYZ": about x, the new y, the new z; R = Rx Ry Rz turns the object's axes into the global ones.
Packets are as long as their items, or padded to 256, 512 or 1024 bytes. An object that is not tracked is left out, or all zero.
"""

from __future__ import annotations

import math
from struct import Struct

from firmware_iface.camera import FrameListener, UdpListener
from firmware_iface.mocap.bodies import BodyFrame, FARTHEST_m, Fields, Malformed, Quaternion, RigidPose, SeenBody, product

DEFAULT_PORT = 51001
PADDED_bytes = (256, 512, 1024)
_HEADER = Struct("<IB")
_ITEM = Struct("<BH")
_NAME_bytes, _NUMBERS = 24, Struct("<6d")
_OBJECT_ID = 0
_MM = 1e-3


def unpack(datagram: bytes) -> BodyFrame | None:
    """The frame in a datagram, or None if it is not one of the object stream."""
    fields, bodies = Fields(datagram), []
    try:
        number, items = fields.read(_HEADER)
        for _ in range(int(items)):
            kind, size = fields.read(_ITEM)
            if kind == _OBJECT_ID:
                if size != _NAME_bytes + _NUMBERS.size:
                    return None
                bodies.append(_object(fields))
            else:
                fields.skip(int(size))
    except Malformed:
        return None
    names = {body.name for body in bodies}
    if len(names) < len(bodies) or (fields.left and len(datagram) not in PADDED_bytes):
        return None
    return BodyFrame(int(number), tuple(bodies))


def _object(fields: Fields) -> SeenBody:
    name = fields.text(_NAME_bytes)
    x, y, z, *angles = fields.read(_NUMBERS)
    if not name or max(abs(x), abs(y), abs(z)) > FARTHEST_m / _MM or max(map(abs, angles)) > 2.0 * math.pi:
        raise Malformed
    is_visible = any((x, y, z, *angles))
    return SeenBody(name, RigidPose((_MM * x, _MM * y, _MM * z), from_euler_xyz(*angles)), is_visible)


def from_euler_xyz(x_rad: float, y_rad: float, z_rad: float) -> Quaternion:
    """The quaternion of Rx Ry Rz."""
    about_x = (math.cos(x_rad / 2), math.sin(x_rad / 2), 0.0, 0.0)
    about_y = (math.cos(y_rad / 2), 0.0, math.sin(y_rad / 2), 0.0)
    about_z = (math.cos(z_rad / 2), 0.0, 0.0, math.sin(z_rad / 2))
    return product(about_x, product(about_y, about_z))


class ViconStream(FrameListener[BodyFrame]):
    """Meets BodyStream: listens for the packets of one computer (`host`), or of any (empty)."""

    def __init__(self, host: str, port: int) -> None:
        """PortMissing if the port is taken."""
        super().__init__(UdpListener("Vicon", port, host), unpack)

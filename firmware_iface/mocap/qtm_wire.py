"""Qualisys QTM's real-time protocol on its little-endian port (QTM RT server protocol, 1.19 and later).

Every packet: its size u32 (with these 8 bytes), kind u32, content.

    kind 0 error, 1 command, 2 XML   text, zero-terminated
    kind 3 data                      time u64 [us], frame u32, components u32; each: size u32 (with these 8 bytes), kind u32,
                                     content
    component 11, 6D with residual   bodies u32, drop rate u16, out of sync u16; each body: x y z f32 [mm], rotation matrix 9 f32
                                     column by column, residual f32 [mm]; not tracked: NaN

Bodies have no names here: they come in the order of the XML parameters "6D".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from struct import Struct
from xml.etree import ElementTree

from firmware_iface.mocap.bodies import NOWHERE, BodyFrame, Quaternion, RigidPose, SeenBody, unit
from firmware_iface.mocap.fields import MOST_ITEMS, FARTHEST_m, Fields, Malformed

ERROR, COMMAND, XML, DATA = 0, 1, 2, 3
LONGEST_bytes = 4_000_000  # of a packet; XML of all parameters has some 100 kB
HEADER = Struct("<II")
_DATA, _BODIES, _BODY = Struct("<QII"), Struct("<IHH"), Struct("<3f9ff")
_6D_RESIDUAL = 11
_MM = 1e-3


class Packets:
    """Cuts a stream of bytes into packets."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, received: bytes) -> list[tuple[int, bytes]]:
        """Kind and content of each packet that is complete. Malformed for a size that no packet has."""
        self._buffer += received
        found = []
        while len(self._buffer) >= HEADER.size:
            size, kind = HEADER.unpack_from(self._buffer)
            if not HEADER.size <= size <= LONGEST_bytes:
                raise Malformed
            if len(self._buffer) < size:
                break
            found.append((kind, self._buffer[HEADER.size : size]))
            self._buffer = self._buffer[size:]
        return found


def command(text: str) -> bytes:
    """A client's command."""
    content = text.encode() + b"\0"
    return HEADER.pack(HEADER.size + len(content), COMMAND) + content


def text_of(content: bytes) -> str:
    """The text of an error, a command or XML."""
    return content.split(b"\0", 1)[0].decode(errors="replace")


def unpack_names(content: bytes) -> list[tuple[str, bool]] | None:
    """Names of the 6D bodies in order, and whether each is enabled, from the XML parameters; None if it is something else."""
    text = text_of(content)
    if "<!" in text.replace("<!--", ""):  # no document types: entities could grow without end
        return None
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return None
    bodies = root.findall(".//The_6D/Body")
    found = [
        (body.findtext("Name", ""), body.findtext("Enabled", "true").lower() == "true") for body in bodies
    ]
    return found if all(name for name, _ in found) and len(found) <= MOST_ITEMS else None


def unpack_data(content: bytes, names: Sequence[tuple[str, bool]]) -> BodyFrame | None:
    """The bodies of a data packet, or None. Bodies that are not enabled may be left out."""
    fields = Fields(content)
    try:
        time_us, number, components = fields.read(_DATA)
        bodies: tuple[SeenBody, ...] | None = None
        for _ in range(int(components)):
            size, kind = fields.read(HEADER)
            end = fields.at - HEADER.size + int(size)
            if kind == _6D_RESIDUAL:
                bodies = _bodies(fields, names)
            fields.skip(end - fields.at)
    except Malformed:
        return None
    if fields.left or bodies is None:
        return None
    return BodyFrame(int(number), bodies, 1e-6 * time_us)


def _bodies(fields: Fields, names: Sequence[tuple[str, bool]]) -> tuple[SeenBody, ...]:
    count, *_ = fields.read(_BODIES)
    called = [name for name, _ in names]
    if count != len(called):
        called = [name for name, is_enabled in names if is_enabled]
    if count != len(called) or len(set(called)) < len(called):
        raise Malformed
    return tuple(_body(name, *fields.read(_BODY, is_finite=False)) for name in called)


def _body(name: str, x: float, y: float, z: float, *rest: float) -> SeenBody:
    *matrix, residual_mm = rest
    if not all(map(math.isfinite, (x, y, z, *matrix))):
        return SeenBody(name, NOWHERE, is_visible=False)
    quaternion = _quaternion(matrix)
    if quaternion is None or max(abs(x), abs(y), abs(z)) > FARTHEST_m / _MM:
        raise Malformed
    return SeenBody(name, RigidPose((_MM * x, _MM * y, _MM * z), quaternion), True, _MM * residual_mm)


def _quaternion(columns: Sequence[float]) -> Quaternion | None:
    """Of a rotation matrix column by column; None if it is none. Each square from the diagonal; the largest divides."""
    a, d, g, b, e, h, c, f, i = columns
    squares = (1.0 + a + e + i, 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i)
    largest = max(range(4), key=squares.__getitem__)
    rows = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    )
    scale = 2.0 * math.sqrt(max(squares[largest], 1e-12))
    return unit([value / scale for value in rows[largest]])

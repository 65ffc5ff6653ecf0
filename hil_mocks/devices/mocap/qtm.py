"""Qualisys Track Manager's real-time server: greets, agrees on a version, tells the bodies' names, streams 6D with residuals."""

from __future__ import annotations

import math
import struct

from hil_mocks.devices.camera import Filmed
from hil_mocks.devices.mocap.scene import MocapMock, Sight

_ERROR, _COMMAND, _XML, _DATA = 0, 1, 2, 3
_6D_RESIDUAL = 11
RESIDUAL_mm = 0.2
GREETING = b"QTM RT Interface connected"


class QtmMock(MocapMock):
    """Answers commands on a TCP connection; `request` is one packet of the client, empty when it connects."""

    transport = "connection"
    _is_streaming = False

    def tick(self, now_s: float, arm: Filmed) -> list[bytes]:
        """Data packets, once the client has asked for them."""
        packets = super().tick(now_s, arm)
        return packets if self._is_streaming else []

    def answer(self, request: bytes) -> list[bytes]:
        """The answers to one command."""
        if not request:
            self._is_streaming = False
            return [_packet(_COMMAND, GREETING + b"\0")]
        words = request[8:].split(b"\0")[0].decode(errors="replace").split()
        match [word.lower() for word in words]:
            case ["version", version]:
                return [_packet(_COMMAND, f"Version set to {version}\0".encode())]
            case ["getparameters", "6d"]:
                return [_packet(_XML, self._parameters().encode() + b"\0")]
            case ["streamframes", *how]:
                self._is_streaming = how != ["stop"]
                return []
        return [_packet(_ERROR, b"Parse error\0")]

    def _parameters(self) -> str:
        bodies = "".join(
            f"<Body><Name>{name}</Name><RGBColor>255</RGBColor><Mesh><Name></Name></Mesh></Body>"
            for name in self.names
        )
        return f"<QTM_Parameters_Ver_1.19><The_6D><Bodies>{len(self.names)}</Bodies>{bodies}</The_6D></QTM_Parameters_Ver_1.19>"

    def packet(self, number: int, time_s: float, sights: list[Sight]) -> bytes:
        """One frame with one component."""
        bodies = b"".join(_body(sight) for sight in sights)
        content = struct.pack("<IHH", len(sights), 0, 0) + bodies
        component = struct.pack("<II", 8 + len(content), _6D_RESIDUAL) + content
        return _packet(_DATA, struct.pack("<QII", round(time_s * 1e6), number, 1) + component)


def _packet(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", 8 + len(content), kind) + content


def _body(sight: Sight) -> bytes:
    if not sight.is_visible:
        return struct.pack("<13f", *[math.nan] * 13)
    return struct.pack("<3f9ff", *(1e3 * sight.position_m), *sight.rotation.T.ravel(), RESIDUAL_mm)

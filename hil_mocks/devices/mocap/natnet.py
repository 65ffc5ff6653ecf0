"""Motive as NatNet 4.1, unicast: answers connect and model requests, sends rigid bodies to the client that has asked last."""

from __future__ import annotations

import math
import struct

import numpy as np

from hil_mocks.devices.mocap.scene import Array, MocapMock, Sight

_CONNECT, _SERVER_INFO, _REQUEST_MODELS, _MODELS, _FRAME = 0, 1, 4, 5, 7
_UNKNOWN_REQUEST = 100
_EMPTY = struct.pack("<ii", 0, 0)  # a kind of data without items: count and size
FIRST_ID = 11
MEAN_ERROR_m = 2e-4


class NatNetMock(MocapMock):
    """Answers commands, and sends a datagram a frame once a client has connected."""

    transport = "commands"

    def answer(self, request: bytes) -> list[bytes]:
        """Server info, names of the rigid bodies, or nothing."""
        if len(request) < 4:
            return []
        (message,) = struct.unpack_from("<H", request)
        match message:
            case 0:
                return [_packet(_SERVER_INFO, self._server_info())]
            case 4:
                return [_packet(_MODELS, self._models())]
            case 10:
                return []
        return [_packet(_UNKNOWN_REQUEST, b"")]

    def _server_info(self) -> bytes:
        name = b"Motive".ljust(256, b"\0")
        return (
            name
            + bytes((3, 1, 0, 0, 4, 1, 0, 0))
            + struct.pack("<QHB4B", 10_000_000, 1511, 0, 239, 255, 42, 99)
        )

    def _models(self) -> bytes:
        markers = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0)]
        models = []
        for number, name in enumerate(self.names, FIRST_ID):
            body = (
                name.encode()
                + b"\0"
                + struct.pack("<ii3f", number, -1, 0.0, 0.0, 0.0)
                + struct.pack("<i", len(markers))
            )
            body += b"".join(struct.pack("<3f", *marker) for marker in markers)
            body += struct.pack(f"<{len(markers)}i", *range(len(markers)))
            body += b"".join(b"Marker\0" for _ in markers)
            models.append(struct.pack("<ii", 1, len(body)) + body)
        marker_set = b"all\0" + struct.pack("<i", 1) + b"one\0"
        models.insert(0, struct.pack("<ii", 0, len(marker_set)) + marker_set)
        return struct.pack("<i", len(models)) + b"".join(models)

    def packet(self, number: int, time_s: float, sights: list[Sight]) -> bytes:
        """One frame, with a marker set and labelled markers as Motive sends them."""
        marker_set = b"all\0" + struct.pack("<i3f", 1, 0.1, 0.2, 0.3)
        bodies = b"".join(_body(at, sight) for at, sight in enumerate(sights, FIRST_ID))
        labelled = struct.pack("<i3ffHf", 1, 0.1, 0.2, 0.3, 0.014, 2, 1e-4)
        parts = [
            struct.pack("<i", number),
            struct.pack("<ii", 1, len(marker_set)) + marker_set,
            _EMPTY,
            struct.pack("<ii", len(sights), len(bodies)) + bodies,
            _EMPTY,
            _EMPTY,
            struct.pack("<ii", 1, len(labelled)) + labelled,
            _EMPTY,
            _EMPTY,
            struct.pack("<IIdQQQH", 0, 0, time_s, 0, 0, 0, 0),
        ]
        return _packet(_FRAME, b"".join(parts))


def _packet(message: int, payload: bytes) -> bytes:
    return struct.pack("<HH", message, len(payload)) + payload


def _body(number: int, sight: Sight) -> bytes:
    if not sight.is_visible:
        return struct.pack("<i3f4ffH", number, *[0.0] * 7, 0.0, 0)
    w, x, y, z = quaternion_of(sight.rotation)
    return struct.pack("<i3f4ffH", number, *sight.position_m, x, y, z, w, MEAN_ERROR_m, 1)


def quaternion_of(rotation: Array) -> tuple[float, float, float, float]:
    """w, x, y, z by the eigenvector of Bar-Itzhack's matrix (J. Guidance 23, 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, 3].tolist()
    length = math.hypot(w, x, y, z)
    return w / length, x / length, y / length, z / length

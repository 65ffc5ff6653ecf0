"""Vicon Tracker as a UDP object stream: docs/motion_capture.md has the bytes. Objects that are hidden are left out."""

from __future__ import annotations

import math
import struct

from hil_mocks.devices.mocap.scene import MocapMock, Sight

_OBJECT = struct.Struct("<BH24s6d")
_OBJECT_bytes = 72


class ViconMock(MocapMock):
    """Sends one datagram a frame."""

    def packet(self, number: int, time_s: float, sights: list[Sight]) -> bytes:
        """Header and one item for each visible object."""
        seen = [sight for sight in sights if sight.is_visible]
        items = b"".join(
            _OBJECT.pack(0, _OBJECT_bytes, sight.name.encode(), *(1e3 * sight.position_m), *_euler_xyz(sight))
            for sight in seen
        )
        return struct.pack("<IB", number & 0xFFFFFFFF, len(seen)) + items


def _euler_xyz(sight: Sight) -> tuple[float, float, float]:
    """Angles with rotation = Rx Ry Rz."""
    r = sight.rotation
    return (
        math.atan2(-r[1, 2], r[2, 2]),
        math.asin(max(-1.0, min(1.0, float(r[0, 2])))),
        math.atan2(-r[0, 1], r[0, 0]),
    )

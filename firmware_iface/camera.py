"""Camera frames over UDP: one datagram per marker and image. docs/camera.md defines the format.

offset 0 magic b"AWCM", 4 version u8 = 1, 5 flags u8 (bit 0: visible), 6 source u16,
8 sequence u32, 12 time_s f64, 20 x_m, 28 y_m, 36 z_m f64; little endian, 44 bytes
"""

import math
from dataclasses import dataclass
from struct import Struct

from firmware_iface.udp import FrameListener, UdpListener

DEFAULT_PORT = 47310
TIP_SOURCE = 0
_MAGIC = b"AWCM"
_VERSION = 1
_LAYOUT = Struct("<4sBBHIdddd")


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """Position of a marker in the base frame at `time_s` of the camera's own clock."""

    sequence: int
    time_s: float
    position_m: tuple[float, float, float]
    is_visible: bool = True
    source: int = TIP_SOURCE


def unpack(datagram: bytes) -> CameraFrame | None:
    """Return the frame in `datagram`, or None if it is not a camera frame."""
    if len(datagram) != _LAYOUT.size:
        return None
    magic, version, flags, source, sequence, time_s, x_m, y_m, z_m = _LAYOUT.unpack(datagram)
    if magic != _MAGIC or version != _VERSION or flags > 1:
        return None
    if not all(map(math.isfinite, (time_s, x_m, y_m, z_m))):
        return None
    return CameraFrame(sequence, time_s, (x_m, y_m, z_m), bool(flags), source)


class CameraReceiver(FrameListener[CameraFrame]):
    """Listens on a UDP port."""

    def __init__(self, port: int = DEFAULT_PORT, host: str = "127.0.0.1") -> None:
        """Listen on `port` of the interface with address `host`; port 0 takes any free one."""
        super().__init__(UdpListener("camera", port, interface=host), unpack)

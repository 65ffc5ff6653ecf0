"""Opens the stream of a motion capture system by the system's name."""

from __future__ import annotations

from firmware_iface.clock import Clock
from firmware_iface.mocap.bodies import BodyStream
from firmware_iface.mocap.natnet import NatNetStream
from firmware_iface.mocap.qtm import QtmStream
from firmware_iface.mocap.vicon import ViconStream


def open_stream(system: str, host: str, port: int, clock: Clock) -> BodyStream:
    """Open it, and wait for its names where it says them. LinkError if the port is taken or nothing answers."""
    if system == "natnet":
        return NatNetStream(host, port, clock)
    if system == "qualisys":
        return QtmStream(host, port, clock)
    return ViconStream(host, port)

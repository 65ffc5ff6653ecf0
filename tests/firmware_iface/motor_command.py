"""A COMMAND as the motor boards read it."""

import struct
from dataclasses import dataclass
from typing import Self

from firmware_iface.motor import wire


@dataclass(frozen=True, slots=True)
class MotorCommand:
    """One COMMAND; the set-point in the unit of the mode [mV], [mA], [count]."""

    controlword: int
    mode: int
    sequence: int
    setpoint_raw: int
    feedforward_mV: int = 0

    def pack(self) -> bytes:
        """Pack the payload; struct.error if a number does not fit its field."""
        return wire.pack_raw_command(self.controlword, self.mode | self.sequence << 3, self.setpoint_raw, self.feedforward_mV)

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Unpack 8 bytes."""
        controlword, mixed, setpoint_raw, feedforward_mV = struct.unpack("<BBih", payload)
        return cls(controlword, mixed & 7, mixed >> 3, setpoint_raw, feedforward_mV)

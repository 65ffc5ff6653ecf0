"""The motor board's frames: encoding and decoding. motor_board.dbc defines them.

Little endian; ids are base + node. Tests compare this file with the DBC.

    EMERGENCY_STOP    0x000       reason u8
    COMMAND           0x100+node  controlword u8, mode bits 0-2 | sequence bits 3-7, setpoint i32 (mV, mA,
                                  counts), feedforward i16 (mV)
    REPLY             0x180+node  statusword u8, mode | echoed sequence, current i16 (mA), supply u16 (mV),
                                  temperature i8 (degC), faults u8
    PARAMETER_REQUEST 0x200+node  operation u8, index u8, sequence u8, zero u8, value i32
    PARAMETER_ANSWER  0x280+node  result u8, index u8, sequence u8, zero u8, value i32
    DIGITAL_COMMAND   0x300+node  sequence u8, mask u8, levels u8, zeros
    DIGITAL_REPLY     0x380+node  sequence u8, levels u8, outputs u8, is_safe u8, zeros
"""

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from struct import Struct
from typing import NamedTuple, Self

from firmware_iface.motor.cia402 import STATE_OF_STATUSWORD, DriveState

PROTOCOL_VERSION = 1
NODES = range(1, 16)
EMERGENCY_STOP_ID = 0x000
COMMAND_ID = 0x100
REPLY_ID = 0x180
PARAMETER_REQUEST_ID = 0x200
PARAMETER_ANSWER_ID = 0x280
DIGITAL_COMMAND_ID = 0x300
DIGITAL_REPLY_ID = 0x380
SEQUENCE_MASK = 0x1F
WARNING_BIT = 0x80

_COMMAND = Struct("<BBih")
_REPLY = Struct("<BBhHbB")
_PARAMETER = Struct("<BBBxi")
_DIGITAL_COMMAND = Struct("<BBB5x")
_DIGITAL_REPLY = Struct("<BBBB4x")

pack_raw_command = _COMMAND.pack
"""(controlword, mode | sequence << 3, setpoint_raw, feedforward_mV) to bytes; struct.error if a number does not fit."""


class SetpointMode(IntEnum):
    """Meaning of the set-point of a COMMAND."""

    OFF = 0
    VOLTAGE = 1
    CURRENT = 2
    POSITION = 3
    HOLD = 4


class MotorFault(IntFlag):
    """Fault bits of a board."""

    OVER_CURRENT = 0x01
    OVER_TEMPERATURE = 0x02
    UNDER_VOLTAGE = 0x04
    OVER_VOLTAGE = 0x08
    WATCHDOG = 0x10
    ENCODER = 0x20
    BAD_COMMAND = 0x40
    EMERGENCY_STOP = 0x80


class Operation(IntEnum):
    """Operation of a PARAMETER_REQUEST."""

    READ = 0
    WRITE = 1


class ParameterResult(IntEnum):
    """Result code of a PARAMETER_ANSWER."""

    DONE = 0
    UNKNOWN_INDEX = 1
    READ_ONLY = 2
    OUT_OF_RANGE = 3
    NOT_IN_THIS_STATE = 4


class MotorParameter(IntEnum):
    """Parameter indices; units are those of the raw value."""

    PROTOCOL_VERSION = 0
    BOARD_SERIAL_NUMBER = 1
    FIRMWARE_VERSION = 2
    ENCODER_COUNTS_PER_TURN = 3
    POSITION_COUNT = 4
    CONTROL_PERIOD_us = 5
    RESET_CAUSE = 6
    KP_uV_count = 16
    KI_uV_count_s = 17
    KD_nV_s_count = 18
    DERIVATIVE_FILTER_us = 19
    CURRENT_LIMIT_mA = 20
    VOLTAGE_LIMIT_mV = 21
    INTEGRAL_LIMIT_mV = 22
    SPEED_FEEDFORWARD_nV_s_count = 23
    WATCHDOG_ms = 32
    WATCHDOG_ACTION = 33
    DISABLED_OUTPUT = 34
    STOP_AFTER_ms = 35
    STOP_TIME_ms = 36
    DIGITAL_PINS = 48
    DIGITAL_OUTPUTS = 49
    DIGITAL_SAFE_LEVELS = 50
    DIGITAL_SAFE_KEEP = 51


class ResetCause(IntEnum):
    """Values of RESET_CAUSE: why a board last started."""

    NOT_KNOWN = 0
    POWER_UP = 1
    RESET_LINE = 2
    WATCHDOG = 3
    LOW_SUPPLY = 4
    PROGRAM = 5


class IdleOutput(IntEnum):
    """Values of WATCHDOG_ACTION and (without HOLD) of DISABLED_OUTPUT."""

    OPEN_CIRCUIT = 0
    BRAKE = 1
    HOLD = 2


class Reply(NamedTuple):
    """One REPLY in SI units. A named tuple, because three are created per cycle (0.5 us faster each)."""

    statusword: int
    mode: int
    sequence: int
    current_A: float
    supply_V: float
    temperature_degC: int
    faults: int

    @property
    def state(self) -> DriveState | None:
        """The drive's state; None if the statusword is invalid."""
        return STATE_OF_STATUSWORD[self.statusword]

    @property
    def fault_flags(self) -> MotorFault:
        """The fault bits by name."""
        return MotorFault(self.faults)

    @property
    def is_limited(self) -> bool:
        """Whether the board limits the output (status bit 7)."""
        return bool(self.statusword & WARNING_BIT)

    def pack(self) -> bytes:
        """Pack the payload; struct.error if a number does not fit its field."""
        current_mA, supply_mV = round(self.current_A * 1e3), round(self.supply_V * 1e3)
        mixed = self.mode | self.sequence << 3
        return _REPLY.pack(self.statusword, mixed, current_mA, supply_mV, self.temperature_degC, self.faults)


def unpack_reply(payload: bytes) -> Reply:
    """Unpack 8 bytes."""
    statusword, mixed, current_mA, supply_mV, temperature, faults = _REPLY.unpack(payload)
    # One a board and cycle: without a named tuple's own constructor, which is a Python function.
    return tuple.__new__(Reply, (statusword, mixed & 7, mixed >> 3, current_mA * 1e-3, supply_mV * 1e-3, temperature, faults))


@dataclass(frozen=True, slots=True)
class ParameterRequest:
    """Read or write one parameter."""

    operation: int
    index: int
    sequence: int
    value: int = 0

    def pack(self) -> bytes:
        """Pack the payload; struct.error if a number does not fit its field."""
        return _PARAMETER.pack(self.operation, self.index, self.sequence, self.value)

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Unpack 8 bytes."""
        return cls(*_PARAMETER.unpack(payload))


@dataclass(frozen=True, slots=True)
class ParameterAnswer:
    """The present value. `sequence` 0: unsolicited, the board has just started."""

    result: int
    index: int
    sequence: int
    value: int

    def pack(self) -> bytes:
        """Pack the payload; struct.error if a number does not fit its field."""
        return _PARAMETER.pack(self.result, self.index, self.sequence, self.value)

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Unpack 8 bytes."""
        return cls(*_PARAMETER.unpack(payload))


@dataclass(frozen=True, slots=True)
class DigitalCommand:
    """Set the outputs of `mask` to their bits of `levels`, and ask for the pins."""

    sequence: int
    mask: int = 0
    levels: int = 0

    def pack(self) -> bytes:
        """Pack the payload; struct.error if a number does not fit its field."""
        return _DIGITAL_COMMAND.pack(self.sequence, self.mask, self.levels)

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Unpack 8 bytes."""
        return cls(*_DIGITAL_COMMAND.unpack(payload))


@dataclass(frozen=True, slots=True)
class DigitalReply:
    """The levels of all pins, and of the outputs as the board drives them; `is_safe`: they have their safe levels."""

    sequence: int
    levels: int
    outputs: int
    is_safe: int

    def pack(self) -> bytes:
        """Pack the payload; struct.error if a number does not fit its field."""
        return _DIGITAL_REPLY.pack(self.sequence, self.levels, self.outputs, self.is_safe)

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Unpack 8 bytes."""
        return cls(*_DIGITAL_REPLY.unpack(payload))

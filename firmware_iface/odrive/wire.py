"""Frames of an ODrive on CAN (CANSimple, firmware 0.6), without I/O. Source: ODrive's CAN documentation and its DBC, 0.6.10.

    11-bit id: node << 5 | command; numbers are little endian, f32 unless said otherwise

    from the ODrive, at rates of its own                 to the ODrive
    HEARTBEAT 0x01     u32 errors, u8 state,             SET_AXIS_STATE 0x07       u32 state
                       u8 procedure result, u8 done      SET_CONTROLLER_MODE 0x0B  u32 control, u32 input
    ENCODER 0x09       turns, turns/s                    SET_INPUT_POS 0x0C        turns, i16 1e3/(turns/s), i16 1e3/Nm
    IQ 0x14            set A, measured A                 SET_INPUT_TORQUE 0x0E     Nm
    TEMPERATURE 0x15   FETs degC, motor degC             SET_LIMITS 0x0F           turns/s, A
    BUS 0x17           V, A                              CLEAR_ERRORS 0x18         u8 0

Firmware 0.5 has messages of the same form and another meaning. It answers an empty frame of SENSORLESS_ERROR 0x05 by the same,
u32 error and four bytes of 0, which 0.6 does not know (ODrive's own can_simple.cpp of 0.5.6). There 0x05 carries answers about
settings: u8 0, u16 which, u8 0, the value.

The errors of HEARTBEAT are those that there are, and those that ended the last operation until CLEAR_ERRORS.
"""

import struct
from enum import IntEnum, IntFlag
from typing import Final, NamedTuple

NODES: Final = range(63)  # 63 is all of them
MOST_SPEED_turns_s: Final = 32.767  # of a feed-forward
PASSTHROUGH: Final = 1  # an input mode: set-points take effect as they come

Frame = tuple[int, bytes]


class OdriveCommand(IntEnum):
    """Commands of CANSimple."""

    HEARTBEAT = 0x01
    SENSORLESS_ERROR = 0x05  # of firmware 0.5
    SET_AXIS_STATE = 0x07
    ENCODER = 0x09
    SET_CONTROLLER_MODE = 0x0B
    SET_INPUT_POS = 0x0C
    SET_INPUT_TORQUE = 0x0E
    SET_LIMITS = 0x0F
    IQ = 0x14
    TEMPERATURE = 0x15
    BUS = 0x17
    CLEAR_ERRORS = 0x18


class AxisState(IntEnum):
    """States of an axis that are used here."""

    IDLE = 1
    CLOSED_LOOP_CONTROL = 8


class OdriveControlMode(IntEnum):
    """Control modes that are used here."""

    TORQUE = 1
    POSITION = 3


class Error(IntFlag):
    """Errors of an axis."""

    INITIALIZING = 1 << 0
    SYSTEM_LEVEL = 1 << 1
    TIMING_ERROR = 1 << 2
    MISSING_ESTIMATE = 1 << 3
    BAD_CONFIG = 1 << 4
    DRV_FAULT = 1 << 5
    MISSING_INPUT = 1 << 6
    DC_BUS_OVER_VOLTAGE = 1 << 8
    DC_BUS_UNDER_VOLTAGE = 1 << 9
    DC_BUS_OVER_CURRENT = 1 << 10
    DC_BUS_OVER_REGEN_CURRENT = 1 << 11
    CURRENT_LIMIT_VIOLATION = 1 << 12
    MOTOR_OVER_TEMP = 1 << 13
    INVERTER_OVER_TEMP = 1 << 14
    VELOCITY_LIMIT_VIOLATION = 1 << 15
    POSITION_LIMIT_VIOLATION = 1 << 16
    WATCHDOG_TIMER_EXPIRED = 1 << 24
    ESTOP_REQUESTED = 1 << 25
    SPINOUT_DETECTED = 1 << 26
    BRAKE_RESISTOR_DISARMED = 1 << 27
    THERMISTOR_DISCONNECTED = 1 << 28
    CALIBRATION_ERROR = 1 << 30


class Heartbeat(NamedTuple):
    """Errors, state (AxisState, or another number), and how the last procedure ended (0: well, 1: it goes on)."""

    errors: Error
    state: int
    result: int


def frame_id(node: int, command: int) -> int:
    """The 11-bit id of a command to or from a node."""
    return node << 5 | command


def axis_state(node: int, state: AxisState) -> Frame:
    """Ask for a state. An axis that is asked for the state that it has leaves it and enters it anew."""
    return frame_id(node, OdriveCommand.SET_AXIS_STATE), struct.pack("<I", state)


def controller_mode(node: int, control: OdriveControlMode) -> Frame:
    """Choose what the inputs are; they take effect as they come."""
    return frame_id(node, OdriveCommand.SET_CONTROLLER_MODE), struct.pack("<II", control, PASSTHROUGH)


def position(node: int, turns: float, speed_turns_s: float = 0.0) -> Frame:
    """Set the encoder's position, and the speed at which it moves there: at most MOST_SPEED_turns_s, the field's end."""
    speed = round(1e3 * min(max(speed_turns_s, -MOST_SPEED_turns_s), MOST_SPEED_turns_s))
    return frame_id(node, OdriveCommand.SET_INPUT_POS), struct.pack("<fhh", turns, speed, 0)


def torque(node: int, torque_Nm: float) -> Frame:
    """Set the motor's torque."""
    return frame_id(node, OdriveCommand.SET_INPUT_TORQUE), struct.pack("<f", torque_Nm)


def limits(node: int, speed_turns_s: float, current_A: float) -> Frame:
    """Limit speed and current until the next start; nothing is stored."""
    return frame_id(node, OdriveCommand.SET_LIMITS), struct.pack("<ff", speed_turns_s, current_A)


def clear_errors(node: int) -> Frame:
    """Forget errors whose cause is gone."""
    return frame_id(node, OdriveCommand.CLEAR_ERRORS), b"\x00"


def ask_sensorless_error(node: int) -> Frame:
    """A question that firmware 0.5 answers, and no other."""
    return frame_id(node, OdriveCommand.SENSORLESS_ERROR), b""


def is_sensorless_error(payload: bytes) -> bool:
    """Whether an answer is one of firmware 0.5, of whose errors the first byte has all; else it is 0.6's about a setting."""
    return len(payload) == 8 and not any(payload[1:])


def heartbeat(payload: bytes) -> Heartbeat:
    """HEARTBEAT, with or without what follows the result. struct.error if it is shorter."""
    errors, state, result = struct.unpack_from("<IBB", payload)
    return Heartbeat(Error(errors), state, result)


def pair(payload: bytes) -> tuple[float, float]:
    """The two numbers of ENCODER, IQ, TEMPERATURE or BUS. struct.error if it has another length."""
    first, second = struct.unpack("<ff", payload)
    return first, second

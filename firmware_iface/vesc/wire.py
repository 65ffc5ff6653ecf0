"""Frames of a VESC on CAN, without I/O. Source: VESC firmware 6, comm/comm_can.c, datatypes.h and confgenerator.c.

    29-bit id: packet << 8 | controller id; numbers are big endian

    SET_DUTY 0              i32 duty 1e5             STATUS 9      i32 erpm, i16 current 10/A, i16 duty 1e3
    SET_CURRENT 1           i32 current 1e3/A        STATUS_2 14   i32 charge drawn 1e4/Ah, i32 charge returned 1e4/Ah
    SET_POS 4               i32 angle 1e6/deg        STATUS_3 15   i32 energy drawn 1e4/Wh, i32 energy returned 1e4/Wh
    CONF_CURRENT_LIMITS 21  i32, i32 1e3/A           STATUS_4 16   i16 FETs 10/degC, i16 motor 10/degC, i16 input 10/A,
    PING 17                 u8 who asks                            i16 angle 50/deg
    PONG 18 (to who asked)  u8 id, u8 hardware       STATUS_5 27   i32 tachometer, i16 supply 10/V, i16 reserved
    NOTIFY_BOOT 57          after a start            STATUS_6 58   i16 ADC 1, 2, 3 1e3/V, i16 pulse input 1e3

    PROCESS_SHORT_BUFFER 8  u8 who asks, u8 0, a command of the serial protocol of at most 6 bytes; its answer, if as short,
    comes in the same packet to who asked, with u8 id, u8 1 before it. COMM_GET_VALUES_SELECTIVE 50: u32 mask, then the values.
    A longer answer comes to who asked in FILL_RX_BUFFER 5, u8 place (LONG 6, u16 place), bytes; PROCESS_RX_BUFFER 7, u8 id, u8 1,
    u16 length, u16 CRC of all ends it. COMM_GET_APPCONF 17: u32 signature, u8 id, u32 time-out 1e3/s, f32 its brake current A; 20
    bytes, then u8 application

The current of STATUS is positive while the motor drives and negative while it brakes; with the duty's sign it has a direction.
"""

import struct
from enum import IntEnum
from typing import Final, NamedTuple

IDS: Final = range(254)  # 255 is all of them; 254 is the host's
HOST: Final = 254
COUNTS_PER_TURN: Final = 18_000  # the angle of STATUS_4
GET_APPCONF: Final = 17
GET_VALUES_SELECTIVE: Final = 50
_APPCONF: Final = struct.Struct(">B4xBIf20xB")
FAULT_MASK: Final = 1 << 15
_ASK, _ANSWER = 0, 1
_MOST_i32: Final = 2**31 - 1


class Packet(IntEnum):
    """Packets of VESC's CAN protocol."""

    SET_DUTY = 0
    SET_CURRENT = 1
    SET_POS = 4
    FILL_RX_BUFFER = 5
    FILL_RX_BUFFER_LONG = 6
    PROCESS_RX_BUFFER = 7
    PROCESS_SHORT_BUFFER = 8
    STATUS = 9
    STATUS_2 = 14
    STATUS_3 = 15
    STATUS_4 = 16
    PING = 17
    PONG = 18
    CONF_CURRENT_LIMITS = 21
    STATUS_5 = 27
    NOTIFY_BOOT = 57
    STATUS_6 = 58


Frame = tuple[int, bytes]


class VescStatus(NamedTuple):
    """Electrical speed [1/min], current [A] as described above, duty -1 to 1."""

    erpm: int
    current_A: float
    duty: float


class Status4(NamedTuple):
    """Temperatures, input current, and the encoder's angle in COUNTS_PER_TURN."""

    fets_degC: float
    motor_degC: float
    input_A: float
    angle_count: int


class Status5(NamedTuple):
    """Tachometer in its own counts, and supply."""

    tachometer: int
    supply_V: float


def frame_id(packet: int, controller: int) -> int:
    """The 29-bit id of a packet to or from a controller."""
    return packet << 8 | controller


def duty(controller: int, share: float) -> Frame:
    """Drive with a share of the supply, -1 to 1; 0 shorts the windings."""
    return _scaled(Packet.SET_DUTY, controller, share, 1e5)


def current(controller: int, amperes: float) -> Frame:
    """Drive with a current; 0 opens the circuit."""
    return _scaled(Packet.SET_CURRENT, controller, amperes, 1e3)


def position(controller: int, count: int) -> Frame:
    """Turn the shorter way to an angle within one turn, in COUNTS_PER_TURN."""
    return _scaled(Packet.SET_POS, controller, count % COUNTS_PER_TURN * 360.0 / COUNTS_PER_TURN, 1e6)


def current_limits(controller: int, amperes: float) -> Frame:
    """Limit driving and braking currents until the next start; nothing is stored."""
    most = min(round(amperes * 1e3), _MOST_i32)
    return frame_id(Packet.CONF_CURRENT_LIMITS, controller), struct.pack(">ii", -most, most)


def ping(controller: int) -> Frame:
    """Ask whether a controller is there."""
    return frame_id(Packet.PING, controller), bytes((HOST,))


def ask_fault(controller: int) -> Frame:
    """Ask for the fault code."""
    payload = struct.pack(">BBBI", HOST, _ASK, GET_VALUES_SELECTIVE, FAULT_MASK)
    return frame_id(Packet.PROCESS_SHORT_BUFFER, controller), payload


def fault_in(payload: bytes) -> tuple[int, int] | None:
    """Controller and fault code of an answer to `ask_fault`; None if it is another answer."""
    if len(payload) != 8:
        return None
    controller, kind, command, mask, fault = struct.unpack(">BBBIB", payload)
    if (kind, command, mask) != (_ANSWER, GET_VALUES_SELECTIVE, FAULT_MASK):
        return None
    return controller, fault


class Settings(NamedTuple):
    """What is stored in a controller: its time-out, the brake current after it, and the application that may command it, too."""

    timeout_s: float
    brake_A: float
    application: int


def ask_settings(controller: int) -> Frame:
    """Ask for the application's configuration; a long answer."""
    return frame_id(Packet.PROCESS_SHORT_BUFFER, controller), bytes((HOST, _ASK, GET_APPCONF))


def settings_in(answer: bytes, controller: int) -> Settings | None:
    """What a long answer says of a controller; None if it is another answer, or of another layout."""
    if len(answer) < _APPCONF.size:
        return None
    command, number, timeout_ms, brake_A, application = _APPCONF.unpack_from(answer)
    is_it = (command, number) == (GET_APPCONF, controller)
    return Settings(timeout_ms * 1e-3, brake_A, application) if is_it else None


def status(payload: bytes) -> VescStatus:
    """STATUS. struct.error if it has another length."""
    erpm, current_, duty_ = struct.unpack(">ihh", payload)
    return VescStatus(erpm, current_ / 10, duty_ / 1000)


def counters(payload: bytes) -> tuple[int, int]:
    """STATUS_2 or STATUS_3: what was drawn and returned since the start, in 1e-4 Ah or Wh. struct.error."""
    drawn, returned = struct.unpack(">ii", payload)
    return drawn, returned


def status_4(payload: bytes) -> Status4:
    """STATUS_4. struct.error if it has another length."""
    fets, motor, input_, angle = struct.unpack(">hhhh", payload)
    return Status4(fets / 10, motor / 10, input_ / 10, angle)


def status_5(payload: bytes) -> Status5:
    """STATUS_5, with or without its reserved bytes. struct.error if it has another length."""
    tachometer, supply = struct.unpack(">ih", payload[:6])
    return Status5(tachometer, supply / 10)


def adc_1_V(payload: bytes) -> float:
    """The first analog input in STATUS_6. struct.error if it has another length."""
    volts: int = struct.unpack(">hhhh", payload)[0]
    return volts / 1000


def _scaled(packet: Packet, controller: int, value: float, scale: float) -> Frame:
    return frame_id(packet, controller), struct.pack(">i", round(value * scale))

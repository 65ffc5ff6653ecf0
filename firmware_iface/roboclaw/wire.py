"""Packet serial of RoboClaw and Basicmicro motor controllers: bytes of requests and replies, without I/O.

Source: RoboClaw Series User Manual (Basicmicro), chapters "Packet Serial" and "Advanced Packet Serial". Numbers are big endian.

    to set or command   address, command, data, CRC-16     answered by 0xFF; not at all if the packet was invalid
    to read             address, command                   answered by data, CRC-16 over address, command and data

The CRC has the polynomial 0x1021 and begins at 0 (CRC-16/XMODEM). A gap of more than 10 ms between two bytes of a packet makes
the board discard it.
"""

import struct
from binascii import crc_hqx
from enum import IntEnum, IntFlag
from typing import Final

ADDRESSES: Final = range(0x80, 0x88)
ACKNOWLEDGED: Final = 0xFF
PACKET_GAP_s: Final = 0.010  # after so much silence the board has forgotten a partial packet
FULL_DUTY: Final = 32767
FASTEST_DUTY_CHANGE: Final = 655_359  # -100 % to 100 % in 100 ms: what the board allows at most
TIMEOUT_STEP_s: Final = 0.1
LONGEST_VERSION: Final = 48
PIN_MODE_BYTES: Final = (3, 5)  # the manual's S3 to S5; and CTRL1, CTRL2: the vendor's client basicmicro 2.0.10, GETPINFUNCTIONS
HOME_PINS: Final = (0x62, 0x04)  # modes of S4 and S5, as command 74 has them: "Home (User)"; in earlier manuals, "home"
# "Limit (Fwd)", "Limit (Rev)", "Limit (Both)": the board itself stops a motor that drives forward, backward or either way
# into it.
LIMIT_FORWARD, LIMIT_REVERSE = 0x12, 0x22
LIMIT_BOTH: Final = LIMIT_FORWARD | LIMIT_REVERSE
_CRC = struct.Struct(">H")


class RoboclawCommand(IntEnum):
    """Command numbers of the manual; the names are its, too."""

    SET_SERIAL_TIMEOUT = 14  # u8 in 0.1 s
    READ_SERIAL_TIMEOUT = 15
    READ_FIRMWARE_VERSION = 21  # text, line feed, 0
    SET_ENCODER_1 = 22  # u32
    SET_ENCODER_2 = 23
    READ_MAIN_BATTERY = 24  # u16 in 0.1 V
    DUTY_M1_M2 = 34  # i16, i16
    READ_DUTIES = 48  # i16, i16: "PWM" in the manual
    READ_CURRENTS = 49  # i16, i16 in 10 mA
    SET_DUTY_ACCELERATION_1 = 68  # u32 of rise; and u32 of fall where READ_PIN_MODES says five
    SET_DUTY_ACCELERATION_2 = 69
    READ_PIN_MODES = 75  # u8, u8, u8; two more with today's firmware
    READ_ENCODERS = 78  # u32, u32
    READ_TEMPERATURE = 82  # u16 in 0.1 degC
    READ_STATUS = 90  # u32; u16 with other bits in older firmware
    READ_ENCODER_MODES = 91  # u8, u8
    SET_CURRENT_LIMIT_1 = 133  # u32 in 10 mA, u32 0
    SET_CURRENT_LIMIT_2 = 134
    READ_PWM_IDLE = 161  # u8, u8: IDLES and a delay in 0.1 s, of each motor; today's firmware


class RoboclawStatus(IntFlag):
    """Bits of READ_STATUS: errors, which stop the motors, in the lower half; warnings in the upper."""

    E_STOP = 0x0001
    TEMPERATURE = 0x0002
    TEMPERATURE_2 = 0x0004
    MAIN_VOLTAGE_HIGH = 0x0008
    LOGIC_VOLTAGE_HIGH = 0x0010
    LOGIC_VOLTAGE_LOW = 0x0020
    DRIVER_1 = 0x0040
    DRIVER_2 = 0x0080
    SPEED_1 = 0x0100
    SPEED_2 = 0x0200
    POSITION_1 = 0x0400
    POSITION_2 = 0x0800
    CURRENT_1 = 0x1000
    CURRENT_2 = 0x2000
    MAIN_VOLTAGE_LOW = 0x4000
    OVER_CURRENT_WARNING_1 = 0x01_0000
    OVER_CURRENT_WARNING_2 = 0x02_0000
    S4_TRIGGERED = 0x40_0000
    S5_TRIGGERED = 0x80_0000


ERRORS: Final = 0xFFFF
STATUS_BYTES: Final = (2, 4)
# Bits of the older status (Basicmicro's Arduino library, ReadError of two bytes), and today's. Its warnings of supply and
# temperature are none of today's errors.
_OLDER_STATUS: Final = (
    (0x0004, RoboclawStatus.E_STOP),
    (0x0008, RoboclawStatus.TEMPERATURE),
    (0x0010, RoboclawStatus.TEMPERATURE_2),
    (0x0020, RoboclawStatus.MAIN_VOLTAGE_HIGH),
    (0x0040, RoboclawStatus.LOGIC_VOLTAGE_HIGH),
    (0x0080, RoboclawStatus.LOGIC_VOLTAGE_LOW),
    (0x0100, RoboclawStatus.DRIVER_1),
    (0x0200, RoboclawStatus.DRIVER_2),
    (0x0001, RoboclawStatus.OVER_CURRENT_WARNING_1),
    (0x0002, RoboclawStatus.OVER_CURRENT_WARNING_2),
    (0x4000, RoboclawStatus.S4_TRIGGERED),
    (0x8000, RoboclawStatus.S5_TRIGGERED),
)
IDLES: Final = 0x80  # at duty 0, after the delay, the motor is free
QUADRATURE_ONLY: Final = 0x9F  # of an encoder mode: neither absolute nor RC/analog; bits 5 and 6 only reverse senses


def status(data: bytes) -> RoboclawStatus:
    """Data of READ_STATUS, of either firmware."""
    flags = int.from_bytes(data, "big")
    if len(data) == STATUS_BYTES[0]:
        flags = sum(bit for older, bit in _OLDER_STATUS if flags & older)
    return RoboclawStatus(flags)


def command_packet(address: int, command: int, data: bytes = b"") -> bytes:
    """A packet that sets or commands something."""
    body = bytes((address, command)) + data
    return body + _CRC.pack(crc_hqx(body, 0))


def read_packet(address: int, command: int) -> bytes:
    """A packet that reads something: without a CRC."""
    return bytes((address, command))


def reply_data(address: int, command: int, reply: bytes) -> bytes | None:
    """The data of a reply to a read, or None if its CRC is wrong: another board's, another command's, or noise."""
    data, crc = reply[:-2], reply[-2:]
    return data if crc == _CRC.pack(crc_hqx(bytes((address, command)) + data, 0)) else None


def duty_data(duty_1: int, duty_2: int) -> bytes:
    """Data of DUTY_M1_M2."""
    return struct.pack(">hh", duty_1, duty_2)


def pair_of_counts(data: bytes) -> tuple[int, int]:
    """Data of READ_ENCODERS, as signed 32-bit counts."""
    first, second = struct.unpack(">ii", data)
    return first, second


def pair_of_currents_A(data: bytes) -> tuple[float, float]:
    """Data of READ_CURRENTS."""
    first, second = struct.unpack(">hh", data)
    return first * 0.01, second * 0.01


def tenths(data: bytes) -> float:
    """Data of READ_MAIN_BATTERY in V, of READ_TEMPERATURE in degC."""
    (value,) = struct.unpack(">H", data)
    return float(value) * 0.1

"""Frames of a moteus controller on CAN FD, without I/O. Source: moteus' CAN protocol, register and diagnostic references.

id: reply wanted << 15 | source << 8 | destination; the host is 0, so a reply comes with controller << 8

A frame holds subframes, and NOP (0x50) up to a length that CAN FD has; numbers are little endian.
write 0x00, read 0x10, reply 0x20, each + type << 2 (int8, int16, int32, f32) + number of registers, 0: it follows as varuint;
then the first register as varuint, then the values. 0x30, 0x31: a write or read failed; register and error as varuints.

Text goes to and from its console in 0x40 (to it), 0x41 (from it) and 0x42 (asks for it), each + channel, 1, as varuint, then the
number of bytes as varuint; "conf get NAME" is answered by a line with the value of a setting.

registers: 0x000 mode, 0x001 position in turns, 0x002 turns/s, 0x003 torque Nm, 0x004 Q current A, 0x00C how the position
is referenced (2: to the output), 0x00D supply (int16: 0.1 V), 0x00E degC, 0x00F fault, 0x05E inputs of aux1, 0x070 ms since
the start; commands of position mode: 0x020 turns, 0x021 turns/s, 0x022 Nm, 0x023 kp and 0x024 kd scale, 0x025 most Nm,
0x027 watchdog s, 0x028 and 0x029 limits of speed and acceleration (negative: none, whatever is stored), 0x02B scale of the
integral; 0x101 firmware, 0x120 to 0x122 serial number
"""

import math
import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import Final, NamedTuple

IDS: Final = range(1, 128)
NOP: Final = 0x50
_LENGTHS: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
_TYPES: Final = (struct.Struct("<b"), struct.Struct("<h"), struct.Struct("<i"), struct.Struct("<f"))
_WANTS_REPLY: Final = 0x8000
_REPLY, _WRITE_ERROR, _READ_ERROR = 0x20, 0x30, 0x31
_TEXT_TO, _TEXT_FROM, _ASK_TEXT = 0x40, 0x41, 0x42
_CONSOLE: Final = 1  # a channel
_TEXT_BYTES: Final = 48  # of an answer

Frame = tuple[int, bytes]


class MoteusMode(IntEnum):
    """Modes that are used here."""

    STOPPED = 0
    FAULT = 1
    POSITION = 10
    TIMEOUT = 11
    BRAKE = 15


class Register(IntEnum):
    """Registers that are read here."""

    MODE = 0x000
    POSITION = 0x001
    Q_CURRENT = 0x004
    HOME_STATE = 0x00C
    VOLTAGE = 0x00D
    TEMPERATURE = 0x00E
    FAULT = 0x00F
    AUX1_INPUTS = 0x05E
    MILLISECONDS = 0x070
    FIRMWARE = 0x101
    SERIAL = 0x120


class Position(NamedTuple):
    """A command of position mode. With `gain` 0 it is one of torque; then the position does not matter."""

    turns: float
    speed_turns_s: float
    torque_Nm: float
    gain: float
    most_Nm: float
    watchdog_s: float


REFERENCED_TO_ROTOR, REFERENCED_TO_OUTPUT = 1, 2  # of HOME_STATE
# int8 mode; f32 position to Q current; int16 voltage; int8 temperature and fault; int8 inputs; int32 milliseconds
QUERY: Final = bytes.fromhex("11 00 1c 04 01 15 0d 12 0e 11 5e 19 70")
# int8 home state; int32 firmware; int32 serial number
IDENTITY_QUERY: Final = bytes.fromhex("11 0c 19 81 02 1b a0 02")
_POSITION: Final = struct.Struct("<6B6f2B3f2Bf")
_MODE: Final = b"\x01\x00"
_NO_LIMIT: Final = -1.0  # of 0x028 and 0x029


def position(controller: int, command: Position) -> Frame:
    """Command position mode, and ask for the values."""
    c = command
    written = _POSITION.pack(
        *_MODE,
        MoteusMode.POSITION,
        0x0C,
        6,
        0x20,
        c.turns,
        c.speed_turns_s,
        c.torque_Nm,
        c.gain,
        c.gain,
        c.most_Nm,
        0x0F,
        0x27,
        c.watchdog_s,
        _NO_LIMIT,
        _NO_LIMIT,
        0x0D,
        0x2B,
        c.gain,
    )
    return _frame(controller, written + QUERY)


def drives(frame: Frame) -> bool:
    """Whether a frame commands position mode."""
    return frame[1].startswith(_MODE + bytes((MoteusMode.POSITION,)))


def torque(torque_Nm: float, most_Nm: float, watchdog_s: float) -> Position:
    """Position mode without its gains."""
    return Position(math.nan, 0.0, torque_Nm, 0.0, most_Nm, watchdog_s)


def brake(controller: int) -> Frame:
    """Short the windings, and ask for the values."""
    return _frame(controller, _MODE + bytes((MoteusMode.BRAKE,)) + QUERY)


def stop(controller: int) -> Frame:
    """Free the motor, end a fault or a time-out, and ask for the values."""
    return _frame(controller, _MODE + bytes((MoteusMode.STOPPED,)) + QUERY)


def ask(controller: int, query: bytes = QUERY) -> Frame:
    """Ask for values; nothing is commanded."""
    return _frame(controller, query)


def say(controller: int, text: bytes) -> Frame:
    """A line to its console; it has no reply. At most 61 bytes."""
    return controller, _padded(bytes((_TEXT_TO, _CONSOLE, len(text))) + text)


def ask_text(controller: int) -> Frame:
    """Ask what its console has said since."""
    return _frame(controller, bytes((_ASK_TEXT, _CONSOLE, _TEXT_BYTES)))


def text_in(payload: bytes) -> bytes | None:
    """What its console said; None if the frame is another. ValueError if it is cut short."""
    if payload[:1] != bytes((_TEXT_FROM,)):
        return None
    channel, at = _varuint(payload, 1)
    length, at = _varuint(payload, at)
    if channel != _CONSOLE or len(payload) < at + length:
        raise ValueError("cut short, or of another channel")
    return payload[at : at + length]


def _frame(controller: int, subframes: bytes) -> Frame:
    return _WANTS_REPLY | controller, _padded(subframes)


def _padded(subframes: bytes) -> bytes:
    length = next(length for length in _LENGTHS if length >= len(subframes))
    return subframes.ljust(length, bytes((NOP,)))


def values(payload: bytes) -> dict[int, float]:
    """The registers of a reply, integers as they are; without those that the firmware does not know.

    ValueError if it is no reply, or tells that something was not written; struct.error if it is cut short.
    """
    return dict(_registers(payload))


def _registers(payload: bytes) -> Iterator[tuple[int, float]]:
    at = 0
    while at < len(payload):
        kind = payload[at]
        at += 1
        if kind == NOP:
            continue
        if kind in (_WRITE_ERROR, _READ_ERROR):
            register, at = _varuint(payload, at)
            _, at = _varuint(payload, at)
            if kind == _WRITE_ERROR:
                raise ValueError(f"register 0x{register:03x} cannot be written")
            continue
        if kind & 0xF0 != _REPLY:
            raise ValueError(f"subframe 0x{kind:02x}")
        count = kind & 3
        if not count:
            count, at = _varuint(payload, at)
        first, at = _varuint(payload, at)
        type_ = _TYPES[kind >> 2 & 3]
        for register in range(first, first + count):
            yield register, type_.unpack_from(payload, at)[0]
            at += type_.size


def _varuint(payload: bytes, at: int) -> tuple[int, int]:
    """A number of 7 bits a byte, least significant first, and where it ends."""
    number = shift = 0
    while at < len(payload):
        byte = payload[at]
        at += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, at
        shift += 7
    raise ValueError("cut short")

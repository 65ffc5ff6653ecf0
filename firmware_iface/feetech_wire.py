"""Feetech STS servos: bytes of instructions and status packets, without I/O. Source: Feetech's "FTServo" SDK and protocol manual.

    ff ff   id u8   length u8   instruction u8   parameters   checksum u8     length: parameters + 2
    status: an error byte in the instruction's place

The checksum is the inverted sum of all bytes from the id on. Numbers are little endian; signed ones have their sign in bit 15.

"""

from collections.abc import Sequence
from typing import Final

from firmware_iface.smart_servo import Instruction, StatusPacket

HEADER: Final = b"\xff\xff"
BROADCAST: Final = 0xFE
IDS: Final = range(253)
STATUS_OVERHEAD: Final = 6  # header, id, length, error, checksum
_SIGN: Final = 1 << 15


def checksum(inside: bytes) -> int:
    """Of all bytes from the id on."""
    return ~sum(inside) & 0xFF


def packet(servo: int, instruction: int, parameters: bytes = b"") -> bytes:
    """An instruction packet."""
    inside = bytes((servo, len(parameters) + 2, instruction)) + parameters
    return HEADER + inside + bytes((checksum(inside),))


def read(servo: int, address: int, count: int) -> bytes:
    """Read `count` bytes of the memory table."""
    return packet(servo, Instruction.READ, bytes((address, count)))


def write(servo: int, address: int, data: bytes) -> bytes:
    """Write bytes of the memory table."""
    return packet(servo, Instruction.WRITE, bytes((address,)) + data)


def sync_read(servos: Sequence[int], address: int, count: int) -> bytes:
    """Read `count` bytes of several servos' memory tables; they answer one after the other."""
    return packet(BROADCAST, Instruction.SYNC_READ, bytes((address, count, *servos)))


def sync_write(address: int, values: dict[int, bytes]) -> bytes:
    """Write the same bytes of several servos' memory tables, without an answer."""
    size = len(next(iter(values.values())))
    parameters = bytes((address, size)) + b"".join(bytes((servo,)) + data for servo, data in values.items())
    return packet(BROADCAST, Instruction.SYNC_WRITE, parameters)


def refusal(error: int) -> str | None:
    """The error byte tells of the servo, not of the instruction."""
    return None


def status_in(received: bytes) -> StatusPacket | None:
    """The first status packet in what was received; None if it is not complete. ValueError if its checksum is wrong."""
    begin = received.find(HEADER)
    if begin < 0 or len(received) < begin + 4:
        return None
    end = begin + 4 + received[begin + 3]
    if len(received) < end:
        return None
    inside = received[begin + 2 : end - 1]
    if len(inside) < 3 or checksum(inside) != received[end - 1]:
        raise ValueError("checksum")
    return StatusPacket(inside[0], inside[2], inside[3:], end)


def signed(raw: int, bit: int = 15) -> int:
    """A number with its sign in a bit."""
    return -(raw & ~(1 << bit)) if raw >> bit & 1 else raw


def raw(value: int) -> bytes:
    """The two bytes of a number with its sign in bit 15."""
    return (abs(value) | (_SIGN if value < 0 else 0)).to_bytes(2, "little")

"""Dynamixel protocol 2.0: bytes of instructions and status packets, without I/O. Source: ROBOTIS e-Manual, "Protocol 2.0".

    ff ff fd 00   id u8   length u16   instruction u8   parameters   crc u16          length: from the instruction to the CRC
    status: instruction 0x55, then an error byte before the parameters; its bit 7 is the alert of a hardware error

Numbers are little endian. Where parameters contain ff ff fd, another fd follows it (dynamixel-sdk 4.1.0 leaves it out). The CRC
is CRC-16/BUYPASS (polynomial 0x8005 from 0) of all bytes before it.

"""

from collections.abc import Sequence
from typing import Final

from firmware_iface.smart_servo import Instruction, StatusPacket

HEADER: Final = b"\xff\xff\xfd\x00"
BROADCAST: Final = 0xFE
IDS: Final = range(253)
STATUS: Final = 0x55
ALERT: Final = 0x80
STATUS_OVERHEAD: Final = 11  # header, id, length, instruction, error, CRC


REFUSALS: Final = {
    1: "it failed",
    2: "it knows no such instruction",
    3: "the CRC was wrong",
    4: "the value is out of range",
    5: "the value is too short",
    6: "the value is beyond the limit that is set in it",
    7: "it cannot be written now",
}
"""Why an instruction was not obeyed, by the error number of a status packet."""


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
        table.append(crc & 0xFFFF)
    return tuple(table)


_TABLE: Final = _crc_table()


def crc16(data: bytes) -> int:
    """CRC-16/BUYPASS."""
    crc = 0
    for byte in data:
        crc = (crc << 8) & 0xFFFF ^ _TABLE[(crc >> 8) ^ byte]
    return crc


def packet(servo: int, instruction: int, parameters: bytes = b"") -> bytes:
    """An instruction packet."""
    stuffed = (bytes((instruction,)) + parameters).replace(HEADER[:3], HEADER[:3] + b"\xfd")
    body = HEADER + bytes((servo,)) + (len(stuffed) + 2).to_bytes(2, "little") + stuffed
    return body + crc16(body).to_bytes(2, "little")


def read(servo: int, address: int, count: int) -> bytes:
    """Read `count` bytes of the control table."""
    return packet(servo, Instruction.READ, address.to_bytes(2, "little") + count.to_bytes(2, "little"))


def write(servo: int, address: int, data: bytes) -> bytes:
    """Write bytes of the control table."""
    return packet(servo, Instruction.WRITE, address.to_bytes(2, "little") + data)


def sync_read(servos: Sequence[int], address: int, count: int) -> bytes:
    """Read `count` bytes of several servos' control tables; they answer one after the other."""
    span = address.to_bytes(2, "little") + count.to_bytes(2, "little")
    return packet(BROADCAST, Instruction.SYNC_READ, span + bytes(servos))


def sync_write(address: int, values: dict[int, bytes]) -> bytes:
    """Write the same bytes of several servos' control tables, without an answer."""
    size = len(next(iter(values.values())))
    parameters = address.to_bytes(2, "little") + size.to_bytes(2, "little")
    parameters += b"".join(bytes((servo,)) + data for servo, data in values.items())
    return packet(BROADCAST, Instruction.SYNC_WRITE, parameters)


def refusal(error: int) -> str | None:
    """Why the instruction was not obeyed; None if it was."""
    number = error & ~ALERT
    return f"{REFUSALS.get(number, 'unknown')} (error {number})" if number else None


def status_in(received: bytes) -> StatusPacket | None:
    """The first status packet in what was received; None if it is not complete. ValueError if its CRC is wrong."""
    begin = received.find(HEADER)
    if begin < 0 or len(received) < begin + 7:
        return None
    end = begin + 7 + int.from_bytes(received[begin + 5 : begin + 7], "little")
    if len(received) < end:
        return None
    whole = received[begin:end]
    if crc16(whole[:-2]) != int.from_bytes(whole[-2:], "little"):
        raise ValueError("CRC")
    inside = whole[7:-2].replace(HEADER[:3] + b"\xfd", HEADER[:3])
    if len(inside) < 2 or inside[0] != STATUS:
        raise ValueError("not a status packet")
    return StatusPacket(whole[4], inside[1], inside[2:], end)

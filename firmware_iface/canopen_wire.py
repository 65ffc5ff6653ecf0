"""CANopen frames (CiA 301) without I/O: NMT, SYNC, heartbeat, emergency, expedited SDO. Numbers are little endian.

0x000            NMT command: u8 command, u8 node (0: all)
0x080            SYNC, empty
0x080 + node     emergency: u16 error code, u8 error register, 5 bytes of the manufacturer
0x180, 0x280     + node: TPDO 1, 2 (from the drive);  0x200, 0x300 + node: RPDO 1, 2 (to it)
0x580, 0x600     + node: SDO answer, SDO request
0x700 + node     heartbeat: u8 NMT state; 0 after power-up (boot-up)

"""

import struct
from enum import IntEnum
from typing import Final, NamedTuple

NODES: Final = range(1, 128)
NMT, SYNC, EMERGENCY, TPDO_1, RPDO_1, TPDO_2, RPDO_2 = 0x000, 0x080, 0x080, 0x180, 0x200, 0x280, 0x300
SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x580, 0x600, 0x700
BOOT_UP: Final = 0x00
_SDO = struct.Struct("<BHB4s")
_ABORT: Final = 0x80
_TYPES = {"u8": "<B", "i8": "<b", "u16": "<H", "i16": "<h", "u32": "<I", "i32": "<i"}

ABORT_TEXT: Final = {
    0x0503_0000: "toggle bit not alternated",
    0x0504_0000: "SDO time-out",
    0x0504_0001: "unknown SDO command",
    0x0601_0000: "unsupported access",
    0x0601_0001: "write only",
    0x0601_0002: "read only",
    0x0602_0000: "no such object",
    0x0604_0041: "cannot be mapped to a PDO",
    0x0604_0042: "the mapped objects exceed the PDO's length",
    0x0607_0010: "wrong length of data",
    0x0609_0011: "no such sub-index",
    0x0609_0030: "value out of range",
    0x0800_0020: "cannot be stored",
    0x0800_0022: "not in the present state",
}


class NmtCommand(IntEnum):
    """What an NMT command asks for."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81


class DictionaryObject(NamedTuple):
    """An object of the dictionary: index (`at`), sub-index and type."""

    at: int
    sub: int
    kind: str

    @property
    def mapping(self) -> int:
        """Its value in a PDO mapping: index, sub-index, length in bits."""
        return self.at << 16 | self.sub << 8 | 8 * struct.calcsize(_TYPES[self.kind])

    def __str__(self) -> str:
        return f"0x{self.at:04X}:{self.sub:02X}"


class SdoAnswer(NamedTuple):
    """An answer to an SDO request: the data of a read, b"" after a write, or the code with which it was refused."""

    at: int
    sub: int
    data: bytes
    abort: int


def packed(kind: str, value: int) -> bytes:
    """A value as bytes. struct.error if it does not fit."""
    return struct.pack(_TYPES[kind], value)


def unpacked(kind: str, data: bytes) -> int:
    """A value from bytes; a shorter answer is extended as its type says."""
    size = struct.calcsize(_TYPES[kind])
    (value,) = struct.unpack(_TYPES[kind], data[:size].ljust(size, b"\0"))
    return int(value)


def read_request(entry: DictionaryObject) -> bytes:
    """An SDO request to read (upload)."""
    return _SDO.pack(0x40, entry.at, entry.sub, bytes(4))


def write_request(entry: DictionaryObject, value: int) -> bytes:
    """An SDO request to write (expedited download)."""
    data = packed(entry.kind, value)
    return _SDO.pack(0x23 | (4 - len(data)) << 2, entry.at, entry.sub, data.ljust(4, b"\0"))


def sdo_answer(payload: bytes) -> SdoAnswer | None:
    """The answer in a frame; None if it is segmented, or no answer."""
    if len(payload) != 8:
        return None
    command, index, sub, data = _SDO.unpack(payload)
    if command == _ABORT:
        return SdoAnswer(index, sub, b"", int.from_bytes(data, "little"))
    if command == 0x60:
        return SdoAnswer(index, sub, b"", 0)
    if command & 0xE2 == 0x42:  # expedited; the size may be left out
        size = 4 - (command >> 2 & 3) if command & 1 else 4
        return SdoAnswer(index, sub, data[:size], 0)
    return None


def abort_text(code: int) -> str:
    """Why an SDO request was refused."""
    return ABORT_TEXT.get(code, "refused") + f" (0x{code:08X})"

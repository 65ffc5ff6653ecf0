"""The encoder board's frames: encoding and decoding. docs/encoder_board.md defines them.

Decoded frame, little endian: `type u8 | sequence u8 | body | crc16 u16`, CRC-16/CCITT-FALSE over
all before it; on the line COBS-coded and ended by 0x00.

    0x01 Poll            -                                        host to board
    0x02 Stream          period_us u32
    0x03 SetZero         channel u8, count i32
    0x04 ArmIndex        channel u8, action u8
    0x05 Identify        -
    0x81 Report          board_time_us u32, flags u8 x 3, count i32 x 3    board to host
    0x82 Identity        protocol u8, request_sequence u8, firmware u16, serial_number u32,
                         channels u8, counts_per_turn u32 x 3, encoder_bits u8
    0x83 Ack             request_sequence u8, result u8
    0x84 IndexLatch      channel u8, board_time_us u32, count i32

COBS is Consistent Overhead Byte Stuffing (Cheshire and Baker, IEEE/ACM Trans. Networking 7(2), 1999). A coded block holds no
0x00, so 0x00 can end it. Each run of up to 254 bytes without a zero is written as its length + 1 and itself; a length below 255
implies the zero that followed.
"""

import struct
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import astuple, dataclass
from enum import IntEnum, IntFlag
from struct import Struct
from typing import NamedTuple

from firmware_iface.errors import MisuseError

DELIMITER = b"\x00"
_LONGEST_CODE = 0xFF  # 254 bytes follow, and no zero is implied
PROTOCOL_VERSION = 1
CHANNELS = 3
REPORT_WIRE_BYTES = 25
LONGEST_CODED = 66  # a receiver discards a longer frame without a 0x00
CRC_START = 0xFFFF
_SMALLEST_DECODED = 4  # type, sequence, CRC


class ChannelFlag(IntFlag):
    """State of a channel in a Report."""

    INDEX_LEVEL = 0x01
    INDEX_LATCHED = 0x02
    HOME = 0x04
    ZERO_SET = 0x08
    QUADRATURE_ERROR = 0x10
    SIGNAL_LOST = 0x20


class AckResult(IntEnum):
    """Result code of an Ack."""

    DONE = 0
    UNKNOWN_REQUEST = 1
    BAD_ARGUMENT = 2
    NOT_POSSIBLE_NOW = 3


class IndexAction(IntEnum):
    """Action of an ArmIndex request."""

    DISARM = 0
    ARM = 1
    SEND_AGAIN = 2


class Report(NamedTuple):
    """Counts, flags and time of all channels. A named tuple, because one is created every cycle (0.5 us faster)."""

    sequence: int
    board_time_us: int
    flags: tuple[int, int, int]
    counts: tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of the board; `request_sequence` 0 means that it has just started."""

    sequence: int
    protocol: int
    request_sequence: int
    firmware: int
    serial_number: int
    channels: int
    counts_per_turn: tuple[int, int, int]
    encoder_bits: int


@dataclass(frozen=True, slots=True)
class Ack:
    """Answer to a request without an answer type of its own."""

    sequence: int
    request_sequence: int
    result: int


@dataclass(frozen=True, slots=True)
class IndexLatch:
    """Count latched by the index pulse."""

    sequence: int
    channel: int
    board_time_us: int
    count: int


@dataclass(frozen=True, slots=True)
class Poll:
    """Requests one Report."""

    sequence: int


@dataclass(frozen=True, slots=True)
class Stream:
    """Requests a Report every `period_us`; 0 stops the stream."""

    sequence: int
    period_us: int


@dataclass(frozen=True, slots=True)
class SetZero:
    """Sets the count at the present position to `count`."""

    sequence: int
    channel: int
    count: int


@dataclass(frozen=True, slots=True)
class ArmIndex:
    """Arms or disarms the index latch, or requests the latched count again."""

    sequence: int
    channel: int
    action: int


@dataclass(frozen=True, slots=True)
class Identify:
    """Requests the Identity."""

    sequence: int


@dataclass(frozen=True, slots=True)
class Foreign:
    """A frame with a good CRC that this protocol does not know: unknown type or wrong length."""

    raw: bytes


Request = Poll | Stream | SetZero | ArmIndex | Identify
Frame = Report | Identity | Ack | IndexLatch | Request
AnyFrame = Frame | Foreign

REPORT_TYPE = 0x81
IDENTITY_TYPE = 0x82
_REPORT = Struct("<xBI3B3i")
_CHECKED_REPORT = Struct("<xBI3B3iH")
_IDENTITY = Struct("<xBBBHIB3IB")
# type: (frame, layout from the sequence on with the type as a pad byte)
_SIMPLE: dict[int, tuple[type[Ack | IndexLatch | Request], Struct]] = {
    0x01: (Poll, Struct("<xB")),
    0x02: (Stream, Struct("<xBI")),
    0x03: (SetZero, Struct("<xBBi")),
    0x04: (ArmIndex, Struct("<xBBB")),
    0x05: (Identify, Struct("<xB")),
    0x83: (Ack, Struct("<xBBB")),
    0x84: (IndexLatch, Struct("<xBBIi")),
}
_TYPE_OF = {frame: number for number, (frame, _) in _SIMPLE.items()}


def crc16(raw: bytes) -> int:
    """CRC-16/CCITT-FALSE of `raw`; 0x29B1 for b"123456789"."""
    return crc_hqx(raw, CRC_START)


def encode(frame: Frame) -> bytes:
    """Encode `frame` for the line, including its 0x00. Raises MisuseError if a number does not fit."""
    try:
        raw = _pack(frame)
    except struct.error as problem:
        raise MisuseError(f"encoder frame {frame}: a number does not fit its field ({problem})") from None
    return cobs_encode(raw + crc16(raw).to_bytes(2, "little")) + DELIMITER


def _pack(frame: Frame) -> bytes:
    if isinstance(frame, Report):
        body = _REPORT.pack(frame.sequence, frame.board_time_us, *frame.flags, *frame.counts)
        return bytes((REPORT_TYPE,)) + body[1:]
    if isinstance(frame, Identity):
        *head, counts_per_turn, encoder_bits = astuple(frame)
        return bytes((IDENTITY_TYPE,)) + _IDENTITY.pack(*head, *counts_per_turn, encoder_bits)[1:]
    number = _TYPE_OF[type(frame)]
    return bytes((number,)) + _SIMPLE[number][1].pack(*astuple(frame))[1:]


def _parse_identity(raw: bytes) -> Identity:
    (sequence, protocol, request, firmware, serial, channels, c0, c1, c2, bits) = _IDENTITY.unpack(raw)
    return Identity(sequence, protocol, request, firmware, serial, channels, (c0, c1, c2), bits)


def _parse_simple(raw: bytes) -> AnyFrame:
    frame, layout = _SIMPLE[raw[0]]
    return frame(*layout.unpack(raw))


_PARSERS: dict[int, tuple[int, Callable[[bytes], AnyFrame]]] = {
    IDENTITY_TYPE: (_IDENTITY.size, _parse_identity),
    **{number: (layout.size, _parse_simple) for number, (_, layout) in _SIMPLE.items()},
}
_NO_PARSER: tuple[int, Callable[[bytes], AnyFrame]] = (-1, Foreign)


def parse(raw: bytes) -> AnyFrame:
    """The frame in `raw` (COBS-decoded, CRC removed) unless it is a Report; Foreign if undefined."""
    size, parser = _PARSERS.get(raw[0], _NO_PARSER)
    return parser(raw) if len(raw) == size else Foreign(raw)


class Decoder:
    """Decodes a byte stream into frames. Never raises; errors are counted."""

    def __init__(self) -> None:
        self.crc_errors = 0
        self.framing_errors = 0
        self._rest = b""
        self._is_skipping = False

    def feed(self, received: bytes) -> list[AnyFrame]:
        """Return the frames that `received` completes, oldest first."""
        if received.find(0) == len(received) - 1 and not self._rest and not self._is_skipping:
            # The usual case: exactly one whole frame. (-1 = -1 for b"", which holds none.)
            return [frame] if (frame := self._frame(received[:-1])) is not None else []
        blocks = (self._rest + received).split(DELIMITER)
        rest = blocks.pop()
        if self._is_skipping and blocks:
            self._is_skipping = False
            blocks[0] = b""
        if self._is_skipping:
            rest = b""
        elif len(rest) > LONGEST_CODED:
            self.framing_errors += 1
            self._is_skipping, rest = True, b""
        self._rest = rest
        return [frame for block in blocks if (frame := self._frame(block)) is not None]

    def _frame(self, block: bytes) -> AnyFrame | None:
        if not block:
            return None
        framed = cobs_decode(block) if len(block) <= LONGEST_CODED else None
        if framed is None or len(framed) < _SMALLEST_DECODED:
            self.framing_errors += 1
            return None
        if framed[0] == REPORT_TYPE and len(framed) == _CHECKED_REPORT.size:
            return self._report(framed)
        raw = bytes(framed[:-2])
        if crc_hqx(raw, CRC_START) != framed[-2] | framed[-1] << 8:
            self.crc_errors += 1
            return None
        return parse(raw)

    def _report(self, framed: bytearray) -> Report | None:
        # Reports come every cycle: one unpack for body and CRC, and no constructor, which is a Python function.
        sequence, time_us, f0, f1, f2, count0, count1, count2, crc = _CHECKED_REPORT.unpack(framed)
        if crc_hqx(framed[:-2], CRC_START) != crc:
            self.crc_errors += 1
            return None
        return tuple.__new__(Report, (sequence, time_us, (f0, f1, f2), (count0, count1, count2)))


def cobs_encode(raw: bytes) -> bytes:
    """Encode `raw`, without the delimiter; at most len(raw) // 254 + 1 bytes longer."""
    if len(raw) < _LONGEST_CODE - 1:
        runs = raw.split(DELIMITER)
        return b"".join([part for run in runs for part in (bytes((len(run) + 1,)), run)])
    return _cobs_encode_long(raw)


def cobs_decode(coded: bytes) -> bytearray | None:
    """Decode a block (without its delimiter); None if it is invalid."""
    size = len(coded)
    if size >= _LONGEST_CODE:
        return _cobs_decode_long(coded)
    # Below 255 bytes each code byte replaces a zero: restore the zeros and drop the first code.
    # The appended zero ends the loop where a valid block ends; a code that points past it raises IndexError.
    raw = bytearray(coded + DELIMITER)
    at = 0
    try:
        while code := raw[at]:
            raw[at] = 0
            at += code
    except IndexError:
        return None
    return raw[1:at] if at == size and size else None


def _cobs_encode_long(raw: bytes) -> bytes:
    coded = bytearray()
    runs = raw.split(DELIMITER)
    for number, run in enumerate(runs):
        while len(run) >= _LONGEST_CODE - 1:
            coded.append(_LONGEST_CODE)
            coded += run[: _LONGEST_CODE - 1]
            run = run[_LONGEST_CODE - 1 :]
            if not run and number == len(runs) - 1:
                return bytes(coded)  # the data ends with a full run: no zero follows
        coded.append(len(run) + 1)
        coded += run
    return bytes(coded)


def _cobs_decode_long(coded: bytes) -> bytearray | None:
    raw = bytearray()
    at = 0
    while at < len(coded):
        code = coded[at]
        run = coded[at + 1 : at + code]
        if code == 0 or DELIMITER in run or len(run) != code - 1:
            return None
        raw += run
        at += code
        if code != _LONGEST_CODE and at < len(coded):
            raw += DELIMITER
    return raw

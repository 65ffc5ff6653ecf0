r"""Frames of rows: how a recording is stored compactly, some 20 ms of it a frame, each on the disk as soon as it is written.

Frame: u32 bytes of the content, u16 number of rows (bit 15: a new deflate stream begins, bit 14: the rows are packed as they
are), u32 CRC-32 of these six bytes and the content; little endian. The content is the next part of a raw deflate stream, flushed,
without the `\0\0\xff\xff` that ends a flush. In it, column after column, each row's difference (control.recording.fixed_point)
as a zigzag LEB128 number. A column that may be NaN codes it as 0, and all else as one more. Values that have no integer, such
as an infinite one, make a frame of packed rows, after which differences start again from 0, as they do with a new stream.

Frames are only ever appended: a killed writer loses what it had not written, and a reader takes every whole frame. After a
damaged one it goes on with the next stream. Plain Python: the writer process has no numpy to wait for.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from operator import sub
from typing import Final

from control.recording.fixed_point import LARGEST, NO_COLUMN, StoredColumn, in_turn

HEAD: Final = struct.Struct("<IHI")
FLUSHED: Final = b"\0\0\xff\xff"
RESTART, PLAIN, ROWS = 0x8000, 0x4000, 0x3FFF
ROWS_MOST: Final = 128  # in a frame
STREAM_ROWS: Final = 8192  # a damaged frame costs no more; a new stream costs some 2 kB
CONTENT_MOST_bytes: Final = 1 << 24
LEVEL, MEMORY = 6, 9  # of zlib: level 9 takes three times as long for 2 %
NUMBER_bytes: Final = 10  # the longest LEB128 number of 64 bits
SMALL: Final = 1 << 14
WRAP, HALF = (1 << 64) - 1, 1 << 63
_BITS: Final = {"f": "i", "d": "q"}


def _leb128(number: int) -> bytes:
    code = bytearray()
    while number > 0x7F:
        code.append(number & 0x7F | 0x80)
        number >>= 7
    code.append(number)
    return bytes(code)


_CODES: Final = tuple(_leb128(number) for number in range(SMALL))


class FrameEncoder:
    """Makes frames of packed rows. A frame that did not reach the disk must be followed by `restart`."""

    def __init__(self, columns: Sequence[StoredColumn], packing: struct.Struct) -> None:
        self._columns, self._packing = columns, packing
        self._turn = in_turn(columns)
        self.restart()

    def restart(self) -> None:
        """Begin a new stream with the next frame."""
        self._rows_left = 0

    def frame(self, rows: bytes) -> bytes:
        """The frame of 1 to ROWS_MOST packed rows."""
        flags = 0
        if self._rows_left <= 0:
            flags, self._rows_left = RESTART, STREAM_ROWS
            self._stream = zlib.compressobj(LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS, MEMORY)
            self._forget()
        values = list(zip(*self._packing.iter_unpack(rows), strict=True))
        try:
            content = self._coded(values)
        except (ValueError, OverflowError):
            flags, content = flags | PLAIN, rows
            self._forget()
        self._rows_left -= len(values[0])
        deflated = (self._stream.compress(content) + self._stream.flush(zlib.Z_SYNC_FLUSH))[: -len(FLUSHED)]
        return head(deflated, len(values[0]) | flags) + deflated

    def _forget(self) -> None:
        self._last = [[0] * column.order for column in self._columns]

    def _coded(self, values: Sequence[Sequence[float]]) -> bytes:
        """All columns; ValueError or OverflowError if a value has no integer, and then nothing is remembered."""
        integers: list[list[int]] = [[] for _ in values]
        coded, last = [b""] * len(values), [list(before) for before in self._last]
        for k in self._turn:
            coded[k], integers[k] = self._column(k, values[k], integers, last[k])
        self._last = last
        return b"".join(coded)

    def _column(
        self, k: int, values: Sequence[float], integers: Sequence[Sequence[int]], last: list[int]
    ) -> tuple[bytes, list[int]]:
        """The coded column and its integers; `last` becomes the last of each difference."""
        column = self._columns[k]
        beside = _beside(column, integers)
        whole = _integers(column, values, beside, last[0])
        rest = list(map(sub, whole, beside)) if beside else whole
        for level in range(column.order):
            step = list(map(sub, rest, [last[level], *rest]))
            last[level] = rest[-1]
            rest = step
        if not column.per_unit:
            rest = [(number + HALF & WRAP) - HALF for number in rest]
        codes = [number << 1 if number >= 0 else (-number << 1) - 1 for number in rest]
        if column.has_holes:
            codes = [code + 1 if value == value else 0 for code, value in zip(codes, values, strict=True)]
        return b"".join([_CODES[code] if code < SMALL else _leb128(code) for code in codes]), whole


def _beside(column: StoredColumn, integers: Sequence[Sequence[int]]) -> list[int]:
    """What the column beside says of this one; empty where there is none."""
    if column.beside == NO_COLUMN:
        return []
    return [round(number * column.factor) for number in integers[column.beside]]


def _integers(column: StoredColumn, values: Sequence[float], beside: Sequence[int], last: int) -> list[int]:
    """The values as integers; where one is NaN, the remainder is that of the row before."""
    if not column.per_unit:
        count = len(values)
        return list(
            struct.unpack(f"<{count}{_BITS[column.code]}", struct.pack(f"<{count}{column.code}", *values))
        )
    per_unit = column.per_unit
    if column.has_holes and any(value != value for value in values):
        whole = []
        for row, value in enumerate(values):
            reference = beside[row] if beside else 0
            if value == value:
                last = round(value * per_unit) - reference
            whole.append(last + reference)
    else:
        whole = [round(value * per_unit) for value in values]
    if max(whole) > LARGEST or min(whole) < -LARGEST:
        raise OverflowError
    return whole


def head(content: bytes, rows_and_flags: int) -> bytes:
    """The head of a frame."""
    start = HEAD.pack(len(content), rows_and_flags, 0)[:6]
    return start + zlib.crc32(content, zlib.crc32(start)).to_bytes(4, "little")


def is_whole(start: bytes, content: bytes) -> bool:
    """Whether the content is that of which the head speaks."""
    return start == head(content, HEAD.unpack(start)[1])


def frames_in(content: bytes) -> Iterator[tuple[int, bytes, bytes]]:
    """The whole frames of a file's content: where each ends, its head, and its content. Ends where none can begin."""
    at = 0
    while at + HEAD.size <= len(content):
        start = content[at : at + HEAD.size]
        size, rows, _ = HEAD.unpack(start)
        end = at + HEAD.size + size
        if size > CONTENT_MOST_bytes or not 0 < rows & ROWS <= ROWS_MOST or end > len(content):
            return
        yield end, start, content[at + HEAD.size : end]
        at = end


def in_frames(rows: bytes, row_bytes: int) -> Iterator[bytes]:
    """Packed rows, in portions of a frame."""
    portion = ROWS_MOST * row_bytes
    for at in range(0, len(rows), portion):
        yield rows[at : at + portion]

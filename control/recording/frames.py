r"""Frames of rows: how a recording is stored compactly, some 20 ms of it a frame, each on the disk as soon as it is written.

Frame: u32 bytes of the content, u16 number of rows (bit 15: a new deflate stream begins, bit 14: the rows are packed as they
are), u32 CRC-32 of these six bytes and the content; little endian. The content is the next part of a raw deflate stream, flushed,
without the `\0\0\xff\xff` that ends a flush. In it, column after column, each row's difference (`Kind`) as a zigzag LEB128
number, of what remains after the column `beside` (-1: none) times `factor`, rounded. A `float` column of order 1 with a
`per_unit` codes NaN as 0, and all else as one more. Values that have no integer, such
as an infinite one, make a frame of packed rows, after which differences start again from 0, as they do with a new stream.

Frames are only ever appended: a killed writer loses what it had not written, and a reader takes every whole frame. After a
damaged one it goes on with the next stream. Plain Python: the writer process has no numpy to wait for.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import sub
from typing import Any, Final

NO_COLUMN: Final = -1
ORDER_MOST: Final = 3
FLOATS: Final = "fd"
WHOLE: Final = "bBhHiI"
LARGEST: Final = 1 << 59  # 18 years in ns; three differences stay within 64 bits


@dataclass(frozen=True, slots=True)
class Kind:
    """How finely a column is stored, and from what its next value is predicted.

    A stored value is an integer: the value times `per_unit`, rounded; exact for what is counted, and for what has no entry
    here, whose bits are taken (`per_unit` 0). What goes into the file is the `order`-th difference of these integers over
    the rows, which is zero or small for what moves smoothly. A column `beside` another one is told by what remains of it
    after the other. Resolutions are far below the noise of what they store: a count is 3e-5 rad, the boards send mA, mV and
    us.
    """

    per_unit: int
    order: int
    beside: str = ""


COUNTED: Final = Kind(1, 1)
BITS: Final = Kind(0, 1)
KINDS: Final[Mapping[str, Kind]] = {
    # The host's clock counts ns. Without its lateness a cycle comes exactly one period after the last.
    "t_s": Kind(10**9, 2, "late_s"),
    "cycle": Kind(1, 2),
    "late_s": Kind(10**9, 1),
    "busy_s": Kind(10**6, 1),
    "age_s": Kind(10**5, 1),
    "payload_kg": Kind(10**6, 1),
    "x_m": Kind(10**7, 1),
    "y_m": Kind(10**7, 1),
    "z_m": Kind(10**7, 1),
    "q{}_rad": Kind(10**10, 1, "count{}"),
    "q{}_set_rad": Kind(10**10, 3),
    "joint{}_rad": Kind(10**10, 1, "q{}_rad"),
    "joint{}_set_rad": Kind(10**10, 2, "q{}_set_rad"),
    "speed{}_rad_s": Kind(10**6, 1),
    "speed{}_set_rad_s": Kind(10**7, 3),
    "count{}": Kind(1, 2),
    "counted{}_s": Kind(10**6, 2),
    "u{}_V": Kind(10**4, 1),
    "i{}_A": Kind(10**3, 1),
    "supply{}_V": Kind(10**3, 1),
    "temperature{}_C": Kind(10**2, 1),
    "gripper_m": Kind(10**7, 1),
    "gripper_goal_m": Kind(10**7, 1),
    "gripper_A": Kind(10**3, 1),
}


@dataclass(frozen=True, slots=True)
class StoredColumn:
    """A column as it is stored; `beside` is the index of another one, and `factor` its integers in ours."""

    code: str
    per_unit: int
    order: int
    beside: int = NO_COLUMN
    factor: float = 0.0

    @property
    def has_holes(self) -> bool:
        """Whether NaN has a code of its own: 0, and all other codes are one larger."""
        return self.code in FLOATS and self.per_unit > 0 and self.order == 1


def stored_columns(names: Sequence[str], codes: str, rad_per_count: Sequence[float] = ()) -> tuple[StoredColumn, ...]:
    """How columns of these names and `struct` codes are stored; `rad_per_count` of each joint's encoder, if known."""
    return tuple(_stored(names, codes, name, rad_per_count) for name in names)


def _stored(names: Sequence[str], codes: str, name: str, rad_per_count: Sequence[float]) -> StoredColumn:
    code, joint = codes[names.index(name)], re.search(r"\d+", name)
    number = joint[0] if joint else ""
    form = name.replace(number, "{}", 1) if joint else name
    kind = COUNTED if code in WHOLE else KINDS.get(form, BITS)
    if form in KINDS and code in WHOLE:
        kind = KINDS[form]
    beside = kind.beside.format(number)
    if beside not in names:
        return StoredColumn(code, kind.per_unit, kind.order)
    factor = 1.0
    if form == "q{}_rad":
        factor = kind.per_unit * rad_per_count[int(number) - 1] if rad_per_count else 0.0
    return StoredColumn(code, kind.per_unit, kind.order, names.index(beside), factor)


def content_of(columns: Sequence[StoredColumn]) -> dict[str, Any]:
    """As the header of a recording holds it."""
    return {key: [getattr(column, key) for column in columns] for key in ("per_unit", "order", "beside", "factor")}


def columns_of(content: Mapping[str, Any], codes: str) -> tuple[StoredColumn, ...]:
    """From the header; ValueError, KeyError or TypeError if it does not describe these columns."""
    columns = tuple(
        StoredColumn(code, int(per_unit), int(order), int(beside), float(factor))
        for code, per_unit, order, beside, factor in zip(
            codes, content["per_unit"], content["order"], content["beside"], content["factor"], strict=True
        )
    )
    for column in columns:
        is_known = column.code in FLOATS + WHOLE and (column.per_unit > 0 or column.code in FLOATS)
        if not is_known or not 0 <= column.per_unit <= 10**15 or not 1 <= column.order <= ORDER_MOST:
            raise ValueError(f"a column stored as {column}")
        if not NO_COLUMN <= column.beside < len(columns) or not abs(column.factor) < 1e15:
            raise ValueError(f"a column stored as {column}")
    in_turn(columns)
    return columns


def in_turn(columns: Sequence[StoredColumn]) -> tuple[int, ...]:
    """Indices of the columns, each after the one that it stands beside; ValueError if there is no such order."""
    turn: list[int] = []
    waiting = list(range(len(columns)))
    while waiting:
        ready = [k for k in waiting if columns[k].beside == NO_COLUMN or columns[k].beside in turn]
        if not ready:
            raise ValueError("columns stand beside each other in a circle")
        turn += ready
        waiting = [k for k in waiting if k not in ready]
    return tuple(turn)


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
        return list(struct.unpack(f"<{count}{_BITS[column.code]}", struct.pack(f"<{count}{column.code}", *values)))
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

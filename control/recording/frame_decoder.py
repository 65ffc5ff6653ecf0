"""Packed rows from frames (control.recording.frames), many frames at once."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from control.recording.frames import (
    FLUSHED,
    HEAD,
    NO_COLUMN,
    ORDER_MOST,
    PLAIN,
    RESTART,
    ROWS,
    CONTENT_MOST_bytes,
    NUMBER_bytes,
    StoredColumn,
    frames_in,
    in_turn,
    is_whole,
)

Integers = npt.NDArray[np.int64]
NUMPY_OF_CODE: Final = {"d": "<f8", "f": "<f4", "I": "<u4", "i": "<i4", "H": "<u2", "h": "<i2", "B": "u1", "b": "i1"}
_UNFINISHED: Final = bytes(range(0x80, 0x100))  # bytes of a number that goes on
_LONG: Final = bytes(0x80) + _UNFINISHED[:1] * 0x80
_BATCH_FRAMES: Final = 1000  # summed up at once: more would not be faster, and takes memory
_TOO_LONG: Final = _UNFINISHED[:1] * NUMBER_bytes


def row_type(names: Sequence[str], packing: struct.Struct) -> np.dtype[Any]:
    """The numpy type of a packed row. ValueError for a packing without one."""
    codes = packing.format.removeprefix("<")
    if len(codes) != len(names) or any(code not in NUMPY_OF_CODE for code in codes):
        raise ValueError(f"rows packed as {packing.format!r}")
    return np.dtype([(name, NUMPY_OF_CODE[code]) for name, code in zip(names, codes, strict=True)])


class FrameDecoder:
    """Follows the frames of one recording; `lost_rows` are those of damaged frames, and after them of the same stream."""

    def __init__(self, columns: Sequence[StoredColumn], names: Sequence[str], packing: struct.Struct) -> None:
        self._columns, self._row_type, self._row_bytes = columns, row_type(names, packing), packing.size
        self._turn = in_turn(columns)
        self._orders = np.array([column.order for column in columns])
        self._last = np.zeros((ORDER_MOST, len(columns)), np.int64)
        self._stream: Any = None
        self.lost_rows = 0

    def rows(self, content: bytes) -> tuple[bytes, int]:
        """The packed rows of the whole frames in `content`, and how many of its bytes they take."""
        done, decoded = 0, []
        pending: list[tuple[int, bytes]] = []
        for end, start, deflated in frames_in(content):
            _, number, _ = HEAD.unpack(start)
            done, count = end, number & ROWS
            inflated = self._inflated(start, deflated, number)
            if inflated is None:
                self.lost_rows += count
                continue
            if number & (RESTART | PLAIN) or len(pending) >= _BATCH_FRAMES:
                decoded.append(self._decoded(pending))
                pending = []
            if number & (RESTART | PLAIN):
                self._last[:] = 0
            if number & PLAIN:
                decoded.append(inflated)
            else:
                pending.append((count, inflated))
        decoded.append(self._decoded(pending))
        return b"".join(decoded), done

    def _inflated(self, start: bytes, deflated: bytes, number: int) -> bytes | None:
        """The frame's content; None after damage, until a new stream begins."""
        if not is_whole(start, deflated):
            self._stream = None
            return None
        if number & RESTART:
            self._stream = zlib.decompressobj(-zlib.MAX_WBITS)
        if self._stream is None:
            return None
        count = number & ROWS
        most = count * (self._row_bytes if number & PLAIN else NUMBER_bytes * len(self._columns))
        try:
            inflated: bytes = self._stream.decompress(deflated + FLUSHED, min(most, CONTENT_MOST_bytes) + 1)
        except zlib.error:
            inflated = b""
        if not self._is_complete(inflated, count, bool(number & PLAIN)):
            self._stream = None
            return None
        return inflated

    def _is_complete(self, inflated: bytes, count: int, is_plain: bool) -> bool:
        if is_plain:
            return len(inflated) == count * self._row_bytes
        numbers = len(inflated.translate(None, _UNFINISHED))
        return numbers == count * len(self._columns) and inflated[-1] < 0x80 and _TOO_LONG not in inflated.translate(_LONG)

    def _decoded(self, frames: Sequence[tuple[int, bytes]]) -> bytes:
        """Packed rows of frames of one run of differences."""
        if not frames:
            return b""
        codes = _numbers(b"".join(inflated for _, inflated in frames))
        parts, at = [], 0
        for count, _ in frames:
            size = count * len(self._columns)
            parts.append(codes[at : at + size].reshape(len(self._columns), count))
            at += size
        return self._packed(np.concatenate(parts, axis=1))

    def _packed(self, codes: npt.NDArray[np.uint64]) -> bytes:
        holes = np.array([column.has_holes for column in self._columns])
        is_nan = holes[:, None] & (codes == 0)
        codes = codes - (holes[:, None] & ~is_nan)
        rest = (codes >> np.uint64(1)).astype(np.int64) ^ -(codes & np.uint64(1)).astype(np.int64)
        self._sum_up(rest)
        rows = np.empty(codes.shape[1], self._row_type)
        with np.errstate(invalid="ignore", over="ignore"):  # of a file that was made up
            for k in self._turn:
                column, name = self._columns[k], self._row_type.names[k]  # type: ignore[index]
                if column.beside != NO_COLUMN:
                    rest[k] += np.rint(rest[column.beside] * column.factor).astype(np.int64)
                rows[name] = _values(column, rest[k])
                if column.has_holes:
                    rows[name][is_nan[k]] = np.nan
        return rows.tobytes()

    def _sum_up(self, rest: Integers) -> None:
        """Differences become values, in place; the last of each is kept for the next frames."""
        for level in range(ORDER_MOST, 0, -1):
            chosen = self._orders >= level
            summed = np.cumsum(rest[chosen], axis=1) + self._last[level - 1, chosen][:, None]
            rest[chosen] = summed
            self._last[level - 1, chosen] = summed[:, -1]


def _values(column: StoredColumn, integers: Integers) -> npt.NDArray[Any]:
    if not column.per_unit:
        kind = np.int32 if column.code == "f" else np.int64
        bits: npt.NDArray[Any] = integers.astype(kind).view(NUMPY_OF_CODE[column.code])
        return bits
    if column.per_unit == 1:
        return integers
    return integers / column.per_unit


def _numbers(content: bytes) -> npt.NDArray[np.uint64]:
    """All LEB128 numbers; their last bytes are below 0x80."""
    coded = np.frombuffer(content, np.uint8)
    ends = np.flatnonzero(coded < 0x80)
    starts = np.concatenate([[0], ends[:-1] + 1])
    numbers = np.zeros(len(ends), np.uint64)
    for place in range(int((ends - starts).max()) + 1):
        at = starts + place
        has = at <= ends
        part = coded[at[has]].astype(np.uint64) & np.uint64(0x7F)
        numbers[has] |= part << np.uint64(min(7 * place, 63))
    return numbers

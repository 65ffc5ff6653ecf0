"""Reads fields of a packet one after the other; a packet that is too short, or holds what it must not, is Malformed."""

from __future__ import annotations

import math
from struct import Struct

LONGEST_NAME = 256
MOST_ITEMS = 10_000  # of a kind in one packet; more is not a count
FARTHEST_m = 1000.0  # a larger coordinate is no capture volume


class Malformed(Exception):
    """The packet is not one of the format. Never leaves the module that unpacks."""


class Fields:
    """A cursor over bytes, little endian."""

    def __init__(self, content: bytes, at: int = 0) -> None:
        self._content, self.at = content, at

    @property
    def left(self) -> int:
        """Bytes that are not read yet."""
        return len(self._content) - self.at

    def read(self, layout: Struct, is_finite: bool = True) -> tuple[float, ...]:
        """The fields of a layout; all numbers are finite, unless told otherwise."""
        if layout.size > self.left:
            raise Malformed
        values = layout.unpack_from(self._content, self.at)
        self.at += layout.size
        if is_finite and not all(map(math.isfinite, values)):
            raise Malformed
        return values

    def skip(self, size: int) -> None:
        """Pass over bytes."""
        if not 0 <= size <= self.left:
            raise Malformed
        self.at += size

    def count(self, layout: Struct) -> int:
        """A number of items."""
        (count,) = self.read(layout)
        if not 0 <= count <= MOST_ITEMS:
            raise Malformed
        return int(count)

    def text(self, size: int) -> str:
        """Text in a field of this size, padded with zeros."""
        begin = self.at
        self.skip(size)
        return _decoded(self._content[begin : self.at].split(b"\0", 1)[0])

    def name(self) -> str:
        """Text that ends with a zero byte."""
        end = self._content.find(b"\0", self.at, self.at + LONGEST_NAME)
        if end < 0:
            raise Malformed
        begin, self.at = self.at, end + 1
        return _decoded(self._content[begin:end])


def _decoded(text: bytes) -> str:
    try:
        return text.decode()
    except UnicodeDecodeError:
        raise Malformed from None

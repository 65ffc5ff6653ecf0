"""Frames of the encoder board's serial line: COBS, CRC-16/CCITT-FALSE (docs/encoder_board.md). For the mock only.

firmware_iface has its own; the two share no code, so that each tests the other.
"""

from __future__ import annotations

import binascii

_MAX_GATHERED = 66  # longer data without a delimiter is discarded up to the next
_CODE = tuple(bytes([n]) for n in range(256))


def frame(content: bytes) -> bytes:
    """Encode type, sequence and body for the wire: CRC appended, COBS-coded, delimited. At most 252 bytes."""
    checked = content + binascii.crc_hqx(content, 0xFFFF).to_bytes(2, "little")
    return b"".join([_CODE[len(run) + 1] + run for run in checked.split(b"\0")]) + b"\0"


def deframe(coded: bytes) -> bytes | None:
    """Content of a frame without its delimiter; None if COBS, length or CRC is bad."""
    out = bytearray()
    at, end = 0, len(coded)
    while at < end:
        code = coded[at]
        if code == 0 or at + code > end:
            return None
        out += coded[at + 1 : at + code]
        at += code
        if code != 0xFF and at < end:
            out.append(0)
    if len(out) < 4 or binascii.crc_hqx(bytes(out[:-2]), 0xFFFF) != int.from_bytes(out[-2:], "little"):
        return None
    return bytes(out[:-2])


class Gatherer:
    """Splits a byte stream into the contents of its valid frames, and drops invalid ones."""

    def __init__(self) -> None:
        self._gathered = b""

    def feed(self, received: bytes) -> list[bytes]:
        """Contents of the frames completed by the received bytes."""
        *ended, self._gathered = (self._gathered + received).split(b"\0")
        if len(self._gathered) > _MAX_GATHERED:
            self._gathered = b"\x01" * (_MAX_GATHERED + 1)  # remains oversized until the next delimiter
        contents = (deframe(coded) for coded in ended if 0 < len(coded) <= _MAX_GATHERED)
        return [content for content in contents if content is not None]

"""The encoder board's firmware in Python: counts, index, home switch, set-zero, streaming; written from docs/encoder_board.md."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from hil_mocks.devices.encoder_inputs import (
    INDEX_LATCHED,
    QUADRATURE_ERROR,
    ZERO_SET,
    EncoderBoardHardware,
    Gatherer,
    Latched,
    frame,
)

POLL, STREAM, SET_ZERO, ARM_INDEX, IDENTIFY = 1, 2, 3, 4, 5
REPORT, IDENTITY, ACK, INDEX = 0x81, 0x82, 0x83, 0x84
DONE, UNKNOWN_REQUEST, BAD_ARGUMENT, NOT_NOW = 0, 1, 2, 3

_REPORT = struct.Struct("<BBIBBBiii")
_IDENTITY = struct.Struct("<BBBBHIBIIIB")
_BODY_SIZE = {POLL: 0, STREAM: 4, SET_ZERO: 5, ARM_INDEX: 2, IDENTIFY: 0}
_FRAME_BITS = 250  # a REPORT on the line


class _Channel:
    """Zero and index latch of one encoder."""

    __slots__ = ("flags", "latch", "zero")

    def __init__(self, zero: int) -> None:
        self.zero = zero  # count - counter
        self.flags = 0
        self.latch: tuple[int, int] | None = None  # (board time, count)


class EncoderBoardMock(EncoderBoardHardware):
    """An encoder board whose firmware is this class."""

    def _boot(self, now_s: float) -> None:
        self._channels = [_Channel(-value) for value in self._raw]
        self._wrap = 1 << self.setup.encoder_bits
        self._half = self._wrap >> 1
        self._gatherer = Gatherer()
        self._sequence = 0
        self._period_us = 0
        self._last: tuple[bytes, int | None] | None = None  # request, result of its ACK
        self._put(b"\0", now_s)
        self._send_identity(0, now_s)

    def preset(self, counts: Sequence[int], is_zero_set: bool) -> None:
        """Set the counters of a board that was powered, and perhaps zeroed, before the simulation started."""
        counters, _ = self._latched()
        for channel, counter, count in zip(self._channels, counters, counts, strict=True):
            channel.zero = count - counter
            channel.flags = ZERO_SET if is_zero_set else 0

    def receive(self, received: bytes, now_s: float) -> None:
        """Process bytes from the host, which take effect at once."""
        for content in self._gatherer.feed(received):
            self._request(content, now_s)

    def count(self, at: int) -> int:
        """The count of a channel as reported by the board."""
        counters, _ = self._latched()
        return self._wrapped(counters[at] + self._channels[at].zero)

    def _report(self, due_us: int, latched: Latched, start_s: float) -> None:
        self._send_report(due_us, latched, start_s)
        self._due_us = due_us + self._period_us

    def _send_report(self, time_us: int, latched: Latched, start_s: float) -> None:
        counters, levels = latched
        flags, counts, wrap, half = [0, 0, 0], [0, 0, 0], self._wrap, self._half
        if self.has_frozen_clock:
            time_us = self._frozen_us
        for at, channel in enumerate(self._channels):
            counts[at] = (counters[at] + channel.zero + half) % wrap - half
            flags[at] = levels[at] | channel.flags
        self._put_content(_REPORT.pack(REPORT, self._sequence, time_us & 0xFFFFFFFF, *flags, *counts), start_s)

    def _wrapped(self, value: int) -> int:
        return (value + self._half) % self._wrap - self._half

    def _put_content(self, content: bytes, start_s: float) -> None:
        self._sequence = (self._sequence + 1) & 0xFF
        self._put(frame(content), start_s)

    def _send(self, kind: int, body: bytes, now_s: float) -> None:
        self._put_content(bytes([kind, self._sequence]) + body, now_s)

    def _request(self, content: bytes, now_s: float) -> None:
        kind, sequence, body = content[0], content[1], content[2:]
        last, self._last = self._last, (content, None)
        if last is not None and last[0] == content and last[1] is not None:
            self._answer(content, last[1], now_s)
            if kind == ARM_INDEX and last[1] == DONE and body[1] == 2:
                self._send_latch(body[0], now_s)
        elif kind not in _BODY_SIZE:
            self._answer(content, UNKNOWN_REQUEST, now_s)
        elif len(body) != _BODY_SIZE[kind]:
            self._answer(content, BAD_ARGUMENT, now_s)
        elif kind == POLL:
            self._send_report(self._board_us(now_s), self._latched(), now_s)
        elif kind == IDENTIFY:
            self._send_identity(sequence, now_s)
        elif kind == STREAM:
            self._answer(content, self._stream(int.from_bytes(body, "little"), now_s), now_s)
        elif kind == SET_ZERO:
            self._answer(content, self._set_zero(body[0], int.from_bytes(body[1:], "little", signed=True)), now_s)
        else:
            self._arm_index(content, body[0], body[1], now_s)

    def _answer(self, content: bytes, result: int, now_s: float) -> None:
        self._last = (content, result)
        self._send(ACK, bytes([content[1], result]), now_s)

    def _send_identity(self, request_sequence: int, now_s: float) -> None:
        setup = self.setup
        counts = (*setup.counts_per_turn, 0, 0, 0)[:3]
        content = _IDENTITY.pack(
            IDENTITY,
            self._sequence,
            setup.protocol,
            request_sequence,
            setup.firmware,
            setup.serial_number,
            len(setup.counts_per_turn),
            *counts,
            setup.encoder_bits,
        )
        self._put_content(content, now_s)

    def _stream(self, period_us: int, now_s: float) -> int:
        shortest_us = -(-_FRAME_BITS * 1_000_000 // self.setup.baud)
        if period_us and not shortest_us <= period_us <= 1_000_000:
            return BAD_ARGUMENT
        self._period_us = period_us
        self._due_us = self._board_us(now_s) + period_us if period_us else None
        return DONE

    def _set_zero(self, at: int, count: int) -> int:
        if at >= len(self._channels):
            return BAD_ARGUMENT
        if at in self.lost:
            return NOT_NOW
        channel, (counters, _) = self._channels[at], self._latched()
        channel.zero = count - counters[at]
        channel.flags = (channel.flags | ZERO_SET) & ~(QUADRATURE_ERROR | INDEX_LATCHED)
        channel.latch = None
        self._watch(at, False)
        return DONE

    def _illegal_transition(self, at: int) -> None:
        self._channels[at].flags |= QUADRATURE_ERROR

    def _arm_index(self, content: bytes, at: int, action: int, now_s: float) -> None:
        if at >= len(self._channels) or action > 2:
            self._answer(content, BAD_ARGUMENT, now_s)
            return
        channel = self._channels[at]
        if action == 2:
            self._answer(content, DONE if channel.latch else NOT_NOW, now_s)
            self._send_latch(at, now_s)
            return
        channel.latch = None
        channel.flags &= ~INDEX_LATCHED
        self._watch(at, action == 1)
        self._answer(content, DONE, now_s)

    def _watch(self, at: int, is_armed: bool) -> None:
        self._armed = [*(other for other in self._armed if other != at), *((at,) if is_armed else ())]

    def _index(self, at: int, time_us: int, counter: int, now_s: float) -> None:
        channel = self._channels[at]
        channel.latch = (time_us & 0xFFFFFFFF, self._wrapped(counter + channel.zero))
        channel.flags |= INDEX_LATCHED
        self._watch(at, False)
        self._send_latch(at, now_s)

    def _send_latch(self, at: int, now_s: float) -> None:
        latch = self._channels[at].latch
        if latch is not None:
            self._send(INDEX, struct.pack("<BIi", at, *latch), now_s)

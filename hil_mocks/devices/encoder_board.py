"""An encoder board: its hardware, that is shafts, counters, index lines, its clock and its serial line; and its firmware in
Python: counts, index, home switch, set-zero, streaming, written from docs/encoder_board.md.

All times are those of the simulation; the board's own clock drifts against it.

Frames: COBS, CRC-16/CCITT-FALSE (docs/encoder_board.md). firmware_iface has its own; the two share no code, so that each
tests the other.
"""

from __future__ import annotations

import binascii
import struct
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

INDEX_LEVEL, INDEX_LATCHED, HOME, ZERO_SET, QUADRATURE_ERROR, SIGNAL_LOST = 1, 2, 4, 8, 16, 32


@dataclass(frozen=True, slots=True)
class EncoderBoardSetup:
    """Identity of the board, and properties of its line and clock."""

    serial_number: int
    counts_per_turn: tuple[int, ...]
    encoder_bits: int = 32
    firmware: int = 0x0100
    protocol: int = 1
    baud: int = 1_000_000
    clock_ppm: float = 0.0
    index_spacing_counts: tuple[int, ...] = ()  # true counts of the encoders; empty: `counts_per_turn`


Latched = tuple[list[int], list[int]]
"""Counters (without wrap) and flags of all channels at one moment. Not named: a board makes two a cycle."""


class EncoderBoardHardware(ABC):
    """An encoder board of up to three channels, without its firmware.

    `raw` counts come from the shafts, start anywhere and never wrap; `index_raw` is one index position of each.
    """

    def __init__(self, setup: EncoderBoardSetup, index_raw: Sequence[int]) -> None:
        self.setup = setup
        self._rate = 1.0 + setup.clock_ppm * 1e-6
        self._spacing = setup.index_spacing_counts or setup.counts_per_turn
        self._index_raw = list(index_raw)
        self.outgoing: list[tuple[float, bytes]] = []  # (when its last byte has left, frame)
        self.stuck: set[int] = set()  # channels with a stuck counter, set by a fault
        self.lost: set[int] = set()  # channels with a broken wire
        self.backwards: set[int] = set()  # channels that count the wrong way
        self.drift: dict[int, float] = {}  # counts a second by which a channel drifts
        self.has_frozen_clock = False
        self._drifted: dict[int, float] = {}
        self.power_up(0.0, [0] * len(setup.counts_per_turn))

    def power_up(self, now_s: float, raw: Sequence[int]) -> None:
        """Reset everything: counts 0, no stream; send the identity."""
        self._raw = self._before = raw
        self._shift = [0] * len(raw)  # counter - raw, by faults
        self._is_home: Sequence[bool] = [False] * len(raw)
        self._started_s = self._tick_s = self._line_free_s = now_s
        self._armed: Sequence[int] = ()  # channels whose index edge the firmware waits for
        self._due_us: int | None = None  # of the next report of the stream
        self._reported_us = 0
        self.outgoing.clear()
        self._boot(now_s)

    @abstractmethod
    def receive(self, received: bytes, now_s: float) -> None:
        """Process bytes from the host, which take effect at once."""

    @abstractmethod
    def preset(self, counts: Sequence[int], is_zero_set: bool) -> None:
        """Set the counters of a board that was powered, and perhaps zeroed, before the simulation started."""

    def tick(self, now_s: float, raw: Sequence[int], is_home: Sequence[bool]) -> None:
        """Move the shafts to `raw` counts; make the reports that became due since the last tick."""
        self._before, self._raw, self._is_home = self._raw, raw, is_home
        if self.stuck or self.lost or self.backwards:
            self._miscount()
        if self._armed and raw != self._before and (passed := self._passed_indices(now_s)):
            for moment_s, at, counter in sorted(passed):
                self._index(at, self._board_us(moment_s), counter, now_s)
        if self.drift:
            self._drift(now_s)
        if self._due_us is not None:
            now_us = self._board_us(now_s)
            while self._due_us is not None and self._due_us <= now_us:
                self._report_due(self._due_us, now_s)
        self._tick_s = now_s

    @abstractmethod
    def count(self, at: int) -> int:
        """The count of a channel as reported by the board."""

    def quadrature_error(self, at: int, counts: int) -> None:
        """Inject a fault: an illegal transition that lost or gained some counts."""
        self._shift[at] += counts
        self._illegal_transition(at)

    def freeze_clock(self, is_frozen: bool) -> None:
        """Inject a fault: reports keep the time stamp of now."""
        self._frozen_us = self._reported_us
        self.has_frozen_clock = is_frozen

    def slip(self, at: int, counts: int) -> None:
        """Inject a fault: the encoder slips on its shaft, with its index."""
        self._shift[at] += counts
        self._index_raw[at] -= counts

    def jump(self, at: int, counts: int) -> None:
        """Inject a fault: the counter jumps unseen; its index stays where it is."""
        self._shift[at] += counts

    @abstractmethod
    def _boot(self, now_s: float) -> None:
        """Start the firmware at power-up."""

    @abstractmethod
    def _index(self, at: int, time_us: int, counter: int, now_s: float) -> None:
        """The firmware learns of the index edge of an armed channel."""

    @abstractmethod
    def _report(self, due_us: int, latched: Latched, start_s: float) -> None:
        """The firmware reports what was latched at `due_us`, and sets `_due_us` anew."""

    @abstractmethod
    def _illegal_transition(self, at: int) -> None:
        """The firmware learns of an illegal transition."""

    def _latched(self, part: float = 1.0) -> Latched:
        """What the inputs have at `part` of the time from the last tick to this one."""
        raws = self._raw
        if part < 1.0:
            raws = [was + round((raw - was) * part) for was, raw in zip(self._before, raws, strict=True)]
        flags = [
            (HOME if is_home else 0) if (raw - index_raw) % spacing else (INDEX_LEVEL | HOME if is_home else INDEX_LEVEL)
            for raw, index_raw, spacing, is_home in zip(raws, self._index_raw, self._spacing, self._is_home, strict=True)
        ]
        if self.lost:
            flags = [flag | SIGNAL_LOST if at in self.lost else flag for at, flag in enumerate(flags)]
        return [raw + shift for raw, shift in zip(raws, self._shift, strict=True)], flags

    def _board_us(self, now_s: float) -> int:
        return int((now_s - self._started_s) * self._rate * 1e6 + 1e-3)

    def _put(self, coded: bytes, start_s: float) -> None:
        """Queue a frame: the line carries one at a time, 10 bits per byte."""
        begin_s = start_s if start_s > self._line_free_s else self._line_free_s
        self._line_free_s = begin_s + 10.0 * len(coded) / self.setup.baud
        self.outgoing.append((self._line_free_s, coded))

    def _report_due(self, due_us: int, now_s: float) -> None:
        due_s = due_us / (1e6 * self._rate) + self._started_s
        span_s = now_s - self._tick_s
        part = 1.0 if span_s <= 0.0 else min(1.0, max(0.0, (due_s - self._tick_s) / span_s))
        self._reported_us = due_us
        self._report(due_us, self._latched(part), due_s)

    def _miscount(self) -> None:
        for at, (before, raw) in enumerate(zip(self._before, self._raw, strict=True)):
            if at in self.stuck or at in self.lost:
                self._shift[at] -= raw - before  # motion of the shaft meanwhile is lost
            elif at in self.backwards:
                self._shift[at] -= 2 * (raw - before)

    def _drift(self, now_s: float) -> None:
        for at, counts_s in self.drift.items():
            whole, self._drifted[at] = divmod(self._drifted.get(at, 0.0) + counts_s * (now_s - self._tick_s), 1.0)
            self._shift[at] += int(whole)

    def _passed_indices(self, now_s: float) -> list[tuple[float, int, int]]:
        """Interpolated time, channel and counter where armed shafts came upon their index, in either direction.

        One on which a shaft stood must be left first.
        """
        passed = []
        for at in self._armed:
            before, raw = self._before[at], self._raw[at]
            if raw > before:
                here = before + 1 + (self._index_raw[at] - before - 1) % self._spacing[at]
                is_passed = here <= raw
            elif raw < before:
                here = before - 1 - (before - 1 - self._index_raw[at]) % self._spacing[at]
                is_passed = here >= raw
            else:
                continue
            if is_passed and at not in self.stuck and at not in self.lost:
                share = (here - before) / (raw - before)
                passed.append((self._tick_s + (now_s - self._tick_s) * share, at, here + self._shift[at]))
        return passed


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

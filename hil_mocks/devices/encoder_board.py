"""The encoder board: counts, index, home switch, set-zero, streaming; written from docs/encoder_board.md.

A state machine without I/O: `receive` bytes, `tick` with the encoders' counts, read `outgoing`. All times are those of
the simulation; the board's own clock drifts against it.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from hil_mocks.devices.framing import Gatherer, frame

POLL, STREAM, SET_ZERO, ARM_INDEX, IDENTIFY = 1, 2, 3, 4, 5
REPORT, IDENTITY, ACK, INDEX = 0x81, 0x82, 0x83, 0x84
DONE, UNKNOWN_REQUEST, BAD_ARGUMENT, NOT_NOW = 0, 1, 2, 3
INDEX_LEVEL, INDEX_LATCHED, HOME, ZERO_SET, QUADRATURE_ERROR, SIGNAL_LOST = 1, 2, 4, 8, 16, 32

_REPORT = struct.Struct("<BBIBBBiii")
_IDENTITY = struct.Struct("<BBBBHIBIIIB")
_BODY_SIZE = {POLL: 0, STREAM: 4, SET_ZERO: 5, ARM_INDEX: 2, IDENTIFY: 0}
_FRAME_BITS = 250  # a REPORT on the line


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


class _Channel:
    """Counter and index of one encoder."""

    __slots__ = ("armed", "counts_per_turn", "flags", "index_raw", "latch", "offset")

    def __init__(self, counts_per_turn: int, index_raw: int) -> None:
        self.counts_per_turn = counts_per_turn
        self.index_raw = index_raw
        self.offset = 0  # count - raw
        self.flags = 0
        self.armed = False
        self.latch: tuple[int, int] | None = None  # (board time, count)

    def index_between(self, before: int, raw: int) -> int | None:
        """The index position that the shaft passed, in either direction."""
        if raw > before:
            first = before + 1 + (self.index_raw - before - 1) % self.counts_per_turn
            return first if first <= raw else None
        if raw < before:
            first = before - 1 - (before - 1 - self.index_raw) % self.counts_per_turn
            return first if first >= raw else None
        return None


class EncoderBoardMock:
    """An encoder board of up to three channels.

    `raw` counts come from the shafts, start anywhere and never wrap; `index_raw` is one index position of each.
    """

    def __init__(self, setup: EncoderBoardSetup, index_raw: Sequence[int]) -> None:
        self.setup = setup
        self._rate = 1.0 + setup.clock_ppm * 1e-6
        self._index_raw = tuple(index_raw)
        self._wrap = 1 << setup.encoder_bits
        self._half = self._wrap >> 1
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
        spacing = self.setup.index_spacing_counts or self.setup.counts_per_turn
        self._channels = [_Channel(c, i) for c, i in zip(spacing, self._index_raw, strict=True)]
        self._raw = self._before = raw
        self._is_home: Sequence[bool] = [False] * len(raw)
        for channel, value in zip(self._channels, raw, strict=True):
            channel.offset = -value
        self._is_watching = False  # some channel is armed
        self._gatherer = Gatherer()
        self._sequence = 0
        self._period_us = 0
        self._due_us = 0
        self._started_s = self._tick_s = now_s
        self._answered: tuple[bytes, int] | None = None
        self._line_free_s = now_s
        self.outgoing.clear()
        self.outgoing.append((now_s, b"\0"))
        self._send_identity(0, now_s)

    def preset(self, counts: Sequence[int], is_zero_set: bool) -> None:
        """Set the counters of a board that was powered, and perhaps zeroed, before the simulation started."""
        for channel, raw, count in zip(self._channels, self._raw, counts, strict=True):
            channel.offset = count - raw
            channel.flags = ZERO_SET if is_zero_set else 0

    def receive(self, received: bytes, now_s: float) -> None:
        """Process bytes from the host, which take effect at once."""
        for content in self._gatherer.feed(received):
            self._request(content, now_s)

    def tick(self, now_s: float, raw: Sequence[int], is_home: Sequence[bool]) -> None:
        """Move the shafts to `raw` counts; make the reports that became due since the last tick."""
        self._before, self._raw, self._is_home = self._raw, raw, is_home
        if self._is_watching or self.stuck or self.lost or self.backwards:
            self._watch(now_s)
        if self.drift:
            self._drift(now_s)
        if self._period_us:
            now_us = self._board_us(now_s)
            while self._due_us <= now_us:
                self._report_due(now_s)
        self._tick_s = now_s

    def count(self, at: int) -> int:
        """The count of a channel reported by the board."""
        return self._wrapped(self._raw[at] + self._channels[at].offset)

    def _report_due(self, now_s: float) -> None:
        due_s = self._due_us / (1e6 * self._rate) + self._started_s
        span_s = now_s - self._tick_s
        part = 1.0 if span_s <= 0.0 else min(1.0, max(0.0, (due_s - self._tick_s) / span_s))
        self._send_report(self._due_us, part, due_s)
        self._due_us += self._period_us

    def _send_report(self, time_us: int, part: float, start_s: float) -> None:
        """Send one REPORT of the counts interpolated at `part` of the time from the last tick to this one."""
        flags, counts, wrap, half = [0, 0, 0], [0, 0, 0], self._wrap, self._half
        if self.has_frozen_clock:
            time_us = self._frozen_us
        for at, channel in enumerate(self._channels):
            raw = self._raw[at]
            if part < 1.0:
                raw = self._before[at] + round((raw - self._before[at]) * part)
            counts[at] = (raw + channel.offset + half) % wrap - half
            level = channel.flags
            if (raw - channel.index_raw) % channel.counts_per_turn == 0:
                level |= INDEX_LEVEL
            if self._is_home[at]:
                level |= HOME
            if at in self.lost:
                level |= SIGNAL_LOST
            flags[at] = level
        self._put(_REPORT.pack(REPORT, self._sequence, time_us & 0xFFFFFFFF, *flags, *counts), start_s)

    def _wrapped(self, value: int) -> int:
        return (value + self._half) % self._wrap - self._half

    def _board_us(self, now_s: float) -> int:
        return int((now_s - self._started_s) * self._rate * 1e6 + 1e-3)

    def _put(self, content: bytes, start_s: float) -> None:
        """Queue a frame: the line carries one at a time, 10 bits per byte."""
        self._sequence = (self._sequence + 1) & 0xFF
        coded = frame(content)
        begin_s = start_s if start_s > self._line_free_s else self._line_free_s
        self._line_free_s = begin_s + 10.0 * len(coded) / self.setup.baud
        self.outgoing.append((self._line_free_s, coded))

    def _send(self, kind: int, body: bytes, now_s: float) -> None:
        self._put(bytes([kind, self._sequence]) + body, now_s)

    def _request(self, content: bytes, now_s: float) -> None:
        kind, sequence, body = content[0], content[1], content[2:]
        if self._answered is not None and self._answered[0] == content:
            self._acknowledge(sequence, self._answered[1], now_s)
            if kind == ARM_INDEX and self._answered[1] == DONE and body[1] == 2:
                self._send_latch(body[0], now_s)
            return
        if kind not in _BODY_SIZE:
            self._answer(content, UNKNOWN_REQUEST, now_s)
        elif len(body) != _BODY_SIZE[kind]:
            self._answer(content, BAD_ARGUMENT, now_s)
        elif kind == POLL:
            self._send_report(self._board_us(now_s), 1.0, now_s)
        elif kind == IDENTIFY:
            self._send_identity(sequence, now_s)
        elif kind == STREAM:
            self._answer(content, self._stream(int.from_bytes(body, "little"), now_s), now_s)
        elif kind == SET_ZERO:
            self._answer(
                content, self._set_zero(body[0], int.from_bytes(body[1:], "little", signed=True)), now_s
            )
        else:
            self._arm_index(content, body[0], body[1], now_s)

    def _answer(self, content: bytes, result: int, now_s: float) -> None:
        self._answered = (content, result)
        self._acknowledge(content[1], result, now_s)

    def _acknowledge(self, sequence: int, result: int, now_s: float) -> None:
        self._send(ACK, bytes([sequence, result]), now_s)

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
        self._put(content, now_s)

    def _stream(self, period_us: int, now_s: float) -> int:
        shortest_us = -(-_FRAME_BITS * 1_000_000 // self.setup.baud)
        if period_us and not shortest_us <= period_us <= 1_000_000:
            return BAD_ARGUMENT
        self._period_us = period_us
        self._due_us = self._board_us(now_s) + period_us
        return DONE

    def _set_zero(self, at: int, count: int) -> int:
        if at >= len(self._channels):
            return BAD_ARGUMENT
        if at in self.lost:
            return NOT_NOW
        channel = self._channels[at]
        channel.offset = count - self._raw[at]
        channel.flags = (channel.flags | ZERO_SET) & ~(QUADRATURE_ERROR | INDEX_LATCHED)
        channel.armed, channel.latch = False, None
        return DONE

    def quadrature_error(self, at: int, counts: int) -> None:
        """Inject a fault: an illegal transition that lost or gained some counts."""
        self._channels[at].flags |= QUADRATURE_ERROR
        self._channels[at].offset += counts

    def freeze_clock(self, is_frozen: bool) -> None:
        """Inject a fault: reports keep the time stamp of now."""
        self._frozen_us = self._due_us - self._period_us
        self.has_frozen_clock = is_frozen

    def slip(self, at: int, counts: int) -> None:
        """Inject a fault: the encoder slips on its shaft, with its index."""
        channel = self._channels[at]
        channel.offset += counts
        channel.index_raw -= counts

    def jump(self, at: int, counts: int) -> None:
        """Inject a fault: the counter jumps unseen; its index stays where it is."""
        self._channels[at].offset += counts

    def _drift(self, now_s: float) -> None:
        for at, counts_s in self.drift.items():
            whole, self._drifted[at] = divmod(
                self._drifted.get(at, 0.0) + counts_s * (now_s - self._tick_s), 1.0
            )
            self._channels[at].offset += int(whole)

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
        channel.armed = action == 1
        self._is_watching = any(other.armed for other in self._channels)
        self._answer(content, DONE, now_s)

    def _watch(self, now_s: float) -> None:
        """The slow part of a tick: armed channels, and those with a stuck counter."""
        for at, channel in enumerate(self._channels):
            if at in self.stuck or at in self.lost:
                # The counter is stuck; motion of the shaft meanwhile is lost.
                channel.offset -= self._raw[at] - self._before[at]
                continue
            if at in self.backwards:
                channel.offset -= 2 * (self._raw[at] - self._before[at])
            if channel.armed:
                self._watch_index(at, channel, now_s)

    def _watch_index(self, at: int, channel: _Channel, now_s: float) -> None:
        """Latch the count where the shaft passed the index, at the interpolated time.

        A shaft that was on its index when armed must leave it first: `index_between` starts one count further.
        """
        before, raw = self._before[at], self._raw[at]
        here = channel.index_between(before, raw)
        if here is None:
            return
        moment_s = self._tick_s + (now_s - self._tick_s) * (here - before) / (raw - before)
        channel.latch = (self._board_us(moment_s) & 0xFFFFFFFF, self._wrapped(here + channel.offset))
        channel.flags |= INDEX_LATCHED
        channel.armed = False
        self._is_watching = any(other.armed for other in self._channels)
        self._send_latch(at, now_s)

    def _send_latch(self, at: int, now_s: float) -> None:
        latch = self._channels[at].latch
        if latch is not None:
            self._send(INDEX, struct.pack("<BIi", at, *latch), now_s)

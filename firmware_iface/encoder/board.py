"""One encoder board on a serial line, seen from the host. docs/encoder_board.md defines the protocol."""

import math
from collections.abc import Callable, Sequence

from firmware_iface.clock import Clock
from firmware_iface.encoder import wire
from firmware_iface.encoder.wire import ChannelFlag, IndexAction
from firmware_iface.errors import (
    BoardRefused,
    BoardReset,
    BoardSilent,
    LinkLost,
    MisuseError,
    Problems,
    ProtocolViolation,
    WrongIdentity,
)
from firmware_iface.link import ByteLink

_INDEX_LATCHED = int(ChannelFlag.INDEX_LATCHED)  # an IntFlag takes 1 us to be combined, each cycle
_LATCH_REPEAT_s = 0.02  # INDEX is requested again if it comes later than this after its flag
_WATCH_EVERY_s = 0.02  # arm one of the watched indices: 27 bytes, a tenth of a slow line


class IndexLatches:
    """Which indices are armed and what they latched; asks again for an INDEX frame that was lost."""

    def __init__(self, send: Callable[[int, IndexAction], int]) -> None:
        """`send` an ARM_INDEX for a channel without waiting; returns its sequence."""
        self._send = send
        self._latches: dict[int, int] = {}
        self._armed: dict[int, float] = {}  # channel: when its latch was last asked for [s]
        self._none_latched_s = -math.inf  # when the board last said that no index has latched
        self._arming: tuple[int, int] | None = None  # (request sequence, channel) of ARM_INDEX under way
        self._watch_asked: Sequence[int] = ()
        self._watched: list[int] = []  # channels whose indices are watched, the next one to arm first
        self._watch_at_s = -math.inf  # when an index was last armed for that
        self._passed: list[tuple[int, int]] = []

    def latched(self, channel: int) -> int | None:
        """The count latched since the index was armed, or None."""
        return self._latches.get(channel)

    def forget(self, channel: int) -> None:
        """Drop what a channel latched, and do not wait for it."""
        self._armed.pop(channel, None)
        self._latches.pop(channel, None)

    def clear(self) -> None:
        """After a restart of the board nothing is armed or watched."""
        self._armed.clear()
        self._latches.clear()
        self._watched.clear()

    def expect(self, sequence: int, channel: int) -> None:
        """An ARM_INDEX goes out. An INDEX of an older arming comes before its ACK and is dropped with it."""
        self._arming = (sequence, channel)

    def acknowledged(self, sequence: int, now_s: float) -> None:
        """The board has answered a request: from here on, an armed index may come."""
        if self._arming is not None and self._arming[0] == sequence:
            channel, self._arming = self._arming[1], None
            self._latches.pop(channel, None)
            self._armed[channel] = now_s

    def take(self, frame: wire.IndexLatch) -> None:
        """An index pulse has come."""
        if frame.channel not in self._watched:
            self._latches[frame.channel] = frame.count
        elif frame.channel in self._armed:
            self.forget(frame.channel)
            self._passed.append((frame.channel, frame.count))

    def watch(self, channels: Sequence[int]) -> None:
        """Arm the index of each channel again and again; none ends it."""
        if channels is self._watch_asked and len(channels) == len(self._watched):
            return  # asked every cycle
        self._watch_asked = channels
        if list(channels) != sorted(self._watched):
            for channel in {*self._watched, *channels}:
                self.forget(channel)
            self._watched = sorted(channels)
            self._arming = None
            self._passed.clear()

    def passed(self) -> list[tuple[int, int]]:
        """(channel, count) of the watched pulses that came since the last call."""
        passed, self._passed = self._passed, []
        return passed

    def attend(self, now_s: float, latest: wire.Report | None) -> None:
        """Ask for lost latches, and arm the next watched index when it is time."""
        if self._armed:
            self._ask_for_lost_latches(now_s, latest)
        if self._watched and now_s - self._watch_at_s >= _WATCH_EVERY_s:
            self._arm_next(now_s)

    def _ask_for_lost_latches(self, now_s: float, latest: wire.Report | None) -> None:
        f0, f1, f2 = latest.flags if latest else (0, 0, 0)
        if not self._latches and not (f0 | f1 | f2) & _INDEX_LATCHED:  # so it is in almost every cycle
            self._none_latched_s = now_s
            return
        for channel, asked_s in tuple(self._armed.items()):
            if channel in self._latches:
                del self._armed[channel]
            elif not latest or not latest.flags[channel] & _INDEX_LATCHED:
                self._armed[channel] = now_s
            elif now_s - max(asked_s, self._none_latched_s) > _LATCH_REPEAT_s:
                self._armed[channel] = now_s
                self._send(channel, IndexAction.SEND_AGAIN)

    def _arm_next(self, now_s: float) -> None:
        """Arm the next watched index that does not wait for its pulse."""
        self._watch_at_s = now_s
        for _ in self._watched:
            channel = self._watched.pop(0)
            self._watched.append(channel)
            if channel not in self._armed:
                self.forget(channel)
                self.expect(self._send(channel, IndexAction.ARM), channel)
                return


ANSWER_TIMEOUT_s = 0.05  # the board answers within 5 ms; hosts are late by tens of milliseconds at times
ATTEMPTS = 3
_STEP_s = 0.001
_REPORT_BITS = wire.REPORT_WIRE_BYTES * 10  # 8N1: 10 bit times a byte
_STREAM_LOAD = 0.9  # of the line; the rest is for answers and index frames
_LONGEST_PERIOD_s = 1.0
_LATE_FRAMES = 128  # half of the sequence: a report further behind is of a board that has restarted
_LATE_us = 1_000_000
_REQUESTS = (wire.Poll, wire.Stream, wire.SetZero, wire.ArmIndex, wire.Identify)


class EncoderBoard:
    """Drains its link, keeps the latest report, and sends requests.

    The cycle only calls `update()`. Requests poll for their answers through the clock, every
    1 ms, and are sent three times before they raise BoardSilent. Use them before and after a run only.
    """

    def __init__(self, link: ByteLink, clock: Clock, name: str = "enc0") -> None:
        self.name = name
        self.latest: wire.Report | None = None
        self.latest_at_s = -math.inf
        self.fresh_at_s = -math.inf
        """When a prompt report with the latest counts would have been read: repeated and late reports are old."""
        self.identity: wire.Identity | None = None
        self.reports = 0
        self.lost = 0
        self.late = 0
        """Reports that came after a newer one, and were dropped."""
        self.resets = 0
        self._link = link
        self._clock = clock
        self._decoder = wire.Decoder()
        self._time = BoardTime()
        self._sequence = 0
        self._board_sequence: int | None = None
        self._has_sent = False
        self._answer: wire.Ack | wire.Identity | None = None
        self._indices = IndexLatches(self._send_arm_index)
        self._problems = Problems()

    @property
    def where(self) -> str:
        """Name in messages: `encoder board "enc0" on /dev/ttyUSB0`."""
        return f'encoder board "{self.name}" on {self._link.name}'

    @property
    def crc_errors(self) -> int:
        """Frames dropped for a bad CRC."""
        return self._decoder.crc_errors

    @property
    def framing_errors(self) -> int:
        """Frames dropped for bad stuffing or a wrong length."""
        return self._decoder.framing_errors

    @property
    def board_time_s(self) -> float:
        """When the latest counts were latched, in the board's time without wrap [s]."""
        return self._time.seconds

    def update(self) -> None:
        """Process everything received. Raises LinkLost, and once per event BoardReset or ProtocolViolation.

        The rest of what was received is processed even if this raises.
        """
        self._look()
        if self._problems:
            raise self._problems.pop(0)

    def await_report(self, made_s: float, until_s: float) -> float:
        """The board time of the latest report [s], once it was made at `made_s` or later; waits for that until then at most.

        NaN without a report. What goes wrong meanwhile is raised by the next `update`.
        """
        while not (self.latest is not None and self.board_time_s >= made_s):
            if self._problems or not self._link.wait(until_s - self._clock.now_s()):
                break
            try:
                self._look()
            except LinkLost:  # it stays lost
                break
        return self.board_time_s if self.latest is not None else math.nan

    def _look(self) -> None:
        received = self._link.read()
        if received:
            now_s = self._clock.now_s()
            for frame in self._decoder.feed(received):
                if type(frame) is wire.Report:
                    self._take_report(frame, now_s)
                else:
                    self._take_other(frame)
            self._indices.attend(now_s, self.latest)

    def require_fresh(self, now_s: float, limit_s: float) -> None:
        """Raises BoardSilent if the latest report came more than `limit_s` ago."""
        if now_s - self.latest_at_s > limit_s:
            age = f"for {now_s - self.latest_at_s:.3f} s" if self.latest else "yet"
            raise BoardSilent(f"{self.where}: no report {age} (limit {limit_s:.3f} s){self._noise()}")

    def identify(self, timeout_s: float = ANSWER_TIMEOUT_s, serial_number: int | None = None) -> wire.Identity:
        """Request the identity; check the protocol version and, if given, the serial number. Raises WrongIdentity."""
        self.identity = None
        sequence = self._next_sequence()
        answer = self._ask(wire.Identify(sequence), timeout_s)
        if not isinstance(answer, wire.Identity):
            raise ProtocolViolation(f"{self.where}: answered IDENTIFY by {answer}")
        self._check_protocol(answer.protocol)
        if serial_number is not None and answer.serial_number != serial_number:
            raise WrongIdentity(
                f"{self.where}: expected the board with serial number {serial_number}, "
                f"found {answer.serial_number}; check for swapped boards"
            )
        self.identity = answer
        return answer

    def stream(self, period_s: float) -> None:
        """Start a stream of reports every `period_s`; 0 stops it. Raises MisuseError if the line is too slow."""
        shortest_s = _REPORT_BITS / _STREAM_LOAD / self._link.baud if self._link.baud else 0.0
        if period_s and not max(shortest_s, 1e-6) <= period_s <= _LONGEST_PERIOD_s:
            raise MisuseError(
                f"{self.where}: cannot stream every {period_s * 1e3:g} ms: expected 0 or "
                f"{shortest_s * 1e3:.3g} ms (25 bytes a report at {self._link.baud} baud) to "
                f"{_LONGEST_PERIOD_s * 1e3:g} ms; take a longer period or a higher baud rate"
            )
        self._request(wire.Stream(self._next_sequence(), round(period_s * 1e6)))

    def poll(self) -> None:
        """Request one report without waiting; a later update() receives it."""
        self._send(wire.Poll(self._next_sequence()))

    def set_zero(self, channel: int, count: int = 0) -> None:
        """Set the count of `channel` at the present position to `count`; the joint should be at rest.

        Returns once the board has confirmed; the next report has the new count.
        """
        self._check_channel(channel)
        frame = wire.SetZero(self._next_sequence(), channel, count)
        wire.encode(frame)  # raises MisuseError before any state is cleared
        self._indices.forget(channel)
        self._request(frame)

    def arm_index(self, channel: int) -> None:
        """Arm the index latch of `channel` for the next pulse; see `index_latch`."""
        self._check_channel(channel)
        self._indices.forget(channel)
        frame = wire.ArmIndex(self._next_sequence(), channel, IndexAction.ARM)
        self._indices.expect(frame.sequence, channel)
        self._request(frame)

    def index_latch(self, channel: int) -> int | None:
        """The count latched since `arm_index`, or None."""
        return self._indices.latched(channel)

    def watch_indices(self, channels: Sequence[int]) -> None:
        """Let `update` arm the index of each channel again and again, without waiting; none ends it.

        Not beside `arm_index`, which is for one pulse.
        """
        self._indices.watch(channels)

    def passed_indices(self) -> list[tuple[int, int]]:
        """(channel, count) of the watched index pulses that came since the last call."""
        return self._indices.passed()

    def _check_channel(self, channel: int) -> None:
        channels = self.identity.channels if self.identity else wire.CHANNELS
        if not 0 <= channel < channels:
            raise MisuseError(f"{self.where}: no channel {channel}: expected 0 to {channels - 1}")

    def _check_protocol(self, protocol: int) -> None:
        if protocol != wire.PROTOCOL_VERSION:
            raise WrongIdentity(
                f"{self.where}: speaks protocol version {protocol}, expected {wire.PROTOCOL_VERSION}; "
                "update the board's firmware or this program"
            )

    def _next_sequence(self) -> int:
        self._sequence = self._sequence % 255 + 1  # 0 marks an unsolicited answer
        return self._sequence

    def _send(self, frame: wire.Request) -> None:
        coded = wire.encode(frame)
        if not self._has_sent:
            coded = wire.DELIMITER + coded  # ends a partial frame of a previous host
            self._has_sent = True
        self._link.write(coded)

    def _send_arm_index(self, channel: int, action: IndexAction) -> int:
        frame = wire.ArmIndex(self._next_sequence(), channel, action)
        self._send(frame)
        return frame.sequence

    def _request(self, frame: wire.Request) -> None:
        answer = self._ask(frame, ANSWER_TIMEOUT_s)
        result = answer.result if isinstance(answer, wire.Ack) else -1
        if result != wire.AckResult.DONE:
            reason = wire.AckResult(result).name if result in set(wire.AckResult) else f"result {result}"
            raise BoardRefused(f"{self.where}: refused {frame}: {reason.replace('_', ' ').lower()}")

    def _ask(self, frame: wire.Request, timeout_s: float) -> wire.Ack | wire.Identity:
        self._answer = None
        for _ in range(ATTEMPTS):
            self._send(frame)
            deadline_s = self._clock.now_s() + timeout_s
            while (now_s := self._clock.now_s()) < deadline_s:
                self._clock.wait_until_s(now_s + _STEP_s)
                self.update()
                if (answer := self._answer_to(frame.sequence)) is not None:
                    return answer
        raise BoardSilent(
            f"{self.where}: no answer to {type(frame).__name__} within {timeout_s:.3f} s, asked {ATTEMPTS} times{self._noise()}"
        )

    def _answer_to(self, sequence: int) -> wire.Ack | wire.Identity | None:
        answer = self._answer  # answers to older requests have another sequence
        return answer if answer is not None and answer.request_sequence == sequence else None

    def _noise(self) -> str:
        bad = self.crc_errors + self.framing_errors
        return f"; {bad} bad frames received: check the baud rate ({self._link.baud})" if bad else ""

    def _take_report(self, report: wire.Report, now_s: float) -> None:
        before, made_s = self.latest, self._time.seconds
        if before is not None:
            behind = (before.sequence - report.sequence) & 0xFF
            if 0 < behind < _LATE_FRAMES and _is_older(report, before):
                self.late += 1
                return
        if self._time.advance(report.board_time_us, now_s) and not _has_lost_zero(before, report):
            self._count_lost(report.sequence)
        else:
            # Its start-up message was lost too: the gap in the sequence is a restart, not lost frames.
            self._was_reset(report.sequence)
            self._time.advance(report.board_time_us, now_s)
        self.latest = report
        self.latest_at_s = now_s
        if before is None or self._time.seconds != made_s:
            self.fresh_at_s = now_s - self._time.lag_s
        self.reports += 1

    def _take_other(self, frame: wire.AnyFrame) -> None:
        if isinstance(frame, _REQUESTS):
            self._violation("sent a host's request; check for a bridge between TX and RX", wire.encode(frame))
        elif isinstance(frame, wire.Foreign):
            self._take_foreign(frame.raw)
        else:
            self._take_answer(frame)

    def _take_foreign(self, raw: bytes) -> None:
        # The protocol version stands in the same place in all versions of IDENTITY.
        if raw[0] == wire.IDENTITY_TYPE and len(raw) > 2 and raw[2] != wire.PROTOCOL_VERSION:
            try:
                self._check_protocol(raw[2])
            except WrongIdentity as wrong:
                self._problems.append(wrong)
        else:
            self._violation("sent a frame unknown to protocol version 1", raw)

    def _take_answer(self, frame: wire.AnyFrame) -> None:
        if isinstance(frame, wire.Identity) and frame.request_sequence == 0:
            if self.identity is not None or self.latest is not None:
                self._was_reset(frame.sequence)
            self._board_sequence = frame.sequence
        elif isinstance(frame, wire.Identity | wire.Ack):
            self._count_if_new(frame.sequence)
            self._answer = frame
            self._indices.acknowledged(frame.request_sequence, self._clock.now_s())
        elif isinstance(frame, wire.IndexLatch):
            self._count_if_new(frame.sequence)
            if frame.channel >= wire.CHANNELS:
                self._violation(f"sent an index of channel {frame.channel}", wire.encode(frame))
            else:
                self._indices.take(frame)

    def _count_if_new(self, sequence: int) -> None:
        """Count those lost before a frame without a time stamp, unless it is late or came before."""
        if self._board_sequence is None or 0 < (sequence - self._board_sequence) & 0xFF < _LATE_FRAMES:
            self._count_lost(sequence)

    def _count_lost(self, sequence: int) -> None:
        if self._board_sequence is not None:
            self.lost += (sequence - self._board_sequence - 1) & 0xFF
        self._board_sequence = sequence

    def _was_reset(self, sequence: int) -> None:
        self.resets += 1
        self._board_sequence = sequence
        self.latest, self.latest_at_s, self.fresh_at_s = None, -math.inf, -math.inf
        self._time = BoardTime()
        self._indices.clear()
        self._problems.append(
            BoardReset(
                f"{self.where}: restarted by itself; its counts are no longer valid positions: check its supply, then home again"
            )
        )

    def _violation(self, what: str, received: bytes) -> None:
        self._problems.append(ProtocolViolation(f"{self.where}: {what}", received))


def _is_older(report: wire.Report, newest: wire.Report) -> bool:
    """Whether a report was made before the newest one by the same running board."""
    older_us = (newest.board_time_us - report.board_time_us) & 0xFFFFFFFF
    return 0 < older_us < _LATE_us and not _has_lost_zero(newest, report)


def _has_lost_zero(before: wire.Report | None, now: wire.Report) -> bool:
    """Only a reset clears ZERO_SET."""
    if before is None or before.flags == now.flags:
        return False
    return any(was & ~is_now & ChannelFlag.ZERO_SET for was, is_now in zip(before.flags, now.flags, strict=True))


# Unwraps the board's u32 microsecond counter, which wraps after 71.6 min, to continuous seconds, and tells late reports.
_WRAP_us = 1 << 32
_HALF_us = 1 << 31
# A board's time can lead the host's estimate by the drift of the crystals and by how
# late earlier reports were read, never by a whole second. Late reports may lag by any amount.
_AHEAD_LIMIT_us = 1_000_000
# The first reports may have waited for a host that was busy with its start: then the next ones lead by as much.
_AHEAD_LIMIT_AT_FIRST_us = 60_000_000
_AT_FIRST_us = 5_000_000
_DRIFT = 3e-4  # two crystals differ by less; a board whose clock falls back faster sends old counts


class BoardTime:
    """Unwraps the time stamps of one board and distinguishes a restart from a wrap."""

    def __init__(self) -> None:
        self.seconds = 0.0
        """Unwrapped board time of the last report; starts at the board's first counter value."""
        self._last_us = 0
        self._host_us = 0
        self._started_us = 0  # on the host's clock
        self._furthest_ahead_us = 0
        self._prompt_ahead_us = 0.0  # lead over the host's time in a report without delay
        self._has_started = False

    @property
    def lag_s(self) -> float:
        """How much later the last report was read, after it was made, than a prompt one [s]."""
        return (self._prompt_ahead_us - (self._last_us - self._host_us)) * 1e-6

    def advance(self, board_time_us: int, host_s: float) -> bool:
        """Process the time stamp of a report read at `host_s`. Returns False if the board has restarted."""
        host_us = int(host_s * 1e6)
        if not self._has_started:
            self._start(board_time_us, host_us)
            return True
        # Of all times with these low 32 bits, the one nearest to what the host's clock predicts.
        predicted_us = self._last_us + host_us - self._host_us
        now_us = predicted_us + (board_time_us - predicted_us + _HALF_us) % _WRAP_us - _HALF_us
        ahead_us = now_us - host_us
        is_early = host_us - self._started_us < _AT_FIRST_us
        limit_us = _AHEAD_LIMIT_AT_FIRST_us if is_early else _AHEAD_LIMIT_us
        if now_us < self._last_us or ahead_us > self._furthest_ahead_us + limit_us:
            self._start(board_time_us, host_us)
            return False
        self._prompt_ahead_us = max(self._prompt_ahead_us - _DRIFT * (host_us - self._host_us), ahead_us)
        self._last_us, self._host_us, self.seconds = now_us, host_us, now_us * 1e-6
        if ahead_us > self._furthest_ahead_us:
            self._furthest_ahead_us = ahead_us
        return True

    def _start(self, board_time_us: int, host_us: int) -> None:
        self._last_us, self._host_us, self.seconds = board_time_us, host_us, board_time_us * 1e-6
        self._started_us = host_us
        self._furthest_ahead_us = board_time_us - host_us
        self._prompt_ahead_us = self._furthest_ahead_us
        self._has_started = True

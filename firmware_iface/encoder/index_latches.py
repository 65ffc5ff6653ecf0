"""Index pulses of one encoder board, seen from the host: one that is waited for, or all that pass."""

import math
from collections.abc import Callable, Sequence

from firmware_iface.encoder import wire
from firmware_iface.encoder.wire import ChannelFlag, IndexAction

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
            self._armed = dict.fromkeys(self._armed, now_s)
            return
        for channel, asked_s in tuple(self._armed.items()):
            if channel in self._latches:
                del self._armed[channel]
            elif not latest or not latest.flags[channel] & _INDEX_LATCHED:
                self._armed[channel] = now_s
            elif now_s - asked_s > _LATCH_REPEAT_s:
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

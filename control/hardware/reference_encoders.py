"""Encoder boards of docs/encoder_board.md as the encoders of an arm."""

from collections.abc import Mapping

from control.hardware.interface import Feedback
from firmware_iface.clock import Clock
from firmware_iface.encoder.board import EncoderBoard
from firmware_iface.errors import BoardSilent, MisuseError

REPORT_WAIT_S = (
    0.05  # a stream runs at 500 Hz or more, and hosts pause for some 40 ms; longer where stale_s is
)


def start_stream(encoder: EncoderBoard, period_s: float) -> None:
    """Stream two reports per cycle if the line is fast enough, so that the newest is at most half a cycle old."""
    try:
        encoder.stream(0.5 * period_s)
    except MisuseError:
        encoder.stream(period_s)


class ReferenceEncoders:
    """One encoder board; meets `control.hardware.roles.Encoders` and `Line`."""

    is_asked = False

    def __init__(
        self, board: EncoderBoard, channels: Mapping[int, int], clock: Clock, period_s: float, stale_s: float
    ) -> None:
        """`channels`: the channel of each joint. `stale_s`: how long the arm bears a silent board."""
        self.joints = tuple(channels)
        self._board = board
        self._channels = dict(channels)
        self._pairs = tuple(channels.items())
        self._joints = {channel: joint for joint, channel in channels.items()}
        self._watched = sorted(channels.values())
        self._clock = clock
        self._period_s = period_s
        self._wait_s = max(REPORT_WAIT_S, stale_s)
        self._serial_number = None if board.identity is None else board.identity.serial_number

    def await_counts(self, made_s: float, until_s: float) -> float:
        """When the newest counts were made, by the board's clock, once that is `made_s` or later; waits until then at most."""
        return self._board.await_report(made_s, until_s)

    def update(self) -> None:
        """Drain the line."""
        self._board.update()

    def flush(self) -> None:
        """The board streams by itself."""

    def take(self, feedback: Feedback) -> None:
        """Write the newest report."""
        board = self._board
        report, fresh_at_s, counted_at_s = board.latest, board.fresh_at_s, board.board_time_s
        for joint, channel in self._pairs:
            if report is not None:
                feedback.count[joint] = report.counts[channel]
                feedback.counted_at_s[joint] = counted_at_s
                feedback.channel_flags[joint] = report.flags[channel]
            feedback.reported_at_s[joint] = fresh_at_s

    def fresh_count(self, joint: int) -> int:
        """The count of the next report. BoardSilent if there is none."""
        board, asked_s = self._board, self._clock.now_s()
        while (now_s := self._clock.now_s()) - asked_s < self._wait_s:
            self._clock.wait_until_s(now_s + 0.0005)
            board.update()
            if board.latest is not None and board.latest_at_s > asked_s:
                return board.latest.counts[self._channels[joint]]
        raise BoardSilent(f"{board.where}: no report for {self._wait_s:g} s while a zero was set")

    def arm_index(self, joint: int) -> None:
        """Arm the index latch of the joint."""
        self._board.arm_index(self._channels[joint])

    def index_count(self, joint: int) -> int | None:
        """The count latched since `arm_index`, or None."""
        return self._board.index_latch(self._channels[joint])

    def watch_indices(self, is_wanted: bool) -> None:
        """Arm the index latches of all joints again and again, or end that."""
        self._board.watch_indices(self._watched if is_wanted else ())

    def passed_indices(self) -> list[tuple[int, int]]:
        """(joint, count) of the watched index pulses that came since the last call."""
        return [(self._joints[channel], count) for channel, count in self._board.passed_indices()]

    def shift(self, joint: int, counts: int) -> None:
        """Shift the counter of a joint at rest; the motor may move by at most one count meanwhile."""
        self._board.set_zero(self._channels[joint], self.fresh_count(joint) + counts)
        self.fresh_count(joint)

    def restore(self) -> None:
        """Start the stream again where none comes: after a reset, also one that nobody saw.

        WrongIdentity if another board has taken the place of this one, BoardSilent, BoardReset.
        """
        if self._clock.now_s() - self._board.latest_at_s > REPORT_WAIT_S:
            self._board.identify(serial_number=self._serial_number)
            start_stream(self._board, self._period_s)
            self.fresh_count(self.joints[0])

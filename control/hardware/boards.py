"""The arm's hardware, composed of encoders and drives of any kind, by board; `control.hardware.connect` opens and checks them.

A board that has both meets both Protocols. Joints are 0-based numbers of the arm; each object writes the entries of its own
joints into the arm's `Feedback` and reads those of the arm's outputs. Counts keep the encoder's sense; volts and amperes
carry the joint's sign, which each driver makes of its wiring. What the openers of all kinds of boards are given, and add to while
an arm is connected, is `Opened`. Mock boards are connected behind the links; the code here is the same for both.
"""

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from control.hardware.interface import Attended, EndBoards, Feedback, Hardware, OutputMode, Wanted
from control.model.arm import Arm, Board, Drive
from firmware_iface.clock import Clock
from firmware_iface.errors import LinkError, LinkLost, Problems


class Line(Protocol):
    """A port or bus that is drained once a cycle."""

    def update(self) -> None:
        """Process what has arrived, without blocking. Raises LinkError; the rest is processed all the same."""
        ...

    def flush(self) -> None:
        """All boards on it have their commands of this cycle: send what is not yet sent. Raises LinkLost."""
        ...


class AskedLine(Line, Attended, Protocol):
    """A line whose boards speak only when they are asked."""


class AskedEncoders:
    """What encoders have in common that send no stream of reports and read no index: nothing to follow, count or watch."""

    is_asked = True

    def await_counts(self, made_s: float, until_s: float) -> float:
        """No stream of reports."""
        return math.nan

    def watch_indices(self, is_wanted: bool) -> None:
        """No index is watched."""

    def passed_indices(self) -> list[tuple[int, int]]:
        """No index is watched."""
        return []

    def restore(self) -> None:
        """Nothing is lost by a restart that the next answers do not bring."""


class Encoders(Protocol):
    """The encoders on one board."""

    @property
    def joints(self) -> Sequence[int]:
        """Whose encoders they are."""
        ...

    def take(self, feedback: Feedback) -> None:
        """Write count, its time, when it was reported, and the channel flags of each joint."""
        ...

    def await_counts(self, made_s: float, until_s: float) -> float:
        """When the newest counts were made, by the board's clock [s], once that is `made_s` or later; waits until then at most.

        NaN without counts, and from boards that send no stream of them. Never raises: `Line.update` does.
        """
        ...

    @property
    def is_asked(self) -> bool:
        """Whether a count is made when it is asked for; else at the board's own rate."""
        ...

    def fresh_count(self, joint: int) -> int:
        """A count that the board makes from now on; waits for it. Raises BoardSilent."""
        ...

    def arm_index(self, joint: int) -> None:
        """Arm the index latch. Waits some ms for the board's answer."""
        ...

    def index_count(self, joint: int) -> int | None:
        """The count latched since `arm_index`, or None."""
        ...

    def watch_indices(self, is_wanted: bool) -> None:
        """Arm all index latches again and again, or end that; does not wait."""
        ...

    def passed_indices(self) -> list[tuple[int, int]]:
        """(joint, count) of the watched index pulses that came since the last call."""
        ...

    def shift(self, joint: int, counts: int) -> None:
        """Add `counts` to the counter of a joint at rest, mark its zero as set, and wait for a count that includes it."""
        ...

    def restore(self) -> None:
        """Let a board that was reset report again. Raises LinkError; WrongIdentity if it is another one."""
        ...


class Drives(Protocol):
    """The drives on one bus or board."""

    @property
    def joints(self) -> Sequence[int]:
        """Which joints they drive."""
        ...

    def take(self, feedback: Feedback) -> None:
        """Write currents, supply, temperature, statusword, faults and the time of the reply."""
        ...

    def write(
        self,
        wanted: Wanted,
        modes: Sequence[OutputMode],
        output: Sequence[float],
        feedforward_V: Sequence[float],
        feedback: Feedback,
    ) -> None:
        """Command every joint, or take its drive one step closer to what is wanted; notes `feedback.sent_V`.

        The board's own word says whether it is in operation. Only ENABLING takes it there: who left it otherwise stays out.
        """
        ...

    def is_any_enabled(self) -> bool:
        """Whether a drive was in OPERATION ENABLED in its last reply."""
        ...

    def has_torque(self, joint: int) -> bool:
        """Whether the joint's board drives its motor, or holds it after a time-out, as far as it says so."""
        ...

    def configure(self, fresh_count: Callable[[int], int]) -> None:
        """Upload limits, time-outs and gains where a board does not have them; waits. `fresh_count`: of a joint's encoder.

        No torque is switched on by it, nor off, unless a board takes its parameters in no other way.
        WrongIdentity if a board that was reset is another one.
        """
        ...

    def acknowledge_faults(self) -> None:
        """Reset the drives' faults; none is enabled by it. Raises BoardFaulted."""
        ...

    def follow_shift(self, joint: int, fresh_count: Callable[[int], int]) -> None:
        """The counter of the joint's encoder was shifted."""
        ...

    def emergency_stop(self) -> None:
        """Stop all drives now. Raises LinkError."""
        ...


@dataclass(slots=True)
class Opened:
    """What was opened of an arm's boards for a cycle of `period_s`: encoders, drives and lines, who answered, what failed."""

    arm: Arm
    clock: Clock
    period_s: float
    encoders: list[Encoders] = field(default_factory=list)
    drives: list[Drives] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)
    polled: list[AskedLine] = field(default_factory=list)  # of `lines`: those that live from being attended to
    identities: list[tuple[str, str]] = field(default_factory=list)  # where, what the board says of itself
    closers: list[Callable[[], None]] = field(default_factory=list)
    failures: list[LinkError] = field(default_factory=list)

    def driven(self, boards: Iterable[Board]) -> list[tuple[Board, Drive]]:
        """Boards of one motor, each with its joint's drive, or the gripper's."""
        drives = {drive.board: drive for drive in self.arm.motors}
        return [(board, drives[board.name]) for board in boards]


@contextlib.contextmanager
def collect(failures: list[LinkError]) -> Iterator[None]:
    """Note a failure and go on: one error names all devices that failed."""
    try:
        yield
    except LinkError as error:
        failures.append(error)


LOOK_AGAIN_S = 0.1  # until a link that is gone is asked again: half of the boards' usual watchdog
ATTEND_EVERY_S = 0.00025  # an answer waits so long at most until the next request goes out
NO_END = EndBoards()


class BoardHardware:
    """Implements `control.hardware.interface.Hardware` on boards; made and checked by control.hardware.connect."""

    def __init__(self, opened: Opened, end: EndBoards = NO_END) -> None:
        """Lines are drained in the order in which they were opened, and those in `polled` attended to between the cycles.

        Every joint has one of the encoders and one of the drives.
        """
        self.feedback = Feedback(len(opened.arm.drives))
        self.offers = _offers(opened.arm)
        self._polled = tuple(opened.polled)
        self.end = end
        self._encoders, self._drives, self._lines = tuple(opened.encoders), tuple(opened.drives), tuple(opened.lines)
        self._encoder_of = {joint: encoder for encoder in self._encoders for joint in encoder.joints}
        self._drive_of = {joint: drive for drive in self._drives for joint in drive.joints}
        self._clock = opened.clock
        self.wanted = Wanted.AS_FOUND
        """Of the last `write`."""
        self._problems = Problems()
        # what failed at a link, why, and when it is tried again
        self._gone: dict[Callable[..., None], tuple[str, float]] = {}

    # ---- every cycle

    @property
    def gone(self) -> str:
        """Why a link is gone; empty while all are there."""
        return next(iter(self._gone.values()))[0] if self._gone else ""

    @property
    def is_polled(self) -> bool:
        """Whether some of its boards speak only when they are asked."""
        return bool(self._polled)

    def attend(self, until_s: float, beside: Sequence[Hardware] = ()) -> None:
        """Wait until then, and serve the polled lines meanwhile, with those of other arms `beside`."""
        clock = self._clock
        polled: Sequence[Attended] = self.polled_lines()
        for other in beside:
            polled = (*polled, *other.polled_lines())
        while polled and (now_s := clock.now_s()) < until_s - ATTEND_EVERY_S:
            for line in polled:
                line.attend()
            clock.wait_until_s(now_s + ATTEND_EVERY_S)
        clock.wait_until_s(until_s)

    def polled_lines(self) -> Sequence[AskedLine]:
        """The lines that are there and must be asked."""
        if self._gone:
            return tuple(line for line in self._polled if line.update not in self._gone)
        return self._polled

    def read(self) -> Feedback:
        """Drain the links into `feedback`. Raises, one a call, each BoardReset, ProtocolViolation, and LinkLost found since."""
        feedback = self.feedback
        feedback.motor_counts.clear()
        for line in self._lines:
            self._try(line.update)
        for encoder in self._encoders:
            encoder.take(feedback)
        for drive in self._drives:
            drive.take(feedback)
        if not self.wanted.is_on:  # nobody asks whether a drive that is wanted on still has torque
            for joint, drive in self._drive_of.items():
                feedback.has_torque[joint] = drive.has_torque(joint)
        feedback.encoder_at_s = min(feedback.reported_at_s)
        if self._problems:
            raise self._problems.pop(0)
        return feedback

    def write(self, wanted: Wanted, modes: Sequence[OutputMode], output: Sequence[float], feedforward_V: Sequence[float]) -> None:
        """Command every drive, or take it one step closer to what is wanted; what that meets is raised by `read`.

        The gripper's follows with its next command.
        """
        self.wanted = wanted
        if self.end.gripper is not None:
            self.end.gripper.torque.wanted = wanted
        for drive in self._drives:
            self._try(drive.write, wanted, modes, output, feedforward_V, self.feedback)
        for line in self._lines:
            self._try(line.flush)

    def _try(self, step: Callable[..., None], *what: Any) -> None:
        """Do something at a link. One that is gone is not asked for its error in every cycle, and hides no other."""
        gone = self._gone.get(step) if self._gone else None
        if gone is not None and self._clock.now_s() < gone[1]:
            return
        try:
            step(*what)
        except LinkLost as lost:
            if gone is None:
                self._problems.append(lost)
            self._gone[step] = (str(lost), self._clock.now_s() + LOOK_AGAIN_S)
        except LinkError as error:
            self._problems.append(error)
        else:
            if gone is not None:
                del self._gone[step]

    def is_any_enabled(self) -> bool:
        """Whether a drive was in OPERATION ENABLED in its last reply."""
        return any(drive.is_any_enabled() for drive in self._drives)

    def has_torque(self) -> bool:
        """Whether a board drives its motor, or holds it by itself; the gripper's, too."""
        gripper = self.end.gripper
        return (gripper is not None and gripper.has_torque()) or any(
            drive.has_torque(joint) for joint, drive in self._drive_of.items()
        )

    def await_counts(self, made_s: float, until_s: float) -> float:
        """Wait for counts of the first encoder board; not while a link is gone."""
        return math.nan if self._gone else self._encoders[0].await_counts(made_s, until_s)

    # ---- outside of the cycle: these wait for answers

    def prepare(self) -> None:
        """Let boards that restarted report again, and upload the parameters, so that `write` may take them into operation."""
        self._gone.clear()
        self._restore()
        self._configure()
        self.end.prepare()

    def reset_drive_faults(self) -> None:
        """Acknowledge the drives' faults and restore the state of boards that were reset.

        Raises BoardFaulted, and WrongIdentity where another board has taken the place of one.
        """
        self._gone.clear()
        self._restore()
        for drive in self._drives:
            drive.acknowledge_faults()
        self._configure()
        self.reset_gripper()
        for drive in self._drives:
            drive.take(self.feedback)  # what is asked next must not be refused for a fault that is gone

    def reset_gripper(self) -> None:
        """Let `write` acknowledge the fault of the gripper's board; a board that restarted gets its parameters. BoardSilent."""
        if self.end.gripper is not None:
            self.end.gripper.reset_fault()
        if self.wanted.is_on:
            self.end.prepare()

    def emergency_stop(self) -> None:
        """Stop all drives. Never raises: the boards' watchdogs do the same a little later."""
        for drive in self._drives:
            with contextlib.suppress(LinkError):
                drive.emergency_stop()
        if self.end.gripper is not None:
            with contextlib.suppress(LinkError):
                self.end.gripper.emergency_stop()

    def arm_index(self, joint: int) -> None:
        """Arm the index latch of the joint."""
        self._encoder_of[joint].arm_index(joint)

    def index_count(self, joint: int) -> int | None:
        """The count latched since `arm_index`, or None."""
        return self._encoder_of[joint].index_count(joint)

    def watch_indices(self, is_wanted: bool) -> None:
        """Arm the index latches of all joints again and again, or end that."""
        for encoder in self._encoders:
            encoder.watch_indices(is_wanted)

    def passed_indices(self) -> list[tuple[int, int]]:
        """(joint, count) of the watched index pulses that came since the last call."""
        return [passed for encoder in self._encoders for passed in encoder.passed_indices()]

    def shift_count(self, joint: int, counts: int) -> None:
        """Shift the counter of a joint at rest; the motor may move by at most one count meanwhile."""
        self._encoder_of[joint].shift(joint, counts)
        self.feedback.shift_count[joint] += counts
        self._drive_of[joint].follow_shift(joint, self._fresh_count)

    def _fresh_count(self, joint: int) -> int:
        return self._encoder_of[joint].fresh_count(joint)

    def _restore(self) -> None:
        for encoder in self._encoders:
            encoder.restore()

    def _configure(self) -> None:
        for drive in self._drives:
            drive.configure(self._fresh_count)


def _offers(arm: Arm) -> frozenset[OutputMode]:
    """What every drive of the arm can be commanded to do; a board that cannot hold, or open its circuit, brakes instead."""
    kinds = [arm.kind_of(drive) for drive in arm.drives]
    offers = {OutputMode.HOLD, OutputMode.OFF}
    for mode in (OutputMode.VOLTAGE, OutputMode.CURRENT, OutputMode.POSITION):
        if all(mode.name.lower() in kind.modes for kind in kinds):
            offers.add(mode)
    return frozenset(offers)

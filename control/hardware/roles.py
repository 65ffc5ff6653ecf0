"""What `control.hardware.boards.BoardHardware` is composed of: encoders and drives, by board.

A board that has both meets both Protocols. Joints are 0-based numbers of the arm; each object writes the entries of its own
joints into the arm's `Feedback` and reads those of the arm's outputs. Counts keep the encoder's sense; volts and amperes
carry the joint's sign, which each driver makes of its wiring. What the
openers of all kinds of boards are given, and add to while an arm is connected, is `Opened`.
"""

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from control.hardware.interface import Attended, Feedback, OutputMode, Wanted
from control.model.arm import Arm, Board, Drive
from firmware_iface.clock import Clock
from firmware_iface.errors import LinkError


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

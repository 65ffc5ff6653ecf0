"""The hardware interface of the loop: measured values in, outputs out.

The only interface between loop and wires. Values are per joint, in the joint's own sign (board wiring signs are corrected
below it) and in the encoder's counts; the loop maps counts to angles. `read` and `write` do not block: `read` drains what has
arrived, `write` queues what is to be sent.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

from control.hardware.gripper_board import GripperHardware
from control.hardware.words import Wanted
from control.model.end_effector import Digital
from firmware_iface.motor.board import DigitalPins

# The named pins of an arm's motor boards, for the loop.

STALE_s = 0.2  # ten questions; older levels are unknown


class NamedPins:
    """Sets outputs and reads levels by name."""

    def __init__(self, described: Sequence[Digital], boards: Mapping[int, DigitalPins]) -> None:
        self._described = tuple(described)
        self._boards = boards
        self._resets = dict.fromkeys(boards, -1)

    def configure(self) -> None:
        """Tell each board, where it does not know it, which pins are outputs and what is safe. Waits; not while it is enabled."""
        for node, pins in self._boards.items():
            if self._resets[node] == pins.board.resets:
                continue
            of_board = [pin for pin in self._described if pin.board == node and pin.direction == "output"]
            pins.configure(
                sum(1 << pin.pin for pin in of_board),
                sum(1 << pin.pin for pin in of_board if pin.safe == "high"),
                sum(1 << pin.pin for pin in of_board if pin.safe == "keep"),
            )
            self._resets[node] = pins.board.resets

    def command(self, wanted: Mapping[str, bool]) -> None:
        """Set the outputs that are in `wanted`, and ask for all levels; does not wait. LinkLost."""
        for node, pins in self._boards.items():
            of_board = [pin for pin in self._described if pin.board == node and pin.name in wanted]
            mask = sum(1 << pin.pin for pin in of_board)
            pins.command(mask, sum(1 << pin.pin for pin in of_board if wanted[pin.name]))

    def levels(self, now_s: float) -> dict[str, bool | None]:
        """Levels at the pins; None while a board does not say."""
        level_of: dict[str, bool | None] = {}
        for pin in self._described:
            board = self._boards[pin.board]
            reply = board.reply if now_s - board.reply_at_s <= STALE_s else None
            level_of[pin.name] = None if reply is None else bool(reply.levels >> pin.pin & 1)
        return level_of


class OutputMode(Enum):
    """Meaning of a number passed to `write`. `OFF` opens the motor circuit: the joint is free and a loaded arm drops; a board
    that cannot do so shorts the windings. `HOLD`: the board brings its joint to rest and holds it by its own encoder.
    """

    OFF = 0
    VOLTAGE = 1
    CURRENT = 2
    POSITION = 3
    HOLD = 4


@dataclass(slots=True)
class Feedback:
    """The boards' latest values. One object, overwritten by every read; lists have one entry per joint."""

    joint_count: int
    encoder_at_s: float = float("-inf")  # of the board with the oldest counts, on the host's clock
    counted_at_s: list[float] = field(default_factory=list)  # when `count` was latched, on its board's own clock
    count_late_s: list[float] = field(default_factory=list)  # by how much later it may have been: 0, if the board tells
    # when the joint's counts were made; a repeated report or one that was under way for long is as old as its counts
    reported_at_s: list[float] = field(default_factory=list)
    reply_at_s: list[float] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    shift_count: list[int] = field(default_factory=list)  # sum of `shift_count` calls that `count` already includes
    channel_flags: list[int] = field(default_factory=list)
    current_A: list[float] = field(default_factory=list)
    supply_V: list[float] = field(default_factory=list)
    temperature_C: list[float] = field(default_factory=list)
    statusword: list[int] = field(default_factory=list)
    drive_faults: list[int] = field(default_factory=list)
    # whether the board drives its motor or holds it by itself, whatever its state is called, as far as it says so
    has_torque: list[bool] = field(default_factory=list)
    # of the last COMMAND, in the joint's sign; NaN while the board finds the voltage itself, or drives nothing
    sent_V: list[float] = field(default_factory=list)
    # (joint, its count without shifts, its motor board's count of the same moment) that came in this cycle; the latter in the
    # sense of the former, or of the joint where it is of a second encoder
    motor_counts: list[tuple[int, int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        n = self.joint_count
        self.reported_at_s, self.reply_at_s = [float("-inf")] * n, [float("-inf")] * n
        for name in ("count", "shift_count", "channel_flags", "statusword", "drive_faults"):
            setattr(self, name, [0] * n)
        for name in ("counted_at_s", "count_late_s", "current_A", "supply_V", "temperature_C"):
            setattr(self, name, [0.0] * n)
        self.sent_V = [float("nan")] * n
        self.has_torque = [False] * n


@dataclass(frozen=True, slots=True)
class EndBoards:
    """What is at the end of the arm, if anything: the boards that the joints do not need."""

    gripper: GripperHardware | None = None
    pins: NamedPins | None = None

    def prepare(self) -> None:
        """Upload what the boards do not have; waits. Pins belong to boards that are not enabled yet."""
        if self.pins is not None:
            self.pins.configure()
        if self.gripper is not None:
            self.gripper.prepare()


class Attended(Protocol):
    """A line whose boards speak only when they are asked."""

    def attend(self) -> None:
        """Go on asking, while the loop waits for its next cycle. Never raises: `update` does."""
        ...


class Hardware(Protocol):
    """The arm as seen by the loop; real and mock boards implement it alike."""

    feedback: Feedback
    end: EndBoards
    offers: frozenset[OutputMode]
    """The modes in which every drive of the arm can be commanded."""

    @property
    def gone(self) -> str:
        """Why a link is gone, as text; empty while all are there. Only the first `read` after the loss raises LinkLost."""
        ...

    @property
    def is_polled(self) -> bool:
        """Whether some of its boards speak only when they are asked."""
        ...

    def attend(self, until_s: float, beside: Sequence["Hardware"] = ()) -> None:
        """Wait until then; lines whose boards speak only when asked are served meanwhile, those of other arms `beside`, too."""
        ...

    def polled_lines(self) -> Sequence[Attended]:
        """Those lines, as far as they are there."""
        ...

    def read(self) -> Feedback:
        """Drain the links into `feedback`. Raises, once per event, LinkLost, BoardReset or ProtocolViolation."""
        ...

    def write(self, wanted: Wanted, modes: Sequence[OutputMode], output: Sequence[float], feedforward_V: Sequence[float]) -> None:
        """Take every drive, the gripper's too, a step towards what is wanted, and command those in operation.

        `output` in V, A or rad, as each entry of `modes` says; in POSITION mode the board adds `feedforward_V`.
        """
        ...

    def has_torque(self) -> bool:
        """Whether a board drives its motor or holds it by itself, as far as it says so: in operation, or after a time-out."""
        ...

    def await_counts(self, made_s: float, until_s: float) -> float:
        """When the first encoder board's newest counts were made, by its own clock [s]; NaN from boards without a stream.

        Waits, until then at most, for counts that were made at `made_s` or later. Never raises: `read` does.
        """
        ...

    def prepare(self) -> None:
        """Upload what the boards need before `write` takes them to OPERATION ENABLED; none is switched on or off by it. Waits.

        Raises a firmware_iface error that names each failed drive.
        """
        ...

    def reset_drive_faults(self) -> None:
        """Acknowledge the drives' own faults. Raises when a drive stays in FAULT."""
        ...

    def reset_gripper(self) -> None:
        """Let `write` acknowledge the fault of the gripper's board; a board that restarted gets its parameters now."""
        ...

    def emergency_stop(self) -> None:
        """Broadcast the emergency stop: every board shorts its windings and goes to FAULT. Never raises."""
        ...

    def arm_index(self, joint: int) -> None:
        """Arm the index latch of joint (0-based). Waits some ms for the board's answer."""
        ...

    def index_count(self, joint: int) -> int | None:
        """The count latched since `arm_index`, or None if there was no index pulse yet."""
        ...

    def watch_indices(self, is_wanted: bool) -> None:
        """Arm the index latches of all joints again and again, or end that. Not while `arm_index` is used; does not wait."""
        ...

    def passed_indices(self) -> list[tuple[int, int]]:
        """(joint, count) of the watched index pulses that came since the last call."""
        ...

    def shift_count(self, joint: int, counts: int) -> None:
        """Add `counts` to the board's counter of joint (0-based), which must be at rest, and mark its zero as set.

        Waits some ms for the board's answer. From the next read on, `feedback.count` is relative to the new zero and
        `feedback.shift_count` is the sum of the shifts.
        """
        ...

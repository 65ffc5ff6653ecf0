"""The hardware interface of the loop: measured values in, outputs out; of joints, gripper and named pins.

The only interface between loop and wires. Values are per joint, in the joint's own sign (board wiring signs are corrected
below it) and in the encoder's counts; the loop maps counts to angles. `read` and `write` do not block: `read` drains what has
arrived, `write` queues what is to be sent. Flags, states and faults are those of the reference boards, into which other boards'
are translated.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final, Protocol

from control.model.end_effector import Digital
from firmware_iface.errors import LinkError
from firmware_iface.motor.board import DigitalPins


class Wanted(Enum):
    """What is wanted of every drive of an arm. The loop says it in each cycle, with what is to be commanded."""

    AS_FOUND = "nothing is commanded: each board goes on with what it did when it was connected"
    DISABLED = "no torque; a board that has it all the same is switched off"
    ENABLING = "all are taken to OPERATION ENABLED: by a person's request only"
    ENABLED = "those in operation are commanded; one that has left it is not taken back"

    def __init__(self, _: str) -> None:
        self.is_on: bool = self.name in ("ENABLING", "ENABLED")
        """Whether drives in operation are commanded."""


# Flags of an encoder channel, docs/encoder_board.md.
HOME_SWITCH: Final = 1 << 2
ZERO_SET: Final = 1 << 3
QUADRATURE_ERROR: Final = 1 << 4
SIGNAL_LOST: Final = 1 << 5
# Of a drive's own inputs for limit switches, in the joint's sense: no encoder channel has them.
LOWER_LIMIT: Final = 1 << 8
UPPER_LIMIT: Final = 1 << 9

# Statuswords of CiA 402, low byte, docs/motor_board.md.
STATE_MASK: Final = 0x6F
SWITCH_ON_DISABLED: Final = 0x40
OPERATION_ENABLED: Final = 0x27
FAULT: Final = 0x08
WARNING: Final = 0x80  # the board limits its output

# Faults of a drive.
OVER_CURRENT: Final = 1 << 0
OVER_TEMPERATURE: Final = 1 << 1
SUPPLY_LOW: Final = 1 << 2
SUPPLY_HIGH: Final = 1 << 3
WATCHDOG: Final = 1 << 4
OWN_ENCODER: Final = 1 << 5
BAD_COMMAND: Final = 1 << 6
EMERGENCY_STOP: Final = 1 << 7


def as_counter(count: int) -> int:
    """A count as a counter of 32 bits says it: boards that say turns, and zeros that are kept here, know no such end."""
    return (count + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000


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


@dataclass(slots=True)
class GripperFeedback:
    """The board's latest values. `moved_m`: by the motor since power-up, opening positive; NaN without an encoder."""

    current_A: float = 0.0
    moved_m: float = math.nan
    moved_at_s: float = -math.inf
    reply_at_s: float = -math.inf
    is_enabled: bool = False
    faults: str = ""  # of its board, in words
    problem: LinkError | None = None  # it restarted, or sent nonsense; once


class TorqueWithTheArm:
    """What is wanted of the gripper's drive: as of the arm's; and ENABLING when its fault was acknowledged."""

    def __init__(self) -> None:
        self._wanted = Wanted.AS_FOUND
        self._is_coming = False

    @property
    def wanted(self) -> Wanted:
        """Of the arm's drives, with ENABLING until this one is there."""
        return Wanted.ENABLING if self._is_coming and self._wanted.is_on else self._wanted

    @wanted.setter
    def wanted(self, of_arm: Wanted) -> None:
        self._is_coming |= of_arm.is_on and not self._wanted.is_on
        self._wanted = of_arm if of_arm is not Wanted.ENABLING else Wanted.ENABLED

    def take_back(self) -> None:
        """Its fault was acknowledged."""
        self._is_coming = True

    def note(self, is_enabled: bool) -> None:
        """Whether it is in operation: from then on it is not taken back."""
        self._is_coming &= not is_enabled


class GripperHardware(Protocol):
    """The gripper's motor, on a board of any kind."""

    feedback: GripperFeedback
    torque: TorqueWithTheArm

    def read(self, now_s: float) -> GripperFeedback:
        """The values by now; the links have been drained before."""
        ...

    def write(self, volts: float | None, now_s: float) -> None:
        """Take the drive a step towards what is wanted, or command a voltage, opening positive, or an open circuit (None)."""
        ...

    def has_torque(self) -> bool:
        """Whether the board drives its motor, or holds it by itself."""
        ...

    def prepare(self) -> None:
        """Upload what the board does not have. Waits."""
        ...

    def reset_fault(self) -> None:
        """Acknowledge the board's fault, if it has one."""
        ...

    def emergency_stop(self) -> None:
        """Stop now, where the joints' stop does not reach it."""
        ...


STALE_s = 0.2  # of pins: ten questions; older levels are unknown


class NamedPins:
    """The named pins of an arm's motor boards: sets outputs and reads levels by name."""

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

"""What bring-up works with: boards of any kind behind one Protocol, and the operator who confirms, stops and reports."""

from __future__ import annotations

import contextlib
import math
import random
import select
import sys
import termios
import tty
from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

from control.errors import ArmError
from control.hardware.interface import LOWER_LIMIT, UPPER_LIMIT
from control.model.arm import Drive
from control.model.drive import OWN_INPUT
from firmware_iface.clock import Clock

if TYPE_CHECKING:
    from hil_mocks.rig import SteppedRig


class Stopped(Exception):
    """The operator did not confirm a motion, or stopped one. The drive is off."""


class BringupOperator(Protocol):
    """A person at a terminal, or one at a mock arm."""

    def say(self, text: str) -> None:
        """Show a text."""
        ...

    def allow(self, what: str) -> bool:
        """Announce a motion; True if it may begin."""
        ...

    def wants_stop(self) -> bool:
        """Whether to stop; polled every cycle while a motor is driven."""
        ...

    def what_moved(self, joint_count: int) -> tuple[int, int] | None:
        """The joint (1-based) that has just moved, and its sign by the drawing; None if nothing did."""
        ...

    def angle_rad(self, joint: int) -> float | None:
        """The joint's angle by the drawing, in rad, as read with a protractor or an inclinometer; None if it cannot be read."""
        ...

    def support(self, joint: int, are_held: bool) -> None:
        """The joint (1-based) that will move is next; ask to support the links of the others, if boards do not hold them."""
        ...

    def let_go(self) -> None:
        """Links need no more support."""
        ...


# The operator at a terminal: Enter allows a motion, any key stops it, answers are typed.
NOTHING = ("0", "n", "no", "none", "nothing")


class TerminalOperator:
    """A `BringupOperator`. A context manager: it restores the terminal."""

    def __init__(self, without_confirmation: bool = False) -> None:
        """`without_confirmation`: motions are announced and begin without Enter; questions are still asked."""
        self._without_confirmation = without_confirmation
        self._is_terminal = sys.stdin.isatty()
        self._settings = termios.tcgetattr(sys.stdin) if self._is_terminal else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self._by_lines()

    def say(self, text: str) -> None:
        """Print it."""
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()

    def allow(self, what: str) -> bool:
        """Enter begins; any other answer declines."""
        if self._without_confirmation:
            self.say(f"  {what}")
        elif self._line(
            f"  {what}\n  Enter: go; keep a hand on the emergency stop. Any key stops the motion. s and Enter: do not move. "
        ).strip():
            return False
        self._by_keys()
        return True

    def wants_stop(self) -> bool:
        """Whether a key was pressed since the motion was allowed."""
        if not self._is_terminal or not select.select([sys.stdin], [], [], 0)[0]:
            return False
        sys.stdin.read(1)
        return True

    def what_moved(self, joint_count: int) -> tuple[int, int] | None:
        """Asked until the answer is valid."""
        while True:
            answer = self._line(
                "  Which joint moved, and in which direction of the drawing? Joint and sign, such as 1+ or 2-; 0: nothing moved. "
            ).strip()
            if answer.lower() in NOTHING:
                return None
            joint, sign = answer[:-1].strip(), answer[-1:]
            if joint.isdigit() and 1 <= int(joint) <= joint_count and sign in ("+", "-"):
                return int(joint), 1 if sign == "+" else -1
            self.say(f"  Expected 1 to {joint_count} with + or -, or 0; got {answer!r}.")

    def angle_rad(self, joint: int) -> float | None:
        """Degrees are what protractors have."""
        while True:
            answer = self._line(
                f"  Angle of joint {joint} as in the drawing, in degrees (protractor or inclinometer; Enter: cannot be read): "
            ).strip()
            if not answer:
                return None
            with contextlib.suppress(ValueError):
                degrees = float(answer.replace(",", "."))
                if math.isfinite(degrees) and abs(degrees) <= 720.0:
                    return math.radians(degrees)
            self.say(f"  Expected a number of degrees, got {answer!r}.")

    def support(self, joint: int, are_held: bool) -> None:
        """Tell the operator which links to support."""
        if are_held:
            self.say(
                f"Joint {joint} is next. The boards hold the other joints, until one is at fault: keep a hand below the links,"
                " but do not press."
            )
        else:
            self.say(f"Joint {joint} is next. Support the links of the other joints: they are braked, but not held.")

    def let_go(self) -> None:
        """Nothing to do: a person sees that the motion is over."""

    def _line(self, question: str) -> str:
        self._by_lines()
        sys.stdout.write(question)
        sys.stdout.flush()
        line = sys.stdin.readline()
        if not line:
            sys.stdout.write("\n")  # what is said next has a line of its own
            raise Stopped("the operator's input has ended")
        return line

    def _by_keys(self) -> None:
        if self._is_terminal:
            termios.tcflush(sys.stdin, termios.TCIFLUSH)  # keys that were pressed before stop nothing
            tty.setcbreak(sys.stdin)

    def _by_lines(self) -> None:
        if self._settings is not None:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._settings)


# The person beside a mock arm: reads true joint angles with the accuracy of an inclinometer, and supports links on request.
READING_SD_RAD = 0.002  # a tenth of a degree, an inclinometer's
SEEN_RAD = 0.01  # the smallest visible turn


class MockOperator:
    """A `BringupOperator` for a stepped rig. Its answers are printed."""

    def __init__(self, rig: SteppedRig, seed: int = 0, is_silent: bool = False) -> None:
        self._rig = rig
        self._random = random.Random(f"operator {seed}")
        self._is_silent = is_silent
        self._before = rig.joint_rad()
        self.let_go()

    def say(self, text: str) -> None:
        """Print it."""
        if not self._is_silent:
            sys.stdout.write(f"{text}\n")

    def allow(self, what: str) -> bool:
        """Always True; notes the joint angles before the motion."""
        self.say(f"  {what}  [mock operator: go]")
        self._before = self._rig.joint_rad()
        return True

    def wants_stop(self) -> bool:
        """Never."""
        return False

    def what_moved(self, joint_count: int) -> tuple[int, int] | None:
        """The joint that has turned most since the last motion was allowed."""
        turned = [now - before for before, now in zip(self._before, self._rig.joint_rad(), strict=True)]
        joint = max(range(joint_count), key=lambda j: abs(turned[j]))
        answer = (joint + 1, 1 if turned[joint] > 0.0 else -1) if abs(turned[joint]) > SEEN_RAD else None
        words = f"joint {answer[0]}, {'positive' if answer[1] > 0 else 'negative'}" if answer else "nothing moved"
        self.say(f"  Which joint moved, and in which direction?  [mock operator: {words}]")
        return answer

    def angle_rad(self, joint: int) -> float | None:
        """The true angle with a small reading error."""
        return self._rig.joint_rad()[joint - 1] + self._random.gauss(0.0, READING_SD_RAD)

    def support(self, joint: int, are_held: bool) -> None:
        """Hold all links but one, whose weight its motor carries; none where boards hold them, against a hand."""
        self._hold(() if are_held else set(range(1, self._rig.robot.plant.joints + 1)) - {joint})

    def let_go(self) -> None:
        """Carry the weight of all links, which may turn."""
        self._hold(())
        self._rig.robot.plant.carry(True)

    def _hold(self, joints: Collection[int]) -> None:
        plant = self._rig.robot.plant
        plant.carry(False)
        for j in range(plant.joints):
            plant.block(j, j + 1 in joints, "operator")


Channel = tuple[int, int]
"""Encoder board and channel on it, both from 0."""


class SafetyTrip(ArmError):
    """A limit of bring-up was exceeded, or a board stopped reporting: the drive was switched off at once."""


@dataclass(frozen=True, slots=True)
class DriveLimits:
    """Limits of a motor's drive, and of its encoder's speed and travel."""

    current_A: float
    voltage_V: float
    speed_count_s: float = math.inf
    travel_count: float = math.inf


@dataclass(frozen=True, slots=True)
class Sample:
    """One cycle: all channels, and the driven motor (board's sign)."""

    t_s: float
    counts: dict[Channel, int]
    flags: dict[Channel, int]
    speed_count_s: dict[Channel, float]
    volts: float
    current_A: float
    is_limited: bool
    """The board reduced the voltage to one of its limits."""
    limits: Mapping[int, int] = field(default_factory=dict)
    """Active limit switches, LOWER_LIMIT and UPPER_LIMIT, by the draft's joint."""


class Workbench(Protocol):
    """The open boards. `driving` enables one motor; within it, `cycle` sends a voltage and waits for the replies."""

    clock: Clock
    operator: BringupOperator
    look_s: float  # between two looks at a home switch, beyond those of an encoder board
    has_index: bool  # index pulses are latched
    limits_current: bool  # the boards keep to the current of bring-up
    has_volts: bool  # a board applies the voltage; else it closes its own loop, and a voltage means the speed that it makes

    def prepare(self) -> None:
        """The operator has allowed a motion: boards that hold their joints begin to."""
        ...

    def observe(self, duration_s: float) -> Sample:
        """Read all boards for a while; nothing is driven."""
        ...

    def driving(self, node: int, limits: DriveLimits) -> AbstractContextManager[None]:
        """Enable one motor at 0 V under these limits; on every exit, it stands still."""
        ...

    def cycle(self, volts: float) -> Sample:
        """Send a voltage (board's sign), wait for the next cycle, read all boards. Raises SafetyTrip or Stopped."""
        ...

    def arm_index(self, at: Channel) -> None:
        """Arm the index latch."""
        ...

    def index_latch(self, at: Channel) -> int | None:
        """The unwrapped count that the index latched since `arm_index`, or None."""
        ...

    def motor_count(self, node: int) -> int:
        """The motor board's own count of its encoder."""
        ...

    def counts_per_turn(self, at: Channel) -> int | None:
        """What a board says of an encoder, None if nothing."""
        ...

    def serials(self) -> dict[int, int]:
        """Serial numbers of reference motor boards, by node."""
        ...


HOMED_ON = {"lower": LOWER_LIMIT, "upper": UPPER_LIMIT}
"""The limit switch that is the home switch, by `switch` of [drive.home]."""


def limits_of(drive: Drive, levels: Mapping[str, bool | None], own_flags: int = 0) -> int:
    """LOWER_LIMIT and UPPER_LIMIT where a joint's switches are active; a board that does not say counts as an active one."""
    if (switches := drive.limit_switches) is None:
        return 0
    flags = 0
    for pin, flag in ((switches.lower, LOWER_LIMIT), (switches.upper, UPPER_LIMIT)):
        level = bool(own_flags & flag) if pin == OWN_INPUT else levels.get(pin)
        if pin and (level is None or level is (switches.active == "high")):
            flags |= flag
    return flags


def node_of(drive: Drive) -> int:
    """What bring-up calls the motor of a drive: a reference board's node; on a bought board, its joint in the draft."""
    return drive.joint if drive.board else drive.motor_node


def channel_of(drive: Drive) -> Channel:
    """What bring-up calls the encoder of a drive: a reference board's channel; on a bought board, that of its joint."""
    return (0, drive.joint - 1) if drive.board else (drive.encoder_board, drive.encoder_channel)


def named(drive: Drive) -> str:
    """The board of a drive in messages."""
    return f'board "{drive.board}" (output {drive.board_channel})' if drive.board else f"motor board {drive.motor_node}"

"""The operator at a terminal: Enter allows a motion, any key stops it, answers are typed."""

import contextlib
import math
import select
import sys
import termios
import tty
from types import TracebackType
from typing import Self

from procedures.bringup.operator import Stopped

NOTHING = ("0", "n", "no", "none", "nothing")


class TerminalOperator:
    """`procedures.bringup.operator.BringupOperator`. A context manager: it restores the terminal."""

    def __init__(self, without_confirmation: bool = False) -> None:
        """`without_confirmation`: motions are announced and begin without Enter; questions are still asked."""
        self._without_confirmation = without_confirmation
        self._is_terminal = sys.stdin.isatty()
        self._settings = termios.tcgetattr(sys.stdin) if self._is_terminal else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
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
                "  Which joint moved, and in which direction of the drawing? Joint and sign, such as 1+ or 2-; 0:"
                " nothing moved. "
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
                f"  Angle of joint {joint} as in the drawing, in degrees (protractor or inclinometer; Enter: cannot"
                " be read): "
            ).strip()
            if not answer:
                return None
            with contextlib.suppress(ValueError):
                degrees = float(answer.replace(",", "."))
                if math.isfinite(degrees) and abs(degrees) <= 720.0:
                    return math.radians(degrees)
            self.say(f"  Expected a number of degrees, got {answer!r}.")

    def support(self, joint: int) -> None:
        """Tell the operator which links to support."""
        self.say(
            f"Joint {joint} is next. Support the links of the other joints: they are braked, but not held."
        )

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

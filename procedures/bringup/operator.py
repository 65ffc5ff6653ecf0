"""The person beside the arm, as bring-up sees them: who confirms a motion, stops it, and reports what the joint did."""

from typing import Protocol


class Stopped(Exception):
    """The operator did not confirm a motion, or stopped one. The drive is off."""


class Operator(Protocol):
    """A person at a terminal, or one at a mock arm."""

    def say(self, text: str) -> None:
        """Show a text."""
        ...

    def allow(self, what: str) -> bool:
        """Announce a motion; True when it may begin."""
        ...

    def wants_stop(self) -> bool:
        """Asked in every cycle while a motor is driven."""
        ...

    def what_moved(self, joint_count: int) -> tuple[int, int] | None:
        """Which joint (1-based) has just moved, and its sign by the drawing; None when nothing did."""
        ...

    def angle_rad(self, joint: int) -> float | None:
        """The joint's angle by the drawing, in rad, as read with a protractor or an inclinometer; None if it cannot be read."""
        ...

    def support(self, joint: int) -> None:
        """Joint (1-based) will move now; the links of the others are to stay where they are."""
        ...

    def let_go(self) -> None:
        """No link needs support any more."""
        ...

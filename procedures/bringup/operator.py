"""The operator in bring-up, who confirms and stops motions and reports what the joint did."""

from typing import Protocol


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

    def support(self, joint: int) -> None:
        """Ask to support the links of all joints but the one (1-based) that will move."""
        ...

    def let_go(self) -> None:
        """Links need no more support."""
        ...

"""The loop's clock: while it waits for the next cycle, boards that speak only when they are asked are served."""

from typing import Protocol

from firmware_iface.clock import Clock


class Attendant(Protocol):
    """Waits, and serves boards meanwhile: the hardware of an arm, or all arms of a loop."""

    def attend(self, until_s: float) -> None:
        """Wait until then."""
        ...


class AttendedClock:
    """A `firmware_iface.clock.Clock` whose waiting is done by an attendant."""

    def __init__(self, clock: Clock, attendant: Attendant) -> None:
        self.now_s = clock.now_s
        self.wait_until_s = attendant.attend

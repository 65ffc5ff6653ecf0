"""The loop's clock: while it waits for the next cycle, the hardware is attended to."""

from control.hardware.interface import Hardware
from firmware_iface.clock import Clock


class AttendedClock:
    """A `firmware_iface.clock.Clock` whose waiting serves boards that speak only when they are asked."""

    def __init__(self, clock: Clock, hardware: Hardware) -> None:
        self.now_s = clock.now_s
        self.wait_until_s = hardware.attend

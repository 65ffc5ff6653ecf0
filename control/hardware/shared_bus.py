"""CAN buses that several arms share: each is opened once and drained for all of them, also while the loop waits."""

from collections.abc import Callable, Mapping
from typing import Protocol

from control.hardware.connect import Connection, connect
from control.hardware.words import Wanted
from control.model.arm import CanBus
from control.model.cell import Cell
from firmware_iface.can_link import open_can
from firmware_iface.clock import Clock
from firmware_iface.errors import ConnectionFailed, LinkError
from firmware_iface.motor.bus import MotorBus


class SharedBuses:
    """The open buses of a cell, by interface and channel."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._open: dict[tuple[str, str], MotorBus] = {}
        self._failed: dict[tuple[str, str], LinkError] = {}
        self._closers: list[Callable[[], None]] = []

    def bus(self, can: CanBus) -> MotorBus:
        """The bus; opened at the first call. LinkError, the same one at each call."""
        key = (can.interface, can.channel)
        if key in self._failed:
            raise self._failed[key]
        if key not in self._open:
            try:
                link = open_can(can.interface, can.channel, can.bitrate, **can.options)
            except LinkError as error:
                self._failed[key] = error
                raise
            self._closers.append(link.close)
            self._open[key] = MotorBus(link, self._clock)
        return self._open[key]

    def close(self) -> None:
        """Close all."""
        for close in self._closers:
            close()


class CellConnection:
    """The open links of all arms, by the arms' names. Close it after the drives are off."""

    def __init__(self, of_arms: Mapping[str, Connection], buses: SharedBuses) -> None:
        self.of_arms, self._buses = of_arms, buses

    def leave_safely(self) -> None:
        """Brake if drives are still on, however the loop ended; their watchdogs would do it a little later.

        An arm that boards held when they were found, and that nobody has taken over, is left so.
        """
        for connection in self.of_arms.values():
            hardware = connection.hardware
            if hardware.is_any_enabled() and hardware.wanted is not Wanted.AS_FOUND:
                hardware.emergency_stop()
        self.close()

    def close(self) -> None:
        """Stop the streams and close all links."""
        for connection in self.of_arms.values():
            connection.close()
        self._buses.close()


def connect_cell(cell: Cell, clock: Clock, period_s: float, camera_ports: Mapping[str, int | None]) -> CellConnection:
    """Connect every arm, as `control.hardware.connect.connect` does. ConnectionFailed names what failed of any arm."""
    buses = SharedBuses(clock)
    opened: dict[str, Connection] = {}
    failures: list[LinkError] = []
    try:
        for placed in cell.arms:
            try:
                opened[placed.name] = connect(
                    placed.arm, clock, period_s, camera_ports.get(placed.name), buses.bus if len(cell.arms) > 1 else None
                )
            except ConnectionFailed as error:
                failures += error.failures
        if failures:
            raise ConnectionFailed(failures)
    except BaseException:
        CellConnection(opened, buses).close()
        raise
    return CellConnection(opened, buses)


# The loop's clock: while it waits for the next cycle, boards that speak only when they are asked are served.


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

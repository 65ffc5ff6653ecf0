"""ODrives over CAN as encoders and drives of an arm: by the motor's torque, or by the board's position loop (docs/odrive.md).

Where the loop controls nothing, an ODrive in operation holds its position: it has no brake by shorted windings. A fault or the
end of operation frees the motor. The zero is kept by the host, unless the board's settings make its position the joint's.
"""

import math
from collections.abc import Sequence
from typing import Final

from control.hardware import interface
from control.hardware.boards import Opened, collect
from control.hardware.bought.can_node import NodeEncoder, PositionLoopDrive, SetPointSpeed, open_bus, own_encoder
from control.model.arm import Board, Drive
from firmware_iface.can_link import open_can
from firmware_iface.odrive import Error, OdriveAxis, OdriveBus

# Errors of an axis as the loop's faults; the rest concerns its encoder, its settings or itself.
_OVER_CURRENT: Final = (
    Error.DC_BUS_OVER_CURRENT | Error.DC_BUS_OVER_REGEN_CURRENT | Error.CURRENT_LIMIT_VIOLATION | Error.DRV_FAULT
)
_FAULT_OF: Final = (
    (Error.DC_BUS_OVER_VOLTAGE | Error.BRAKE_RESISTOR_DISARMED, interface.SUPPLY_HIGH),
    (Error.DC_BUS_UNDER_VOLTAGE, interface.SUPPLY_LOW),
    (_OVER_CURRENT, interface.OVER_CURRENT),
    (Error.MOTOR_OVER_TEMP | Error.INVERTER_OVER_TEMP | Error.THERMISTOR_DISCONNECTED, interface.OVER_TEMPERATURE),
    (Error.WATCHDOG_TIMER_EXPIRED, interface.WATCHDOG),
    (Error.ESTOP_REQUESTED, interface.EMERGENCY_STOP),
)
SPEED_MARGIN: Final = 2.0  # of the board's speed limit over the joint's: the loop's own limits come first


class OdriveDrive(PositionLoopDrive):
    """One motor; meets `control.hardware.boards.Drives`."""

    def __init__(self, axis: OdriveAxis, encoder: NodeEncoder | None, drive: Drive, speed: SetPointSpeed) -> None:
        """`encoder`: the board's own, None if the loop uses another."""
        super().__init__(axis, encoder, drive, speed)
        self._axis = axis
        turns_s = drive.joint_speed_limit_rad_s / drive.encoder_turn_rad
        self._limits = (SPEED_MARGIN * turns_s, drive.current_limit_A)
        self._is_stopped = False

    def _faults_now(self) -> int:
        errors = self._axis.errors or Error(0)
        known = [bit for mask, bit in _FAULT_OF if errors & mask]
        return sum(known) if known else interface.OWN_ENCODER if errors else 0

    def _is_driving(self) -> bool:
        return self._axis.is_driving

    def _is_in_operation(self) -> bool:
        return self._axis.is_driving

    def _look(self) -> None:
        self._axis.want_nothing()

    def _go(self, count: int, speed_count_s: float) -> None:
        self._axis.want_count(count, speed_count_s)

    def _push(self, torque_Nm: float) -> None:
        self._axis.want_torque(torque_Nm)

    def _brake(self) -> None:
        holds_stop = self._is_stopped and self._axis.is_driving and not self._is_to_let_go
        if self._is_enabled or holds_stop:
            self._hold()
        else:
            self._held = None
            self._axis.want_idle()

    def _set_up(self) -> None:
        if all(map(math.isfinite, self._limits)):
            self._axis.limit(*self._limits)

    def _fault_left(self) -> str:
        """One that is idle stays so."""
        self._is_stopped = False
        return "" if self._axis.clear_errors() else f"error {self._axis.errors!r}"

    def require_force_limit(self) -> None:
        """Nothing to look for: every axis takes a limit of its current."""

    def limit_force(self, current_A: float) -> None:
        """At most so much current from now on; does not wait."""
        speed_turns_s, before_A = self._limits
        self._limits = (speed_turns_s, current_A)
        if current_A != before_A:
            self._axis.limit(*self._limits)

    def emergency_stop(self) -> None:
        """Hold the position now, and until the fault is acknowledged: without power a loaded arm would drop."""
        self._faults |= interface.EMERGENCY_STOP
        self._is_stopped = True
        if self._axis.is_driving:
            self._hold()
            self._axis.send_now()


def open_boards(boards: Sequence[Board], opened: Opened) -> None:
    """Open the CAN bus, and wait for what every ODrive sends."""
    bus = open_bus(opened, "ODrives", open_can, OdriveBus)
    for described, drive in opened.driven(boards):
        with collect(opened.failures):
            axis = OdriveAxis(bus, described.address, described.name, drive.encoder_counts_per_rev)
            axis.identify()
            encoder = own_encoder(axis, drive, opened, described.absolute)
            opened.drives.append(OdriveDrive(axis, encoder, drive, SetPointSpeed(drive, opened)))
            opened.identities.append((axis.where, f"{axis.errors!r}, supply {axis.supply_V:.1f} V"))

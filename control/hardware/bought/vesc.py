"""VESCs over CAN as encoders and drives of an arm: brushed motors, by duty, current or position (docs/vesc.md).

A VESC obeys its last command until its time-out; it has no states, so the states of CiA 402 that the loop follows are kept
here. It ends a fault by itself after half a second: here FAULT is left only by `acknowledge_faults`.
"""

import math
from collections.abc import Sequence
from typing import Final

from control.hardware import interface
from control.hardware.boards import Opened, collect
from control.hardware.bought.can_node import NodeDrive, NodeEncoder, open_bus, own_encoder
from control.hardware.interface import Feedback, OutputMode
from control.model.arm import Board, Drive
from control.model.drive import JointMap
from firmware_iface import vesc
from firmware_iface.can_link import open_extended_can
from firmware_iface.errors import MisuseError, WrongIdentity
from firmware_iface.vesc import Vesc, VescBus

# mc_fault_code of the firmware's datatypes.h, as the loop's faults; the rest concerns encoder and sensors.
_CODES_OF: Final = {
    interface.SUPPLY_HIGH: (1, 7),
    interface.SUPPLY_LOW: (2, 8, 9),
    interface.OVER_CURRENT: (3, 4),
    interface.OVER_TEMPERATURE: (5, 6),
    interface.WATCHDOG: (10,),
}
_FAULT_OF: Final = {code: fault for fault, codes in _CODES_OF.items() for code in codes}
SILENT_APPLICATIONS: Final = (0, 3)  # none, UART; the others turn an input into commands
FAULT_STOP_S: Final = 0.6  # a VESC stops for 0.5 s after a fault (VESC Tool), then it is gone if its cause is


class VescDrive(NodeDrive):
    """One motor; meets `control.hardware.boards.Drives`."""

    def __init__(self, board: Vesc, encoder: NodeEncoder | None, drive: Drive, bus: VescBus) -> None:
        """`encoder`: the board's own, None if the loop uses another."""
        super().__init__(board, encoder, drive)
        self._board, self._bus = board, bus
        self._limit_A = drive.current_limit_A
        self._was_driving = False  # when it was found

    def _faults_now(self) -> int:
        code = self._board.fault
        return _FAULT_OF.get(code, interface.OWN_ENCODER) if code else 0

    def write(
        self,
        wanted: interface.Wanted,
        modes: Sequence[OutputMode],
        output: Sequence[float],
        feedforward_V: Sequence[float],
        feedback: Feedback,
    ) -> None:
        """Set the command of this cycle; without one the windings are shorted."""
        board, joint = self._board, self._joint
        self._is_enabled = self._may_drive(wanted)
        if wanted is interface.Wanted.AS_FOUND:
            board.wanted = None
            return
        mode = modes[joint] if self._is_enabled else OutputMode.HOLD
        volts = output[joint] if mode is OutputMode.VOLTAGE else 0.0
        feedback.sent_V[joint] = volts if mode is OutputMode.VOLTAGE else math.nan
        number = board.number
        if mode is OutputMode.POSITION and self._encoder is not None:
            board.wanted = vesc.position(number, self._map.count(output[joint]) - self._encoder.offset)
        elif mode is OutputMode.CURRENT:
            board.wanted = vesc.current(number, self._sign * output[joint])
        elif mode is OutputMode.OFF:
            board.wanted = vesc.current(number, 0.0)
        else:
            board.wanted = vesc.duty(number, _share(self._sign * volts, board.supply_V))

    def has_torque(self, joint: int) -> bool:
        """Whether it was found giving its motor a voltage, which may pass through 0 while it holds; or is driven from here."""
        self._was_driving |= self._board.is_driving
        return self._is_enabled or (self._board.wanted is None and self._was_driving)

    def _set_up(self) -> None:
        if math.isfinite(self._limit_A):
            self._board.limit_current(self._limit_A)

    def _fault_left(self) -> str:
        """It has the time in which a VESC ends it."""
        return "" if self._board.is_well_within(FAULT_STOP_S) else f"fault {self._board.fault} (mc_fault_code)"

    def emergency_stop(self) -> None:
        """Short the windings now, and stay there until the fault is acknowledged."""
        self._faults |= interface.EMERGENCY_STOP
        shorted = self._board.wanted = vesc.duty(self._board.number, 0.0)
        self._bus.send(shorted)


def _share(volts: float, supply_V: float) -> float:
    """The duty for a mean terminal voltage at this supply."""
    return min(max(volts / supply_V, -1.0), 1.0) if supply_V > 0.0 else 0.0


def _require_settings(board: Vesc, watchdog_s: float) -> str:
    """What is stored in the board of its time-out, in words. WrongIdentity where the arm cannot rely on it."""
    stored = board.settings
    if stored is None:
        return f"settings unread: its time-out must be {watchdog_s:g} s at most, with a brake current, and no application"
    for is_right, expected, stored_value in (
        (0.0 < stored.timeout_s <= watchdog_s, f"a time-out up to {watchdog_s:g} s", f"{stored.timeout_s:g} s"),
        (stored.brake_A > 0.0, "a brake current after it", f"{stored.brake_A:g} A: the motor is free then"),
        (
            stored.application in SILENT_APPLICATIONS,
            "no application, or UART",
            f"number {stored.application}, which commands it, too",
        ),
    ):
        if not is_right:
            raise WrongIdentity(
                f"{board.where}: expected {expected}, it is {stored_value}: set it in VESC Tool (App Settings, General)"
            )
    return f"time-out {stored.timeout_s:g} s, then {stored.brake_A:g} A"


def _require_one_turn(board: Vesc, drive: Drive) -> None:
    """A VESC turns to an angle the shorter way, so the joint's whole range must be less than half a turn of the encoder."""
    counts = JointMap(drive).counts_per_radian * (drive.joint_upper_rad - drive.joint_lower_rad)
    if drive.encoder_board >= 0 or not abs(counts) < 0.5 * vesc.COUNTS_PER_TURN:
        raise MisuseError(
            f'{board.where}: [drive.pid] mode = "position" needs its own encoder at the joint, and a range below half a turn: it'
            ' turns the shorter way to an angle; use "voltage" or "current"'
        )


def open_boards(boards: Sequence[Board], opened: Opened) -> None:
    """Open the CAN bus for 29-bit ids, and identify every VESC."""
    bus = open_bus(opened, "VESCs", open_extended_can, VescBus)
    for described, drive in opened.driven(boards):
        with collect(opened.failures):
            board = Vesc(bus, described.address, described.name)
            if drive.pid.mode == "position":
                _require_one_turn(board, drive)
            silent = board.identify()
            settings = _require_settings(board, opened.arm.limits.watchdog_s) + silent
            encoder = own_encoder(board, drive, opened)
            board.is_counted = encoder is not None
            opened.drives.append(VescDrive(board, encoder, drive, bus))
            said = f"{settings}, fault code {board.fault}, supply {board.supply_V:.1f} V"
            opened.identities.append((board.where, said))

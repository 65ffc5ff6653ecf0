"""VESCs over CAN as encoders and drives of an arm: brushed motors, by duty, current or position (docs/vesc.md).

A VESC obeys its last command until its time-out; it has no states, so the states of CiA 402 that the loop follows are kept
here. It ends a fault by itself after half a second: here FAULT is left only by `acknowledge_faults`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from control.errors import MissingModel
from control.hardware.interface import Feedback, OutputMode
from control.hardware.opened import Opened, collect
from control.hardware.roles import AskedEncoders
from control.hardware.words import (
    EMERGENCY_STOP,
    FAULT,
    HOME_SWITCH,
    OPERATION_ENABLED,
    OVER_CURRENT,
    OVER_TEMPERATURE,
    OWN_ENCODER,
    SUPPLY_HIGH,
    SUPPLY_LOW,
    SWITCH_ON_DISABLED,
    WATCHDOG,
    ZERO_SET,
)
from control.model.arm import Arm, Board, Drive
from control.model.joint_map import JointMap
from firmware_iface.clock import Clock
from firmware_iface.errors import BoardFaulted, MisuseError
from firmware_iface.link import open_extended_can
from firmware_iface.vesc import wire
from firmware_iface.vesc.controller import Vesc, VescBus

# mc_fault_code of the firmware's datatypes.h, as the loop's faults; the rest concerns encoder and sensors.
_FAULT_OF: Final = {
    1: SUPPLY_HIGH, 2: SUPPLY_LOW, 3: OVER_CURRENT, 4: OVER_CURRENT, 5: OVER_TEMPERATURE, 6: OVER_TEMPERATURE,
    7: SUPPLY_HIGH, 8: SUPPLY_LOW, 9: SUPPLY_LOW, 10: WATCHDOG,
}  # fmt: skip
FAULT_STOP_S: Final = 0.6  # a VESC stops for 0.5 s after a fault (VESC Tool), then it is gone if its cause is


class VescLine:
    """The bus, as the loop drains it; meets `control.hardware.roles.Line`."""

    def __init__(self, bus: VescBus) -> None:
        self.update = bus.update
        self.flush = bus.flush


class VescEncoder(AskedEncoders):
    """The encoder of a VESC, whose turns are counted here; meets `control.hardware.roles.Encoders`."""

    is_asked = False

    def __init__(self, board: Vesc, joint: int) -> None:
        self.joints = (joint,)
        self.offset = 0
        """What is added to the count: the zero is set here."""
        self._joint, self._board = joint, board
        self._is_zero_set = False
        self._latched: int | None = None
        self._resets = 0

    def take(self, feedback: Feedback) -> None:
        """Write the newest count."""
        board, joint = self._board, self._joint
        if self._resets != board.resets:
            self._resets, self._is_zero_set, self._latched = board.resets, False, None
        feedback.count[joint] = board.count + self.offset
        feedback.counted_at_s[joint] = feedback.reported_at_s[joint] = board.counted_at_s
        flags = ZERO_SET if self._is_zero_set else 0
        feedback.channel_flags[joint] = flags | (HOME_SWITCH if board.is_switch_on else 0)

    def fresh_count(self, joint: int) -> int:
        """A count that is sent from now on. BoardSilent if there is none."""
        self._board.await_status()
        return self._board.count + self.offset

    def arm_index(self, joint: int) -> None:
        """The count at which the home switch is seen takes the index's place."""
        self._latched = self._board.count + self.offset

    def index_count(self, joint: int) -> int | None:
        """The count at the switch."""
        return self._latched

    def watch_indices(self, is_wanted: bool) -> None:
        """No index is watched."""

    def passed_indices(self) -> list[tuple[int, int]]:
        """No index is watched."""
        return []

    def shift(self, joint: int, counts: int) -> None:
        """Shift the zero, which is kept here."""
        self.fresh_count(joint)
        self.offset += counts
        self._is_zero_set = True

    def restore(self) -> None:
        """Nothing is lost that is sent all the time."""


class VescDrive:
    """One motor; meets `control.hardware.roles.Drives`."""

    def __init__(
        self, board: Vesc, encoder: VescEncoder | None, joint: int, drive: Drive, bus: VescBus
    ) -> None:
        """`encoder`: the board's own, None if the loop uses another."""
        self.joints = (joint,)
        self._board, self._encoder, self._joint, self._bus = board, encoder, joint, bus
        self._map = JointMap(drive)
        self._sign = float(drive.motor_direction)
        self._limit_A = drive.current_limit_A
        self._configured_resets = -1
        self._faults = 0
        self._is_enabled = False
        self._held: int | None = None

    def take(self, feedback: Feedback) -> None:
        """Write current, supply, temperature and the state kept here."""
        board, joint = self._board, self._joint
        feedback.reply_at_s[joint] = board.at_s
        if board.fault is None or math.isnan(board.supply_V):
            feedback.statusword[joint] = 0
            return
        if board.fault:
            self._faults |= _FAULT_OF.get(board.fault, OWN_ENCODER)
        feedback.current_A[joint] = self._sign * board.current_A
        feedback.supply_V[joint] = board.supply_V
        feedback.temperature_C[joint] = board.temperature_degC
        feedback.drive_faults[joint] = self._faults
        state = OPERATION_ENABLED if self._is_enabled else SWITCH_ON_DISABLED
        feedback.statusword[joint] = FAULT if self._faults else state

    def write(
        self, wants_enabled: bool, modes: Sequence[OutputMode], output: Sequence[float],
        feedforward_V: Sequence[float], feedback: Feedback,
    ) -> None:  # fmt: skip
        """Set the command of this cycle; without one the windings are shorted."""
        board, joint = self._board, self._joint
        self._is_enabled = wants_enabled and self._configured_resets == board.resets and not self._faults
        mode = modes[joint] if self._is_enabled else OutputMode.HOLD
        volts = output[joint] if mode is OutputMode.VOLTAGE else 0.0
        feedback.sent_V[joint] = volts if mode is OutputMode.VOLTAGE else math.nan
        number = board.number
        if mode is OutputMode.POSITION and self._encoder is not None:
            board.wanted = wire.position(number, self._map.count(output[joint]) - self._encoder.offset)
        elif mode is OutputMode.CURRENT:
            board.wanted = wire.current(number, self._sign * output[joint])
        elif mode is OutputMode.OFF:
            board.wanted = wire.current(number, 0.0)
        else:
            board.wanted = wire.duty(number, _share(self._sign * volts, board.supply_V))

    def is_any_enabled(self) -> bool:
        """Whether the motor may be driven."""
        return self._is_enabled

    def configure(self, fresh_count: Callable[[int], int]) -> None:
        """Limit the current, which a restart of the board forgets."""
        if self._configured_resets != self._board.resets:
            resets = self._board.resets
            if math.isfinite(self._limit_A):
                self._board.limit_current(self._limit_A)
            self._configured_resets = resets
        self._board.await_status()

    def acknowledge_faults(self) -> None:
        """Forget a fault that is gone. Raises BoardFaulted for one that is not within the time in which a VESC ends it."""
        self._is_enabled = False
        if not self._board.is_well_within(FAULT_STOP_S):
            raise BoardFaulted(
                f"{self._board.where}: its fault {self._board.fault} (mc_fault_code) cannot be acknowledged: the cause persists"
            )
        self._faults = 0

    def follow_shift(self, joint: int, fresh_count: Callable[[int], int]) -> None:
        """The encoder's offset is used with every position."""

    def emergency_stop(self) -> None:
        """Short the windings now, and stay there until the fault is acknowledged."""
        self._faults |= EMERGENCY_STOP
        self._board.wanted = wire.duty(self._board.number, 0.0)
        self._bus.send(self._board.wanted)


def _share(volts: float, supply_V: float) -> float:
    """The duty for a mean terminal voltage at this supply."""
    return min(max(volts / supply_V, -1.0), 1.0) if supply_V > 0.0 else 0.0


def open_boards(arm: Arm, boards: Sequence[Board], clock: Clock, period_s: float, opened: Opened) -> None:
    """Open the CAN bus for 29-bit ids, and identify every VESC."""
    if arm.can is None:
        raise MissingModel(f"arm {arm.name}: no [can] bus for its VESCs: add it")
    with collect(opened.failures):
        link = open_extended_can(arm.can.interface, arm.can.channel, arm.can.bitrate, **arm.can.options)
        opened.closers.append(link.close)
        bus = VescBus(link, clock)
        opened.lines.append(VescLine(bus))
        by_board: Mapping[str, tuple[int, Drive]] = {d.board: (j, d) for j, d in enumerate(arm.drives)}
        for described in boards:
            with collect(opened.failures):
                _open_vesc(bus, described, *by_board[described.name], opened)


def _open_vesc(bus: VescBus, described: Board, joint: int, drive: Drive, opened: Opened) -> None:
    board = Vesc(bus, described.address, described.name)
    if drive.pid.mode == "position":
        _require_one_turn(board, drive)
    if drive.encoder_board < 0 and drive.encoder_counts_per_rev != wire.COUNTS_PER_TURN:
        raise MisuseError(
            f"{board.where}: a VESC sends its angle in {wire.COUNTS_PER_TURN} counts a turn, whatever the"
            f" encoder: encoder_counts_per_rev = {wire.COUNTS_PER_TURN}, got {drive.encoder_counts_per_rev}"
        )
    board.identify()
    encoder = VescEncoder(board, joint) if drive.encoder_board < 0 else None
    if encoder is not None:
        opened.encoders.append(encoder)
    opened.drives.append(VescDrive(board, encoder, joint, drive, bus))
    opened.identities.append((board.where, f"fault code {board.fault}, supply {board.supply_V:.1f} V"))


def _require_one_turn(board: Vesc, drive: Drive) -> None:
    """A VESC turns to an angle the shorter way, so the joint's whole range must be less than half a turn of the encoder."""
    counts = JointMap(drive).counts_per_radian * (drive.joint_upper_rad - drive.joint_lower_rad)
    if drive.encoder_board >= 0 or not abs(counts) < 0.5 * wire.COUNTS_PER_TURN:
        raise MisuseError(
            f'{board.where}: [drive.pid] mode = "position" needs its own encoder at the joint, and a range below half a turn: it'
            ' turns the shorter way to an angle; use "voltage" or "current"'
        )

"""CiA 402 drives on CANopen as encoders and drives of an arm (docs/cia402.md).

The drive closes its own position or torque loop. Where the loop controls nothing, the drive holds its position: it has no
brake by shorted windings. The zero is kept here, as an offset, so nothing is stored in a drive.
"""

import math
from collections.abc import Callable, Sequence

from control.hardware import interface
from control.hardware.boards import Opened, collect
from control.hardware.bought.can_node import NodeEncoder, open_bus
from control.hardware.interface import Feedback, OutputMode
from control.model.arm import Board, Drive
from control.model.drive import JointMap
from firmware_iface.can_link import open_can
from firmware_iface.canopen import (
    CYCLE_TIME,
    CYCLIC_POSITION,
    CYCLIC_TORQUE,
    FAULT_REACTION,
    FOLLOWING_ERROR_WINDOW,
    INCREMENTS,
    MODES,
    NO_WINDOW,
    POSITION_UNIT,
    CanOpenBus,
    Cia402Drive,
)
from firmware_iface.clock import Clock
from firmware_iface.errors import MisuseError, WrongIdentity
from firmware_iface.link import FrameLink
from firmware_iface.motor.cia402 import DriveState

PROFILE = 402
HEARTBEATS = 4  # within the drives' time-out
# What 0x605E lets a drive do at a fault, before its power stage is off.
_REACTIONS = {
    None: "does not say what it does",
    0: "frees its motor at once",
    1: "slows down by its ramp",
    2: "slows down by its quick stop ramp",
    3: "slows down at its current limit",
    4: "slows down at its voltage limit",
}
ALIKE = 30.0  # times: a unit mistaken in the drive or in arm.toml is a thousand
# Error codes of CiA 402 and CiA 301 by their first digits, as the loop's faults; the rest counts as a bad encoder or sensor.
_FAULT_OF = (
    (0x2000, 0xF000, interface.OVER_CURRENT),
    (0x3100, 0xFF00, interface.SUPPLY_LOW),
    (0x3210, 0xFFF0, interface.SUPPLY_HIGH),
    (0x3220, 0xFFF0, interface.SUPPLY_LOW),
    (0x4000, 0xF000, interface.OVER_TEMPERATURE),
    (0x8100, 0xFF00, interface.WATCHDOG),
)


class Cia402Encoder(NodeEncoder):
    """The encoder of a drive, and the limit switches at its inputs: negative and positive are in the encoder's sense."""

    def __init__(self, drive: Cia402Drive, described: Drive) -> None:
        super().__init__(drive, described.joint - 1, is_asked=True)
        self._drive = drive
        flags = (interface.LOWER_LIMIT, interface.UPPER_LIMIT)
        self._negative, self._positive = flags if JointMap(described).counts_per_radian > 0.0 else flags[::-1]

    def take(self, feedback: Feedback) -> None:
        """Write the newest count, and the inputs of the same moment or of the SYNC before."""
        super().take(feedback)
        at_negative, at_positive = self._drive.are_limits_on
        found = (self._negative if at_negative else 0) | (self._positive if at_positive else 0)
        feedback.channel_flags[self._joint] |= found


class Cia402Joint:
    """One drive; meets `control.hardware.boards.Drives`."""

    def __init__(self, drive: Cia402Drive, encoder: NodeEncoder, described: Drive, period_s: float, watchdog_s: float) -> None:
        self._joint, self._drive, self._encoder = described.joint - 1, drive, encoder
        self.joints = (self._joint,)
        self._map = JointMap(described)
        self._sign = float(described.motor_direction)
        self._permille_per_A = 1e3 * described.torque_constant_Nm_A / drive.rated_torque_Nm
        self._supply_V = described.supply_V
        self._period_s, self._watchdog_s = period_s, watchdog_s
        self._configured_resets = -1
        self._held: int | None = None
        self._is_stopped = False

    def take(self, feedback: Feedback) -> None:
        """Write torque as current, supply and state."""
        drive, joint = self._drive, self._joint
        feedback.reply_at_s[joint] = drive.heard_at_s
        if drive.state is None:
            feedback.statusword[joint] = 0
            return
        feedback.current_A[joint] = self._sign * drive.torque_permille / self._permille_per_A
        supply_mV = drive.supply_mV
        feedback.supply_V[joint] = self._supply_V if supply_mV is None else supply_mV * 1e-3
        is_faulted = drive.state in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)
        feedback.drive_faults[joint] = self._faults() if is_faulted else 0
        # Bit 7 of a drive's statusword is a warning of its own, not that its output is limited.
        feedback.statusword[joint] = interface.FAULT if is_faulted else drive.statusword & interface.STATE_MASK

    def _faults(self) -> int:
        codes = self._drive.errors[-1:] or [0]
        if self._is_stopped:
            return interface.EMERGENCY_STOP
        return next((bit for at, mask, bit in _FAULT_OF if codes[0] & mask == at), interface.OWN_ENCODER)

    def write(
        self,
        wanted: interface.Wanted,
        modes: Sequence[OutputMode],
        output: Sequence[float],
        feedforward_V: Sequence[float],
        feedback: Feedback,
    ) -> None:
        """Send the set-point, or the next step towards the wanted state."""
        drive, joint = self._drive, self._joint
        drive.ask_supply()
        feedback.sent_V[joint] = math.nan
        is_in_operation = drive.state is DriveState.OPERATION_ENABLED
        if not (wanted.is_on and is_in_operation) or self._is_stopped:
            self._held = None
        if wanted is interface.Wanted.AS_FOUND:
            return  # SYNC alone asks for its values
        is_driving = drive.state in (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
        if self._is_stopped and is_driving and wanted is not interface.Wanted.DISABLED:
            drive.quick_stop()  # and it stays there until the stop is acknowledged, or the arm goes off
        elif wanted is interface.Wanted.DISABLED or self._is_stopped:
            drive.step_towards(DriveState.SWITCH_ON_DISABLED)
        elif is_in_operation:
            self._command(modes[joint], output[joint])
        elif drive.state is DriveState.QUICK_STOP_ACTIVE:
            if wanted is interface.Wanted.ENABLING:
                drive.resume()
            else:
                drive.quick_stop()
        else:
            is_wanted = wanted is interface.Wanted.ENABLING
            drive.step_towards(DriveState.OPERATION_ENABLED if is_wanted else DriveState.SWITCH_ON_DISABLED)

    def _command(self, mode: OutputMode, output: float) -> None:
        drive = self._drive
        if mode not in (OutputMode.POSITION, OutputMode.CURRENT, OutputMode.OFF):
            self._held = drive.count if self._held is None else self._held
            drive.command_position(self._held)
            return
        self._held = None
        if mode is OutputMode.POSITION:
            drive.command_position(self._map.count(output) - self._encoder.offset)
        else:
            current_A = output if mode is OutputMode.CURRENT else 0.0
            drive.command_torque(round(self._sign * current_A * self._permille_per_A))

    def is_any_enabled(self) -> bool:
        """Whether the drive was in OPERATION ENABLED at the last SYNC."""
        return self._drive.state is DriveState.OPERATION_ENABLED

    def has_torque(self, joint: int) -> bool:
        """Whether the drive is in operation, or holds after a quick stop: without a host it does so."""
        return self._drive.state in (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)

    def configure(self, fresh_count: Callable[[int], int]) -> None:
        """Map and start a drive that was not, or that has restarted."""
        if self._configured_resets != self._drive.resets:
            resets = self._drive.resets
            self._drive.set_up(self._period_s, self._watchdog_s)
            self._configured_resets = resets
        self._encoder.fresh_count(self._joint)

    def acknowledge_faults(self) -> None:
        """Reset the drive's fault; it ends in SWITCH ON DISABLED. Raises BoardFaulted."""
        if self._configured_resets == self._drive.resets:
            self._drive.acknowledge_fault()
        self._is_stopped = False

    def follow_shift(self, joint: int, fresh_count: Callable[[int], int]) -> None:
        """The encoder's offset is used with every set-point."""

    def require_force_limit(self) -> None:
        """Raise RequestRefused if the drive has no limit of its torque or current."""
        self._drive.read(self._drive.force_limit)

    def limit_force(self, current_A: float) -> None:
        """At most so much current from now on; does not wait."""
        self._drive.limit_current(current_A, self._permille_per_A)

    def emergency_stop(self) -> None:
        """Quick stop: the drive slows down and holds until it is acknowledged."""
        self._is_stopped = True
        self._drive.quick_stop()
        self._drive.bus.sync()  # with which it takes effect


def open_boards(boards: Sequence[Board], opened: Opened) -> None:
    """Open the CAN bus, and identify and start every drive."""
    watchdog_s = opened.arm.limits.watchdog_s

    def make(link: FrameLink, clock: Clock) -> CanOpenBus:
        return CanOpenBus(link, clock, watchdog_s / HEARTBEATS)

    bus = open_bus(opened, "CiA 402 drives", open_can, make)
    for described, drive in opened.driven(boards):
        with collect(opened.failures):
            _open_drive(bus, described, drive, opened)


def _require_rated_torque(node: Cia402Drive, drive: Drive) -> str:
    """A rated torque that the drive does not say is that of its rated current: what is told of it, in words. WrongIdentity."""
    if node.rated_torque_Nm > 0.0:
        return ""
    if not node.rated_current_A > 0.0:
        raise WrongIdentity(
            f"{node.where}: expected a motor rated torque (0x6076), or a rated current: set the motor's data in the drive"
        )
    node.rated_torque_Nm = node.rated_current_A * drive.torque_constant_Nm_A
    return f"; no rated torque (0x6076): taken for {node.rated_torque_Nm:.3g} N m, by its rated current"


def _require_same_motor(node: Cia402Drive, drive: Drive) -> None:
    """WrongIdentity where rated torque and current of the drive contradict arm.toml: torques would be a thousandfold."""
    by_current_Nm = node.rated_current_A * drive.torque_constant_Nm_A
    if math.isnan(by_current_Nm) or 1.0 / ALIKE < by_current_Nm / node.rated_torque_Nm < ALIKE:
        return
    raise WrongIdentity(
        f"{node.where}: its motor rated torque (0x6076) is {node.rated_torque_Nm:.3g} N m, but its rated current"
        f" {node.rated_current_A:.3g} A times torque_constant_Nm_A makes {by_current_Nm:.3g} N m: correct the motor's data in"
        " the drive, or torque_constant_Nm_A"
    )


def _require_wide_window(node: Cia402Drive, drive: Drive, following_error_rad: float) -> None:
    """MisuseError where the drive trips, and its joint drops, at an error at which the loop would still stop and hold it."""
    window = node.read_if_there(FOLLOWING_ERROR_WINDOW)
    needed = math.ceil(following_error_rad / abs(JointMap(drive).radians_per_count))
    if drive.pid.mode != "position" or window is None or window >= needed:
        return
    raise MisuseError(
        f"{node.where}: expected a following error window (0x6065) of {needed} increments or more ([limits]"
        f" following_error_rad), it is {window}: with less the drive trips first, and its joint drops; {NO_WINDOW} is none"
    )


def _require_mode(node: Cia402Drive, drive: Drive) -> None:
    """WrongIdentity where the drive says that it does not have the mode that it is to be driven in."""
    mode, called = {
        "position": (CYCLIC_POSITION, "cyclic synchronous position"),
        "current": (CYCLIC_TORQUE, "cyclic synchronous torque"),
    }[drive.pid.mode]
    has = node.read_if_there(MODES)
    if has and not has >> (mode - 1) & 1:
        raise WrongIdentity(
            f"{node.where}: expected {called} (bit {mode - 1} of 0x6502), it has 0x{has:08X}: choose another [drive.pid] mode"
        )


def _doubts(node: Cia402Drive) -> str:
    """What else is told of a drive: what it says of its units and its interpolation."""
    unit = node.read_if_there(POSITION_UNIT)
    doubts = [] if unit in (None, 0, INCREMENTS) else [f"its positions are in units of 0x60A8 = 0x{unit:08X}"]
    doubts += ["it has no 0x60C2"] if node.read_if_there(CYCLE_TIME) is None else []
    return "".join(f"; {doubt}" for doubt in doubts)


def _open_drive(bus: CanOpenBus, described: Board, drive: Drive, opened: Opened) -> None:
    limits = opened.arm.limits
    node = Cia402Drive(bus, described.address, described.name)
    identity = node.identify()
    if identity.profile != PROFILE:
        raise WrongIdentity(f"{node.where}: expected device profile 402 (a drive), got {identity.profile}")
    unsaid = _require_rated_torque(node, drive)
    _require_same_motor(node, drive)
    _require_mode(node, drive)
    _require_wide_window(node, drive, limits.following_error_rad)
    reaction = node.read_if_there(FAULT_REACTION)
    encoder = Cia402Encoder(node, drive)
    driven = Cia402Joint(node, encoder, drive, opened.period_s, limits.watchdog_s)
    driven.configure(encoder.fresh_count)
    opened.encoders.append(encoder)
    opened.drives.append(driven)
    opened.identities.append(
        (
            node.where,
            f"vendor 0x{identity.vendor:08X}, product 0x{identity.product:08X}, serial number {identity.serial_number};"
            f" at a fault it {_REACTIONS.get(reaction, f'does as its maker says of 0x605E = {reaction}')}{unsaid}{_doubts(node)}",
        )
    )

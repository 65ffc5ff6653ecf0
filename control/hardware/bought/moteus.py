"""moteus controllers over CAN FD as encoders and drives of an arm: by torque or by the board's position loop (docs/moteus.md).

Where the loop controls nothing, a moteus shorts its windings. Each command carries the watchdog's time. A fault frees the motor;
a time-out holds the joint by the board's settings. Both are left only by `acknowledge_faults`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from control.hardware import interface
from control.hardware.boards import Opened, collect
from control.hardware.bought.can_node import NodeEncoder, PositionLoopDrive, SetPointSpeed, open_bus, own_encoder
from control.hardware.interface import Feedback, OutputMode
from control.model.arm import Board, Drive
from firmware_iface import moteus
from firmware_iface.can_link import open_fd_can
from firmware_iface.errors import BoardSilent, WrongIdentity
from firmware_iface.moteus import Moteus, MoteusBus, MoteusMode

# Fault codes of the register reference, as the loop's faults; the rest concerns its encoder, its settings or itself.
_CODES_OF: Final = {
    interface.OVER_CURRENT: (33, 44),
    interface.SUPPLY_HIGH: (34,),
    interface.OVER_TEMPERATURE: (38,),
    interface.BAD_COMMAND: (39,),
    interface.SUPPLY_LOW: (40,),
}
_FAULT_OF: Final = {code: fault for fault, codes in _CODES_OF.items() for code in codes}


class RequiredSetting(NamedTuple):
    """A setting by its name in tview, and what is expected of it. One that is not set, or not known to the firmware, is told."""

    name: str
    is_right: Callable[[float, Drive], bool]
    expected: str


def _reaches(most_A: float, drive: Drive) -> bool:
    return math.isinf(drive.current_limit_A) or not most_A < (1.0 - TOLD) * drive.current_limit_A


TOLD: Final = 1e-5  # it tells six decimals of a number of 32 bits
_DIGITAL_INPUT: Final = 14
SETTINGS: Final = (
    RequiredSetting("servo.timeout_mode", lambda mode, _: mode in (10, 15), "10 (holds without the host) or 15 (brakes)"),
    RequiredSetting("servo.voltage_mode_control", lambda is_on, _: is_on == 0, "0"),
    RequiredSetting("servo.fixed_voltage_mode", lambda is_on, _: is_on == 0, "0"),
    RequiredSetting("servo.bemf_feedforward", lambda share, _: share == 0, "0 (else it asks for a limit of acceleration)"),
    RequiredSetting("servo.max_current_A", _reaches, "current_limit_A or more"),
    RequiredSetting(
        "aux1.pins.0.mode",
        lambda mode, drive: drive.home is None or mode == _DIGITAL_INPUT,
        f"{_DIGITAL_INPUT} (the home switch)",
    ),
)
# Torque constant times Kv, N m/A and rpm/V between two phases: moteus' currents are amplitudes of a phase.
KT_Kv: Final = 60.0 / (2.0 * math.pi) * math.sqrt(3.0) / 2.0
ALIKE: Final = 1.1  # below the 1.155 by which the constant of other makers' currents is off


def _require_settings(board: Moteus, drive: Drive) -> str:
    """What cannot be looked up of its settings, in words.

    WrongIdentity where what is stored in the board contradicts arm.toml, or what is commanded here.
    """
    try:
        stored = {setting: board.setting(setting.name) for setting in SETTINGS}
        kv, turns = board.setting("motor.Kv"), board.setting("motor_position.rotor_to_output_ratio")
    except BoardSilent:
        return "; its console is silent: look at " + ", ".join(setting.name for setting in SETTINGS)
    wrong = [
        f"expected {setting.name} {setting.expected}, it is {value:g}"
        for setting, value in stored.items()
        if not (math.isnan(value) or setting.is_right(value, drive))
    ]
    given_Nm_A, kv_of_joint = drive.torque_constant_Nm_A, kv * turns
    its_own_Nm_A = KT_Kv / kv_of_joint if kv_of_joint and math.isfinite(kv_of_joint) else math.nan
    if max(given_Nm_A / its_own_Nm_A, its_own_Nm_A / given_Nm_A) > ALIKE:
        wrong.append(f"its motor.Kv {kv:g} makes {its_own_Nm_A:.3g} N m/A, torque_constant_Nm_A is {given_Nm_A:g}")
    if wrong:
        raise WrongIdentity(f"{board.where}: {'; '.join(wrong)}: correct it in tview (then `conf write`) or in arm.toml")
    unknown = [setting.name for setting, value in stored.items() if math.isnan(value)]
    return f"; it does not say {', '.join(unknown)}" if unknown else ""


class MoteusDrive(PositionLoopDrive):
    """One motor; meets `control.hardware.boards.Drives`."""

    def __init__(self, board: Moteus, encoder: NodeEncoder | None, drive: Drive, speed: SetPointSpeed, watchdog_s: float) -> None:
        """`encoder`: the board's own, None if the loop uses another."""
        super().__init__(board, encoder, drive, speed)
        self._board = board
        limit_Nm = drive.torque_constant_Nm_A * drive.current_limit_A
        self._most_Nm = limit_Nm if math.isfinite(limit_Nm) else math.nan  # NaN: the board's own limit
        self._watchdog_s = watchdog_s
        self._was_found_driving = False  # by another host, whose time-out has not come

    def _faults_now(self) -> int:
        board = self._board
        if board.mode == MoteusMode.FAULT:
            return _FAULT_OF.get(board.fault, interface.OWN_ENCODER)
        return interface.WATCHDOG if board.mode == MoteusMode.TIMEOUT else 0

    def _is_driving(self) -> bool:
        return self._board.is_driving or self._is_in_operation()

    def _is_in_operation(self) -> bool:
        # Shorted windings are commanded out of operation, too: one that was stopped by somebody else stays out of it.
        return (self._is_enabled or self._was_found_driving) and self._board.is_running

    def has_torque(self, joint: int) -> bool:
        """Whether it drives its motor, or holds it after a time-out."""
        return self._board.is_driving or self._board.mode == MoteusMode.TIMEOUT

    def write(
        self,
        wanted: interface.Wanted,
        modes: Sequence[OutputMode],
        output: Sequence[float],
        feedforward_V: Sequence[float],
        feedback: Feedback,
    ) -> None:
        """Set the command of this cycle; a hold that its time-out began ends by a stop alone."""
        super().write(wanted, modes, output, feedforward_V, feedback)
        self._was_found_driving = wanted is interface.Wanted.AS_FOUND and self._board.is_driving
        if wanted is interface.Wanted.DISABLED and self._board.mode == MoteusMode.TIMEOUT:
            self._board.wanted = moteus.stop(self._board.number)

    def _look(self) -> None:
        self._held = None
        self._board.wanted = moteus.ask(self._board.number)

    def _go(self, count: int, speed_count_s: float) -> None:
        board, turn = self._board, self._board.counts_per_turn
        command = moteus.Position(count / turn, speed_count_s / turn, 0.0, 1.0, self._most_Nm, self._watchdog_s)
        board.wanted = moteus.position(board.number, command)

    def _push(self, torque_Nm: float) -> None:
        command = moteus.torque(torque_Nm, self._most_Nm, self._watchdog_s)
        self._board.wanted = moteus.position(self._board.number, command)

    def _brake(self) -> None:
        self._held = None
        self._board.wanted = moteus.brake(self._board.number)

    def _fault_left(self) -> str:
        """The windings stay shorted."""
        return "" if self._board.reset_fault() else f"fault {self._board.fault}"

    def require_force_limit(self) -> None:
        """Nothing to look for: each command carries its largest torque."""

    def limit_force(self, current_A: float) -> None:
        """At most so much current from the next command on."""
        self._most_Nm = current_A * abs(self._torque_Nm_A)

    def emergency_stop(self) -> None:
        """Short the windings now, and stay there until the fault is acknowledged."""
        self._faults |= interface.EMERGENCY_STOP
        self._board.stop_now()


def open_boards(boards: Sequence[Board], opened: Opened) -> None:
    """Open the CAN FD bus, and identify every moteus."""
    bus, arm = open_bus(opened, "moteus controllers", open_fd_can, MoteusBus), opened.arm
    for described, drive in opened.driven(boards):
        with collect(opened.failures):
            board = Moteus(bus, described.address, described.name, drive.encoder_counts_per_rev)
            is_absolute = arm.has_absolute_encoder(drive)
            of_rotor = moteus.REFERENCED_TO_ROTOR if arm.turn_of_home_rad(drive) else 0
            identity = board.identify(moteus.REFERENCED_TO_OUTPUT if is_absolute else of_rotor)
            unsaid = _require_settings(board, drive)
            encoder = own_encoder(board, drive, opened, is_absolute, is_asked=True)
            opened.drives.append(MoteusDrive(board, encoder, drive, SetPointSpeed(drive, opened), arm.limits.watchdog_s))
            opened.identities.append((board.where, f"{identity}, supply {board.supply_V:.1f} V{unsaid}"))

"""RoboClaw boards as encoders and drives of an arm: two joints a board, several boards a line (docs/roboclaw.md).

A board takes duties and obeys the last one until its time-out; it has no states, so the states of CiA 402 that the loop
follows are kept here. It never goes on by itself after an error: FAULT is left only by `acknowledge_faults`.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence

from control.hardware import interface
from control.hardware.boards import AskedEncoders, Opened, collect
from control.hardware.bought.serial_line import TURN_AROUND_S, PolledBoards, on_line, open_lines, require_fit
from control.hardware.interface import Feedback, OutputMode
from control.model.arm import Board, Drive
from control.model.drive import OWN_INPUT
from firmware_iface import roboclaw
from firmware_iface.errors import BoardFaulted, MisuseError
from firmware_iface.link import ByteLink
from firmware_iface.roboclaw import CHANNELS, PacketLine, RoboClaw, RoboclawStatus

# What an error of the board is to the loop: of both motors, and by channel.
_SHARED = (
    (RoboclawStatus.E_STOP, interface.EMERGENCY_STOP),
    (RoboclawStatus.TEMPERATURE | RoboclawStatus.TEMPERATURE_2, interface.OVER_TEMPERATURE),
    (RoboclawStatus.MAIN_VOLTAGE_HIGH | RoboclawStatus.LOGIC_VOLTAGE_HIGH, interface.SUPPLY_HIGH),
    (RoboclawStatus.MAIN_VOLTAGE_LOW | RoboclawStatus.LOGIC_VOLTAGE_LOW, interface.SUPPLY_LOW),
)
_OWN = (
    (
        (RoboclawStatus.DRIVER_1 | RoboclawStatus.CURRENT_1, interface.OVER_CURRENT),
        (RoboclawStatus.SPEED_1 | RoboclawStatus.POSITION_1, interface.OWN_ENCODER),
    ),
    (
        (RoboclawStatus.DRIVER_2 | RoboclawStatus.CURRENT_2, interface.OVER_CURRENT),
        (RoboclawStatus.SPEED_2 | RoboclawStatus.POSITION_2, interface.OWN_ENCODER),
    ),
)
_LIMITS_CURRENT = (RoboclawStatus.OVER_CURRENT_WARNING_1, RoboclawStatus.OVER_CURRENT_WARNING_2)
_SWITCH = (RoboclawStatus.S4_TRIGGERED, RoboclawStatus.S5_TRIGGERED)
# Bytes of a cycle a board, there and back: duties 8 + 1, currents 2 + 6, status 2 + 6, encoders 2 + 10.
CYCLE_BYTES = 37
QUESTIONS = 4
STATUS_BYTES = 8  # of one more, for boards with a limit switch
_RATED = re.compile(r"\d+x(\d+)A")  # in its version: motors and continuous current, as in "RoboClaw 2x15A v4.3.6"
PEAK_OF_RATED = 2.0  # at most, by the boards' data sheets: 1.25 to 2 by model


def cycle_s(boards: int, baud: int, with_switch: int = 0) -> float:
    """How long a cycle's questions take on a line, some of whose boards have a limit switch: the loop's shortest period."""
    every_s = CYCLE_BYTES * 10 / baud + QUESTIONS * TURN_AROUND_S
    return boards * every_s + with_switch * (STATUS_BYTES * 10 / baud + TURN_AROUND_S)


class RoboClawEncoders(AskedEncoders):
    """The encoder inputs of one board; meets `control.hardware.boards.Encoders`."""

    def __init__(self, board: RoboClaw, drives: Mapping[int, Drive]) -> None:
        """`drives`: those whose encoder is on this board, by joint (0-based)."""
        self.joints = tuple(drives)
        self._board = board
        self._channels = {joint: drive.board_channel - 1 for joint, drive in drives.items()}
        flags = {0.0: interface.HOME_SWITCH, -1.0: interface.LOWER_LIMIT, 1.0: interface.UPPER_LIMIT}
        self._switch_flags = {joint: flags[_limit_side(drive)] for joint, drive in drives.items()}
        self._are_zeros_set = dict.fromkeys(drives, False)
        self._latched: dict[int, int] = {}
        self._resets = 0

    def take(self, feedback: Feedback) -> None:
        """Write the newest counts."""
        board = self._board
        if self._resets != board.resets:
            self._resets = board.resets
            self._are_zeros_set = dict.fromkeys(self.joints, False)
            self._latched.clear()
        status = board.status or RoboclawStatus(0)
        for joint, channel in self._channels.items():
            feedback.count[joint] = board.counts[channel]
            feedback.counted_at_s[joint] = feedback.reported_at_s[joint] = board.counted_at_s
            feedback.count_late_s[joint] = board.count_late_s
            flags = interface.ZERO_SET if self._are_zeros_set[joint] else 0
            feedback.channel_flags[joint] = flags | (self._switch_flags[joint] if status & _SWITCH[channel] else 0)

    def fresh_count(self, joint: int) -> int:
        """The count now. BoardSilent if there is no answer."""
        return self._board.read_counts()[self._channels[joint]]

    def arm_index(self, joint: int) -> None:
        """There is no index input: the count at which the switch is seen takes the index's place."""
        self._latched[joint] = self._board.counts[self._channels[joint]]

    def index_count(self, joint: int) -> int | None:
        """The count at the switch."""
        return self._latched.get(joint)

    def shift(self, joint: int, counts: int) -> None:
        """Set the counter of a joint at rest."""
        self._board.set_count(self._channels[joint] + 1, self.fresh_count(joint) + counts)
        self.fresh_count(joint)
        self._are_zeros_set[joint] = True


class RoboClawDrives:
    """The motors of one board; meets `control.hardware.boards.Drives`."""

    def __init__(self, board: RoboClaw, drives: Mapping[int, Drive], timeout_s: float, shout: Callable[[bytes], None]) -> None:
        """`drives`: of each joint (0-based); `timeout_s`: of the board; `shout` sends a packet at once."""
        self.joints = tuple(drives)
        self._board = board
        self._drives = tuple((joint, drive.board_channel - 1, float(drive.motor_direction)) for joint, drive in drives.items())
        self._limit_sides = [0.0] * CHANNELS
        for drive in drives.values():
            self._limit_sides[drive.board_channel - 1] = _limit_side(drive)
        self._current_limits_A = _by_channel(drives)
        self._timeout_s = timeout_s
        self._shout = shout
        self._configured_resets = -1
        self._faults = [0] * CHANNELS
        self._is_enabled = False

    def take(self, feedback: Feedback) -> None:
        """Write currents, supply and the states kept here."""
        board, status = self._board, self._board.status
        if status is not None and status & roboclaw.ERRORS:
            for channel in range(CHANNELS):
                self._faults[channel] |= _faults(status, channel)
        replied_at_s = min(board.obeyed_at_s, board.currents_at_s) if board.is_commanded else board.currents_at_s
        for joint, channel, sign in self._drives:
            feedback.reply_at_s[joint] = replied_at_s
            if status is None or board.supply_V is None:
                feedback.statusword[joint] = 0
                continue
            feedback.current_A[joint] = sign * board.currents_A[channel]
            feedback.supply_V[joint] = board.supply_V
            feedback.temperature_C[joint] = board.temperature_degC
            feedback.drive_faults[joint] = self._faults[channel]
            feedback.statusword[joint] = self._statusword(channel, status)

    def _statusword(self, channel: int, status: RoboclawStatus) -> int:
        if self._faults[channel]:
            return interface.FAULT
        is_obeyed = math.isfinite(self._board.obeyed_at_s)
        state = interface.OPERATION_ENABLED if self._is_enabled and is_obeyed else interface.SWITCH_ON_DISABLED
        return state | (interface.WARNING if status & _LIMITS_CURRENT[channel] else 0)

    def write(
        self,
        wanted: interface.Wanted,
        modes: Sequence[OutputMode],
        output: Sequence[float],
        feedforward_V: Sequence[float],
        feedback: Feedback,
    ) -> None:
        """Set the duties; everything but a voltage is 0: the windings are shorted."""
        board = self._board
        is_well = board.supply_V is not None and self._configured_resets == board.resets
        self._is_enabled = wanted.is_on and is_well and not any(self._faults)
        board.is_commanded = wanted is not interface.Wanted.AS_FOUND
        for joint, channel, sign in self._drives:
            is_driven = self._is_enabled and modes[joint] is OutputMode.VOLTAGE
            volts = output[joint] if is_driven else 0.0
            if volts * self._limit_sides[channel] > 0.0 and (board.status or 0) & _SWITCH[channel]:
                volts = 0.0  # the board itself drives no further into its limit switch, and brakes
            board.duty[channel] = _duty(sign * volts, board.supply_V)
            feedback.sent_V[joint] = volts if is_driven else math.nan

    def is_any_enabled(self) -> bool:
        """Whether duties other than 0 may be on."""
        return self._is_enabled

    def has_torque(self, joint: int) -> bool:
        """Whether a motor is driven: by a duty that was found when the board was identified, or by one of ours."""
        return self._is_enabled or (not self._board.is_commanded and any(self._board.found_duty))

    def configure(self, fresh_count: Callable[[int], int]) -> None:
        """Set time-out and limits, which a restart of the board loses."""
        if self._configured_resets != self._board.resets:
            resets = self._board.resets
            self._board.set_up(self._timeout_s, self._current_limits_A)
            self._configured_resets = resets
        self._board.read_status()

    def acknowledge_faults(self) -> None:
        """Forget the errors that are gone. Raises BoardFaulted for those that are not."""
        status = self._board.read_status()
        if status & roboclaw.ERRORS:
            names = ", ".join(str(one.name).replace("_", " ").lower() for one in RoboclawStatus(status & roboclaw.ERRORS))
            raise BoardFaulted(f"{self._board.where}: its error ({names}) cannot be acknowledged: the cause persists")
        self._faults = [0] * CHANNELS

    def follow_shift(self, joint: int, fresh_count: Callable[[int], int]) -> None:
        """Nothing here depends on the count."""

    def emergency_stop(self) -> None:
        """Short the windings now, and stay there until the fault is acknowledged."""
        self._faults = [faults | interface.EMERGENCY_STOP for faults in self._faults]
        self._board.duty[:] = [0] * CHANNELS
        self._shout(self._board.stop_packet())


def _faults(status: RoboclawStatus, channel: int) -> int:
    """The loop's fault bits of one motor."""
    return sum(bit for errors, bit in (*_SHARED, *_OWN[channel]) if status & errors)


def _limit_side(drive: Drive) -> float:
    """At which end the board's input for this motor has a limit switch: -1, 1; 0: at none."""
    if (switches := drive.limit_switches) is None:
        return 0.0
    return float((switches.upper == OWN_INPUT) - (switches.lower == OWN_INPUT))


def _duty(volts: float, supply_V: float | None) -> int:
    """The duty for a mean terminal voltage at this supply."""
    if not supply_V:
        return 0
    share = min(max(volts / supply_V, -1.0), 1.0)
    return round(share * roboclaw.FULL_DUTY)


def _by_channel(drives: Mapping[int, Drive]) -> tuple[float, float]:
    limits_A = [math.inf] * CHANNELS
    for drive in drives.values():
        limits_A[drive.board_channel - 1] = drive.current_limit_A
    return limits_A[0], limits_A[1]


def open_boards(boards: Sequence[Board], opened: Opened) -> None:
    """Open the lines of these boards and identify every board."""
    with_switch = len({drive.board for drive in opened.arm.motors if _limit_side(drive)} & {board.name for board in boards})
    remedy = "raise the baud rate, or give each board a line of its own (USB)"

    def open_on(link: ByteLink, on_it: Sequence[Board]) -> PolledBoards:
        if link.baud:
            needed_s = cycle_s(len(on_it), link.baud, min(len(on_it), with_switch))
            require_fit(on_line("RoboClaw", on_it, link), needed_s, opened.period_s, remedy)
        line = PacketLine(link, opened.clock)
        claws: list[RoboClaw] = []
        for described in on_it:
            with collect(opened.failures):
                claws.append(_open_board(described, line, opened))

        def post_cycle() -> None:
            for board in claws:
                if board.is_commanded:
                    board.post_duties()
            line.post_starved()
            for board in claws:
                board.post_cycle()

        return PolledBoards(line, claws, post_cycle)

    open_lines(boards, opened, open_on)


def _require_rating(where: str, version: str, drive: Drive) -> None:
    """A board limits the current to what it is told, and that must not be beyond its own peak. MisuseError."""
    rated = _RATED.search(version)
    if rated is None or math.isinf(drive.current_limit_A):
        return
    most_A = PEAK_OF_RATED * float(rated[1])
    if drive.current_limit_A > most_A:
        raise MisuseError(
            f"{where}: joint {drive.joint}: current_limit_A = {drive.current_limit_A:g} is above the {most_A:g} A that it gives"
            f" for a moment ({version})"
        )


def _open_board(described: Board, line: PacketLine, opened: Opened) -> RoboClaw:
    arm = opened.arm
    board = RoboClaw(line, described.address, described.name)
    version = board.identify().version
    driven = {drive.joint - 1: drive for drive in arm.motors if drive.board == described.name}
    counted = {joint: drive for joint, drive in driven.items() if drive.encoder_board < 0}
    for drive in counted.values():
        board.require_quadrature(drive.board_channel)
        if side := _limit_side(drive):
            board.require_limit_switch(drive.board_channel, side * drive.motor_direction > 0.0)
        elif drive.home is not None and drive.home.switch == "own":
            board.require_home_switch(drive.board_channel)
    if counted:
        line.keep_asking(board.counts_question)
    for joints in (range(arm.joint_count), (arm.joint_count,)):  # the gripper's apart
        mine = {joint: drive for joint, drive in driven.items() if joint in joints}
        counted_here = {joint: drive for joint, drive in counted.items() if joint in joints}
        if counted_here:
            opened.encoders.append(RoboClawEncoders(board, counted_here))
        if mine:
            opened.drives.append(RoboClawDrives(board, mine, arm.limits.watchdog_s, line.shout))
    for drive in driven.values():
        _require_rating(board.where, version, drive)
        board.require_braking(drive.board_channel)
    opened.identities.append((board.where, version))
    return board

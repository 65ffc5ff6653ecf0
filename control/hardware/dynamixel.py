"""Dynamixel X servos as encoders and drives of an arm: the position loop is in the servo (docs/dynamixel.md).

The encoder is absolute and at the joint, so the arm knows its pose without homing: `zero_count` is the position at joint angle 0.
Where the loop controls nothing, a servo holds its position.
"""

import math
from collections.abc import Callable, Mapping, Sequence

from control.hardware.interface import Feedback, OutputMode
from control.hardware.opened import Opened, collect
from control.hardware.roles import AskedEncoders
from control.hardware.words import (
    EMERGENCY_STOP,
    FAULT,
    OPERATION_ENABLED,
    OVER_CURRENT,
    OVER_TEMPERATURE,
    OWN_ENCODER,
    SUPPLY_LOW,
    SWITCH_ON_DISABLED,
    WATCHDOG,
    ZERO_SET,
)
from control.model.arm import Arm, Board, Drive
from control.model.joint_map import JointMap
from firmware_iface.clock import Clock
from firmware_iface.dynamixel.servo import DynamixelServo, ServoLine
from firmware_iface.errors import BoardFaulted, MisuseError
from firmware_iface.link import open_serial

# Bits of the hardware error status (e-Manual), as the loop's faults.
_FAULT_OF = ((0x01, SUPPLY_LOW), (0x04, OVER_TEMPERATURE), (0x08, OWN_ENCODER), (0x30, OVER_CURRENT))
# A cycle: a sync write (14 bytes and 5 a servo), one state (14 + 46), and for each servo its values (14 + 32).
STATE_BYTES, VALUE_BYTES, GOAL_BYTES, SYNC_BYTES = 60, 46, 5, 14
TURN_AROUND_S = 0.0005
LOOKS_BEFORE_A_READ = 40  # as on a RoboClaw's line


def cycle_s(servos: int, baud: int) -> float:
    """How long the questions of one cycle take on a line: the shortest period of the loop."""
    line_bytes = SYNC_BYTES + STATE_BYTES + servos * (GOAL_BYTES + VALUE_BYTES)
    return line_bytes * 10 / baud + (servos + 1) * TURN_AROUND_S


class DynamixelLine:
    """The line, as the loop drains it; meets `control.hardware.roles.Line` and `PolledLine`."""

    def __init__(self, line: ServoLine) -> None:
        self._line = line

    def update(self) -> None:
        """Take what has arrived. Raises LinkLost, BoardReset."""
        self._line.update()
        for servo in self._line.servos:
            if servo.problems:
                raise servo.problems.pop(0)

    def flush(self) -> None:
        """Queue the cycle's questions and send the first."""
        self._line.post_cycle()
        self._line.update()

    def attend(self) -> None:
        """Go on with the questions."""
        self._line.attend()


class DynamixelEncoder(AskedEncoders):
    """The absolute encoder of a servo; meets `control.hardware.roles.Encoders`."""

    def __init__(self, servo: DynamixelServo, joint: int) -> None:
        self.joints = (joint,)
        self.offset = 0
        """What is added to the servo's position."""
        self._servo, self._joint = servo, joint

    def take(self, feedback: Feedback) -> None:
        """Write the newest position; its zero is always known."""
        servo, joint = self._servo, self._joint
        feedback.count[joint] = servo.position + self.offset
        feedback.counted_at_s[joint] = feedback.reported_at_s[joint] = servo.at_s
        feedback.channel_flags[joint] = ZERO_SET

    def fresh_count(self, joint: int) -> int:
        """The position now. BoardSilent if there is no answer."""
        self._servo.read_state()
        return self._servo.position + self.offset

    def arm_index(self, joint: int) -> None:
        """There is no index: the encoder is absolute."""

    def index_count(self, joint: int) -> int | None:
        """There is no index."""
        return None

    def watch_indices(self, is_wanted: bool) -> None:
        """There is no index."""

    def passed_indices(self) -> list[tuple[int, int]]:
        """There is no index."""
        return []

    def shift(self, joint: int, counts: int) -> None:
        """Shift the zero until the loop ends; for good, it is `zero_count` in arm.toml."""
        self.offset += counts

    def restore(self) -> None:
        """Nothing is lost that is asked for all the time."""


class DynamixelDrive:
    """One servo; meets `control.hardware.roles.Drives`."""

    def __init__(
        self,
        servo: DynamixelServo,
        encoder: DynamixelEncoder,
        joint: int,
        drive: Drive,
        watchdog_s: float,
    ) -> None:
        self.joints = (joint,)
        self._servo, self._encoder, self._joint = servo, encoder, joint
        self._map = JointMap(drive)
        self._sign = float(drive.encoder_direction)  # a servo's current has the sense of its count
        self._watchdog_s = watchdog_s
        self._configured_resets = -1
        self._faults = 0
        self._held: int | None = None
        self._is_enabled = False

    def take(self, feedback: Feedback) -> None:
        """Write current, supply, temperature and state."""
        servo, joint = self._servo, self._joint
        feedback.reply_at_s[joint] = servo.at_s
        if servo.is_torque_on is None:
            feedback.statusword[joint] = 0
            return
        self._faults |= sum(bit for mask, bit in _FAULT_OF if servo.hardware_error & mask)
        self._faults |= WATCHDOG if servo.is_watchdog_expired else 0
        feedback.current_A[joint] = self._sign * servo.current_A
        feedback.supply_V[joint] = servo.supply_V
        feedback.temperature_C[joint] = servo.temperature_degC
        feedback.drive_faults[joint] = self._faults
        state = OPERATION_ENABLED if self._is_enabled else SWITCH_ON_DISABLED
        feedback.statusword[joint] = FAULT if self._faults else state

    def write(
        self, wants_enabled: bool, mode: OutputMode, output: Sequence[float], feedforward_V: Sequence[float],
        feedback: Feedback,
    ) -> None:  # fmt: skip
        """Set the goal position, and switch the torque as it is wanted."""
        servo, joint = self._servo, self._joint
        feedback.sent_V[joint] = math.nan
        if self._configured_resets != servo.resets:
            self._is_enabled = False
            return
        is_free = not wants_enabled or (mode is OutputMode.OFF and not self._faults)
        servo.post_torque(not is_free)
        self._is_enabled = wants_enabled and (is_free or bool(servo.is_torque_on))
        if is_free or not servo.is_torque_on:
            self._held = None
            servo.goal = servo.position
        elif mode is OutputMode.POSITION and not self._faults:
            self._held = None
            servo.goal = self._map.count(output[joint]) - self._encoder.offset
        else:
            self._held = servo.position if self._held is None else self._held
            servo.goal = self._held

    def is_any_enabled(self) -> bool:
        """Whether the torque was on when the servo was last asked."""
        return self._is_enabled and bool(self._servo.is_torque_on)

    def configure(self, fresh_count: Callable[[int], int]) -> None:
        """Set what a restart of the servo loses."""
        if self._configured_resets != self._servo.resets:
            self._servo.set_up(self._watchdog_s)
            self._configured_resets = self._servo.resets
        self._servo.read_state()

    def acknowledge_faults(self) -> None:
        """End a hardware error by restarting the servo, torque off. Raises BoardFaulted."""
        servo = self._servo
        servo.read_state()
        if servo.hardware_error:
            servo.reboot()
            servo.read_state()
        if servo.hardware_error:
            raise BoardFaulted(
                f"{servo.where}: its hardware error (0x{servo.hardware_error:02x}) cannot be acknowledged: the cause persists"
            )
        if self._faults & ~EMERGENCY_STOP:
            self._configured_resets = -1  # set up anew: torque off, bus watchdog cleared
        self._faults, self._held = 0, None

    def follow_shift(self, joint: int, fresh_count: Callable[[int], int]) -> None:
        """The encoder's offset is used with every goal."""

    def emergency_stop(self) -> None:
        """Hold where the joint is, until it is acknowledged: there are no windings to short."""
        self._faults |= EMERGENCY_STOP
        self._servo.goal = self._held = self._servo.position


def open_boards(arm: Arm, boards: Sequence[Board], clock: Clock, period_s: float, opened: Opened) -> None:
    """Open the lines of these servos and identify every one."""
    joints: Mapping[str, tuple[int, Drive]] = {d.board: (j, d) for j, d in enumerate(arm.drives)}
    for port in dict.fromkeys(board.port for board in boards):
        on_it = [board for board in boards if board.port == port]
        with collect(opened.failures):
            link = open_serial(port, on_it[0].baud, LOOKS_BEFORE_A_READ)
            opened.closers.append(link.close)
            _require_time(on_it, link.baud, period_s)
            line = ServoLine(link, clock)
            for described in on_it:
                with collect(opened.failures):
                    _open_servo(described, line, *joints[described.name], arm.limits.watchdog_s, opened)
            polled = DynamixelLine(line)
            opened.lines.append(polled)
            opened.polled.append(polled)


def _open_servo(
    described: Board, line: ServoLine, joint: int, drive: Drive, watchdog_s: float, opened: Opened
) -> None:
    servo = DynamixelServo(line, described.address, described.name)
    identity = servo.identify()
    servo.read_state()
    line.keep_asking(servo.values_question)
    encoder = DynamixelEncoder(servo, joint)
    opened.encoders.append(encoder)
    opened.drives.append(DynamixelDrive(servo, encoder, joint, drive, watchdog_s))
    opened.identities.append((servo.where, identity))


def _require_time(boards: Sequence[Board], baud: int, period_s: float) -> None:
    needed_s = cycle_s(len(boards), baud) if baud else 0.0
    if needed_s > period_s:
        raise MisuseError(
            f"servo line {boards[0].port}: {len(boards)} servos at {baud} baud need {needed_s * 1e3:.1f} ms a cycle, the loop has"
            f" {period_s * 1e3:.1f} ms: serve with --rate {math.floor(1.0 / needed_s)} or less, or raise the servos' baud rate"
        )

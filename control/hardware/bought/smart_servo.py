"""Smart servos as encoders and drives of an arm: the position loop is in the servo (docs/dynamixel.md, docs/feetech.md).

The encoder is absolute and at the joint, so the arm knows its pose without homing: `zero_count` is the position at joint angle 0.
Where the loop controls nothing, a servo in operation holds its position. One whose torque is not on gets no goal: some servos
switch it on by that alone.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, Generic, TypeVar

from control.hardware.boards import AskedEncoders, Opened, collect
from control.hardware.bought.serial_line import TURN_AROUND_S, PolledBoards, on_line, open_lines, require_fit
from control.hardware.interface import (
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
    Feedback,
    OutputMode,
    Wanted,
    as_counter,
)
from control.model.arm import Board, Drive
from control.model.drive import JointMap
from firmware_iface.clock import Clock
from firmware_iface.dynamixel import DynamixelLine, DynamixelServo
from firmware_iface.errors import BoardFaulted, WrongIdentity
from firmware_iface.feetech import FeetechLine, FeetechServo
from firmware_iface.link import ByteLink
from firmware_iface.smart_servo import ServoLine, SmartServo

L = TypeVar("L", bound=ServoLine)
FaultMap = Sequence[tuple[int, int]]
"""Bits of a servo's hardware error, and the loop's fault for each."""

STORED_SLACK_rad = 0.05  # by which stored limits may be narrower than the range: what the loop allows beyond it
ANSWER_GAP_S = 0.0001  # between the answers of servos that are read together, with a return delay of 0
TORQUE_CYCLES = 20  # until a servo that was told to switch its torque on says that it did: asked in turn, some times


class Torque(Enum):
    """What became of a servo's torque."""

    OFF = "not asked for, or switched off by somebody else: only ENABLING switches it on"
    COMING = "asked for, and not yet confirmed"
    ON = "confirmed"
    FREED = "switched off for a hand that guides the arm"


class ServoEncoder(AskedEncoders):
    """The absolute encoder of a servo; meets `control.hardware.boards.Encoders`."""

    def __init__(self, servo: SmartServo, joint: int) -> None:
        self.joints = (joint,)
        self.offset = 0
        """What is added to the servo's position."""
        self._servo, self._joint = servo, joint

    def take(self, feedback: Feedback) -> None:
        """Write the newest position; its zero is always known."""
        servo, joint = self._servo, self._joint
        feedback.count[joint] = as_counter(servo.position + self.offset)
        feedback.counted_at_s[joint] = feedback.reported_at_s[joint] = servo.at_s
        feedback.count_late_s[joint] = servo.late_s
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

    def shift(self, joint: int, counts: int) -> None:
        """Shift the zero until the loop ends; for good, it is `zero_count` in arm.toml."""
        self.offset += counts


class ServoDrive:
    """One servo; meets `control.hardware.boards.Drives`."""

    def __init__(self, servo: SmartServo, encoder: ServoEncoder, drive: Drive, watchdog_s: float, fault_of: FaultMap) -> None:
        self._servo, self._encoder, self._joint = servo, encoder, drive.joint - 1
        self.joints = (self._joint,)
        self._map = JointMap(drive)
        self._sign = float(drive.encoder_direction)  # a servo's current has the sense of its count
        self._drive = drive
        self._duty_per_A = drive.resistance_ohm / drive.supply_V
        self._watchdog_s = watchdog_s
        self._fault_of = fault_of
        self._configured_resets = -1
        self._faults = 0
        self._held: int | None = None
        self._wanted = Wanted.AS_FOUND
        self._torque = Torque.OFF
        self._coming = 0  # cycles since the torque was asked for

    def take(self, feedback: Feedback) -> None:
        """Write current, supply, temperature and state."""
        servo, joint = self._servo, self._joint
        feedback.reply_at_s[joint] = servo.at_s
        if servo.is_torque_on is None:
            feedback.statusword[joint] = 0
            return
        self._faults |= sum(bit for mask, bit in self._fault_of if servo.hardware_error & mask)
        self._faults |= WATCHDOG if servo.is_watchdog_expired else 0
        feedback.current_A[joint] = self._sign * self._current_A()
        feedback.supply_V[joint] = servo.supply_V
        feedback.temperature_C[joint] = servo.temperature_degC
        feedback.drive_faults[joint] = self._faults
        state = OPERATION_ENABLED if self.is_any_enabled() else SWITCH_ON_DISABLED
        feedback.statusword[joint] = FAULT if self._faults else state

    def _current_A(self) -> float:
        """Of all servos of the joint: as measured, else i = (load U - k speed) / R, by the values of arm.toml [A]."""
        servo, drive = self._servo, self._drive
        if math.isnan(servo.load):
            return servo.current_A * drive.servos
        return (servo.load * servo.supply_V - drive.torque_constant_Nm_A * servo.speed_rad_s) / drive.resistance_ohm

    def write(
        self,
        wanted: Wanted,
        modes: Sequence[OutputMode],
        output: Sequence[float],
        feedforward_V: Sequence[float],
        feedback: Feedback,
    ) -> None:
        """Switch the torque as it is wanted, and set the goal position of a servo that has it."""
        servo, joint = self._servo, self._joint
        feedback.sent_V[joint] = math.nan
        self._wanted, servo.goal = wanted, None
        if wanted is Wanted.AS_FOUND:
            return
        # Only a servo that is set up is driven. One that an error of its own has freed must not take its joint again when that
        # ends; one that holds on in spite of its error is not let go by us.
        is_able = self._configured_resets == servo.resets and not servo.hardware_error & servo.frees_at
        mode = modes[joint]
        if not (wanted.is_on and is_able):
            self._let_go(Torque.OFF)
        elif mode is OutputMode.OFF and not self._faults:
            is_lost = self._torque is Torque.OFF and not servo.is_torque_on and wanted is Wanted.ENABLED
            self._let_go(Torque.OFF if is_lost else Torque.FREED)
        else:
            self._follow_torque(wanted)
        if self._torque is not Torque.ON:
            self._held = None
        elif mode is OutputMode.POSITION and not self._faults:
            self._held = None
            servo.goal = self._map.count(output[joint]) - self._encoder.offset
        else:
            self._held = servo.position if self._held is None else self._held
            servo.goal = self._held

    def _let_go(self, torque: Torque) -> None:
        self._torque = torque
        self._servo.post_torque(False)

    def _follow_torque(self, wanted: Wanted) -> None:
        """Torque that is on stays. It is switched on by ENABLING, and when a hand has ended guiding; not when it was lost."""
        servo, before = self._servo, self._torque
        if servo.is_torque_on:
            self._torque = Torque.ON
            servo.post_torque(True)  # withdraws what was wanted a moment ago
            return
        if wanted is Wanted.ENABLING or before is Torque.FREED:
            self._coming = 0 if before is not Torque.COMING else self._coming
            self._torque = Torque.COMING
        elif before is Torque.ON or (before is Torque.COMING and self._coming >= TORQUE_CYCLES):
            self._torque, self._configured_resets = Torque.OFF, -1  # perhaps it has restarted
        if self._torque is Torque.COMING:
            self._coming += 1
            servo.post_torque(True)

    def is_any_enabled(self) -> bool:
        """Whether the torque was on when the servo was last asked, or is off for a hand, or on its way back from that."""
        is_ours = self._torque is Torque.FREED or (self._torque is Torque.COMING and self._wanted is Wanted.ENABLED)
        return is_ours or bool(self._servo.is_torque_on)

    def has_torque(self, joint: int) -> bool:
        """Whether the torque was on when the servo was last asked."""
        return bool(self._servo.is_torque_on)

    def configure(self, fresh_count: Callable[[int], int]) -> None:
        """Set what a restart of the servo loses."""
        if self._configured_resets != self._servo.resets:
            self._servo.set_up(self._watchdog_s)
            self._configured_resets = self._servo.resets
        self._servo.read_state()

    def acknowledge_faults(self) -> None:
        """End a hardware error that has freed or weakened the servo by restarting it, torque off. Raises BoardFaulted."""
        servo = self._servo
        servo.read_state()
        holds_on = servo.is_torque_on and not servo.hardware_error & (servo.frees_at | servo.weakens_at)
        if servo.hardware_error and not holds_on:
            servo.reboot()
            servo.read_state()
        if servo.hardware_error:
            raise BoardFaulted(
                f"{servo.where}: its hardware error (0x{servo.hardware_error:02x}) cannot be acknowledged: the cause persists"
            )
        if self._faults & ~EMERGENCY_STOP:
            self._configured_resets = -1  # set up anew, which clears the bus watchdog
        self._faults, self._held = 0, None

    def follow_shift(self, joint: int, fresh_count: Callable[[int], int]) -> None:
        """The encoder's offset is used with every goal."""

    def require_force_limit(self) -> None:
        """Raise WrongIdentity if the servo is set up to keep none."""
        self._servo.require_force_limit()

    def limit_force(self, current_A: float) -> None:
        """At most so much current from now on, or the duty that gives it at rest; does not wait."""
        self._servo.limit_force(current_A, min(current_A * self._duty_per_A, 1.0))

    def emergency_stop(self) -> None:
        """Hold where the joint is, until it is acknowledged: there are no windings to short."""
        self._faults |= EMERGENCY_STOP
        if self._torque is Torque.ON:
            self._servo.goal = self._held = self._servo.position


@dataclass(frozen=True, slots=True)
class ServoMake(Generic[L]):
    """A make of servos: how line and servo are opened, the loop's faults for bits of its hardware error, and what a cycle costs.

    line_bytes, servo_bytes: that a cycle sends and receives, for the line and for each servo; questions: that are answered.
    """

    line: Callable[[ByteLink, Clock], L]
    servo: Callable[[L, int, str], SmartServo]
    faults: FaultMap
    line_bytes: int
    servo_bytes: int
    questions: int

    def cycle_s(self, servos: int, baud: int, delays_s: Sequence[float] = ()) -> float:
        """How long the packets of one cycle take on a line of so many servos: the shortest period of the loop.

        `delays_s`: by which each servo waits with its answer. All answer one of the questions, one of them each other.
        """
        packets_s = (self.line_bytes + servos * self.servo_bytes) * 10 / baud
        waits_s = sum(delays_s) + (self.questions - 1) * max(delays_s, default=0.0)
        return packets_s + self.questions * TURN_AROUND_S + servos * ANSWER_GAP_S + waits_s

    def open_boards(self, boards: Sequence[Board], opened: Opened) -> None:
        """Open the lines of these servos and identify every one."""

        def open_on(link: ByteLink, on_it: Sequence[Board]) -> PolledBoards:
            called = on_line("servo", on_it, link)
            if link.baud:
                require_fit(called, self.cycle_s(len(on_it), link.baud), opened.period_s, "raise the servos' baud rate")
            line = self.line(link, opened.clock)
            servos: list[SmartServo] = []
            for described, drive in opened.driven(on_it):
                with collect(opened.failures):
                    servos.append(self.servo(line, described.address, described.name))
                    self._join(servos[-1], drive, opened)
            delays_s = [servo.return_delay_s for servo in servos]
            if link.baud and any(delays_s):
                waiting = ", ".join(str(servo.number) for servo in servos if servo.return_delay_s)
                fastest_Hz = math.floor(1.0 / self.cycle_s(len(servos), link.baud))
                remedy = f"set return delay time (register {servos[0].DELAY}) of id {waiting} to 0: up to {fastest_Hz} Hz"
                needed_s = self.cycle_s(len(servos), link.baud, delays_s)
                opened.identities.append((line.name, f"carries {math.floor(1.0 / needed_s)} Hz; {remedy}"))
                require_fit(called, needed_s, opened.period_s, remedy)
            return PolledBoards(line, servos, line.post_cycle)

        open_lines(boards, opened, open_on)

    def _join(self, servo: SmartServo, drive: Drive, opened: Opened) -> None:
        identity = servo.identify()
        _require_type(servo, drive)
        _require_range(servo, drive)
        servo.read_state()
        encoder = ServoEncoder(servo, drive.joint - 1)
        opened.encoders.append(encoder)
        opened.drives.append(ServoDrive(servo, encoder, drive, opened.arm.limits.watchdog_s, self.faults))
        opened.identities.append((servo.where, identity))


DYNAMIXEL: Final = ServoMake(
    DynamixelLine,
    DynamixelServo,
    # bits of the hardware error status (e-Manual)
    faults=((0x01, SUPPLY_LOW), (0x04, OVER_TEMPERATURE), (0x08, OWN_ENCODER), (0x30, OVER_CURRENT)),
    # a sync write of the goals (14 bytes and 5 a servo), one servo's state (14 + 46), a sync read of the values (14 and 1 a
    # servo) and its answers (32 each)
    line_bytes=14 + 60 + 14,
    servo_bytes=5 + 1 + 32,
    questions=2,
)
FEETECH: Final = ServoMake(
    FeetechLine,
    FeetechServo,
    # bits of the servo status: voltage, angle sensor, heat, current, overload
    faults=((0x01, SUPPLY_LOW), (0x02, OWN_ENCODER), (0x04, OVER_TEMPERATURE), (0x28, OVER_CURRENT)),
    # a sync write of the goals (8 bytes and 3 a servo), a sync read of the states (8 and 1 a servo), its answers (37 each)
    line_bytes=8 + 8,
    servo_bytes=3 + 1 + 37,
    questions=1,
)


def _require_type(servo: SmartServo, drive: Drive) -> None:
    """WrongIdentity unless it is of the type that arm.toml names, and made for that supply."""
    if drive.servo and not drive.servo.startswith(servo.model_name):
        raise WrongIdentity(
            f"{servo.where}: expected {drive.servo}, as arm.toml has it there, it is {servo.model_name}: are the ids in"
            " another order? Give each servo its own, or correct `servo`"
        )
    lowest_V, highest_V = servo.bears_V
    if highest_V > 0.0 and not lowest_V <= drive.supply_V <= highest_V:
        raise WrongIdentity(
            f"{servo.where}: expected a servo for {drive.supply_V:g} V, as arm.toml has it, what is stored in it allows"
            f" {lowest_V:.1f} to {highest_V:.1f} V: is it the version for another voltage? Check the plate before you switch the"
            " supply on, and correct `servo` or supply_V"
        )


def _require_range(servo: SmartServo, drive: Drive) -> None:
    """WrongIdentity unless the joint's range lies in the turn that the servo knows, and within its stored limits."""
    ends = [end for end in (drive.joint_lower_rad, drive.joint_upper_rad) if math.isfinite(end)]
    if not ends:
        return  # a gripper's
    mapped = JointMap(drive)
    counts = sorted(map(mapped.count, ends))
    slack = round(STORED_SLACK_rad * abs(mapped.counts_per_radian))
    for allowed, room, what in (
        (servo.known, 0, "the turn that it knows after power-up"),
        (servo.reached, slack, "the position limits stored in it"),
    ):
        if counts[0] < allowed.start - room or counts[-1] >= allowed.stop + room:
            turned = sorted((mapped.radians(allowed.start), mapped.radians(allowed.stop - 1)))
            raise WrongIdentity(
                f"{servo.where}: expected joint {drive.joint}'s range, counts {counts[0]} to {counts[-1]}, within {what}, got"
                f" {allowed.start} to {allowed.stop - 1}: set joint_lower_rad and joint_upper_rad within {turned[0]:.3f} to"
                f" {turned[1]:.3f} rad, or change what is stored in the servo (offset, limits) and zero_count"
            )

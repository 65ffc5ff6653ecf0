"""Bought boards in bring-up: one motor is driven at a time by its own board, all encoders are read, every cycle is monitored.

A board that takes a voltage gets it. One that closes its own loop gets a set-point that moves at the speed which the voltage
would make, close to where the joint is: at the current's limit the set-point waits for the joint. Each joint has the current
limit of bring-up as its `current_limit_A`, which the boards enforce that can.
"""

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final, Literal

from control.errors import ArmError
from control.hardware.connect import connect
from control.hardware.interface import HOME_SWITCH, OPERATION_ENABLED, STATE_MASK, OutputMode, Wanted
from control.model.arm import Arm, Drive
from control.model.drive import JointMap
from firmware_iface.clock import Clock
from firmware_iface.errors import LinkError, MisuseError
from firmware_iface.link import Closing
from procedures.bringup import workbench

ENABLE_S = 1.0
SETTLE_S = 0.05  # after enabling, and until values have come
MOST_LEAD_rad = 0.06  # of a set-point before its joint: the lag of a usual position loop at 0.45 rad/s is half of it
RELIEF_S = 0.2  # in which such a set-point comes back to its joint where the board limits the current; else at once
CURRENT_MARGIN = 1.3  # of the limit
EXCESS_S = 0.15  # a board that does not limit the current exceeds it until its set-point is back at the joint
CURRENT_MARGIN_A = 0.2  # noise of the measurement
SPEED_FILTER_S = 0.02
_MODES: Final[Mapping[Literal["voltage", "current", "position"], OutputMode]] = {
    "voltage": OutputMode.VOLTAGE,
    "position": OutputMode.POSITION,
}


class BoughtBench(Closing):
    """The open boards of an arm on [[board]]s; meets `procedures.bringup.workbench.Workbench`. Channels: (0, joint - 1)."""

    has_index = False

    def __init__(self, arm: Arm, clock: Clock, operator: workbench.BringupOperator, currents_A: Mapping[int, float]) -> None:
        """`currents_A`: by joint, what its drive may draw. Raises the errors of `connect`."""
        self.clock, self.operator = clock, operator
        self._arm = _cautious(arm, currents_A)
        self.has_volts = self._arm.drives[0].pid.mode == "voltage"
        self.limits_current = all(arm.kind_of(drive).limits_current for drive in arm.drives)
        self._period_s = self.look_s = 1.0 / arm.usual_rate_Hz
        self._connection = connect(self._arm, clock, self._period_s)
        self._hardware = self._connection.hardware
        self._maps = [JointMap(drive) for drive in self._arm.drives]
        self._joint: int | None = None  # that is driven, from 0
        self._limits = workbench.DriveLimits(0.0, 0.0)
        self._origin: dict[workbench.Channel, int] = {}
        self._target = 0.0  # of the driven joint in counts, where its board closes the loop
        self._last: dict[workbench.Channel, tuple[float, int]] = {}
        self._speeds: dict[workbench.Channel, float] = {}
        self._wanted = Wanted.AS_FOUND
        self._kept_at_s = clock.now_s()  # when the driven motor's current was last within its limit
        self.observe(SETTLE_S)

    # ---- Workbench

    def prepare(self) -> None:
        """Acknowledge faults, enable, and wait for all boards."""
        if self._wanted is Wanted.ENABLED:
            return
        self._hardware.reset_drive_faults()
        self._hardware.prepare()
        self._wanted = Wanted.ENABLING
        end_s = self.clock.now_s() + ENABLE_S
        while not all(word & STATE_MASK == OPERATION_ENABLED for word in self._hardware.feedback.statusword):
            self._exchanged(0.0)
            if self.clock.now_s() > end_s:
                self._switch_off()
                raise workbench.SafetyTrip(f"not all boards went into operation within {ENABLE_S:g} s; run `armwright doctor`")
        self._wanted = Wanted.ENABLED

    def observe(self, duration_s: float) -> workbench.Sample:
        """Read all boards for a while; nothing is driven, and boards that are on hold. Before `prepare` nothing is commanded."""
        end_s = self.clock.now_s() + duration_s
        sample = self._exchanged(0.0)
        while self.clock.now_s() < end_s:
            sample = self._exchanged(0.0)
        return sample

    @contextlib.contextmanager
    def driving(self, node: int, limits: workbench.DriveLimits) -> Iterator[None]:
        """Drive the motor of a joint of the draft; the others hold, or brake. On every exit it stands still."""
        self.prepare()
        joint = next(k for k, drive in enumerate(self._arm.drives) if drive.joint == node)
        here = self.observe(SETTLE_S)
        self._joint, self._limits, self._origin = joint, limits, dict(here.counts)
        self._kept_at_s = self.clock.now_s()
        self._target = float(here.counts[0, joint])
        try:
            yield
        except BaseException:
            self._switch_off()
            raise
        finally:
            self._joint = None

    def cycle(self, volts: float) -> workbench.Sample:
        """Send a voltage (board's sign), wait for the next cycle, read all boards. Raises SafetyTrip or Stopped."""
        if self._joint is None:
            raise MisuseError("bring-up: a voltage was commanded while no motor is driven")
        sample = self._exchanged(min(max(volts, -self._limits.voltage_V), self._limits.voltage_V))
        self._watch(self._joint, sample)
        if self.operator.wants_stop():
            raise workbench.Stopped("stopped by the operator")
        return sample

    def arm_index(self, at: workbench.Channel) -> None:
        """No index is known."""

    def index_latch(self, at: workbench.Channel) -> int | None:
        """No index is known."""
        return None

    def motor_count(self, node: int) -> int:
        """The same encoder as the loop's: a board with a position loop of its own runs away if it counts down."""
        joint = next(k for k, drive in enumerate(self._arm.drives) if drive.joint == node)
        return self._hardware.feedback.count[joint]

    def counts_per_turn(self, at: workbench.Channel) -> int | None:
        """Boards do not say."""
        return None

    def serials(self) -> dict[int, int]:
        """Serial numbers are those of reference boards."""
        return {}

    # ---- cycles

    def _exchanged(self, volts: float) -> workbench.Sample:
        """Command all boards, wait, and read them."""
        hardware, joint = self._hardware, self._joint
        modes = [OutputMode.VOLTAGE if self.has_volts else OutputMode.HOLD] * len(self._arm.drives)
        output = [0.0] * len(modes)
        is_limited = False
        if joint is not None:
            drive = self._arm.drives[joint]
            modes[joint] = _MODES[drive.pid.mode]
            if self.has_volts:
                output[joint] = volts * drive.motor_direction
            else:
                is_limited = self._lead(joint, volts)
                output[joint] = self._maps[joint].radians(round(self._target))
        hardware.write(self._wanted, modes, output, [0.0] * len(modes))
        hardware.attend(self.clock.now_s() + self._period_s)
        hardware.read()
        return self._sampled(joint, volts, is_limited)

    def _lead(self, joint: int, volts: float) -> bool:
        """Move the set-point by a cycle; whether it had to wait for the joint."""
        drive, feedback = self._arm.drives[joint], self._hardware.feedback
        counts_per_rad = abs(self._maps[joint].counts_per_radian)
        speed_rad_s = volts / (drive.gear_ratio * drive.torque_constant_Nm_A)
        here, most = feedback.count[joint], MOST_LEAD_rad * counts_per_rad
        wanted = self._target + speed_rad_s * self._period_s * counts_per_rad
        if abs(feedback.current_A[joint]) >= self._limits.current_A:
            relief = self._period_s / RELIEF_S * most if self.limits_current else most
            allowed = self._target + min(max(here - self._target, -relief), relief)
        else:
            allowed = min(max(wanted, here - most), here + most)
        self._target = allowed
        return allowed != wanted

    def _sampled(self, joint: int | None, volts: float, is_limited: bool) -> workbench.Sample:
        feedback = self._hardware.feedback
        counts = {(0, k): count for k, count in enumerate(feedback.count)}
        for at, count in counts.items():
            self._follow_speed(at, count, feedback.counted_at_s[at[1]])
        sign = 1.0 if joint is None else float(self._arm.drives[joint].motor_direction)
        current_A = 0.0 if joint is None else sign * feedback.current_A[joint]
        flags = {(0, k): flags for k, flags in enumerate(feedback.channel_flags)}
        limits = {drive.joint: workbench.limits_of(drive, {}, flags[0, k]) for k, drive in enumerate(self._arm.drives)}
        for k, drive in enumerate(self._arm.drives):
            if drive.home is not None and limits[drive.joint] & workbench.HOMED_ON.get(drive.home.switch, 0):
                flags[0, k] |= HOME_SWITCH
        now_s = self.clock.now_s() if joint is None else feedback.counted_at_s[joint]
        return workbench.Sample(now_s, counts, flags, dict(self._speeds), volts, current_A, is_limited, limits)

    def _follow_speed(self, at: workbench.Channel, count: int, counted_at_s: float) -> None:
        if at not in self._last:
            self._last[at], self._speeds[at] = (counted_at_s, count), 0.0
        before_s, before = self._last[at]
        span_s = counted_at_s - before_s
        if span_s > 0.0:
            self._last[at] = (counted_at_s, count)
            share = span_s / (span_s + SPEED_FILTER_S)
            self._speeds[at] += share * ((count - before) / span_s - self._speeds[at])

    def _watch(self, joint: int, sample: workbench.Sample) -> None:
        feedback, limits, now_s = self._hardware.feedback, self._limits, self.clock.now_s()
        stale_s, name = self._arm.limits.stale_s, f"joint {self._arm.drives[joint].joint} in the draft"
        oldest_s = min(feedback.reported_at_s[joint], feedback.reply_at_s[joint])
        if now_s - oldest_s > stale_s:
            raise workbench.SafetyTrip(
                f"{name}: no values for {now_s - oldest_s:.3f} s (limit {stale_s} s); run `armwright doctor`"
            )
        if feedback.statusword[joint] & STATE_MASK != OPERATION_ENABLED:
            raise workbench.SafetyTrip(f"{name}: its board left operation by itself (faults 0x{feedback.drive_faults[joint]:x})")
        if abs(sample.current_A) <= CURRENT_MARGIN * limits.current_A + CURRENT_MARGIN_A:
            self._kept_at_s = now_s
        elif now_s - self._kept_at_s > EXCESS_S:
            raise workbench.SafetyTrip(
                f"{name}: {sample.current_A:+.2f} A measured for {EXCESS_S} s, limit {limits.current_A:.2f} A: limit the current"
                " on the board"
            )
        for at, origin in self._origin.items():
            speed, travel = abs(sample.speed_count_s[at]), abs(sample.counts[at] - origin)
            which = f"the encoder of joint {at[1] + 1}"
            if speed > limits.speed_count_s:
                raise workbench.SafetyTrip(
                    f"{which} RAN AWAY at {speed:.0f} counts/s, limit {limits.speed_count_s:.0f}: the drives were switched"
                    " off; check gear and encoder against the draft, and the load"
                )
            if travel > limits.travel_count:
                raise workbench.SafetyTrip(
                    f"{which} moved {travel} counts, limit {limits.travel_count:.0f}: the drives were switched off; check"
                    " for an obstacle, and that the other joints are supported"
                )

    # ---- on and off

    def _switch_off(self) -> None:
        """All drives off; if a line fails, the boards' own watchdogs do it."""
        self._joint, self._wanted = None, Wanted.DISABLED
        with contextlib.suppress(LinkError):
            self.observe(3.0 * self._period_s)

    def close(self) -> None:
        """Switch off what was switched on, and close all lines."""
        if self._wanted.is_on:
            self._switch_off()
        self._connection.close()


def _cautious(arm: Arm, currents_A: Mapping[int, float]) -> Arm:
    """The arm with the current limits of bring-up, by voltage where all boards take one, else by their position loops."""
    kinds = [arm.kind_of(drive) for drive in arm.drives]
    mode = next((mode for mode in _MODES if all(mode in kind.modes for kind in kinds)), None)
    if mode is None:
        raise ArmError(
            f"arm {arm.name}: bring-up needs boards that all take a voltage, or all close the position loop: bring up two"
            " drafts, each with the joints of one sort"
        )

    def cautious(drive: Drive) -> Drive:
        return replace(drive, current_limit_A=currents_A[drive.joint], pid=replace(drive.pid, mode=mode))

    return replace(arm, drives=tuple(map(cautious, arm.drives)))

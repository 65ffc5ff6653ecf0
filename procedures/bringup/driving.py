"""Drives one joint at a speed over a distance, or until it meets a stop.

    volts = K speed_set + integral(gain (speed_set - speed))

A voltage-driven motor is a speed source with a lag (J R / K^2, some 20 ms), so an integral alone is enough, and it compensates
friction and gravity. It stays from one motion to the next, and holds the joint at their ends: a weak motor's link falls faster on
shorted windings than the joint is to turn.
Signs: `turned_rad` and speeds are in the joint's sign, corrected by the caller's wiring.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise

from control.model.arm import Drive
from control.model.joint_map import JointMap
from procedures.bringup.survey import Caution
from procedures.bringup.workbench import Channel, DriveLimits, Sample, Workbench

INTEGRAL_1_s = 10.0  # crossover of the speed loop, a fifth of the motor's own corner
STALL_WINDOW_S = 0.15
STALL_SHARE = 0.1  # of the distance expected in the window
START_S = 0.35  # start-up time of a joint
HOST_PAUSE_S = 0.05  # between two cycles: a quarter of the shipped watchdog, 25 cycles of 2 ms
REST_S = 0.2
RUNAWAY = 3.0  # times the commanded speed


class MotionEnd(Enum):
    """Why a motion ended."""

    REACHED = "reached"
    STALLED = "stalled"
    SEEN = "seen"


@dataclass(slots=True)
class DrivenMotion:
    """A motion: why it ended, and its cycles as (time, angle, speed, volts, amperes), all in the joint's sign."""

    end: MotionEnd
    rows: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    flags: list[int] = field(default_factory=list)
    limited: list[bool] = field(default_factory=list)
    """Whether the board limited the voltage."""

    @property
    def travelled_rad(self) -> float:
        """Signed travel from the first cycle to the last."""
        return self.rows[-1][1] - self.rows[0][1] if self.rows else 0.0


class JointDriver:
    """A joint by its measured wiring. Angles: counts by the draft's scale, times `scale`, from the first pose."""

    def __init__(
        self,
        bench: Workbench,
        drive: Drive,
        node: int,
        channel: Channel,
        motor_sign: int,
        encoder_sign: int,
        caution: Caution,
    ) -> None:
        self.bench, self.drive, self.node, self.channel = bench, drive, node, channel
        self.scale = 1.0  # true joint angle over the draft's; measured meanwhile
        self._motor_sign, self._encoder_sign = motor_sign, encoder_sign
        self._caution = caution
        self._weight_V = 0.0  # the integral of a joint that turns
        self._per_count = abs(JointMap(drive).radians_per_count)
        self._zero_count = bench.observe(0.02).counts[channel]

    @property
    def radians_per_count(self) -> float:
        """Present estimate of the scale, positive."""
        return self._per_count * self.scale

    def angle_rad(self, count: float) -> float:
        """The joint's angle from the first pose."""
        return self._encoder_sign * (count - self._zero_count) * self.radians_per_count

    def where_rad(self) -> float:
        """The present angle."""
        return self.angle_rad(self.bench.observe(0.004).counts[self.channel])

    def limits(self, speed_rad_s: float, travel_rad: float) -> DriveLimits:
        """Limits for a motion at this speed over this distance."""
        current_A = self._caution.current_A
        constant = self.drive.gear_ratio * self.drive.torque_constant_Nm_A
        holding_V = current_A * self.drive.resistance_ohm
        volts = holding_V + 1.5 * constant * abs(speed_rad_s)
        sinking_rad_s = holding_V / constant  # on shorted windings, under a weight that this current holds
        return DriveLimits(
            current_A,
            min(volts, self.drive.supply_V),
            max(RUNAWAY * abs(speed_rad_s), 0.5, sinking_rad_s) / self.radians_per_count,
            (abs(travel_rad) + 0.2) / self.radians_per_count,
        )

    def turn(
        self,
        distance_rad: float,
        speed_rad_s: float,
        until: Callable[[DrivenMotion, Sample], bool] = lambda run, sample: False,
    ) -> DrivenMotion:
        """Turn by a signed distance at a speed, until it arrives, stalls, or the caller ends it."""
        sign = math.copysign(1.0, distance_rad)
        speed_set = sign * abs(speed_rad_s)
        constant = self.drive.gear_ratio * self.drive.torque_constant_Nm_A
        integral = self._weight_V
        run = DrivenMotion(MotionEnd.REACHED)
        limits = self.limits(speed_rad_s, distance_rad)
        with self.bench.driving(self.node, limits):
            sample = self.bench.cycle(0.0)
            start_rad = self.angle_rad(sample.counts[self.channel])
            while True:
                volts = constant * speed_set + integral
                room = limits.voltage_V
                sample = self.bench.cycle(self._motor_sign * volts)
                row = self._row(sample)
                span_s = row[0] - run.rows[-1][0] if run.rows else 0.0
                # A board with a loop of its own carries the weight; where the joint sinks ahead, its set-point goes on as asked.
                is_free = abs(volts) < room and not sample.is_limited
                has_room = is_free or volts * (speed_set - row[2]) < 0.0
                if self.bench.has_volts and has_room:
                    integral += INTEGRAL_1_s * constant * (speed_set - row[2]) * span_s
                if row[2] * sign > 0.5 * abs(speed_rad_s):  # at a stop it pushes, too
                    self._weight_V = integral
                run.rows.append(row)
                run.flags.append(sample.flags[self.channel])
                run.limited.append(sample.is_limited)
                if (row[1] - start_rad) * sign >= abs(distance_rad):
                    break
                if until(run, sample):
                    run.end = MotionEnd.SEEN
                    break
                if has_stalled(run.rows, abs(speed_rad_s)):
                    run.end = MotionEnd.STALLED
                    break
            self._hold()
        return run

    def _row(self, sample: Sample) -> tuple[float, float, float, float, float]:
        return (
            sample.t_s,
            self.angle_rad(sample.counts[self.channel]),
            self._encoder_sign * sample.speed_count_s[self.channel] * self.radians_per_count,
            self._motor_sign * sample.volts,
            self._motor_sign * sample.current_A,
        )

    def _hold(self) -> None:
        """Command what carries the weight until the joint is at rest; monitoring continues."""
        end_s = self.bench.clock.now_s() + REST_S
        while self.bench.clock.now_s() < end_s:
            self.bench.cycle(self._motor_sign * self._weight_V)

    def go_to(self, angle_rad: float, speed_rad_s: float) -> DrivenMotion:
        """Move to an angle from the first pose."""
        return self.turn(angle_rad - self.where_rad(), speed_rad_s)

    def latches(self, wanted: int, direction: int, speed_rad_s: float, longest_rad: float) -> list[int]:
        """Counts of successive index pulses; the joint is at rest while the next one is armed.

        Fewer than requested if the joint moves `longest_rad` without one, or stalls.
        """
        found: list[int] = []
        while len(found) < wanted:
            self.bench.observe(0.02)
            self.bench.arm_index(self.channel)
            run = self.turn(
                direction * longest_rad,
                speed_rad_s,
                lambda run, sample: self.bench.index_latch(self.channel) is not None,
            )
            latch = self.bench.index_latch(self.channel)
            if run.end is not MotionEnd.SEEN or latch is None:
                break
            found.append(latch)
        return found


def has_stalled(rows: Sequence[tuple[float, float, float, float, float]], speed_rad_s: float) -> bool:
    """Whether the joint has hardly moved within the last window, although it had time to start.

    A pause of the host stops the motor by the board's watchdog; the joint then has to start again.
    """
    now_s, now_rad = rows[-1][0], rows[-1][1]
    is_still = False
    for later, row in pairwise(reversed(rows)):
        if later[0] - row[0] > HOST_PAUSE_S:
            return False
        if not is_still and now_s - row[0] >= STALL_WINDOW_S:
            if abs(now_rad - row[1]) >= STALL_SHARE * speed_rad_s * STALL_WINDOW_S:
                return False
            is_still = True
        if now_s - row[0] >= START_S:
            return True
    return False

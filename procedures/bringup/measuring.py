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
from statistics import fmean, median

from control.hardware.interface import HOME_SWITCH, LOWER_LIMIT, QUADRATURE_ERROR, SIGNAL_LOST
from control.model.arm import Drive
from control.model.drive import JointMap
from procedures.bringup.wiring import Caution, MeasuredWiring
from procedures.bringup.workbench import BringupOperator, DriveLimits, Sample, Stopped, Workbench

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
    LIMIT = "limit switch"


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

    def __init__(self, bench: Workbench, drive: Drive, wiring: MeasuredWiring, caution: Caution) -> None:
        self.bench, self.drive, self.wiring, self.caution = bench, drive, wiring, caution
        self.node, self.channel = wiring.node, wiring.channel
        self.scale = 1.0  # true joint angle over the draft's; measured meanwhile
        self._motor_sign, self._encoder_sign = wiring.motor_direction, wiring.encoder_direction
        self._weight_V = 0.0  # the integral of a joint that turns
        self._is_at_limit: bool | None = None  # whether a limit switch was active, at the last look
        self._barred, self._barred_rad = 0.0, math.inf  # the direction in which one was met, and where it was active last
        self._per_count = abs(JointMap(drive).radians_per_count)
        self._zero_count = bench.observe(0.02).counts[self.channel]

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
        current_A = self.caution.current_A
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
        self, distance_rad: float, speed_rad_s: float, until: Callable[[DrivenMotion, Sample], bool] = lambda run, sample: False
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
                is_barred = self._is_barred(sample, sign)
                if until(run, sample):
                    run.end = MotionEnd.SEEN
                    break
                if is_barred:
                    run.end = MotionEnd.LIMIT
                    break
                if has_stalled(run.rows, abs(speed_rad_s)):
                    run.end = MotionEnd.STALLED
                    break
            self._hold(sign)
        return run

    def _is_barred(self, sample: Sample, sign: float) -> bool:
        """Whether it moves further into a limit switch: as it met it, or, from the start, to the end that the draft names.

        A joint that comes to rest beside the edge that it has just left may act on that switch once more: no other is so near.
        """
        active = sample.limits.get(self.drive.joint, 0)
        was_at_limit, self._is_at_limit = self._is_at_limit, bool(active)
        if not active:
            return False
        where_rad = self.angle_rad(sample.counts[self.channel])
        if was_at_limit is None:
            self._barred = -1.0 if active & LOWER_LIMIT else 1.0
        elif not was_at_limit and abs(where_rad - self._barred_rad) > BACK_OFF_RAD:
            self._barred = sign
        self._barred_rad = where_rad
        return self._barred == sign

    def _row(self, sample: Sample) -> tuple[float, float, float, float, float]:
        return (
            sample.t_s,
            self.angle_rad(sample.counts[self.channel]),
            self._encoder_sign * sample.speed_count_s[self.channel] * self.radians_per_count,
            self._motor_sign * sample.volts,
            self._motor_sign * sample.current_A,
        )

    def _hold(self, sign: float) -> None:
        """Command what carries the weight until the joint is at rest; it may still run into a switch."""
        end_s = self.bench.clock.now_s() + REST_S
        while self.bench.clock.now_s() < end_s:
            self._is_barred(self.bench.cycle(self._motor_sign * self._weight_V), sign)

    def go_to(self, angle_rad: float, speed_rad_s: float) -> DrivenMotion:
        """Move to an angle from the first pose."""
        return self.turn(angle_rad - self.where_rad(), speed_rad_s)

    def latches(self, wanted: int, direction: int, speed_rad_s: float, longest_rad: float) -> list[int]:
        """Counts of successive index pulses; the joint is at rest while the next one is armed.

        Fewer than requested if the joint moves `longest_rad` without one, or stalls.
        """
        latched: list[int] = []
        while len(latched) < wanted:
            self.bench.observe(0.02)
            self.bench.arm_index(self.channel)
            run = self.turn(
                direction * longest_rad, speed_rad_s, lambda run, sample: self.bench.index_latch(self.channel) is not None
            )
            latch = self.bench.index_latch(self.channel)
            if run.end is not MotionEnd.SEEN or latch is None:
                break
            latched.append(latch)
        return latched


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


# Measurements of one joint, in this order: a known angle, index spacing, motor and friction, end stops, home switch.
#
# Returns numbers only; `procedures.bringup.diagnosis` interprets them.


SUPPORT_S = 0.3  # in which a joint comes to rest once the links are supported anew
LATCHES = 5
INDEX_SPEED_rad_s = 0.12
SAME_PULSE_counts = 4
INDEX_TURNS = 2.6  # turns of the encoder by the draft: even at half or twice the counts there are two index pulses
KNOWN_ANGLE_RAD = 0.3  # readings, including those at the end stops
LONG_ANGLE_RAD = 0.6  # readings without end stops
PASS_SPEEDS_rad_s = (0.1, 0.2, 0.4)
PASS_RAD = 0.12  # minimum; longer at higher speed
PASS_S = 0.8
FREE_SHARE = 0.8  # share of cycles without a limit active
MIDDLE = (0.35, 0.65)  # of a pass: settled, and the same place in both directions
ODD_RATIO = 0.06  # of the draft's scale; below it, a slipping encoder or a misread angle is more likely than another gear
TOUCHES = 3
BACK_OFF_RAD = 0.12
TOUCH_SPEED_rad_s = 0.15


@dataclass(frozen=True, slots=True)
class SteadyPass:
    """Means of a pass at constant speed, in the joint's sign, with the speed by the draft's scale."""

    speed_rad_s: float
    volts: float
    current_A: float


@dataclass(slots=True)
class JointMeasurements:
    """One joint; angles nominal (draft's scale), from the first pose, unless stated otherwise. NaN or empty: not measured."""

    spacings_count: list[int] = field(default_factory=list)
    passes: list[SteadyPass] = field(default_factory=list)
    readings: list[tuple[float, float]] = field(default_factory=list)
    """(angle by counts with the draft's scale, the operator's reading)."""
    stops_rad: list[list[float]] = field(default_factory=lambda: [[], []])
    """Angles at the lower and the upper stop, one per touch; or where its limit switch stopped the joint."""
    has_limit: list[bool] = field(default_factory=lambda: [False, False])
    """Whether a limit switch ends the way before the stop does."""
    edges: list[tuple[float, int, bool]] = field(default_factory=list)
    """Angles where the home switch changed, the direction of motion, and whether the switch is active after it."""
    is_home_active: list[bool] = field(default_factory=list)
    """All observed states of the switch."""
    index_rad: float = math.nan
    has_index: bool = True
    """False: the boards latch none; `index_rad` is the edge of the home switch."""
    has_volts: bool = True
    cycle_rad: float = 0.0
    """How far the joint creeps between two looks at its switch, where that is more than a board's own look."""
    flags: int = 0
    stalled_early: bool = False


def measure(driver: JointDriver, operator: BringupOperator, speed_rad_s: float, with_stops: bool) -> JointMeasurements:
    """Take all measurements. Raises Stopped, SafetyTrip and the errors of the boards; the drive is then off."""
    bench, joint = driver.bench, driver.wiring.joint
    measured = JointMeasurements(has_index=bench.has_index, has_volts=bench.has_volts, cycle_rad=bench.look_s * abs(speed_rad_s))
    operator.support(joint, are_held=not bench.has_volts)
    driver.bench.observe(SUPPORT_S)
    try:
        _known_angle(driver, operator, joint, measured, KNOWN_ANGLE_RAD if with_stops else LONG_ANGLE_RAD)
        _allow(
            operator,
            joint,
            f"{'makes a few motor turns to find the index, then ' * measured.has_index}moves back and forth to measure friction",
            0.5,
        )
        if measured.has_index:
            measure_index_spacing(driver, measured)
        _friction(driver, measured)
        if with_stops:
            ends = "end stops" if driver.drive.limit_switches is None else "ends, until a limit switch or a stop"
            _allow(operator, joint, f"creeps to both {ends}; its whole range must be clear", None)
            _stops(driver, operator, joint, measured, speed_rad_s)
    finally:
        operator.let_go()
    return measured


def _allow(operator: BringupOperator, joint: int, what: str, travel_rad: float | None) -> None:
    way = f", at most {math.degrees(travel_rad):.0f} deg" if travel_rad else ""
    if not operator.allow(f"Joint {joint} {what}{way}."):
        raise Stopped(f"the operator did not confirm the motion of joint {joint}")


def _known_angle(driver: JointDriver, operator: BringupOperator, joint: int, measured: JointMeasurements, by_rad: float) -> None:
    """Read, turn by the draft's scale, read again: this reveals a wrong scale before a long motion."""
    _read(driver, operator, joint, measured)
    _allow(operator, joint, "turns in its supposed positive direction", by_rad)
    start_rad = driver.where_rad()
    if abs(_turned(driver, measured, by_rad)) < 0.8 * by_rad:
        _turned(driver, measured, -2.0 * by_rad)  # there was an obstacle
    _read(driver, operator, joint, measured)
    if _is_odd(measured):
        _turned(driver, measured, 0.5 * (start_rad - driver.where_rad()))
        _read(driver, operator, joint, measured)
    _turned(driver, measured, start_rad - driver.where_rad())
    _take_scale(driver, measured)


def _turned(driver: JointDriver, measured: JointMeasurements, distance_rad: float) -> float:
    run = driver.turn(distance_rad, 0.2)
    _note_flags(run, measured)
    return run.travelled_rad


def _note_flags(run: DrivenMotion, measured: JointMeasurements) -> None:
    for flags in run.flags:
        measured.flags |= flags & (QUADRATURE_ERROR | SIGNAL_LOST)


def has_two_indices(drive: Drive) -> bool:
    """Whether the joint turns from one index pulse to the next: not always, where the encoder is on the joint."""
    range_rad = drive.joint_upper_rad - drive.joint_lower_rad
    return drive.encoder_on == "motor" or range_rad > INDEX_TURNS * drive.encoder_turn_rad


def measure_index_spacing(driver: JointDriver, measured: JointMeasurements) -> None:
    """Index pulses in the positive direction, or in the negative one if the joint is blocked."""
    if not has_two_indices(driver.drive):
        return
    start_rad = driver.where_rad()
    longest_rad = INDEX_TURNS * driver.drive.encoder_turn_rad
    for direction in (1, -1):
        latches = driver.latches(LATCHES, direction, INDEX_SPEED_rad_s, longest_rad)
        # A joint that sinks while its index is armed passes the same pulse again.
        spacings = [abs(b - a) for a, b in pairwise(latches) if abs(b - a) > SAME_PULSE_counts]
        if len(spacings) > len(measured.spacings_count):
            measured.spacings_count = spacings
        if len(spacings) >= 2:
            break
    driver.go_to(start_rad, 0.2)


def _friction(driver: JointDriver, measured: JointMeasurements) -> None:
    """Constant-speed passes over the same place in both directions, so that gravity is the same."""
    for speed_rad_s in PASS_SPEEDS_rad_s:
        length_rad = max(PASS_RAD, PASS_S * speed_rad_s)
        for direction in (1.0, -1.0):
            run = driver.turn(direction * length_rad, speed_rad_s)
            _note_flags(run, measured)
            if run.end is not MotionEnd.REACHED:
                measured.stalled_early = True
                continue
            steady = _steady(run, driver.scale)
            if steady is not None:
                measured.passes.append(steady)


def _steady(run: DrivenMotion, scale: float) -> SteadyPass | None:
    """Means over the middle of the pass; None if a limit of the board was active there."""
    begin_rad = run.rows[0][1]
    lower, upper = (part * abs(run.travelled_rad) for part in MIDDLE)
    middle = [k for k, row in enumerate(run.rows) if lower <= abs(row[1] - begin_rad) <= upper]
    rows = [run.rows[k] for k in middle if not run.limited[k]]
    if len(rows) < max(10, FREE_SHARE * len(middle)):
        return None
    span_s = rows[-1][0] - rows[0][0]
    speed = (rows[-1][1] - rows[0][1]) / span_s if span_s > 0.0 else math.nan
    return SteadyPass(speed / scale, fmean(row[3] for row in rows), fmean(row[4] for row in rows))


def _read(driver: JointDriver, operator: BringupOperator, joint: int, measured: JointMeasurements) -> None:
    where_rad = driver.where_rad() / driver.scale
    reading_rad = operator.angle_rad(joint)
    if reading_rad is not None:
        measured.readings.append((where_rad, reading_rad))


def _is_odd(measured: JointMeasurements) -> bool:
    """Whether two readings give another scale than the draft; then a third reading reveals a misread one."""
    if len(measured.readings) < 2:
        return False
    (x0, q0), (x1, q1) = measured.readings[0], measured.readings[-1]
    return abs(q1 - q0 - (x1 - x0)) > ODD_RATIO * abs(x1 - x0)


def _take_scale(driver: JointDriver, measured: JointMeasurements) -> None:
    """Use the measured scale: with a wrong scale the joint must not be driven over its whole range."""
    if len(measured.readings) >= 2:
        (x0, q0), (x1, q1) = measured.readings[0], measured.readings[-1]
        if abs(x1 - x0) > 0.1 and abs(q1 - q0) > 0.02:
            driver.scale = abs((q1 - q0) / (x1 - x0))


def _stops(driver: JointDriver, operator: BringupOperator, joint: int, measured: JointMeasurements, speed_rad_s: float) -> None:
    start_rad = driver.where_rad()
    drive = driver.drive
    range_rad = drive.joint_upper_rad - drive.joint_lower_rad
    longest_rad = 1.3 * range_rad + 0.3 if math.isfinite(range_rad) else 2.2 * math.pi
    for at, direction in enumerate((-1.0, 1.0)):
        run = _creep(driver, measured, direction * longest_rad, speed_rad_s)
        if run.end is MotionEnd.LIMIT:  # once: its level is looked at now and then, so touches differ
            measured.has_limit[at] = True
            measured.stops_rad[at].append(run.rows[-1][1] / driver.scale)
            _creep(driver, measured, -direction * BACK_OFF_RAD, TOUCH_SPEED_rad_s)
            _read(driver, operator, joint, measured)
        if run.end is MotionEnd.STALLED:
            measured.stops_rad[at].append(driver.where_rad() / driver.scale)
            for _ in range(TOUCHES - 1):
                _creep(driver, measured, -direction * BACK_OFF_RAD, TOUCH_SPEED_rad_s)
                again = _creep(driver, measured, 2.0 * direction * BACK_OFF_RAD, TOUCH_SPEED_rad_s)
                if again.end is MotionEnd.STALLED:
                    measured.stops_rad[at].append(driver.where_rad() / driver.scale)
            _creep(driver, measured, -direction * 0.02, TOUCH_SPEED_rad_s)  # the joint is read free of the stop
            _read(driver, operator, joint, measured)
    # Once more over the whole range: this reveals a small slip per turn.
    if all(measured.stops_rad) and _creep(driver, measured, -longest_rad, speed_rad_s).end is MotionEnd.STALLED:
        measured.stops_rad[0].append(driver.where_rad() / driver.scale)
    _creep(driver, measured, start_rad - driver.where_rad(), speed_rad_s)


def _creep(driver: JointDriver, measured: JointMeasurements, distance_rad: float, speed_rad_s: float) -> DrivenMotion:
    """A slow motion that records the home switch and, in the search direction, the index behind it.

    The joint stops at the switch only where the index is to be armed, which requires an answer of the board.
    """
    direction = 1 if distance_rad > 0.0 else -1
    left_rad = abs(distance_rad)
    while True:
        run = driver.turn(direction * left_rad, speed_rad_s, _index_is_next(driver, measured, direction))
        _note_flags(run, measured)
        left_rad -= abs(run.travelled_rad)
        if run.end is not MotionEnd.SEEN:
            return run
        left_rad -= _index_behind(driver, measured, direction)
        if left_rad <= 0.0:
            return run


def _index_is_next(driver: JointDriver, measured: JointMeasurements, direction: int) -> Callable[[DrivenMotion, object], bool]:
    """Records each change of the home switch; true at the one behind which the index is looked for."""
    home = driver.drive.home
    forth = 1 if home is None else round(home.sense)

    def is_next(run: DrivenMotion, sample: object) -> bool:
        is_active = bool(run.flags[-1] & HOME_SWITCH)
        if is_active not in measured.is_home_active:
            measured.is_home_active.append(is_active)
        if len(run.flags) < 2 or bool(run.flags[-2] & HOME_SWITCH) == is_active:
            return False
        edge_rad = _edge(run) / driver.scale
        measured.edges.append((edge_rad, direction, is_active))
        if not is_active or direction != forth:
            return False
        if not measured.has_index:
            measured.index_rad = edge_rad
        return math.isnan(measured.index_rad)

    return is_next


def _edge(run: DrivenMotion) -> float:
    """Angle of the switch edge, between the two cycles around it; the braking distance does not count."""
    return 0.5 * (run.rows[-1][1] + run.rows[-2][1])


def _index_behind(driver: JointDriver, measured: JointMeasurements, direction: int) -> float:
    """Find the first index pulse after the switch; return the distance.

    A joint that sinks while the index is armed passes it: the pulses lie whole turns of the encoder apart.
    """
    before_rad = driver.where_rad()
    drive, is_alone = driver.drive, not has_two_indices(driver.drive)
    way_rad = drive.joint_upper_rad - drive.joint_lower_rad if is_alone else 2.2 * drive.encoder_turn_rad
    latches = driver.latches(1, direction, INDEX_SPEED_rad_s, way_rad * max(1.0, driver.scale))
    if latches and is_alone:
        measured.index_rad = driver.angle_rad(latches[0]) / driver.scale
    elif latches and measured.spacings_count:
        edge_rad, _, _ = measured.edges[-1]
        behind_rad = direction * (driver.angle_rad(latches[0]) / driver.scale - edge_rad)
        turn_rad = median(measured.spacings_count) * driver.radians_per_count / driver.scale
        measured.index_rad = edge_rad + direction * (behind_rad % turn_rad)
    return abs(driver.where_rad() - before_rad)

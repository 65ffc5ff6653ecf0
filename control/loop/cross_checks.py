"""Cross-checks of each cycle: motors against encoders, torques against the model, supply, current, temperature.

`control.loop.watch` compares measured values with what was wanted. Here they are compared with each other, so that an encoder
or a board that is wrong and plausible is found.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from control.dynamics.feedforward import Motor
from control.hardware.interface import HOME_SWITCH, WARNING, Feedback
from control.safety.modes import Fault, Reaction
from control.safety.motor_checks import Lasting, SpeedCheck, TorqueCheck

LASTS_S = 0.02  # of a value outside of its limits: ten cycles at 500 Hz
FRESH_REPLY, FRESH_COUNT = (1.5, 3.0)  # cycles; older values are of another moment than the voltage that was sent
OPEN_CURRENT = 1.5  # of the current limit, where boards trip


@dataclass(frozen=True, slots=True)
class CrossCheckLimits:
    """Limits of an arm, from [limits]: see docs/safety.md."""

    speed_contradiction_rad_s: float
    unexplained_torque: float  # share of the torque at the current limit
    supply_low: float  # shares of the drive's supply_V
    supply_high: float
    temperature_degC: float


class Joint:
    """The checks of one joint."""

    __slots__ = ("current", "motor", "name", "speed", "supply", "temperature", "torque", "was_outside")

    def __init__(self, name: str, motor: Motor, limits: CrossCheckLimits) -> None:
        self.name, self.motor = name, motor
        self.speed = SpeedCheck(motor, limits.speed_contradiction_rad_s)
        self.torque = TorqueCheck(limits.unexplained_torque * motor.current_limit_A)
        most_A = OPEN_CURRENT * motor.current_limit_A
        self.current = Lasting(-most_A, most_A, LASTS_S)
        self.supply = Lasting(limits.supply_low * motor.supply_V, limits.supply_high * motor.supply_V, LASTS_S)
        self.temperature = Lasting(-math.inf, limits.temperature_degC, LASTS_S)
        self.was_outside = False

    def limits_passed(self, elapsed_s: float, supply_V: float, current_A: float, temperature_degC: float) -> list[Fault]:
        """The limits that a cycle's values have passed for long enough; notes whether any is outside."""
        faults = []
        if not self.supply.update(elapsed_s, supply_V):
            faults.append(_of_supply(self, supply_V))
        if not self.current.update(elapsed_s, current_A):
            faults.append(_of_current(self, current_A))
        if not self.temperature.update(elapsed_s, temperature_degC):
            faults.append(_of_temperature(self, temperature_degC))
        self.was_outside = self.supply.is_pending or self.current.is_pending or self.temperature.is_pending
        return faults


class CrossChecks:
    """The checks of all joints; `look` costs some microseconds a cycle and builds texts for faults only."""

    def __init__(self, motors: Sequence[Motor], limits: CrossCheckLimits, names: Sequence[str]) -> None:
        self._joints = tuple(Joint(name, motor, limits) for name, motor in zip(names, motors, strict=True))

    def forget(self) -> None:
        """Start anew, after a time in which the loop did not look."""
        for joint in self._joints:
            joint.speed.forget()
            joint.torque.forget()

    def forget_speeds(self) -> None:
        """Start anew with the motors' speeds: after missed deadlines, current and speed are of different moments."""
        for joint in self._joints:
            joint.speed.forget()

    def look(
        self, now_s: float, elapsed_s: float, feedback: Feedback, speed_rad_s: Sequence[float], model_A: Sequence[float] | None
    ) -> list[Fault]:
        """Return the contradictions of this cycle. `model_A`: currents that the model expects; None: it expects nothing."""
        faults: list[Fault] = []
        for number, joint in enumerate(self._joints):
            supply_V, current_A = feedback.supply_V[number], feedback.current_A[number]
            temperature = feedback.temperature_C[number]
            # Almost every value is inside: comparisons are cheaper than three calls.
            supply, current, warmth = joint.supply, joint.current, joint.temperature
            if joint.was_outside or not (
                supply.lower <= supply_V <= supply.upper
                and current.lower <= current_A <= current.upper
                and warmth.lower <= temperature <= warmth.upper
            ):
                faults += joint.limits_passed(elapsed_s, supply_V, current_A, temperature)
            if (
                now_s - feedback.reply_at_s[number] > FRESH_REPLY * elapsed_s
                or now_s - feedback.reported_at_s[number] > FRESH_COUNT * elapsed_s
            ):
                joint.speed.forget()  # current, voltage and speed are of different moments
                continue
            sent_V = math.nan if feedback.statusword[number] & WARNING else feedback.sent_V[number]
            supply_off = abs(supply_V / joint.motor.supply_V - 1.0)
            if not joint.speed.update(elapsed_s, sent_V, current_A, speed_rad_s[number], supply_off):
                faults.append(_of_speed(joint, speed_rad_s[number]))
            if model_A is None:
                joint.torque.forget()
            elif not joint.torque.update(elapsed_s, current_A, model_A[number]):
                faults.append(_of_torque(joint))
        return faults


def _of_speed(joint: Joint, speed_rad_s: float) -> Fault:
    check = joint.speed
    return Fault(
        "encoder_contradicted",
        joint.name,
        f"its encoder says {speed_rad_s:.3f} rad/s, its motor's voltage and current say"
        f" {speed_rad_s + check.excess_rad_s:.3f} rad/s (difference allowed {check.allowed_rad_s:.3f} rad/s)",
        "check the encoder's cable and coupling and the motor's wires, then home again; at the first start also"
        " resistance_ohm, torque_constant_Nm_A and the signs in arm.toml",
        Reaction.BRAKE,
    )


def _of_torque(joint: Joint) -> Fault:
    check, newton_metres = joint.torque, 1.0 / joint.motor.amperes_per_Nm
    return Fault(
        "unexplained_torque",
        joint.name,
        f"its motor gives {abs(check.excess_A) * newton_metres:.1f} N m that weight and motion do not explain"
        f" (limit {check.allowed_A * newton_metres:.1f} N m)",
        "check for a collision, the payload that is stated, gear_ratio and the masses in arm.toml",
        Reaction.CONTROLLED,
    )


def _of_supply(joint: Joint, supply_V: float) -> Fault:
    message = f"its drive's supply is {supply_V:.1f} V (limits {joint.supply.lower:.1f} to {joint.supply.upper:.1f} V)"
    remedy = "check the supply, the emergency-stop switch and the brake resistor"
    return Fault("supply", joint.name, message, remedy, Reaction.BRAKE)


def _of_current(joint: Joint, current_A: float) -> Fault:
    message = f"its motor draws {current_A:.1f} A (limit {joint.current.upper:.1f} A)"
    remedy = "check for a blocked joint or a short circuit, and the board's current limit"
    return Fault("over_current", joint.name, message, remedy, Reaction.BRAKE)


def _of_temperature(joint: Joint, at_degC: float) -> Fault:
    message = f"its drive's power stage is at {at_degC:.0f} degC (limit {joint.temperature.upper:.0f} degC)"
    remedy = "let it cool; check the load and the fan"
    return Fault("over_temperature", joint.name, message, remedy, Reaction.CONTROLLED)


class MotorCountWatch:
    """Compares how far a joint has turned by its encoder board and by its motor board's own encoder.

    The boards stop and hold by theirs when the loop is gone, so it must be alive and count the right way.
    """

    LEAST_counts = 16
    SHARE = 0.25
    LATE_S = 0.007  # within which a board answers

    def __init__(
        self, counts_per_radian: Sequence[float], counter_bits: Sequence[int], names: Sequence[str], has_two: Sequence[bool] = ()
    ) -> None:
        """`counter_bits`: width of the encoder boards' counters; the motor boards have 32. `has_two`: see LeadWatch."""
        self._has_two = tuple(has_two) or (False,) * len(names)
        self._counts_per_radian = tuple(abs(value) for value in counts_per_radian)
        self._bits = tuple(counter_bits)
        self._names = names
        self._last: list[tuple[int, int, float] | None] = [None] * len(names)

    def forget(self) -> None:
        """Start anew: a board was off."""
        self._last = [None] * len(self._last)

    def look(self, pairs: Sequence[tuple[int, int, int]], speed_rad_s: Sequence[float]) -> list[Fault]:
        """Return a fault for each (joint, count, motor board's count) that has turned otherwise since its last one."""
        faults = []
        for joint, count, motor_count in pairs:
            if self._has_two[joint]:
                continue
            speed_counts_s = abs(speed_rad_s[joint]) * self._counts_per_radian[joint]
            last = self._last[joint]
            self._last[joint] = (count, motor_count, speed_counts_s)
            if last is None:
                continue
            motor_turned = _wrapped(motor_count - last[1], 32)
            off = _wrapped(count - last[0] - motor_turned, self._bits[joint])
            late = self.LATE_S * max(speed_counts_s, last[2])
            if abs(off) > self.LEAST_counts + self.SHARE * abs(motor_turned) + late:
                faults.append(_of_counts(self._names[joint], motor_turned + off, motor_turned))
        return faults


class LeadWatch:
    """Compares motor and joint where both have an encoder: however they turn, play and springs let them differ by so much.

    Nothing may add up, so a slow drift or a slip of either encoder is found, too.
    """

    LATE_S = MotorCountWatch.LATE_S

    def __init__(self, slack_rad: float, names: Sequence[str]) -> None:
        self._slack_rad, self._names = slack_rad, names
        self.forget()

    def forget(self) -> None:
        """Start anew: a board was off."""
        self._least_rad = [math.inf] * len(self._names)
        self._most_rad = [-math.inf] * len(self._names)

    def look(self, lead_rad: Sequence[float], speed_rad_s: Sequence[float]) -> list[Fault]:
        """Return a fault for each joint whose motor was ahead and behind by more than that together. NaN: not seen now."""
        faults = []
        for joint, lead in enumerate(lead_rad):
            if lead != lead:
                continue
            late_rad = self.LATE_S * abs(speed_rad_s[joint])  # the two counts are of moments so far apart at most
            self._least_rad[joint] = min(self._least_rad[joint], lead + late_rad)
            self._most_rad[joint] = max(self._most_rad[joint], lead - late_rad)
            if self._most_rad[joint] - self._least_rad[joint] > self._slack_rad:
                faults.append(self._of_lead(joint))
        return faults

    def _of_lead(self, joint: int) -> Fault:
        differed_rad = self._most_rad[joint] - self._least_rad[joint]
        return Fault(
            "encoders_differ",
            self._names[joint],
            f"its motor and the joint have turned {differed_rad:.4f} rad apart by their encoders"
            f" (limit {self._slack_rad:.4f} rad)",
            "check both encoders' couplings and cables, the belt and the gear's screws, then home again; if the gear is as loose"
            " or soft as that, set [limits] transmission_slack_rad",
            Reaction.BRAKE,
        )


def _wrapped(count: int, bits: int) -> int:
    half = 1 << (bits - 1)
    return (count + half) % (2 * half) - half


def _of_counts(where: str, turned: int, motor_turned: int) -> Fault:
    return Fault(
        "encoders_differ",
        where,
        f"its encoder board has counted {turned}, its motor board {motor_turned} in the same time",
        "check the encoder's plugs at both boards and the motor's leads, then home again; board_holds = false in arm.toml"
        " leaves out a motor board without an encoder",
        Reaction.BRAKE,
    )


@dataclass(frozen=True, slots=True)
class SwitchPlace:
    """A joint's home switch: active beyond `switch_rad` in the direction `sense` (1 or -1), which is good to `tolerance_rad`."""

    name: str
    switch_rad: float
    sense: float
    tolerance_rad: float


class SwitchWatch:
    """Compares each home switch with the side on which its joint is: an encoder that slipped on its shaft, with its index."""

    def __init__(self, places: Sequence[SwitchPlace | None]) -> None:
        self._places = tuple(places)
        self._lasting = tuple(Lasting(0.0, 0.0, LASTS_S) for _ in places)

    def look(self, elapsed_s: float, q_rad: Sequence[float], channel_flags: Sequence[int]) -> list[Fault]:
        """Return a fault for each joint that is clearly on one side of its switch while the switch says the other."""
        faults = []
        for joint, place in enumerate(self._places):
            if place is None:
                continue
            beyond_rad = (q_rad[joint] - place.switch_rad) * place.sense
            is_active = bool(channel_flags[joint] & HOME_SWITCH)
            wrong_rad = -beyond_rad if is_active else beyond_rad
            is_right, lasting = wrong_rad <= place.tolerance_rad, self._lasting[joint]
            if is_right and not lasting.is_pending:
                continue
            if not lasting.update(elapsed_s, 0.0 if is_right else 1.0):
                faults.append(_of_switch(place, q_rad[joint], is_active))
        return faults


def _of_switch(place: SwitchPlace, q_rad: float, is_active: bool) -> Fault:
    return Fault(
        "switch_off",
        place.name,
        f"it is at {q_rad:.3f} rad by its encoder, but its home switch, which changes at {place.switch_rad:.3f} rad"
        f" (tolerance {place.tolerance_rad:.3f} rad), is {'active' if is_active else 'not active'}",
        "check the encoder's coupling on its shaft and the switch, then home again",
        Reaction.CONTROLLED,
    )


class IndexWatch:
    """Compares each index pulse with the one that belongs there: an encoder that lost or gained counts is found in a turn.

    The reference of a joint is its index in arm.toml, or the first pulse after its zero became known.
    """

    TOLERANCE_turns = 0.02  # of the motor: an index is some counts wide, and the two sides differ
    LEAST_counts = 4

    def __init__(
        self,
        counts_per_turn: Sequence[int],
        index_count: Sequence[int | None],
        unwrapped: Callable[[int, int], int],
        names: Sequence[str],
    ) -> None:
        """`unwrapped(joint, count)` unwraps a raw count from near the present position."""
        self._counts_per_turn, self._given = tuple(counts_per_turn), tuple(index_count)
        self._unwrapped, self._names = unwrapped, names
        self._reference = list(index_count)

    def forget(self) -> None:
        """The zero is not known, or is a new one."""
        self._reference = list(self._given)

    def look(self, passed: Sequence[tuple[int, int]]) -> list[Fault]:
        """Return a fault for each pulse (joint, raw count) that came elsewhere than it should."""
        faults = []
        for joint, raw_count in passed:
            count, turn = self._unwrapped(joint, raw_count), self._counts_per_turn[joint]
            reference = self._reference[joint]
            if reference is None:
                self._reference[joint] = count
                continue
            off = (count - reference + turn // 2) % turn - turn // 2
            allowed = max(self.LEAST_counts, round(self.TOLERANCE_turns * turn))
            if abs(off) > allowed:
                faults.append(self._slipped(joint, off, allowed))
        return faults

    def _slipped(self, joint: int, off: int, allowed: int) -> Fault:
        return Fault(
            "index_off",
            self._names[joint],
            f"its index pulse came {abs(off)} counts from its place (allowed {allowed}): its zero is not valid any more",
            "check the encoder's coupling, cable and shield, encoder_counts_per_rev and [drive.home] in arm.toml, then"
            " home again",
            Reaction.CONTROLLED,
        )


@dataclass(frozen=True, slots=True)
class LimitSwitch:
    """A switch at an end of a joint's range (0-based). `side`: 1 at the upper end, -1 at the lower.

    The level is that of a pin, by name, or of a flag of the joint's channel. It changes at one place, good to `edge_rad`.
    """

    joint: int
    name: str
    pin: str
    side: float
    is_active_high: bool
    is_home: bool  # homing seeks it
    edge_rad: float
    flag: int = 0

    def is_active(self, levels: Mapping[str, bool | None], channel_flags: Sequence[int]) -> bool | None:
        """Whether it is active; None while its board does not say."""
        level = bool(channel_flags[self.joint] & self.flag) if self.flag else levels[self.pin]
        return level if level is None else level is self.is_active_high


class MetSwitch:
    """Which way an active limit switch bars: that in which its joint met it, whatever arm.toml says of its side.

    So a switch that is wired to the other end stops its joint, too, and lets it back out, and stays known as such while the
    runtime lives. That takes a joint that went this way for longer than the switch's place is uncertain. One that met it just
    after it had turned round may have gone either way: both are barred until its drives were off. A switch that was active from
    the start is taken at its word. Where it was left it may chatter: it is met there in the same direction.
    """

    __slots__ = ("_at_rad", "_from_rad", "_was_active", "_way", "is_doubtful", "is_elsewhere", "switch")

    def __init__(self, switch: LimitSwitch) -> None:
        self.switch = switch
        self.is_elsewhere = False  # at the other end
        self.forget()

    def forget(self) -> None:
        """Nobody looked: the joint was moved otherwise, or has another zero."""
        self.is_doubtful, self._was_active, self._at_rad = False, True, math.nan
        self._way, self._from_rad = 0.0, math.nan

    def follow(self, is_active: bool, q_rad: float, speed_set_rad_s: float) -> None:
        """Take a cycle's level."""
        if speed_set_rad_s * self._way <= 0.0 and speed_set_rad_s != 0.0:  # it turns round
            self._way, self._from_rad = math.copysign(1.0, speed_set_rad_s), q_rad
        if is_active:
            is_met = not self._was_active and not abs(q_rad - self._at_rad) <= self.switch.edge_rad
            if is_met and speed_set_rad_s != 0.0:
                is_elsewhere = self._way != self.switch.side
                if (q_rad - self._from_rad) * self._way > self.switch.edge_rad:
                    self.is_elsewhere, self.is_doubtful = is_elsewhere, False
                else:
                    self.is_doubtful = is_elsewhere is not self.is_elsewhere
            self._at_rad = q_rad
        self._was_active = is_active

    def bars(self, speed_rad_s: float) -> bool:
        """Whether a joint may not move this way while it is active."""
        if self.is_doubtful:
            return speed_rad_s != 0.0
        return speed_rad_s * self.switch.side * (-1.0 if self.is_elsewhere else 1.0) > 0.0


class LimitSwitchWatch:
    """Stops what moves further into an active limit switch, or towards one that nobody knows of; out of it, everything goes."""

    def __init__(self, switches: Sequence[LimitSwitch]) -> None:
        self.are_there = bool(switches)
        self._met = tuple(MetSwitch(switch) for switch in switches)
        self._homes = tuple(switch for switch in switches if switch.is_home)

    def mark_homes(self, levels: Mapping[str, bool | None], channel_flags: list[int]) -> None:
        """Let the limit switches that homing seeks be the home switches of their joints."""
        for switch in self._homes:
            if switch.is_active(levels, channel_flags):
                channel_flags[switch.joint] |= HOME_SWITCH

    def forget(self) -> None:
        """Start anew: the set-point did not say where the joints go."""
        for met in self._met:
            met.forget()

    def look(
        self,
        levels: Mapping[str, bool | None],
        channel_flags: Sequence[int],
        q_rad: Sequence[float],
        speed_set_rad_s: Sequence[float],
        is_homing: bool,
    ) -> list[Fault]:
        """Return a fault for each joint whose set-point moves further into a switch, unless homing seeks that end."""
        faults = []
        for met in self._met:
            switch = met.switch
            is_active, speed_rad_s = switch.is_active(levels, channel_flags), speed_set_rad_s[switch.joint]
            if is_active is None:
                if speed_rad_s * switch.side > 0.0:
                    faults.append(_of_limit(switch, "whose board does not say whether it is active"))
                continue
            met.follow(is_active, q_rad[switch.joint], speed_rad_s)
            is_sought = is_homing and switch.is_home and not met.is_elsewhere and not met.is_doubtful
            if is_active and met.bars(speed_rad_s) and not is_sought:
                faults.append(_of_limit(switch, _says(met)))
        return faults


def _says(met: MetSwitch) -> str:
    if met.is_doubtful:
        return "met as it turned round: which way leads out is not known; switch the drives off and on, then jog it out"
    return "which seems to be wired to the other end" if met.is_elsewhere else "which is active"


def _of_limit(switch: LimitSwitch, says: str) -> Fault:
    end = "upper" if switch.side > 0.0 else "lower"
    return Fault(
        "limit_switch",
        switch.name,
        f"it moved towards its {end} limit switch ({switch.pin}), {says}",
        "jog it the other way; if it is not at its end, check the switch and its wire, the joint's zero and its limits in"
        " arm.toml",
        Reaction.CONTROLLED,
    )

"""Monitoring of each cycle: measured values against limits; each violation is a fault with a remedy.

Three reactions (control.safety.modes): if the feedback is good, a controlled stop and hold; if the loop has lost it and the
motor boards have not, they stop and hold by themselves; if it cannot be trusted, the windings are shorted on all joints.
Order matters only for the operator: the first finding is usually the cause.
"""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from control.hardware.interface import OPERATION_ENABLED, QUADRATURE_ERROR, SIGNAL_LOST, STATE_MASK, ZERO_SET, Feedback
from control.motion.setpoint import JointState
from control.safety.limits import allowed_lag, is_stale, overrun
from control.safety.modes import Fault, Reaction

DRIVE_FAULTS = {
    0: ("over-current", "check for a blocked joint or a short circuit; reduce the acceleration"),
    1: ("over-temperature", "let it cool; check the load and the fan"),
    2: ("supply too low", "check the supply and the emergency-stop switch"),
    3: ("supply too high", "a braking motor feeds the supply: add a brake resistor"),
    4: ("watchdog", "the board received no command in time: check for late cycles, and the CAN cable"),
    5: ("its encoder, or it did not follow", "check the motor encoder's cable at the drive, and for a blocked joint"),
    6: ("bad command", "firmware and program do not match: compare protocol versions"),
    7: ("emergency stop", "release the emergency stop when it is safe"),
}


@dataclass(frozen=True, slots=True)
class MeasuredLimits:
    """Limits of one joint's measured values.

    Allowed following error = base + `control.safety.limits.allowed_lag`.
    """

    lower_rad: float
    upper_rad: float
    range_margin_rad: float
    speed_rad_s: float
    following_error_rad: float
    following_error_per_speed_s: float

    def holds(self, q_rad: float, q_set_rad: float) -> bool:
        """Whether the joint is inside its range and margin. A joint taken out of it by hand may be held there, but no further."""
        lower = min(self.lower_rad, q_set_rad) - self.range_margin_rad
        upper = max(self.upper_rad, q_set_rad) + self.range_margin_rad
        return lower <= q_rad <= upper


@dataclass(frozen=True, slots=True)
class WatchLimits:
    """Limits of the whole arm: age of the boards' values, and cycles missed in a row.

    `stale_s` limits the age in time that the host attended to: its own pauses do not make a board silent. `silent_s` limits
    the age by the clock, pauses and all.
    """

    joints: tuple[MeasuredLimits, ...]
    stale_s: float
    silent_s: float
    missed_in_row: int


class Expectation(NamedTuple):
    """What the loop expects in this cycle. A named tuple, because one is created every cycle (0.5 us faster)."""

    are_drives_enabled: bool
    is_homed: bool
    is_servoing: bool


class Watch:
    """Compares a cycle's feedback with its limits.

    Almost every cycle is fault-free, so plain comparisons come first, and messages are built only for faults. Each
    comparison is written so that NaN is a fault.
    """

    def __init__(self, limits: WatchLimits, joint_names: Sequence[str]) -> None:
        self._limits = limits
        self._names = joint_names
        self._lag_rad = [0.0] * len(limits.joints)
        self._lag_at_s = -math.inf
        self._pauses: deque[tuple[float, float]] = deque()  # (when the host was back, how long it was away)
        self._waited: tuple[float, float] = (-math.inf, 0.0)  # the same of the loop's last wait for a board

    def note_pause(self, now_s: float, away_s: float) -> None:
        """Note that the host itself was away until now: the silence of the boards meanwhile is not theirs."""
        self._pauses.append((now_s, away_s))
        while self._pauses[0][0] < now_s - self._limits.silent_s:
            self._pauses.popleft()

    def note_wait(self, now_s: float, waited_s: float) -> None:
        """Note that the loop has asked nobody but one board until now, however long that took."""
        self._waited = (now_s, waited_s)

    def age_s(self, now_s: float, at_s: float) -> float:
        """Age of a value, without the pauses of the host since it came."""
        back_s, waited_s = self._waited
        age_s = now_s - at_s - (waited_s if back_s > at_s else 0.0)
        if age_s > self._limits.silent_s or not self._pauses:
            return age_s
        return age_s - sum(away_s for back_s, away_s in self._pauses if back_s > at_s)

    def is_stale(self, now_s: float, at_s: float) -> bool:
        """Whether a board's values are too old. NaN, and none at all, are."""
        limit_s = self._limits.stale_s
        return is_stale(now_s, at_s, limit_s) and not self.age_s(now_s, at_s) <= limit_s

    def look(
        self, now_s: float, feedback: Feedback, measured: JointState, aim: JointState, missed_in_row: int, expected: Expectation
    ) -> list[Fault]:
        """Return all faults of this cycle, the most likely cause first.

        `aim`: what the encoders should say; `missed_in_row`: 0 where nothing is controlled.
        """
        self._allow_lag(now_s, aim.speed_rad_s)
        is_in_order = (
            self._are_boards_well(now_s, feedback, expected)
            and missed_in_row <= self._limits.missed_in_row
            and (not expected.is_servoing or self._is_motion_well(measured, aim.q_rad, expected.is_homed))
        )
        if is_in_order:
            return []
        faults = self._boards(now_s, feedback, expected)
        if faults:
            return faults
        if expected.is_servoing:
            for joint in range(len(self._limits.joints)):
                faults += self._motion(joint, measured, aim, expected.is_homed)
        if missed_in_row > self._limits.missed_in_row:
            faults.append(self._late(missed_in_row))
        return faults

    def _allow_lag(self, now_s: float, speed_set_rad_s: Sequence[float]) -> None:
        elapsed_s, self._lag_at_s = now_s - self._lag_at_s, now_s
        self._lag_rad = [
            allowed_lag(speed, limit.following_error_per_speed_s, before_rad, elapsed_s)
            for speed, limit, before_rad in zip(speed_set_rad_s, self._limits.joints, self._lag_rad, strict=True)
        ]

    def miscounts(self, leap_rad: Sequence[float], has_lost_turns: Sequence[bool], is_homed: bool) -> list[Fault]:
        """A fault for each joint whose count changed faster than its motor can turn, or may have wrapped unseen."""
        faults = self._leaps(leap_rad) if any(leap_rad) else []
        return faults + self._lost_turns(has_lost_turns) if is_homed and True in has_lost_turns else faults

    def _leaps(self, leap_rad: Sequence[float]) -> list[Fault]:
        return [
            Fault(
                "encoder_leap",
                self._names[joint],
                f"its encoder jumped by {leap:.4f} rad between two reports, faster than its motor can turn",
                "check the encoder's coupling, cable and shield, then home again",
                Reaction.BRAKE,
            )
            for joint, leap in enumerate(leap_rad)
            if leap
        ]

    def _lost_turns(self, has_lost: Sequence[bool]) -> list[Fault]:
        return [
            Fault(
                "zero_lost",
                self._names[joint],
                "no report came for so long that its counter may have wrapped unseen",
                "check the encoder board's cable and supply, then home again",
                Reaction.HOLD,
            )
            for joint, lost in enumerate(has_lost)
            if lost
        ]

    def _are_boards_well(self, now_s: float, feedback: Feedback, expected: Expectation) -> bool:
        oldest_s = now_s - self._limits.stale_s
        wanted_flags = ZERO_SET if expected.is_homed else 0
        flags_mask = SIGNAL_LOST | (ZERO_SET | QUADRATURE_ERROR if expected.is_homed else 0)
        if not feedback.encoder_at_s >= oldest_s and self.is_stale(now_s, feedback.encoder_at_s):
            return False
        for flags in feedback.channel_flags:
            if flags & flags_mask != wanted_flags:
                return False
        for replied_s in feedback.reply_at_s:
            if not replied_s >= oldest_s and self.is_stale(now_s, replied_s):
                return False
        if expected.are_drives_enabled:
            for word, fault_bits in zip(feedback.statusword, feedback.drive_faults, strict=True):
                if fault_bits or word & STATE_MASK != OPERATION_ENABLED:
                    return False
        return True

    def _is_motion_well(self, measured: JointState, q_set_rad: Sequence[float], is_homed: bool) -> bool:
        joints = zip(self._limits.joints, measured.q_rad, measured.speed_rad_s, q_set_rad, self._lag_rad, strict=True)
        for limit, q, speed, q_set, lag_rad in joints:
            if not (
                abs(speed) <= limit.speed_rad_s
                and abs(q_set - q) <= limit.following_error_rad + lag_rad
                and (not is_homed or limit.lower_rad <= q <= limit.upper_rad or limit.holds(q, q_set))
            ):
                return False
        return True

    def _boards(self, now_s: float, feedback: Feedback, expected: Expectation) -> list[Fault]:
        """Return the faults of boards and encoders."""
        faults: list[Fault] = []
        if self.is_stale(now_s, feedback.encoder_at_s):
            late = [self.is_stale(now_s, at_s) for at_s in feedback.reported_at_s]
            joints = ", ".join(name for name, is_late in zip(self._names, late, strict=True) if is_late)
            faults.append(_silent_encoder(joints, now_s - feedback.encoder_at_s, self._limits.stale_s))
        for joint in range(feedback.joint_count):
            faults += self._drive(joint, now_s, feedback, expected)
            faults += self._channel(joint, feedback, expected)
        return faults

    def _drive(self, joint: int, now_s: float, feedback: Feedback, expected: Expectation) -> Iterator[Fault]:
        age_s, limit_s = now_s - feedback.reply_at_s[joint], self._limits.stale_s
        if self.is_stale(now_s, feedback.reply_at_s[joint]):
            yield Fault(
                "drive_silent",
                self._names[joint],
                f"its drive sent no reply for {age_s:.3f} s (limit {limit_s:.3f} s)",
                "check its cable (on CAN the termination, too) and the drive's supply",
                Reaction.HOLD,
            )
            return
        if not expected.are_drives_enabled:
            return
        yield from faults_of_drive(self._names[joint], feedback.drive_faults[joint])
        if not feedback.drive_faults[joint]:
            state = feedback.statusword[joint] & STATE_MASK
            if state != OPERATION_ENABLED:
                yield Fault(
                    "drive_left",
                    self._names[joint],
                    f"its drive left OPERATION ENABLED by itself (statusword 0x{feedback.statusword[joint]:02x})",
                    "it was reset, or another program commands it: check its supply and the bus",
                    Reaction.HOLD,
                )

    def _channel(self, joint: int, feedback: Feedback, expected: Expectation) -> Iterator[Fault]:
        flags = feedback.channel_flags[joint]
        if flags & SIGNAL_LOST:
            yield Fault(
                "encoder_signal",
                self._names[joint],
                "its encoder's signal is lost",
                "check the encoder's cable and plug",
                Reaction.BRAKE,
            )
        elif flags & QUADRATURE_ERROR and expected.is_homed:
            yield Fault(
                "encoder_miscount",
                self._names[joint],
                "its encoder made an illegal transition: the count may be wrong",
                "check the encoder's cable and shield, then home again",
                Reaction.BRAKE,
            )
        if expected.is_homed and not flags & ZERO_SET:
            yield Fault(
                "zero_lost",
                self._names[joint],
                "the encoder board was reset and has lost its zero",
                "check its supply, then home again",
                Reaction.HOLD,
            )

    def _motion(self, joint: int, measured: JointState, aim: JointState, is_homed: bool) -> Iterator[Fault]:
        limit, q_rad, q_set_rad = self._limits.joints[joint], measured.q_rad[joint], aim.q_rad[joint]
        speed_rad_s = measured.speed_rad_s[joint]
        if overrun(speed_rad_s, limit.speed_rad_s) > 0.0:
            yield Fault(
                "overspeed",
                self._names[joint],
                f"it moves at {speed_rad_s:.2f} rad/s (limit {limit.speed_rad_s:.2f} rad/s)",
                "check gains, the signs of motor and encoder, and external forces",
                Reaction.BRAKE,
            )
        error_rad, allowed_rad = q_set_rad - q_rad, limit.following_error_rad + self._lag_rad[joint]
        if overrun(error_rad, allowed_rad) > 0.0:
            yield Fault(
                "following_error",
                self._names[joint],
                f"following error {error_rad:.4f} rad (limit {allowed_rad:.4f} rad at {aim.speed_rad_s[joint]:.2f} rad/s)",
                "check for a collision, a loose belt or a load beyond the current limit",
                Reaction.CONTROLLED,
            )
        if is_homed and not limit.holds(q_rad, q_set_rad):
            yield Fault(
                "joint_range",
                self._names[joint],
                f"it is at {q_rad:.4f} rad, outside {limit.lower_rad:.4f} to {limit.upper_rad:.4f} rad",
                "guide it back by hand (`armwright guide`), then find the cause",
                Reaction.CONTROLLED,
            )

    def _late(self, missed_in_row: int) -> Fault:
        return Fault(
            "loop_late",
            "control loop",
            f"{missed_in_row} cycles missed in a row (limit {self._limits.missed_in_row})",
            "stop other programs on this machine; give the operator real-time rights (`armwright doctor` lists them)",
            Reaction.CONTROLLED,
        )


def faults_of_drive(joint_name: str, bits: int) -> Iterator[Fault]:
    """A fault for each bit of what a drive reports."""
    for bit, (name, remedy) in DRIVE_FAULTS.items() if bits else ():
        if bits >> bit & 1:
            yield Fault("drive_fault", joint_name, f"its drive reports a fault: {name}", remedy, Reaction.HOLD)


def _silent_encoder(joints: str, age_s: float, limit_s: float) -> Fault:
    return Fault(
        "encoder_stale",
        "encoder board",
        f"no new counts of {joints} {f'for {age_s:.3f} s' if age_s < math.inf else 'yet'} (limit {limit_s:.3f} s)",
        "check its cable and supply",
        Reaction.HOLD,
    )

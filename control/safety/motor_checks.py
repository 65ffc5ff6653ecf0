"""A motor's voltage and current as a check of its encoder, and of the torque that the model expects.

A brushed DC motor obeys u = R i + K w, whatever the gear, the load or the friction: voltage and current tell its speed a
second time, without its encoder. And the current is a torque: what weight and acceleration do not explain is friction, a
payload that was not stated, a collision, or a gear that is not the one in arm.toml.

Each equation is smoothed, and what may be left of it grows with the terms themselves, because R, K and the masses are
known to a share only. Plain floats: this runs every cycle.
"""

import math
from typing import Final

from control.dynamics.feedforward import Motor

SHARE: Final = 0.25  # of each term: R and K that are a fifth off, from parts or from heat
SHARE_OF_TORQUE: Final = 0.3  # of the model's torque
SPEED_SMOOTHING_S: Final = 0.03  # a frozen encoder at full speed is told after a tenth of this
TORQUE_SMOOTHING_S: Final = 0.1  # an impact ends before this


class SpeedCheck:
    """One motor's equation, from volts and amperes at the joint's sign and rad/s of the joint.

    The current of a reference board's report belongs to the voltage of two commands ago (docs/mock_robot.md), that of a board
    which measures when it is asked, or by itself, to the last one; the check keeps them.
    """

    __slots__ = ("_K", "_R", "_allowed_V", "_base_V", "_before_V", "_is_newest", "_last_V", "_lead_rad", "_left_V", "_slack_rad")

    def __init__(self, motor: Motor, base_rad_s: float) -> None:
        """`base_rad_s`: allowed difference of the two speeds at rest and without current.

        Where the motor may turn while its encoder stands, the integral of what is beyond that must exceed the slack.
        """
        self._slack_rad = motor.slack_rad
        self._R, self._K, self._is_newest = motor.resistance_ohm, motor.volts_per_rad_s, motor.current_is_newest
        self._base_V = base_rad_s * motor.volts_per_rad_s + 0.5 * motor.current_step_A * motor.resistance_ohm
        self.forget()

    def forget(self) -> None:
        """Start anew: the voltage was not known."""
        self._before_V = self._last_V = math.nan
        self._left_V = self._allowed_V = self._lead_rad = 0.0

    def update(self, elapsed_s: float, sent_V: float, current_A: float, speed_rad_s: float, supply_off: float) -> bool:
        """Take a cycle; whether voltage and current agree with the encoder's speed.

        `sent_V`: of the last command, NaN if the board controls it. `supply_off`: share by which the supply differs from the
        nominal one, because some boards send a duty cycle.
        """
        if self._is_newest:
            acted_V, change_V = sent_V, abs(sent_V - self._last_V)
        else:
            acted_V, change_V = self._before_V, abs(self._last_V - self._before_V)
        self._before_V, self._last_V = self._last_V, sent_V
        # Nor with the first command that is none: a board that is asked late measures what that one does.
        if not acted_V - acted_V == 0.0 == change_V - change_V or sent_V != sent_V:
            self._left_V = self._allowed_V = self._lead_rad = 0.0
            return True
        ohmic_V, emf_V = self._R * current_A, self._K * speed_rad_s
        # One cycle of misalignment costs as much as the voltage changes in one.
        allowed_V = SHARE * (abs(ohmic_V) + abs(emf_V)) + supply_off * abs(acted_V) + change_V
        gain = elapsed_s / (elapsed_s + SPEED_SMOOTHING_S)
        self._left_V += gain * (acted_V - ohmic_V - emf_V - self._left_V)
        self._allowed_V += gain * (allowed_V - self._allowed_V)
        left_V = self._left_V
        excess_V = abs(left_V) - self._allowed_V - self._base_V
        if excess_V <= 0.0:
            self._lead_rad = 0.0
            return True
        self._lead_rad += math.copysign(excess_V / self._K, left_V) * elapsed_s
        return abs(self._lead_rad) <= self._slack_rad

    @property
    def excess_rad_s(self) -> float:
        """By how much the motor seems to turn faster than its encoder says, as speed of the joint."""
        return self._left_V / self._K

    @property
    def allowed_rad_s(self) -> float:
        """The difference that would be allowed now."""
        return (self._allowed_V + self._base_V) / self._K


class TorqueCheck:
    """One joint's balance of torques, as motor current: measured against the model of the set-point's motion."""

    __slots__ = ("_base_A", "_left_A", "_model_A")

    def __init__(self, base_A: float) -> None:
        """`base_A`: what friction and unstated loads may take."""
        self._base_A = base_A
        self.forget()

    def forget(self) -> None:
        """Start anew: there was no model of the torque."""
        self._left_A = self._model_A = 0.0

    def update(self, elapsed_s: float, current_A: float, model_A: float) -> bool:
        """Take a cycle; whether the model explains the current."""
        gain = elapsed_s / (elapsed_s + TORQUE_SMOOTHING_S)
        self._left_A += gain * (current_A - model_A - self._left_A)
        self._model_A += gain * (abs(model_A) - self._model_A)
        return abs(self._left_A) <= self._base_A + SHARE_OF_TORQUE * self._model_A

    @property
    def excess_A(self) -> float:
        """The current that the model does not explain."""
        return self._left_A

    @property
    def allowed_A(self) -> float:
        """What would be allowed now."""
        return self._base_A + SHARE_OF_TORQUE * self._model_A


class Lasting:
    """A limit that a value must exceed for a while: noise, and one bad value, are nothing."""

    __slots__ = ("_lasts_s", "_since_s", "lower", "upper")

    def __init__(self, lower: float, upper: float, lasts_s: float) -> None:
        self.lower, self.upper, self._lasts_s = lower, upper, lasts_s
        self._since_s = 0.0

    @property
    def is_pending(self) -> bool:
        """Whether the last value was outside."""
        return self._since_s > 0.0

    def update(self, elapsed_s: float, value: float) -> bool:
        """Take a value; whether it is inside the limits, or not yet outside for long enough. NaN is outside."""
        if self.lower <= value <= self.upper:
            self._since_s = 0.0
            return True
        self._since_s += elapsed_s
        return self._since_s < self._lasts_s

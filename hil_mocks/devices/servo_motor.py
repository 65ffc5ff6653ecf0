"""Motor and position loop of a smart servo: what its control table stands before."""

from __future__ import annotations

import math
from collections.abc import Callable

from hil_mocks.devices.motor_inputs import Output

# With this speed gain an STS3215 at 12 V has 12 N m/rad; one that was identified, 17.8 (TheRobotStudio/SO-ARM100,
# Simulation/SO101/joints_properties.xml). A softer loop swings past its goal with half a kilogram in the hand. A stiffer one
# draws too much in a strong motor, as the gain counts in shares of the motor's own voltage per speed.
POSITION_RATE, SPEED_GAIN, SPEED_INTEGRAL, SPEED_FILTER_S = 15.0, 2.0, 15.0, 0.003
TUNED_SPEED_GAIN = 3.4  # of a board that its owner tunes to the motor (ODrive, moteus)
LIMITED_FADE = 0.99  # of the integral, each period


class ServoMotor:
    """`read_turns` gives the angle of the output shaft in turns; `goal_turns` is where the loop goes, `goal_turns_s` how fast.

    `seen_turns`: what the loop sees of the angle, one count of its encoder; goals are whole counts.
    """

    def __init__(
        self, volts_per_rad_s: float, read_turns: Callable[[], float], seen_turns: float = 0.0, speed_gain: float = SPEED_GAIN
    ) -> None:
        self._volts_per_turn_s = volts_per_rad_s * 6.283185307179586
        self._read_turns, self._seen_turns = read_turns, seen_turns
        self.turns = self.goal_turns = read_turns()
        self.speed_turns_s = self.goal_turns_s = 0.0
        self.position_rate, self._speed_gain = POSITION_RATE, speed_gain
        self._step_s = 0.001
        self._ticked_s: float | None = None
        self._integral_V = self.ramp_turns_s = 0.0

    def measure(self, now_s: float) -> None:
        """Take the angle, and follow the speed."""
        self._step_s = 0.001 if self._ticked_s is None else now_s - self._ticked_s
        self._ticked_s = now_s
        before, self.turns = self.turns, self._read_turns()
        rate = (self.turns - before) / self._step_s
        self.speed_turns_s += (rate - self.speed_turns_s) * self._step_s / (self._step_s + SPEED_FILTER_S)

    def engage(self) -> None:
        """The torque was switched on: the loop begins anew."""
        self._integral_V = self.ramp_turns_s = 0.0

    def follow_ramp(self, target_turns: float, faster: float, slower: float, top_turns_s: float = math.inf) -> None:
        """The goal goes on to a target: faster and slower by so many turns/s², at most at `top_turns_s`."""
        way = target_turns - self.goal_turns
        coming_turns_s = min(math.sqrt(2.0 * slower * abs(way)), abs(way) / self._step_s, top_turns_s)
        change = math.copysign(coming_turns_s, way) - self.ramp_turns_s
        most = (faster if change * self.ramp_turns_s >= 0.0 else slower) * self._step_s
        self.ramp_turns_s += min(max(change, -most), most)
        self.goal_turns += self.ramp_turns_s * self._step_s

    def controlled(self, supply_V: float, is_current_limited: bool = False) -> Output:
        """The output of a control period. Where the current is limited, the integral fades."""
        off_turns = self.goal_turns - self.turns
        wanted = self.position_rate * off_turns + self.goal_turns_s
        error_V = self._volts_per_turn_s * (wanted - self.speed_turns_s)
        wanted_V = self._volts_per_turn_s * wanted + self._speed_gain * error_V + self._integral_V
        limited_V = min(max(wanted_V, -supply_V), supply_V)
        if is_current_limited:
            self._integral_V *= LIMITED_FADE
        elif wanted_V == limited_V:
            if abs(off_turns) < 0.5 * self._seen_turns:  # it is there: what nobody sees adds up to nothing
                error_V = self._volts_per_turn_s * (self.goal_turns_s - self.speed_turns_s)
            self._integral_V += SPEED_INTEGRAL * error_V * self._step_s
        return Output("voltage", limited_V)

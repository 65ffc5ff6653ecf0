"""Rigid map from encoder to joint angles (scale, eccentric discs, belt, measured map) and back, with speeds and accelerations.

    joint_j = (1 + scale_j) e_j + a_j sin e_j + b_j cos e_j + map_j(e_j)  [+ ratio joint_2 for joint 3]

with a, b = amplitude cos(phase), amplitude sin(phase). The belt counts where the encoder is on the motor. Plain floats: both
ways run every cycle.
"""

from collections.abc import Sequence
from math import cos, sin
from typing import Final

from control.kinematics.smooth_table import SmoothTable
from control.model.arm import Arm
from control.model.effects import COUPLED, COUPLED_TO, corrected, linear_values

RIGID_EFFECTS: Final = corrected("encoder")
_COUPLED, _COUPLED_TO = COUPLED - 1, COUPLED_TO - 1
_ROUNDS = 3  # Newton's; each squares an error that begins below 1e-2 rad
Floats = tuple[float, ...]


class EncoderChain:
    """The rigid part of the map between encoder and joint angles, one of each per joint."""

    __slots__ = ("_cosine", "_gain", "_ratio", "_sine", "_table")

    def __init__(self, arm: Arm) -> None:
        n = arm.joint_count
        self._gain, self._sine, self._cosine = [1.0] * n, [0.0] * n, [0.0] * n
        self._ratio = 0.0
        self._table: list[SmoothTable | None] = [None] * n
        for entry in arm.maps:
            if entry.corrects == entry.over == "angle_rad":
                self._table[entry.joint - 1] = SmoothTable.of(entry)
        for effect in arm.effects:
            if not arm.is_behind_encoder(effect.effect, effect.joint):
                continue
            p, j = effect.parameters, (effect.joint or 0) - 1
            match effect.effect:
                case "encoder_scale":
                    self._gain[j] += p["scale"]
                case "encoder_eccentricity":
                    sine, cosine = linear_values(effect.effect, p)
                    self._sine[j] += sine
                    self._cosine[j] += cosine
                case "belt_coupling":
                    self._ratio += p["ratio"]

    def joint_of(self, joint: int, e: float) -> float:
        """Angle of one joint (0-based) without the belt's share."""
        table = self._table[joint]
        measured = 0.0 if table is None else table(e)
        return self._gain[joint] * e + self._sine[joint] * sin(e) + self._cosine[joint] * cos(e) + measured

    def joints(self, encoder_rad: Sequence[float], offset_rad: Sequence[float]) -> Floats:
        """Joint angles if each motor leads its joint by `offset_rad`."""
        q = [self.joint_of(j, e) - offset_rad[j] for j, e in enumerate(encoder_rad)]
        if self._ratio:
            q[_COUPLED] += self._ratio * q[_COUPLED_TO]
        return tuple(q)

    def encoders(
        self, q_rad: Sequence[float], speed_rad_s: Sequence[float], acceleration_rad_s2: Sequence[float]
    ) -> tuple[Floats, Floats, Floats]:
        """Encoder angles, speeds and accelerations at angles, speeds and accelerations of the motors (unbelted joints)."""
        q, speed, acceleration = list(q_rad), list(speed_rad_s), list(acceleration_rad_s2)
        for j, wanted in enumerate(q):
            q[j], speed[j], acceleration[j] = self._encoder(j, wanted, speed[j], acceleration[j])
        return tuple(q), tuple(speed), tuple(acceleration)

    def unbelted(self, values: Sequence[float]) -> list[float]:
        """Angles, speeds or accelerations of the joints without the belt's share in joint 3."""
        unbelted = list(values)
        if self._ratio:
            unbelted[_COUPLED] -= self._ratio * unbelted[_COUPLED_TO]
        return unbelted

    def belt(self, second: float) -> float:
        """The belt's share in joint 3 for an angle, speed or acceleration of joint 2."""
        return self._ratio * second

    def _encoder(self, j: int, q: float, speed: float, acceleration: float) -> tuple[float, float, float]:
        gain = self._gain[j]
        if self._sine[j] == self._cosine[j] == 0.0 and self._table[j] is None:
            return q / gain, speed / gain, acceleration / gain
        e = q / gain
        for _ in range(_ROUNDS):
            value, slope, _ = self._derivatives(j, e)
            e -= (value - q) / slope
        _, slope, bend = self._derivatives(j, e)
        turned = speed / slope
        return e, turned, (acceleration - bend * turned * turned) / slope

    def _derivatives(self, j: int, e: float) -> tuple[float, float, float]:
        """The joint's angle without the belt's share, and its first and second derivative by the encoder's."""
        gain, a, b = self._gain[j], self._sine[j], self._cosine[j]
        sine, cosine, table = sin(e), cos(e), self._table[j]
        value, slope, bend = (gain * e + a * sine + b * cosine, gain + a * cosine - b * sine, -a * sine - b * cosine)
        if table is None:
            return value, slope, bend
        own = table.derivatives(e)
        return value + own[0], slope + own[1], bend + own[2]

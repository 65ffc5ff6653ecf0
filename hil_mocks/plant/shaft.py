"""Errors between the motor's angle and its encoder's reading."""

from __future__ import annotations

import math

from hil_mocks.plant.effects import JointEffects


class Shaft:
    """Motor angle in joint radians -> encoder angle. With eccentricity and drift, the joint leads."""

    __slots__ = ("_amplitude_rad", "_drift_rad", "_phase_rad", "_scale", "_time_constant_s", "is_true")

    def __init__(self, effect: JointEffects) -> None:
        self._scale = 1.0 + effect.encoder_scale
        self._amplitude_rad, self._phase_rad = effect.eccentricity_rad, effect.eccentricity_phase_rad
        self._drift_rad, self._time_constant_s = effect.drift_rad, effect.drift_time_constant_s
        self.is_true = effect.encoder_scale == effect.eccentricity_rad == effect.drift_rad == 0.0

    def reading_rad(self, motor_rad: float, time_s: float) -> float:
        """The encoder's angle e of motor = (1 + scale) e + amplitude sin(e + phase) + drift (1 - exp(-t/T))."""
        rest_rad = motor_rad
        if self._drift_rad != 0.0:
            rest_rad += self._drift_rad * math.expm1(-time_s / self._time_constant_s)
        reading = rest_rad / self._scale
        if self._amplitude_rad != 0.0:
            for _ in range(4):  # contracts by the amplitude, a few mrad, each time
                reading = (rest_rad - self._amplitude_rad * math.sin(reading + self._phase_rad)) / self._scale
        return reading

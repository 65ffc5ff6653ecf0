"""From the coefficients of an effect's law to the parameters of docs/formats.md, each as (value, standard deviation)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.arrays import Array
from calib.gap.finding import Parameters

ToParameters = Callable[[Array, Array], Parameters]  # of coefficients (c,) and their covariance (c, c)


def only(parameter: str) -> ToParameters:
    """The coefficient itself."""
    return lambda value, covariance: {parameter: (float(value[0]), float(np.sqrt(covariance[0, 0])))}


def inverse(parameter: str, beyond: float = 0.0) -> ToParameters:
    """1 / (coefficient + beyond): the stiffness of a compliance."""

    def made(value: Array, covariance: Array) -> Parameters:
        compliance, sd = float(value[0]) + beyond, float(np.sqrt(covariance[0, 0]))
        return {parameter: (1.0 / compliance, sd / compliance**2)}

    return made


def amplitude_and_phase(value: Array, covariance: Array) -> Parameters:
    """Of a sin q + b cos q = A sin(q + phase)."""
    a, b = float(value[0]), float(value[1])
    amplitude = max(float(np.hypot(a, b)), 1e-300)
    by_amplitude, by_phase = np.array([a, b]) / amplitude, np.array([-b, a]) / amplitude**2
    return {
        "amplitude_rad": (amplitude, float(np.sqrt(by_amplitude @ covariance @ by_amplitude))),
        "phase_rad": (float(np.arctan2(b, a)), float(np.sqrt(by_phase @ covariance @ by_phase))),
    }


def sized(size: Array, made: ToParameters) -> ToParameters:
    """Of coefficients that are counted in sizes (c,)."""
    return lambda value, covariance: made(value * size, covariance * np.outer(size, size))

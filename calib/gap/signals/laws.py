"""Friction and cogging as they act at a motor, along a measured motion."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from calib.arrays import Array
from calib.gap.signals.terms import Term
from control.dynamics import effect_laws as laws

REST_rad_s = 0.003  # the sign of a measured speed below this is the noise's; such samples are not used
FAST, FASTEST = 0.3, 0.4  # of a turn of cogging's phase a sample: from here on it fades, and is gone


class Moving(Protocol):
    """Angles, speeds and accelerations (m, n) at times (m,)."""

    @property
    def q(self) -> Array:
        """Angles."""

    @property
    def speed(self) -> Array:
        """Speeds."""

    @property
    def acceleration(self) -> Array:
        """Accelerations."""

    @property
    def t_s(self) -> Array:
        """Times."""


def sampled_friction_Nm(term: Term, run: Moving, j: int, link_Nm: Array, gear_ratio: float) -> Array:
    """`friction_Nm` along a run of equal samples, without what these cannot carry.

    Cogging that passes faster than the samples can follow would come back as a slow torque that never was.
    """
    torque = friction_Nm(term, run, j, link_Nm, gear_ratio)
    if term.form != "cogging":
        return torque
    period_s = float(run.t_s[1] - run.t_s[0])
    turns = np.abs(term.order * gear_ratio * run.speed[:, j]) * period_s / (2.0 * np.pi)  # a sample
    return np.asarray(torque * np.clip((FASTEST - turns) / (FASTEST - FAST), 0.0, 1.0))


def friction_Nm(term: Term, run: Moving, j: int, link_Nm: Array, gear_ratio: float) -> Array:
    """Torque (m,) that the motor has to add for this term."""
    speed, q = run.speed[:, j], run.q[:, j]
    sign = np.tanh(speed / REST_rad_s)
    first = term.values[0]
    match term.form:
        case "coulomb_friction":
            return np.asarray(first * sign)
        case "viscous_friction":
            return np.asarray(laws.viscous_Nm(speed, first))
        case "stribeck_friction":
            return np.asarray(first * np.exp(-((speed / term.values[1]) ** 2)) * sign)
        case "stribeck exponential":
            return np.asarray(first * np.exp(-np.abs(speed) / term.values[1]) * sign)
        case "load_friction":
            return np.asarray(first * np.abs(link_Nm) * sign)
        case "asymmetric_friction":
            return np.asarray(first * np.abs(sign))
        case "cogging":
            angle = term.order * gear_ratio * q
            return np.asarray(first * np.sin(angle) + term.values[1] * np.cos(angle))
        case _:
            raise ValueError(f"no law {term.form}")

"""Friction and cogging as they act at a motor, along a measured motion."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from calib.arrays import Array
from calib.gap.signals.terms import Law

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


def sampled_friction_Nm(
    term: Law, run: Moving, j: int, link_Nm: Array, gear_ratio: float, ahead_rad: Array | float = 0.0
) -> Array:
    """`friction_Nm` along a run of equal samples, without what these cannot carry.

    Cogging that passes faster than the samples can follow would come back as a slow torque that never was.
    """
    torque = friction_Nm(term, run, j, link_Nm, gear_ratio, ahead_rad)
    if not term.form.is_of_motor:
        return torque
    period_s = float(run.t_s[1] - run.t_s[0])
    turns = np.abs(term.order * gear_ratio * run.speed[:, j]) * period_s / (2.0 * np.pi)  # a sample
    return np.asarray(torque * np.clip((FASTEST - turns) / (FASTEST - FAST), 0.0, 1.0))


def friction_Nm(
    term: Law, run: Moving, j: int, link_Nm: Array, gear_ratio: float, ahead_rad: Array | float = 0.0
) -> Array:
    """Torque (m,) that the motor has to add for this term; `ahead_rad` (m,): its angle beyond what its encoder says."""
    if term.form.torque is None:
        raise ValueError(f"{term.form} is no torque at a motor")
    angle = (run.q[:, j] + ahead_rad) * gear_ratio if term.form.is_of_motor else run.q[:, j]
    return np.asarray(term.form.torque(term.values, term.order)(angle, run.speed[:, j], link_Nm))

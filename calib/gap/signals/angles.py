"""Joints that are elsewhere than their encoders say: what link and motor then really do.

An encoder that errs against its motor misstates the motor's speed too, which the back-EMF shows, and its angle, by which
cogging comes round: a milliradian at a joint is a tenth of a radian at a motor with a gear of 100. Where the error sits between
motor and link (`behind`), the motor is where its encoder says. What the camera alone sees (`seen`) moves no mass: a tip that
drifts behind the last link.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arrays import Array
from calib.gap.signals.friction import Moving
from calib.gap.signals.terms import Law
from control.model.effects import followed_joint, moved_joint


@dataclass(frozen=True, slots=True)
class MotorAhead:
    """What the motor's angle, speed and acceleration have beyond what its encoder says, (m, n) or 0."""

    angle_rad: Array | float
    speed_rad_s: Array | float
    acceleration_rad_s2: Array | float


STILL: Final = MotorAhead(0.0, 0.0, 0.0)


def joint_ahead(terms: Sequence[Law], q: Array, t_s: Array) -> Array:
    """How much further than their encoders say the joints have turned, (m, n)."""
    ahead = np.zeros_like(q)
    for term in terms:
        j, by = place(term)
        ahead[:, j] += _turned(term, q[:, by], t_s)[0]
    return ahead


def motor_ahead(terms: Sequence[Law], q: Array, t_s: Array) -> Array:
    """How much further than their encoders say the motors have turned, in joint angles, (m, n)."""
    return joint_ahead([term for term in terms if _is_of_motor(term)], q, t_s)


def _is_of_motor(term: Law) -> bool:
    return term.form.where == "encoder" and not term.form.is_by_time


def angle_error(terms: Sequence[Law], run: Moving) -> tuple[MotorAhead, tuple[Array, Array, Array]]:
    """What the motors do beyond their encoders, and the links' angles, speeds and accelerations."""
    q, speed, acceleration = np.array(run.q), np.array(run.speed), np.array(run.acceleration)
    motor = np.zeros((3, *q.shape))
    for term in terms:
        if term.form.where == "seen":
            continue
        j, by = place(term)
        v, a = run.speed[:, by], run.acceleration[:, by]
        turned, slope, bend = _turned(term, run.q[:, by], run.t_s)
        is_by_time = term.form.is_by_time
        faster = np.asarray(slope if is_by_time else slope * v)
        pushed = np.asarray(bend if is_by_time else slope * a + bend * v * v)
        q[:, j] += turned
        speed[:, j] += faster
        acceleration[:, j] += pushed
        if _is_of_motor(term):
            motor[:, :, j] += turned, faster, pushed
    return MotorAhead(*motor), (q, speed, acceleration)


def place(term: Law) -> tuple[int, int]:
    """The joint (0-based) that is elsewhere, and the one whose angle says how far."""
    name = term.name
    moved, followed = moved_joint(name.effect, name.joint), followed_joint(name.effect, name.joint)
    return (moved or 0) - 1, (followed or 0) - 1


def _turned(term: Law, q: Array, t_s: Array) -> tuple[Array, Array, Array]:
    """The error and its first and second derivative by the angle, by time for a drift."""
    if term.form.angle is None:
        raise ValueError(f"{term.form} is no error of an angle")
    return term.form.angle(term.values, q, t_s)

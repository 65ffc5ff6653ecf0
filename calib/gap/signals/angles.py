"""Joints that are elsewhere than their encoders say: what link and motor then really do.

An encoder that errs against its motor (form `encoder_scale`) misstates the motor's speed too, which the back-EMF shows;
where the error sits between motor and link (form `encoder_scale behind`), the motor is where its encoder says. What the
camera alone sees (form `encoder_scale seen`) moves no mass: a tip that drifts behind the last link.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arrays import Array
from calib.gap.signals.recording import Motion
from calib.gap.signals.terms import Term
from control.model.effects import COUPLED, COUPLED_TO

BEHIND: Final = " behind"  # of a form: between motor and link
SEEN: Final = " seen"  # of a form: by the camera alone
AT_MOTOR: Final = ("encoder_eccentricity", "encoder_scale", "belt_coupling")
ERRORS: Final = (*AT_MOTOR, "thermal_drift")
ANGLES: Final = frozenset((*ERRORS, *(form + BEHIND for form in AT_MOTOR), *(form + SEEN for form in ERRORS)))


@dataclass(frozen=True, slots=True)
class MotorAhead:
    """What the motor's speed and acceleration have beyond what its encoder says, (m, n) or 0."""

    speed_rad_s: Array | float
    acceleration_rad_s2: Array | float


STILL: Final = MotorAhead(0.0, 0.0)


def joint_ahead(terms: Sequence[Term], q: Array, t_s: Array) -> Array:
    """How much further than their encoders say the joints have turned, (m, n)."""
    ahead = np.zeros_like(q)
    for term in terms:
        j, by = place(term)
        ahead[:, j] += _turned(term, q[:, by], t_s)[0]
    return ahead


def angle_error(terms: Sequence[Term], run: Motion) -> tuple[MotorAhead, tuple[Array, Array, Array]]:
    """What the motors do beyond their encoders, and the links' angles, speeds and accelerations."""
    q, speed, acceleration = np.array(run.q), np.array(run.speed), np.array(run.acceleration)
    motor = np.zeros((2, *q.shape))
    for term in terms:
        if term.form.endswith(SEEN):
            continue
        j, by = place(term)
        v, a = run.speed[:, by], run.acceleration[:, by]
        turned, slope, bend = _turned(term, run.q[:, by], run.t_s)
        by_time = term.form == "thermal_drift"
        faster = np.asarray(slope if by_time else slope * v)
        pushed = np.asarray(bend if by_time else slope * a + bend * v * v)
        q[:, j] += turned
        speed[:, j] += faster
        acceleration[:, j] += pushed
        if term.form in AT_MOTOR:
            motor[0, :, j] += faster
            motor[1, :, j] += pushed
    return MotorAhead(motor[0], motor[1]), (q, speed, acceleration)


def place(term: Term) -> tuple[int, int]:
    """The joint (0-based) that is elsewhere, and the one whose angle says how far."""
    is_belt = term.name.effect == "belt_coupling"
    return (COUPLED - 1, COUPLED_TO - 1) if is_belt else (term.index, term.index)


def plain(form: str) -> str:
    """A form without where its error sits."""
    return form.removesuffix(BEHIND).removesuffix(SEEN)


def _turned(term: Term, q: Array, t_s: Array) -> tuple[Array, Array, Array]:
    """The error and its first and second derivative by the angle, by time for a drift."""
    first = term.values[0]
    match plain(term.form):
        case "encoder_eccentricity":
            second = term.values[1]
            sine, cosine = np.sin(q), np.cos(q)
            error = first * sine + second * cosine
            return error, first * cosine - second * sine, -error
        case "encoder_scale" | "belt_coupling":
            return first * q, np.full_like(q, first), np.zeros_like(q)
        case "thermal_drift":
            # Warm-up begins where the clock of the log does.
            gone = np.exp(-t_s / term.values[1])
            return first * (1.0 - gone), first / term.values[1] * gone, -first / term.values[1] ** 2 * gone
        case _:
            raise ValueError(f"no encoder error {term.form}")

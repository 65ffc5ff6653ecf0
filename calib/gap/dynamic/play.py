"""A link behind an elastic gear or in a gear with play, driven by the measured motion of its motor.

The other joints follow their encoders, so each elastic joint is one equation for delta = joint minus motor angle:
    M delta'' = -tau - g delta - (torque of spring, or of a flank)
with tau the link torque that a rigid gear would transmit, M the inertia that the joint turns, g its gravity's slope.
All runs at once: arrays (samples, runs).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array

SUBSTEPS = 4  # of a sample: a flank is met within 0.5 ms at 500 samples a second
SPRING_SUBSTEPS = 2  # the trapezoidal rule is content with fewer


@dataclass(frozen=True, slots=True)
class Follower:
    """What drives a link: torque_Nm, inertia_kg_m2, slope_Nm_rad (samples, runs), and the time between samples."""

    torque_Nm: Array
    inertia_kg_m2: Array
    slope_Nm_rad: Array
    period_s: float


@dataclass(frozen=True, slots=True)
class Followed:
    """delta and its derivatives, and the torque that the gear transmitted, (samples, runs)."""

    delta_rad: Array
    speed_rad_s: Array
    acceleration_rad_s2: Array
    transmitted_Nm: Array


def elastic(of: Follower, stiffness_Nm_rad: float, damping_Nm_s_rad: float) -> Followed:
    """Spring and damper; the trapezoidal rule, which adds no damping of its own. Starts at rest."""
    steps = 1 if stiffness_Nm_rad > 4.0 * float(of.inertia_kg_m2.max()) / of.period_s**2 else SPRING_SUBSTEPS
    h, k, d = of.period_s / steps, stiffness_Nm_rad, damping_Nm_s_rad
    torque, inertia, slope = (
        _fine(part, steps) for part in (of.torque_Nm, of.inertia_kg_m2, of.slope_Nm_rad)
    )
    stiff = slope + k
    inverse = 1.0 / (inertia + 0.5 * h * d + 0.25 * h * h * stiff)
    delta = -torque[0] / stiff[0]
    speed, acceleration = np.zeros_like(delta), np.zeros_like(delta)
    result = np.empty((3, *torque.shape))
    for n in range(len(torque)):
        foreseen_speed = speed + 0.5 * h * acceleration
        foreseen = delta + h * speed + 0.25 * h * h * acceleration
        acceleration = (-torque[n] - d * foreseen_speed - stiff[n] * foreseen) * inverse[n]
        speed = foreseen_speed + 0.5 * h * acceleration
        delta = foreseen + 0.25 * h * h * acceleration
        result[0, n], result[1, n], result[2, n] = delta, speed, acceleration
    delta, speed, acceleration = result[:, ::steps]
    return Followed(delta, speed, acceleration, -k * delta - d * speed)


def loose(of: Follower, width_rad: float, restitution: float = 0.0) -> Followed:
    """Play between two hard flanks: the link lies on one, falls free to the other, and stays there."""
    h = of.period_s / SUBSTEPS
    torque, inertia, slope = (
        _fine(part, SUBSTEPS) for part in (of.torque_Nm, of.inertia_kg_m2, of.slope_Nm_rad)
    )
    half = 0.5 * width_rad
    inverse = 1.0 / inertia
    delta = -half * np.sign(torque[0])
    speed = np.zeros_like(delta)
    result = np.empty((3, *torque.shape))
    for n in range(len(torque)):
        before = speed
        speed = before - h * (torque[n] + slope[n] * delta) * inverse[n]
        wanted = delta + h * speed
        delta = np.clip(wanted, -half, half)
        hit = delta != wanted
        speed = np.where(hit, -restitution * speed, speed)
        result[0, n], result[1, n], result[2, n] = delta, speed, (speed - before) / h
    # Row n is the state after step n. The mean over the steps around a sample keeps an impact's momentum where it was.
    early = np.pad(result, ((0, 0), (SUBSTEPS // 2, 0), (0, 0)), mode="edge")[:, : len(torque)]
    early[2, : SUBSTEPS // 2] = 0.0
    acceleration = early[2].reshape(-1, SUBSTEPS, torque.shape[1]).mean(axis=1)
    before_step = np.pad(result[:2], ((0, 0), (1, 0), (0, 0)), mode="edge")[:, : len(torque)]
    delta, speed = before_step[0, ::SUBSTEPS], before_step[1, ::SUBSTEPS]
    transmitted = of.torque_Nm + of.slope_Nm_rad * delta + of.inertia_kg_m2 * acceleration
    return Followed(delta, speed, acceleration, transmitted)


def _fine(values: Array, steps: int) -> Array:
    """Linear between samples: (samples, runs) to (steps samples, runs)."""
    if steps == 1:
        return values
    following = np.vstack([values[1:], values[-1:]])
    parts = [values + (following - values) * (part / steps) for part in range(steps)]
    return np.stack(parts, axis=1).reshape(-1, values.shape[1])

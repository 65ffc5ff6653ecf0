"""A link behind an elastic gear or in a gear with play, driven by the measured motion of its motor.

The other joints follow their encoders, so each elastic joint is one equation for delta = joint minus motor angle:
    M delta'' = -tau - g delta - (torque of spring, or of a flank) - (friction on the link's side of the gear)
with tau the link torque that a rigid gear would transmit, M the inertia that the joint turns, g its gravity's slope.
The spring of a soft gear with play stands on its flanks: k (delta -+ width / 2) + d delta' beyond one of them, nought between.
Of the joint's Coulomb and viscous friction a share acts on the link; the rest is the motor's.
All runs and several sets of parameters at once: the loop over time costs the same for one as for thirty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import Array
from control.model.effects import SMOOTH_rad_s

SUBSTEPS = 4  # of a sample: a flank is met within 0.5 ms at 500 samples a second
SUBSTEP_s = 0.0006  # more of them where samples are further apart
SPRING_SUBSTEPS = 2  # the trapezoidal rule is content with fewer


@dataclass(frozen=True, slots=True)
class LinkDrive:
    """What drives a link: torque_Nm, inertia_kg_m2, slope_Nm_rad (samples, runs), and the time between samples."""

    torque_Nm: Array
    inertia_kg_m2: Array
    slope_Nm_rad: Array
    period_s: float
    speed_rad_s: Array | None = (
        None  # of the motor; with the joint's friction, for the share of it behind the gear
    )
    coulomb_Nm: float = 0.0
    viscous_Nm_s_rad: float = 0.0

    @property
    def has_friction(self) -> bool:
        """Whether there is any to be shared."""
        return self.speed_rad_s is not None and (self.coulomb_Nm != 0.0 or self.viscous_Nm_s_rad != 0.0)


@dataclass(frozen=True, slots=True)
class LinkPlay:
    """delta and its derivatives, and the torque that the gear transmitted, (samples, runs)."""

    delta_rad: Array
    speed_rad_s: Array
    acceleration_rad_s2: Array
    transmitted_Nm: Array


def elastic(of: LinkDrive, stiffness_Nm_rad: float, damping_Nm_s_rad: float, share: float = 0.0) -> LinkPlay:
    """Spring and damper; the trapezoidal rule, which adds no damping of its own. Starts at rest."""
    return elastics(of, [(stiffness_Nm_rad, damping_Nm_s_rad, share)])[0]


def elastics(of: LinkDrive, springs: Sequence[tuple[float, ...]]) -> list[LinkPlay]:
    """`elastic` for several sets of stiffness, damping, the friction's share on the link and, of gears with play, its width."""
    stiffness, d, share, *widths = (np.array(column)[:, None] for column in zip(*springs, strict=True))
    width = widths[0] if widths else np.zeros_like(stiffness)
    is_loose, flank = bool(width.any()), 0.5 * width
    hard = float(stiffness.min()) > 4.0 * float(of.inertia_kg_m2.max()) / of.period_s**2
    steps = _substeps(of) if is_loose else 1 if hard else SPRING_SUBSTEPS
    h = of.period_s / steps
    torque, inertia, slope = (
        _fine(part, steps) for part in (of.torque_Nm, of.inertia_kg_m2, of.slope_Nm_rad)
    )
    link_friction = _LinkFriction(of, share, steps)
    half, quarter = 0.5 * h, 0.25 * h * h
    stiff = slope[:, None] + stiffness
    mass = inertia[:, None] + half * d + quarter * stiff
    delta = -(torque[0] + stiffness * np.sign(torque[0]) * flank) / stiff[0]
    speed, acceleration = np.zeros_like(delta), np.zeros_like(delta)
    result = np.empty((3, *stiff.shape))
    rows = zip(torque, slope, inertia, stiff, mass, link_friction.speeds, *result, strict=True)
    for pull, tilt, light, hard, heavy, motor, x, v, a in rows:
        np.multiply(acceleration, half, out=v)
        v += speed
        np.multiply(acceleration, quarter, out=x)
        x += delta
        x += h * speed
        if is_loose:  # on a flank only where the spring would push the link that flies on
            flying = light + quarter * tilt
            fall = (pull + tilt * x) / flying
            ahead = x - quarter * fall
            side = np.clip(ahead, -flank, flank)
            push = stiffness * (ahead - side) + d * (v - half * fall)
            touches = (ahead - side) * push > 0.0
            np.multiply(tilt, x, out=a)
            a += np.where(touches, stiffness * (x - side) + d * v, 0.0)
            heavy = np.where(touches, heavy, flying)
        else:
            np.multiply(hard, x, out=a)
            a += d * v
        a += pull
        if link_friction.is_on:
            friction, steep = link_friction.at(motor + v)
            a += friction
            heavy = heavy + half * steep
        a /= heavy
        np.negative(a, out=a)
        v += half * a
        x += quarter * a
        delta, speed, acceleration = x, v, a
    delta, speed, acceleration = result[:, ::steps]
    into = delta - np.clip(delta, -flank, flank)
    spring = stiffness * into + d * speed
    transmitted = np.where(is_loose & (into * spring <= 0.0), 0.0, -spring)
    found = []
    for place in range(len(springs)):
        own = (np.ascontiguousarray(part[:, place]) for part in (delta, speed, acceleration, transmitted))
        found.append(LinkPlay(*own))
    return found


def _substeps(of: LinkDrive) -> int:
    """How many of a sample a flank asks for."""
    return max(SUBSTEPS, round(of.period_s / SUBSTEP_s))


class _LinkFriction:
    """Friction on the links, by their speeds; smooth through zero, and its slope for the implicit step."""

    def __init__(self, of: LinkDrive, share: Array, steps: int) -> None:
        self.is_on = of.has_friction and bool(np.any(share > 0.0))
        self._coulomb, self._viscous = share * of.coulomb_Nm, share * of.viscous_Nm_s_rad
        own = of.torque_Nm if of.speed_rad_s is None else of.speed_rad_s
        self.speeds = _fine(own, steps)

    def at(self, speed: Array) -> tuple[Array, Array]:
        """Torque and its slope."""
        way = np.tanh(speed / SMOOTH_rad_s)
        dry = self._coulomb * way
        return dry + self._viscous * speed, (self._coulomb - dry * way) / SMOOTH_rad_s + self._viscous


def loose(of: LinkDrive, width_rad: float, share: float = 0.0) -> LinkPlay:
    """Play between two hard flanks: the link lies on one, falls free to the other, and stays there.

    What a link springs back by is in the motor's measured motion already, which every impact throws back.
    """
    return looses(of, [(width_rad, share)])[0]


def looses(of: LinkDrive, plays: Sequence[tuple[float, float]]) -> list[LinkPlay]:
    """`loose` for several pairs of width and the friction's share on the link."""
    steps = _substeps(of)
    width, share = (np.array(column)[:, None] for column in zip(*plays, strict=True))
    result = _between_flanks(of, 0.5 * width, _LinkFriction(of, share, steps), steps)
    found = []
    for place in range(len(plays)):
        one = _at_samples(of, result[:, :, place], steps)
        rubbed = _LinkFriction(of, share[place], 1)
        if rubbed.is_on:
            one = replace(
                one, transmitted_Nm=one.transmitted_Nm + rubbed.at(rubbed.speeds + one.speed_rad_s)[0]
            )
        found.append(one)
    return found


def _between_flanks(of: LinkDrive, half_rad: Array, link_friction: _LinkFriction, steps: int) -> Array:
    """Delta, speed and acceleration after each of `steps` per sample, (3, steps x samples, plays, runs)."""
    h = of.period_s / steps
    torque, inertia, slope = (
        _fine(part, steps) for part in (of.torque_Nm, of.inertia_kg_m2, of.slope_Nm_rad)
    )
    falls, tilts = h * torque / inertia, h * slope / inertia
    delta = -half_rad * np.sign(torque[0])
    speed = np.zeros_like(delta)
    result = np.empty((3, len(torque), *delta.shape))
    low, fall, lightness = -half_rad, np.empty_like(delta), h / inertia
    rows = zip(falls, tilts, lightness, link_friction.speeds, result[0], result[1], strict=True)
    for drop, tilt, light, motor, x, v in rows:
        np.multiply(tilt, delta, out=fall)
        fall += drop
        if link_friction.is_on:
            friction, steep = link_friction.at(motor + speed)
            fall += light * friction
            fall /= 1.0 + light * steep
        np.subtract(speed, fall, out=v)
        wanted = v * h
        wanted += delta
        np.maximum(wanted, low, out=x)
        np.minimum(x, half_rad, out=x)
        v *= x == wanted
        delta, speed = x, v
    result[2, 0] = result[1, 0]
    np.subtract(result[1, 1:], result[1, :-1], out=result[2, 1:])
    result[2] /= h
    return result


def _at_samples(of: LinkDrive, result: Array, steps: int) -> LinkPlay:
    """Row n of `result` is the state after step n; the mean over the steps around a sample keeps impacts in time."""
    count = result.shape[1]
    early = np.pad(result[2], ((steps // 2, 0), (0, 0)), mode="edge")[:count]
    early[: steps // 2] = 0.0
    acceleration = early.reshape(-1, steps, early.shape[1]).mean(axis=1)
    before_step = np.pad(result[:2], ((0, 0), (1, 0), (0, 0)), mode="edge")[:, :count]
    delta, speed = before_step[0, ::steps], before_step[1, ::steps]
    transmitted = of.torque_Nm + of.slope_Nm_rad * delta + of.inertia_kg_m2 * acceleration
    return LinkPlay(delta, speed, acceleration, transmitted)


def _fine(values: Array, steps: int) -> Array:
    """Linear between samples: (samples, runs) to (steps samples, runs)."""
    if steps == 1:
        return values
    following = np.vstack([values[1:], values[-1:]])
    parts = [values + (following - values) * (part / steps) for part in range(steps)]
    return np.stack(parts, axis=1).reshape(-1, values.shape[1])

"""A link behind an elastic gear or in a gear with play, driven by the measured motion of its motor.

The other joints follow their encoders, so each elastic joint is one equation for delta = joint minus motor angle:
    M delta'' = -tau - g delta - (torque of spring, or of a flank) - (friction on the link's side of the gear)
with tau the link torque that a rigid gear would transmit, M the inertia that the joint turns, g its gravity's slope.
The spring of a soft gear with play stands on its flanks: k (delta -+ width / 2) + d delta' beyond one of them, nought between.
Of the joint's Coulomb and viscous friction a share acts on the link; the rest is the motor's.
All runs and several sets of parameters at once, a column each: the loop over time costs nearly the same for one as for thirty.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from control.model.effects import SMOOTH_rad_s

SUBSTEPS = 4  # of a sample: a flank is met within 0.5 ms at 500 samples a second
SUBSTEP_s = 0.0006  # more of them where samples are further apart
SPRING_SUBSTEPS = 2  # the trapezoidal rule is content with fewer
CHUNK = 64  # samples that are spread out to rows at a time: they stay in the processor's cache, however long a log is


@dataclass(frozen=True, slots=True)
class LinkDrive:
    """What drives a link: torque_Nm, inertia_kg_m2, slope_Nm_rad (samples, runs), and the time between samples."""

    torque_Nm: Array
    inertia_kg_m2: Array
    slope_Nm_rad: Array
    period_s: float
    speed_rad_s: Array | None = None  # of the motor; with the joint's friction, for the share of it behind the gear
    coulomb_Nm: float = 0.0
    viscous_Nm_s_rad: float = 0.0


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
    columns = _Columns(of, len(springs))
    stiffness, d, share, *widths = (columns.of(own) for own in zip(*springs, strict=True))
    flank = 0.5 * widths[0] if widths else np.zeros_like(stiffness)
    is_loose = bool(flank.any())
    hard = float(stiffness.min()) > 4.0 * float(of.inertia_kg_m2.max()) / of.period_s**2
    steps = _substeps(of) if is_loose else 1 if hard else SPRING_SUBSTEPS
    # as vectors, since a number beside a vector costs as much again as the sum
    h = np.full_like(stiffness, of.period_s / steps)
    half, quarter = 0.5 * h, 0.25 * h * h
    friction = _LinkFriction(of, share)
    fall, ahead, side, push = (np.empty_like(stiffness) for _ in range(4))
    touches = np.empty(len(stiffness), dtype=bool)
    state, found = None, np.empty((3, len(of.torque_Nm), len(stiffness)))
    for part, torque, inertia, slope, motors in columns.rows(steps):
        if state is None:
            delta = -(torque[0] + stiffness * np.sign(torque[0]) * flank) / (slope[0] + stiffness)
            state = delta, np.zeros_like(delta), np.zeros_like(delta)
        stiff = slope + stiffness
        mass, flying = inertia + half * d + quarter * stiff, inertia + quarter * slope
        result, (delta, speed, acceleration) = np.empty((3, *torque.shape)), state
        for pull, tilt, back, heavy, light, motor, x, v, a in zip(
            torque, slope, stiff, mass, flying, motors, *result, strict=True
        ):
            np.multiply(acceleration, half, out=v)
            v += speed
            np.multiply(acceleration, quarter, out=x)
            x += delta
            np.multiply(speed, h, out=a)
            x += a
            if is_loose:  # on a flank only where the spring would push the link that flies on
                np.multiply(tilt, x, out=a)
                a += pull
                np.divide(a, light, out=fall)
                np.multiply(fall, quarter, out=ahead)
                np.subtract(x, ahead, out=ahead)
                np.maximum(ahead, -flank, out=side)
                np.minimum(side, flank, out=side)
                ahead -= side
                fall *= half
                np.subtract(v, fall, out=fall)
                fall *= d
                np.multiply(ahead, stiffness, out=push)
                push += fall
                push *= ahead
                np.greater(push, 0.0, out=touches)
                np.subtract(x, side, out=side)
                side *= stiffness
                np.multiply(v, d, out=push)
                side += push
                np.add(a, side, out=a, where=touches)
                np.copyto(light, heavy, where=touches)
                heavy = light
            else:
                np.multiply(back, x, out=a)
                a += pull
                np.multiply(v, d, out=push)
                a += push
            if friction.is_on:
                steep = friction.add_to(a, motor, v)
                steep *= half
                heavy += steep
            a /= heavy
            np.negative(a, out=a)
            np.multiply(a, half, out=fall)
            v += fall
            np.multiply(a, quarter, out=fall)
            x += fall
            delta, speed, acceleration = x, v, a
        state = delta, speed, acceleration
        found[:, part] = result[:, ::steps]
    into = found[0] - np.clip(found[0], -flank, flank)
    spring = stiffness * into + d * found[1]
    transmitted = np.where(is_loose & (into * spring <= 0.0), 0.0, -spring)
    return columns.split(found, transmitted)


def _substeps(of: LinkDrive) -> int:
    """How many of a sample a flank asks for."""
    return max(SUBSTEPS, round(of.period_s / SUBSTEP_s))


class _Columns:
    """A column for each of `count` sets of parameters and each run."""

    def __init__(self, of: LinkDrive, count: int) -> None:
        speed = np.zeros_like(of.torque_Nm) if of.speed_rad_s is None else of.speed_rad_s
        self._parts, self._count = (of.torque_Nm, of.inertia_kg_m2, of.slope_Nm_rad, speed), count
        self._samples, self._runs = of.torque_Nm.shape

    def of(self, values: Sequence[float]) -> Array:
        """A value of each set for all columns."""
        return np.repeat(np.array(values, dtype=float), self._runs)

    def rows(self, steps: int) -> Iterator[tuple[slice, Array, Array, Array, Array]]:
        """Some samples after the others, torque, inertia, slope and the motor's speed there (steps samples, columns), linear
        between samples.
        """
        for start in range(0, self._samples, CHUNK):
            stop = min(start + CHUNK, self._samples)
            torque, inertia, slope, motor = (
                np.tile(_fine(values[start : stop + 1], steps)[: (stop - start) * steps], self._count) for values in self._parts
            )
            yield slice(start, stop), torque, inertia, slope, motor

    def split(self, motion: Array, transmitted: Array) -> list[LinkPlay]:
        """Each set's own, of delta, speed and acceleration (3, samples, columns) and of torques (samples, columns)."""
        found = []
        for place in range(self._count):
            mine = slice(place * self._runs, (place + 1) * self._runs)
            own = (np.ascontiguousarray(part[:, mine]) for part in (*motion, transmitted))
            found.append(LinkPlay(*own))
        return found


class _LinkFriction:
    """The share (columns,) of a joint's friction on its links, by their speeds; smooth through zero, and its slope for the
    implicit step. Speeds are counted in that up to which it is smooth.
    """

    def __init__(self, of: LinkDrive, share: Array) -> None:
        self._coulomb, viscous = share * of.coulomb_Nm, share * of.viscous_Nm_s_rad
        self.is_on = of.speed_rad_s is not None and bool(self._coulomb.any() or viscous.any())
        self._viscous, self._steep = viscous * SMOOTH_rad_s, self._coulomb / SMOOTH_rad_s
        self._steepest, self._unit = self._steep + viscous, np.full_like(viscous, 1.0 / SMOOTH_rad_s)
        self._turning, self._way = np.empty_like(viscous), np.empty_like(viscous)

    def add_to(self, torque: Array, motor: Array, beyond: Array) -> Array:
        """Adds it to the torques (columns,) of links that turn `beyond` their motors; its slope, overwritten the next time."""
        turning, way = self._turning, self._way
        np.add(motor, beyond, out=turning)
        turning *= self._unit
        np.tanh(turning, out=way)
        turning *= self._viscous
        torque += turning
        np.multiply(way, self._coulomb, out=turning)
        torque += turning
        way *= way
        way *= self._steep
        return np.subtract(self._steepest, way, out=way)


def loose(of: LinkDrive, width_rad: float, share: float = 0.0) -> LinkPlay:
    """Play between two hard flanks: the link lies on one, falls free to the other, and stays there.

    What a link springs back by is in the motor's measured motion already, which every impact throws back.
    """
    return looses(of, [(width_rad, share)])[0]


def looses(of: LinkDrive, plays: Sequence[tuple[float, float]]) -> list[LinkPlay]:
    """`loose` for several pairs of width and the friction's share on the link.

    A sample's acceleration is the mean over the steps around it, half of them before it, which keeps impacts in time.
    """
    columns, steps = _Columns(of, len(plays)), _substeps(of)
    width, share = (columns.of(own) for own in zip(*plays, strict=True))
    friction, high = _LinkFriction(of, share), 0.5 * width
    low, h = -high, np.full_like(high, of.period_s / steps)
    wanted, fall, is_stopped = np.empty_like(high), np.empty_like(high), np.empty(len(high), dtype=bool)
    samples = len(of.torque_Nm)
    found, transmitted = np.empty((3, samples + 1, len(high))), np.empty((samples, len(high)))
    state, middle = None, np.zeros_like(high)
    for part, torque, inertia, slope, motors in columns.rows(steps):
        delta, speed = (low * np.sign(torque[0]), np.zeros_like(high)) if state is None else state
        xs, vs = np.empty_like(torque), np.empty_like(torque)
        for pull, tilt, heavy, motor, x, v in zip(torque, slope, inertia / h, motors, xs, vs, strict=True):
            np.multiply(tilt, delta, out=fall)
            fall += pull
            if friction.is_on:
                heavy += friction.add_to(fall, motor, speed)
            fall /= heavy
            np.subtract(speed, fall, out=v)
            np.multiply(v, h, out=wanted)
            wanted += delta
            np.maximum(wanted, low, out=x)
            np.minimum(x, high, out=x)
            np.not_equal(x, wanted, out=is_stopped)
            np.copyto(v, 0.0, where=is_stopped)
            delta, speed = x, v
        if state is None:
            found[:2, 0] = xs[0], vs[0]
        state = delta, speed
        found[0, part.start + 1 : part.stop + 1] = xs[steps - 1 :: steps]
        found[1, part.start + 1 : part.stop + 1] = vs[steps - 1 :: steps]
        halfway = vs[steps - steps // 2 - 1 :: steps]
        found[2, part] = np.diff(halfway, axis=0, prepend=middle[None]) / of.period_s
        middle = halfway[-1]
        delta_there, speed_there, acceleration = found[:, part]
        pull = torque[::steps] + slope[::steps] * delta_there + inertia[::steps] * acceleration
        for own, motor, beyond in zip(pull, motors[::steps], speed_there, strict=True):
            if friction.is_on:
                friction.add_to(own, motor, beyond)
        transmitted[part] = pull
    return columns.split(found[:, :samples], transmitted)


def _fine(values: Array, steps: int) -> Array:
    """Linear between samples: (samples, runs) to (steps samples, runs)."""
    if steps == 1:
        return values
    following = np.vstack([values[1:], values[-1:]])
    parts = [values + (following - values) * (part / steps) for part in range(steps)]
    return np.stack(parts, axis=1).reshape(-1, values.shape[1])

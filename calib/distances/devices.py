"""The devices of readings, as unknowns: a wire's fixed point, a gauge's direction and zero.

    wire      length = zero + |p - a|           a unknown; zero 0, or unknown
    gauge     length = zero + n . p             n = (n0 + t1 e1 + t2 e2) / |..|, t and zero unknown
    between   length = |p1 - p2|                nothing unknown

p is the tip. Starts are closed forms at the nominal geometry (trilateration; a regression of the readings on the tips).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.parameters import Parameter
from calib.arrays import Array, frozen, norms
from calib.distances.readings import BETWEEN, GAUGE, WIRE, Readings
from calib.errors import UnusablePointsError

LEAST = {WIRE: 4, GAUGE: 4, BETWEEN: 1}  # readings; a wire with an unknown zero needs one more
STEPS = 50
Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Device:
    """One device: its unknowns begin at `parameters`; place (3,): a wire's start, or a gauge's direction n0.

    axes (2, 3): e1 and e2 of a gauge; zero_m: the start of its zero; is_known: whether a wire's place is stated.
    """

    name: str
    kind: str
    parameters: tuple[Parameter, ...]
    place: Array
    axes: Array
    zero_m: float
    is_known: bool = False

    def at(self, values: Array) -> tuple[Array, float]:
        """Fixed point of a wire or direction of a gauge, and the zero, at deviations (k,) of the parameters."""
        if self.kind == WIRE:
            moved, zero = (np.zeros(3), values) if self.is_known else (values[:3], values[3:])
            return self.place + moved, self.zero_m + float(zero.sum())
        if self.kind == GAUGE:
            raw = self.place + values[:2] @ self.axes
            return raw / np.linalg.norm(raw), self.zero_m + float(values[2])
        return self.place, 0.0

    def modelled(self, values: Array, first: Array, second: Array) -> tuple[Array, Array, Array, Array]:
        """Lengths (r,), their derivatives by both tips (r, 3), and by the parameters (r, k)."""
        place, zero_m = self.at(values)
        if self.kind == GAUGE:
            return self._by_gauge(values, first, place, zero_m)
        way = first - (place if self.kind == WIRE else second)
        length = norms(way)
        along = way / np.maximum(length, 1e-12)[:, None]
        own = np.zeros((len(first), len(self.parameters)))
        if self.kind == WIRE:
            if not self.is_known:
                own[:, :3] = -along
            own[:, 0 if self.is_known else 3 :] = 1.0
        return zero_m + length, along, -along if self.kind == BETWEEN else np.zeros_like(along), own

    def _by_gauge(
        self, values: Array, tips: Array, along: Array, zero_m: float
    ) -> tuple[Array, Array, Array, Array]:
        size = float(np.linalg.norm(self.place + values[:2] @ self.axes))
        turns = (self.axes - np.outer(self.axes @ along, along)) / size
        own = np.column_stack((tips @ turns.T, np.ones(len(tips))))
        return zero_m + tips @ along, np.tile(along, (len(tips), 1)), np.zeros_like(tips), own


def devices_of(
    readings: Readings, tips: Array, free_zero: bool, known_m: Mapping[str, Vector], to_spare: int = 0
) -> tuple[Device, ...]:
    """All devices, at their starts by the nominal tips (m, 3). UnusablePointsError for too few readings of one.

    known_m: fixed points of wires in the base frame, by the wires' names; to_spare: readings beyond those that place a device.
    """
    names = list(dict.fromkeys(readings.device))
    for wire in known_m:
        if f"{WIRE}:{wire}" not in names:
            there = ", ".join(name.partition(":")[2] for name in names if name.startswith(WIRE)) or "none"
            raise UnusablePointsError(f'no wire "{wire}" in the readings: expected one of {there}')
    return tuple(_device(name, readings, tips, free_zero, known_m, to_spare) for name in names)


def _device(
    name: str, readings: Readings, tips: Array, free_zero: bool, known_m: Mapping[str, Vector], to_spare: int
) -> Device:
    rows, (kind, _, own) = readings.of(name), name.partition(":")
    is_known = kind == WIRE and own in known_m
    least = 1 if is_known or kind == BETWEEN else LEAST[kind] + (kind == WIRE and free_zero) + to_spare
    if len(rows) < least:
        raise UnusablePointsError(
            f'"{name}": {len(rows)} readings, {least} are needed to find where it stands'
        )
    at, length = tips[readings.pose[rows, 0]], readings.length_m[rows]
    axes, zero_m, place = np.zeros((0, 3)), 0.0, np.zeros(3)
    units: tuple[tuple[str, str], ...] = (("zero", "m"),) if kind == WIRE and free_zero else ()
    if is_known:
        place = np.array(known_m[own])
        zero_m = float(np.mean(length - norms(at - place))) if free_zero else 0.0
    elif kind == WIRE:
        place, zero_m = _fixed_point(at, length, free_zero)
        units = (("x", "m"), ("y", "m"), ("z", "m"), *units)
    elif kind == GAUGE:
        place, zero_m = _direction(name, at, length)
        axes = np.linalg.svd(place[None])[2][1:]
        units = (("tilt1", "rad"), ("tilt2", "rad"), ("zero", "m"))
    called = name.replace(":", "_")
    parameters = tuple(Parameter(f"{called}_{what}", unit, 0.0, math.inf) for what, unit in units)
    return Device(name, kind, parameters, frozen(place), frozen(axes), zero_m, is_known)


def _direction(name: str, tips: Array, length: Array) -> tuple[Array, float]:
    """Unit direction and zero whose readings fit the tips best."""
    centre = tips.mean(axis=0)
    slope, *_ = np.linalg.lstsq(tips - centre, length - length.mean(), rcond=1e-2)
    size = float(np.linalg.norm(slope))
    if size < 1e-9:
        raise UnusablePointsError(
            f'"{name}": its readings do not change with the tip: no direction follows from them'
        )
    direction = slope / size
    return direction, float(np.mean(length - tips @ direction))


def _fixed_point(tips: Array, length: Array, free_zero: bool) -> tuple[Array, float]:
    """Where a wire's fixed point is, and its zero: trilateration, then Gauss-Newton; on both sides of the tips' plane.

    2 p . a - c = p . p - l^2 with c = a . a (- zero^2) is linear in a and c; with an unknown zero also 2 l zero.
    """
    columns = [2.0 * tips, -np.ones((len(tips), 1))] + ([2.0 * length[:, None]] if free_zero else [])
    linear, *_ = np.linalg.lstsq(np.hstack(columns), np.sum(tips**2, axis=1) - length**2, rcond=1e-6)
    first, zero = linear[:3], float(-linear[4]) if free_zero else 0.0
    centre = tips.mean(axis=0)
    normal = np.linalg.svd(tips - centre)[2][2]
    away = float(length.mean())
    starts = [first, first - 2.0 * ((first - centre) @ normal) * normal]
    starts += [centre + side * away * axis for axis in np.eye(3) for side in (1.0, -1.0)]
    found = [_refined(tips, length, start, zero, free_zero) for start in starts]
    _, place, zero_m = min(found, key=lambda one: one[0])
    return place, zero_m


def _refined(
    tips: Array, length: Array, start: Array, zero: float, free_zero: bool
) -> tuple[float, Array, float]:
    """Sum of squares, place and zero after damped Gauss-Newton steps from a start."""
    x = np.append(start, zero) if free_zero else np.array(start)
    damping, best = 1e-3, math.inf

    def residuals(at: Array) -> Array:
        return np.asarray(length - (at[3] if free_zero else 0.0) - norms(tips - at[:3]))

    error = residuals(x)
    best = float(error @ error)
    for _ in range(STEPS):
        way = tips - x[:3]
        slope = -way / np.maximum(norms(way), 1e-9)[:, None]
        if free_zero:
            slope = np.column_stack((slope, np.ones(len(tips))))
        normal = slope.T @ slope
        step = np.linalg.solve(normal + damping * np.eye(len(x)), slope.T @ error)
        moved = residuals(x + step)
        value = float(moved @ moved)
        if value < best:
            x, error, best, damping = x + step, moved, value, 0.1 * damping
        else:
            damping *= 10.0
    return best, x[:3], float(x[3]) if free_zero else 0.0

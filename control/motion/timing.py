"""Velocities and section times from way-points and speeds, for the cubics of spline.py.

Tangent at a way-point between chords d0 (length h0) and d1 (length h1): the direction of h1/h0 d0 + h0/h1 d1,
the parabola through three points over chord length, which is also the exact tangent of the circle through
them.

Arc length of a section whose end tangents make a mean angle phi with its chord h: L = h phi / sin(phi),
exact for circle and straight line.

Section time with speeds v0, v1 at its ends and pace p >= v0, v1, the speed asked for in between:

    T = 3 L p / (2 p^2 + v0 v1)

On a straight section the speed is then a parabola that never exceeds p: constant where v0 = v1 = p (T = L /
p), from rest to p with no acceleration left at p (T = 1.5 L / p), and with p as its crest from rest to rest.

A corner that turns by beta allows cos^2(beta / 2) / cos^2(22.5 deg) of the requested speed, at most all of it:
no loss up to 45 deg (a circle of eight points), nothing at a reversal, where any speed along a tangent would
make a loop.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

from control.motion.setpoint import Vector

# Turning angle up to which a corner keeps its speed: eight points are the coarsest useful circle.
_FREE_TURN = (1.0 + math.cos(math.radians(45.0))) / 2.0
# Below this share of the speed a corner is a reversal, and its tangent is rounding noise.
_REVERSAL = 1e-6


def chord(start: Vector, end: Vector) -> tuple[Vector, float]:
    """Difference end - start and its length [m]."""
    difference = (end[0] - start[0], end[1] - start[1], end[2] - start[2])
    return difference, math.hypot(*difference)


def is_closed(points: Sequence[Vector]) -> bool:
    """Whether the last of more than two way-points is the first one again (within a micrometre)."""
    return len(points) > 3 and chord(points[0], points[-1])[1] < 1e-6


def tangents(points: Sequence[Vector]) -> list[Vector]:
    """Unit tangent at each point (open ends: of the circle through the end section); zero at reversals."""
    inner = [_tangent(*points[i - 1 : i + 2]) for i in range(1, len(points) - 1)]
    if is_closed(points):
        seam = _tangent(points[-2], points[0], points[1])
        return [seam, *inner, seam]
    if not inner:
        inner = [unit(chord(points[0], points[1])[0])]
        return [inner[0], inner[0]]
    return [_mirrored(inner[0], points[0], points[1]), *inner, _mirrored(inner[-1], points[-2], points[-1])]


def corner_factors(points: Sequence[Vector]) -> list[float]:
    """Share of the requested speed that each point's corner allows, 0 .. 1; 1 at open ends."""
    count = len(points)
    factors = [1.0, *(_corner_factor(*points[i - 1 : i + 2]) for i in range(1, count - 1)), 1.0]
    if is_closed(points):
        factors[0] = factors[-1] = _corner_factor(points[-2], points[0], points[1])
    return factors


def arc_lengths(points: Sequence[Vector], directions: Sequence[Vector]) -> list[float]:
    """Length [m] of each section from its chord and the tangents at its ends."""
    lengths = []
    for i in range(len(points) - 1):
        difference, length = chord(points[i], points[i + 1])
        angles = [
            angle for angle in (_angle(directions[j], difference) for j in (i, i + 1)) if angle is not None
        ]
        # Beyond a right angle the chord is not meaningful; a reversal has no tangent and takes its other end's
        # angle.
        phi = min(sum(angles) / len(angles), math.pi / 2.0) if angles else 0.0
        lengths.append(length * phi / math.sin(phi) if phi > 1e-9 else length)
    return lengths


def section_times(lengths: Sequence[float], speeds: Sequence[float], paces: Sequence[float]) -> list[float]:
    """Time of each of n sections [s]; `speeds` at the n + 1 points, `paces` of the sections (see module)."""
    return [
        3.0 * length * pace / (2.0 * pace * pace + start * end)
        for length, (start, end), pace in zip(lengths, pairwise(speeds), paces, strict=True)
    ]


def continuous_velocities(
    points: Sequence[Sequence[float]], times: Sequence[float], first: Sequence[float], last: Sequence[float]
) -> list[tuple[float, ...]]:
    """Velocities at the points for continuous acceleration of the cubics, given the end velocities; any number of axes.

    Equal accelerations at an inner point between sections of T0 and T1 and chords d0 and d1:
    T1 v[i-1] + 2 (T0 + T1) v[i] + T0 v[i+1] = 3 (T1/T0 d0 + T0/T1 d1); solved by the Thomas algorithm, which
    needs no pivoting here because the diagonal dominates.
    """
    axes = [
        _continuous_axis([p[axis] for p in points], times, first[axis], last[axis])
        for axis in range(len(first))
    ]
    return list(zip(*axes, strict=True))


def _continuous_axis(
    values: Sequence[float], times: Sequence[float], first: float, last: float
) -> list[float]:
    """One axis of `continuous_velocities`."""
    count = len(values) - 2
    upper, right = [0.0] * (count + 1), [first] * (count + 1)
    for i in range(1, count + 1):
        t0, t1 = times[i - 1], times[i]
        wanted = 3.0 * (t1 / t0 * (values[i] - values[i - 1]) + t0 / t1 * (values[i + 1] - values[i]))
        pivot = 2.0 * (t0 + t1) - t1 * upper[i - 1]
        upper[i] = t0 / pivot
        right[i] = (wanted - t1 * right[i - 1]) / pivot
    solved = [last]
    for i in range(count, 0, -1):
        solved.append(right[i] - upper[i] * solved[-1])
    return [first, *reversed(solved)]


def unit(vector: Vector) -> Vector:
    """`vector` scaled to length one, or zero where it has none."""
    length = math.hypot(*vector)
    return (vector[0] / length, vector[1] / length, vector[2] / length) if length > 0.0 else (0.0, 0.0, 0.0)


def dot(a: Vector, b: Vector) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _tangent(before: Vector, here: Vector, after: Vector) -> Vector:
    """Unit tangent at `here` of the circle through the three points; zero at a reversal, and where the tip only turns."""
    (d0, h0), (d1, h1) = chord(before, here), chord(here, after)
    if h0 == 0.0 or h1 == 0.0:
        return (0.0, 0.0, 0.0)
    mixed = tuple(h1 / h0 * a + h0 / h1 * b for a, b in zip(d0, d1, strict=True))
    if math.hypot(*mixed) < _REVERSAL * (h0 + h1):
        return (0.0, 0.0, 0.0)
    return unit((mixed[0], mixed[1], mixed[2]))


def _corner_factor(before: Vector, here: Vector, after: Vector) -> float:
    """Share of the speed for the corner at `here`; see the module."""
    (d0, h0), (d1, h1) = chord(before, here), chord(here, after)
    if h0 == 0.0 or h1 == 0.0:
        return 0.0
    factor = (1.0 + dot(d0, d1) / (h0 * h1)) / 2.0 / _FREE_TURN
    return min(factor, 1.0) if factor > _REVERSAL else 0.0


def _mirrored(tangent: Vector, start: Vector, end: Vector) -> Vector:
    """Tangent at the other end of a circular section: `tangent` mirrored in the chord's direction."""
    along = unit(chord(start, end)[0])
    twice = 2.0 * dot(tangent, along)
    return unit((twice * along[0] - tangent[0], twice * along[1] - tangent[1], twice * along[2] - tangent[2]))


def _angle(direction: Vector, difference: Vector) -> float | None:
    """Angle between a unit direction and a chord [rad], None where the direction is zero (a reversal)."""
    if direction == (0.0, 0.0, 0.0):
        return None
    along = unit(difference)
    cosine = dot(direction, along)
    sine = math.hypot(*(d - cosine * a for d, a in zip(direction, along, strict=True)))
    return math.atan2(sine, cosine)

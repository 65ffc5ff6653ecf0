"""Cartesian path of cubic sections: s(t) = a0 + a1 t + a2 t^2 + a3 t^3 (SpringerPlus 5:1771, eq. (3)).

Each section's four coefficients per axis follow from position and velocity at both of its ends. Velocities
come from speeds along the tangent (speed and direction continuous, acceleration steps at way-points), or are
chosen so that the acceleration is continuous too; see py. Evaluation uses plain floats, because it runs
every cycle.
"""

import math
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from control.errors import PathError
from control.kinematics.pose_inverse import TURN_LENGTH_M
from control.motion.setpoint import Vector

# Default speed: slow enough to watch, and usual for friction identification.
DEFAULT_PACE_M_S = 0.1
_REST: Vector = (0.0, 0.0, 0.0)
_COINCIDENT_M = 1e-6  # closer way-points are duplicates; the encoders do not resolve more
_COINCIDENT_RAD = 1e-3  # a smaller turn in place is a duplicate


class CartesianSpline:
    """Sections of cubics over time; immutable.

    Args:
        times_s: start of each section and the end of the last, increasing from 0; n + 1 floats.
        coefficients: per section a0 .. a3 of x, then of y and z [m], [m/s], ...; n tuples of 12 floats.
    """

    __slots__ = ("_sections", "_starts", "coefficients", "duration_s", "times_s")

    def __init__(self, times_s: Iterable[float], coefficients: Iterable[Iterable[float]]) -> None:
        self.times_s = tuple(times_s)
        self.coefficients = tuple(tuple(section) for section in coefficients)
        self.duration_s = self.times_s[-1]
        self._starts = self.times_s[:-1]
        self._sections = tuple((start, *section) for start, section in zip(self._starts, self.coefficients, strict=True))

    def at(self, time_s: float) -> tuple[Vector, Vector, Vector]:
        """Position [m], velocity [m/s] and acceleration [m/s^2] at `time_s`, clamped to the path's time."""
        if time_s < 0.0:
            time_s = 0.0
        elif time_s > self.duration_s:
            time_s = self.duration_s
        section = self._sections[bisect_right(self._starts, time_s) - 1]
        start, x0, x1, x2, x3, y0, y1, y2, y3, z0, z1, z2, z3 = section
        t = time_s - start
        x3t, y3t, z3t = 3.0 * x3 * t, 3.0 * y3 * t, 3.0 * z3 * t
        return (
            (x0 + t * (x1 + t * (x2 + t * x3)), y0 + t * (y1 + t * (y2 + t * y3)), z0 + t * (z1 + t * (z2 + t * z3))),
            (x1 + t * (2.0 * x2 + x3t), y1 + t * (2.0 * y2 + y3t), z1 + t * (2.0 * z2 + z3t)),
            (2.0 * (x2 + x3t), 2.0 * (y2 + y3t), 2.0 * (z2 + z3t)),
        )

    def stretched(self, factor: float) -> "CartesianSpline":
        """The same path in `factor` times the time: speed / factor, acceleration / factor^2."""
        powers = (1.0, factor, factor**2, factor**3) * 3
        scaled = [[a / p for a, p in zip(section, powers, strict=True)] for section in self.coefficients]
        return CartesianSpline((t * factor for t in self.times_s), scaled)


def hermite(points: Sequence[Vector], velocities: Sequence[Vector], times: Sequence[float]) -> CartesianSpline:
    """Sections from positions [m] and velocities [m/s] at their ends (n + 1) and their durations [s] (n)."""
    starts, coefficients = [0.0], []
    for i, duration in enumerate(times):
        section: list[float] = []
        for p0, p1, v0, v1 in zip(points[i], points[i + 1], velocities[i], velocities[i + 1], strict=True):
            slope = (p1 - p0) / duration
            section += (p0, v0, (3.0 * slope - 2.0 * v0 - v1) / duration, (v0 + v1 - 2.0 * slope) / duration**2)
        coefficients.append(section)
        starts.append(starts[-1] + duration)
    return CartesianSpline(starts, coefficients)


@dataclass(frozen=True, slots=True)
class TimedWaypoints:
    """Way-points with the path's speed at each, from which splines are made and slowed.

    `speeds_m_s` at the n + 1 points, after corners and rest; `paces_m_s` of the n sections, see
    `section_times`. `turns_rad` of the sections if the tip also turns; a section counts as long as `_counted` says.
    """

    points: tuple[Vector, ...]
    tangents: tuple[Vector, ...]
    lengths_m: tuple[float, ...]
    speeds_m_s: tuple[float, ...]
    paces_m_s: tuple[float, ...]
    is_acceleration_continuous: bool
    turns_rad: tuple[float, ...] = ()

    def spline(self) -> CartesianSpline:
        """The cubics through the points at these speeds."""
        times = section_times(self.lengths_m, self.speeds_m_s, self.paces_m_s)
        velocities: list[Vector] = [
            (speed * t[0], speed * t[1], speed * t[2]) for speed, t in zip(self.speeds_m_s, self.tangents, strict=True)
        ]
        if self.is_acceleration_continuous:
            joined = continuous_velocities(self.points, times, velocities[0], velocities[-1])
            velocities = [(x, y, z) for x, y, z in joined]
        return hermite(self.points, velocities, times)

    def slowed(self, factors: Sequence[float]) -> "TimedWaypoints":
        """Make each section take at least `factors[i]` (>= 1) times as long, by reducing its end speeds."""
        at_points = [max(pair) for pair in zip((1.0, *factors), (*factors, 1.0), strict=True)]
        return replace(
            self,
            speeds_m_s=tuple(v / k for v, k in zip(self.speeds_m_s, at_points, strict=True)),
            paces_m_s=tuple(v / k for v, k in zip(self.paces_m_s, factors, strict=True)),
        )


def timed(
    waypoints: Iterable[Iterable[float]],
    speeds: float | Sequence[float] | None = None,
    *,
    pace_m_s: float = DEFAULT_PACE_M_S,
    ends_at_rest: bool = True,
    turns_rad: Sequence[float] = (),
) -> TimedWaypoints:
    """Way-points (n + 1 of x, y, z [m]) with speeds [m/s]: one for all, one each, or None.

    With None the sections take the time of `pace_m_s`, and the velocities make the acceleration continuous.
    With `ends_at_rest` the path starts and ends at rest whatever `speeds` says there. Corners lower a speed
    that would make loops, see py. `turns_rad`: by how much the tip turns in each of the n sections; a point may then
    follow itself, and the tip turns in place.

    Raises:
        PathError: fewer than two points, coincident neighbours, not finite, impossible speeds; names the
        way-point.
    """
    points = checked_points(waypoints, turns_rad)
    asked = _checked_speeds(len(points), pace_m_s if speeds is None else speeds)
    # On an acceleration-continuous path the tridiagonal system shapes the corners; the factors only set its
    # times.
    factors = corner_factors(points)
    actual = [speed * factor for speed, factor in zip(asked, factors, strict=True)]
    if ends_at_rest:
        actual[0] = actual[-1] = 0.0
    paces = _paces(asked)
    directions = tangents(points)
    lengths = arc_lengths(points, directions)
    counted = _counted(lengths, turns_rad)
    for i, (length, as_long) in enumerate(zip(lengths, counted, strict=True)):
        if as_long > length:  # the tip turns more than it moves: it passes both ends slower
            actual[i : i + 2] = [min(speed, length / as_long * paces[i]) for speed in actual[i : i + 2]]
    return TimedWaypoints(
        points=tuple(points),
        tangents=tuple(directions),
        lengths_m=tuple(counted),
        speeds_m_s=tuple(actual),
        paces_m_s=tuple(paces),
        is_acceleration_continuous=speeds is None and counted == lengths,
        turns_rad=tuple(turns_rad),
    )


def _paces(speeds_m_s: Sequence[float]) -> list[float]:
    """The faster of both ends' speeds for each section [m/s]; PathError where both are 0."""
    paces = [max(pair) for pair in pairwise(speeds_m_s)]
    for i, pace in enumerate(paces):
        if pace <= 0.0:
            raise PathError(
                f"way-points {i + 1} and {i + 2} both have 0 m/s, so the path between them has no speed:"
                " give one of them a speed",
                i + 1,
            )
    return paces


def _counted(lengths_m: Sequence[float], turns_rad: Sequence[float]) -> list[float]:
    """Lengths that decide the sections' times: at least 0.1 m for each radian that the tip turns."""
    if not turns_rad:
        return list(lengths_m)
    return [max(length, TURN_LENGTH_M * turn) for length, turn in zip(lengths_m, turns_rad, strict=True)]


def checked_points(waypoints: Iterable[Iterable[float]], turns_rad: Sequence[float] = ()) -> list[Vector]:
    """Two or more finite points, no neighbours the same unless the tip turns between them."""
    points: list[Vector] = []
    for number, waypoint in enumerate(waypoints, 1):
        point = tuple(float(value) for value in waypoint)
        if len(point) != 3 or not all(map(math.isfinite, point)):
            raise PathError(f"way-point {number}: expected three finite numbers x, y, z in m, got {point}", number)
        is_same = points and chord(points[-1], (point[0], point[1], point[2]))[1] < _COINCIDENT_M
        if is_same and len(turns_rad) >= len(points) and turns_rad[len(points) - 1] > _COINCIDENT_RAD:
            point = points[-1]
        elif is_same:
            raise PathError(f"way-points {number - 1} and {number} are the same point {point}: remove one", number)
        points.append((point[0], point[1], point[2]))
    if len(points) < 2:
        raise PathError(f"a path needs at least two way-points, got {len(points)}")
    return points


def _checked_speeds(count: int, speeds: float | Sequence[float]) -> list[float]:
    """One finite speed per point, none negative."""
    listed = [float(speeds)] * count if isinstance(speeds, int | float) else [float(speed) for speed in speeds]
    if len(listed) != count:
        raise PathError(f"expected one speed for all or one for each of the {count} way-points, got {len(listed)}")
    for number, speed in enumerate(listed, 1):
        if not 0.0 <= speed < math.inf:
            raise PathError(f"way-point {number}: expected a speed of 0 m/s or more, got {speed}", number)
    return listed


# Velocities and section times from way-points and speeds, for the cubics of spline.py.
#
# Tangent at a way-point between chords d0 (length h0) and d1 (length h1): the direction of h1/h0 d0 + h0/h1 d1,
# the parabola through three points over chord length, which is also the exact tangent of the circle through
# them.
#
# Arc length of a section whose end tangents make a mean angle phi with its chord h: L = h phi / sin(phi),
# exact for circle and straight line.
#
# Section time with speeds v0, v1 at its ends and pace p >= v0, v1, the speed asked for in between:
#
#     T = 3 L p / (2 p^2 + v0 v1)
#
# On a straight section the speed is then a parabola that never exceeds p: constant where v0 = v1 = p (T = L /
# p), from rest to p with no acceleration left at p (T = 1.5 L / p), and with p as its crest from rest to rest.
#
# A corner that turns by beta allows cos^2(beta / 2) / cos^2(22.5 deg) of the requested speed, at most all of it:
# no loss up to 45 deg (a circle of eight points), nothing at a reversal, where any speed along a tangent would
# make a loop.

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
        angles = [angle for angle in (_angle(directions[j], difference) for j in (i, i + 1)) if angle is not None]
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
    axes = [_continuous_axis([p[axis] for p in points], times, first[axis], last[axis]) for axis in range(len(first))]
    return list(zip(*axes, strict=True))


def _continuous_axis(values: Sequence[float], times: Sequence[float], first: float, last: float) -> list[float]:
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

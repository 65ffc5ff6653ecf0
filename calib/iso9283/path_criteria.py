"""Path characteristics, ISO 9283:1998 clauses 8.2 to 8.4: deviation of the attained path from the commanded one.

A commanded path is m calculation points (m, 3); attained paths are n recordings, each (k, 3) in the order of time,
k differing. Attained point (i, j) is where attained path j crosses the normal plane of the commanded path
at its point i.

"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, norms
from calib.iso9283.pose_criteria import SIGMAS, Iso9283Error, above_zero, direction, position, positions, track


@dataclass(frozen=True, slots=True)
class PathDeviation:
    """`total_m`, the largest of the deviations along the path; `skipped`: number of calculation points that an attained path does
    not cross, such as those at the ends.
    """

    total_m: float
    skipped: int


def calculation_points(commanded_m: npt.ArrayLike, count: int, margin: float = 0.0) -> tuple[Array, Array]:
    """`count` points (count, 3) at equal distances along a commanded polyline, and its unit tangents there.

    `margin`: the share of the length omitted at either end.
    """
    line = positions(commanded_m, "commanded path", least=2)
    steps = norms(np.diff(line, axis=0))
    line = line[np.concatenate(([True], steps > 0.0))]
    length = np.concatenate(([0.0], np.cumsum(steps[steps > 0.0])))
    if length[-1] <= 0.0:
        raise Iso9283Error("commanded path: all its points are the same")
    if count < 2 or not 0.0 <= margin < 0.5:
        raise Iso9283Error(f"calculation points: expected 2 or more and a margin below 0.5, got {count}, {margin}")
    at = length[-1] * np.linspace(margin, 1.0 - margin, count)
    reach = 0.5 * (at[1] - at[0])
    points, ahead, behind = (_along(line, length, at + shift) for shift in (0.0, reach, -reach))
    tangent = ahead - behind
    size = norms(tangent)
    if (size <= 0.0).any():
        raise Iso9283Error("commanded path: it turns back on itself at a calculation point")
    return points, np.asarray(tangent / size[:, None])


def crossings(points_m: npt.ArrayLike, tangents: npt.ArrayLike, attained_m: npt.ArrayLike) -> Array:
    """Where one attained path (k, 3) crosses the normal planes of points (m, 3): (m, 3), NaN where it does not.

    Of several crossings, the one nearest to the point counts.
    """
    points, along = positions(points_m, "calculation points"), positions(tangents, "tangents")
    attained = positions(attained_m, "attained path", least=2)
    crossings_m = np.full_like(points, np.nan)
    for i, (point, tangent) in enumerate(zip(points, along, strict=True)):
        height = (attained - point) @ tangent
        k = np.flatnonzero((height[:-1] <= 0.0) != (height[1:] <= 0.0))
        if len(k):
            share = height[k] / (height[k] - height[k + 1])
            places = attained[k] + share[:, None] * (attained[k + 1] - attained[k])
            crossings_m[i] = places[int(np.argmin(norms(places - point)))]
    return crossings_m


def path_accuracy(points_m: npt.ArrayLike, attained_m: npt.ArrayLike) -> PathDeviation:
    """AT (clause 8.2): the largest distance from the commanded path to the barycentre line of the attained ones.

    AT_p = max_i sqrt((x_bar_i - x_ci)^2 + (y_bar_i - y_ci)^2 + (z_bar_i - z_ci)^2), x_bar_i = 1/n sum_j x_ij.
    points_m (m, 3), attained_m (n, m, 3) of `crossings`, n >= 1 (ten in the standard).
    """
    points, attained, used = _sections(points_m, attained_m, "path accuracy", 1)
    distance = norms(attained.mean(axis=0) - points)
    return PathDeviation(float(distance.max()), int((~used).sum()))


def path_repeatability(points_m: npt.ArrayLike, attained_m: npt.ArrayLike) -> PathDeviation:
    """RT (clause 8.3): the largest radius, along the path, about the barycentre line.

    RT_p = max_i (l_bar_i + 3 S_li), l_ij = |p_ij - p_bar_i|, S_li = sqrt(sum_j (l_ij - l_bar_i)^2 / (n - 1)); n >= 2.
    """
    _, attained, used = _sections(points_m, attained_m, "path repeatability", 2)
    lengths = np.linalg.norm(attained - attained.mean(axis=0), axis=2)
    radius = lengths.mean(axis=0) + SIGMAS * lengths.std(axis=0, ddof=1)
    return PathDeviation(float(radius.max()), int((~used).sum()))


def _sections(
    points_m: npt.ArrayLike, attained_m: npt.ArrayLike, what: str, least: int
) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Points and attained crossings with one on every attained path; required for at least half of the points."""
    points, attained = positions(points_m, what), np.asarray(attained_m, dtype=np.float64)
    if attained.ndim != 3 or attained.shape[1:] != points.shape:
        raise Iso9283Error(f"{what}: expected attained paths (n, {len(points)}, 3), got {attained.shape}")
    if len(attained) < least:
        raise Iso9283Error(f"{what}: needs at least {least} attained paths, got {len(attained)}")
    used: npt.NDArray[np.bool_] = np.asarray(np.isfinite(attained).all(axis=(0, 2)))
    if 2 * used.sum() < len(points):
        raise Iso9283Error(
            f"{what}: only {used.sum()} of {len(points)} calculation points are passed by every attained path: check that"
            " commanded and attained paths are in the same frame and recorded to the end"
        )
    return points[used], attained[:, used], used


def _along(line: Array, length: Array, at_m: Array) -> Array:
    """Points of a polyline at distances from its start; extrapolated beyond its ends."""
    inside = np.column_stack([np.interp(at_m, length, line[:, axis]) for axis in range(3)])
    first, last = line[1] - line[0], line[-1] - line[-2]
    before, after = np.minimum(at_m, 0.0), np.maximum(at_m - length[-1], 0.0)
    ends = np.outer(before, first / np.linalg.norm(first)) + np.outer(after, last / np.linalg.norm(last))
    return np.asarray(inside + ends)


# Cornering deviations, ISO 9283:1998 clause 8.5: rounding and overshoot at a sharp corner without a stop.
def corner_round_off(corner_m: npt.ArrayLike, attained_m: Sequence[npt.ArrayLike]) -> float:
    """CR (clause 8.5): the least distance from the corner to the attained path, the mean of n cycles.

    CR = 1/n sum_j min_i |p_ij - p_e|; corner_m (3,), each attained path (k, 3). Between samples the path is
    straight.
    """
    corner = position(corner_m, "corner")
    return float(np.mean([_distance_to(corner, path) for path in _paths(attained_m)]))


def corner_overshoot(
    corner_m: npt.ArrayLike,
    first_direction: npt.ArrayLike,
    second_direction: npt.ArrayLike,
    length_m: float,
    attained_m: Sequence[npt.ArrayLike],
) -> float:
    """CO (clause 8.5): the largest distance beyond the second leg, on the far side of the first, mean of n cycles.

    With the second leg as z axis from the corner and the first leg arriving in the negative y half plane,
    CO_j = max_i sqrt(x_i^2 + y_i^2) over samples with y_i > 0 and 0 <= z_i <= length_m, else 0; CO = 1/n sum_j CO_j.
    Directions (3,) are those of travel along the legs.
    """
    corner, along = position(corner_m, "corner"), direction(second_direction, "second leg")
    arriving = position(first_direction, "first leg")
    outward = arriving - (arriving @ along) * along
    if np.linalg.norm(outward) < 1e-9 * np.linalg.norm(arriving):
        raise Iso9283Error("corner: its two legs lie on one line")
    outward = direction(outward, "first leg")
    largest = []
    for path in _paths(attained_m):
        offset = path - corner
        z, y = offset @ along, offset @ outward
        beyond = norms(offset - np.outer(z, along))[(y > 0.0) & (z >= 0.0) & (z <= length_m)]
        largest.append(float(beyond.max()) if len(beyond) else 0.0)
    return float(np.mean(largest))


def _paths(attained_m: Sequence[npt.ArrayLike]) -> list[Array]:
    if not len(attained_m):
        raise Iso9283Error("cornering: needs at least one attained path")
    return [positions(path, "cornering, attained path", least=2) for path in attained_m]


def _distance_to(point: Array, path: Array) -> float:
    """From a point to a polyline."""
    start, step = path[:-1], np.diff(path, axis=0)
    size = np.maximum(np.einsum("ij,ij->i", step, step), 1e-300)
    share = np.clip(np.einsum("ij,ij->i", point - start, step) / size, 0.0, 1.0)
    return float(norms(start + share[:, None] * step - point).min())


# Path velocity characteristics, ISO 9283:1998 clause 8.6: accuracy, repeatability and fluctuation of the speed.
@dataclass(frozen=True, slots=True)
class PathVelocity:
    """AV and RV in % of the commanded speed (RV None for a single cycle), FV in m/s."""

    accuracy_percent: float
    repeatability_percent: float | None
    fluctuation_m_s: float


def path_velocity(commanded_m_s: float, speeds_m_s: Sequence[npt.ArrayLike]) -> PathVelocity:
    """AV, RV and FV (clause 8.6) from the speeds of n cycles, each (m_j,) at constant commanded speed.

    v_bar_j = 1/m sum_i v_ij, v_bar = 1/n sum_j v_bar_j; AV = 100 (v_bar - v_c) / v_c;
    RV = +-100 . 3 S_v / v_c, S_v = sqrt(sum_j (v_bar_j - v_bar)^2 / (n - 1)); FV = max_j (max_i v_ij - min_i v_ij).
    """
    wanted = above_zero(commanded_m_s, "path velocity, commanded")
    cycles = [np.asarray(speeds, dtype=np.float64) for speeds in speeds_m_s]
    if not cycles or any(c.ndim != 1 or not len(c) or not np.isfinite(c).all() for c in cycles):
        raise Iso9283Error("path velocity: expected finite speeds of at least one cycle, none of them empty")
    means = np.array([cycle.mean() for cycle in cycles])
    repeatability = 100.0 * SIGMAS * float(means.std(ddof=1)) / wanted if len(means) > 1 else None
    return PathVelocity(
        100.0 * (float(means.mean()) - wanted) / wanted, repeatability, max(float(cycle.max() - cycle.min()) for cycle in cycles)
    )


def speeds(time_s: npt.ArrayLike, tip_m: npt.ArrayLike, window_s: float) -> tuple[Array, Array]:
    """Times (m,) and speeds (m,) [m/s]: slopes of straight lines fitted to the positions within `window_s`.

    A position noise of s per axis leaves about s sqrt(12 / w) / window_s per axis with w samples in the window.
    """
    times, tips = track(time_s, tip_m, "speed along the path", least=3)
    period = float(np.median(np.diff(times)))
    width = max(2, min(len(times), 1 + round(above_zero(window_s, "speed window") / period)))
    t = np.lib.stride_tricks.sliding_window_view(times, width)
    p = np.lib.stride_tricks.sliding_window_view(tips, width, axis=0)
    centre = t.mean(axis=1)
    off = t - centre[:, None]
    slope = np.einsum("iw,iaw->ia", off, p) / np.einsum("iw,iw->i", off, off)[:, None]
    return centre, norms(slope)


# Weaving deviations, ISO 9283:1998 clause 11: stroke and frequency of a path that weaves about a line.
@dataclass(frozen=True, slots=True)
class Weave:
    """A recorded weave: `stroke_m` from crest to crest across the line, `frequency_Hz`."""

    stroke_m: float
    frequency_Hz: float


def weaving_deviations(commanded: Weave, attained: Weave) -> tuple[float, float]:
    """WS and WF (clause 11) in %: WS = 100 |s_a - s_c| / s_c, WF = 100 (f_a - f_c) / f_c.

    s: stroke, f: frequency; index a attained, c commanded.
    """
    stroke = above_zero(commanded.stroke_m, "weaving, commanded stroke")
    frequency = above_zero(commanded.frequency_Hz, "weaving, commanded frequency")
    return (100.0 * abs(attained.stroke_m - stroke) / stroke, 100.0 * (attained.frequency_Hz - frequency) / frequency)


def weave_of(time_s: npt.ArrayLike, tip_m: npt.ArrayLike, across: npt.ArrayLike) -> Weave:
    """Stroke and frequency of a recorded weave; `across` (3,) is the direction across the line.

    Crests are the extremes between crossings of the middle; the stroke is the mean distance from crest to crest, the
    frequency that of the crossings. The first and last half weaves, where the arm starts and stops, do not
    count.
    """
    times, tips = track(time_s, tip_m, "weaving")
    swing = (tips - tips.mean(axis=0)) @ direction(across, "direction across the weave")
    y = swing - np.polyval(np.polyfit(times - times[0], swing, 1), times - times[0])  # tilt of the line
    y = y - 0.5 * (y.max() + y.min())
    at = _crossings(y, 0.1 * float(y.max() - y.min()))
    if len(at) < 4:
        raise Iso9283Error(f"weaving: needs at least four crossings of the middle line, got {len(at)}")
    # Crest to crest on the measured values: the tilt of the line cancels between up and down.
    crests = np.array([swing[a + 1 + int(np.argmax(np.abs(y[a + 1 : b + 1])))] for a, b in itertools.pairwise(at)])
    strokes = np.abs(np.diff(crests))
    share = y[at] / (y[at] - y[at + 1])
    crossed_s = times[at] + share * (times[at + 1] - times[at])
    half_waves = len(at) - 1
    frequency = 0.5 * half_waves / float(crossed_s[-1] - crossed_s[0])
    return Weave(0.5 * float(strokes[::2].mean() + strokes[1::2].mean()) if len(strokes) > 1 else float(strokes[0]), frequency)


def _crossings(y: Array, least: float) -> npt.NDArray[np.intp]:
    """Sample before each zero crossing that reaches at least `least`, to ignore noise."""
    samples: list[int] = []
    side = 0.0
    last = 0
    for k, value in enumerate(y):
        if abs(value) < least:
            continue
        if side and np.sign(value) != side:
            between = y[last : k + 1]
            samples.append(last + int(np.flatnonzero(np.sign(between[:-1]) != np.sign(between[1:]))[0]))
        side, last = float(np.sign(value)), k
    return np.array(samples, dtype=np.intp)

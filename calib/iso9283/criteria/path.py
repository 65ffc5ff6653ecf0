"""Path characteristics, ISO 9283:1998 clauses 8.2 to 8.4: deviation of the attained path from the commanded one.

A commanded path is m calculation points (m, 3); attained paths are n recordings, each (k, 3) in the order of time,
k differing. Attained point (i, j) is where attained path j crosses the normal plane of the commanded path
at its point i.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, frozen, norms
from calib.iso9283.criteria.checks import Iso9283Error, positions
from calib.iso9283.criteria.pose import SIGMAS


@dataclass(frozen=True, slots=True)
class PathDeviation:
    """`total_m`, the largest of the deviations along the path (used points,) in m, and where they are.

    `point_m` (used, 3) commanded points; `skipped`: number of calculation points that an attained path does not cross, such as
    those at the ends.
    """

    total_m: float
    along_m: Array
    point_m: Array
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
        raise Iso9283Error(
            f"calculation points: expected 2 or more and a margin below 0.5, got {count}, {margin}"
        )
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
    points, directions = positions(points_m, "calculation points"), positions(tangents, "tangents")
    attained = positions(attained_m, "attained path", least=2)
    found = np.full_like(points, np.nan)
    for i, (point, direction) in enumerate(zip(points, directions, strict=True)):
        height = (attained - point) @ direction
        k = np.flatnonzero((height[:-1] <= 0.0) != (height[1:] <= 0.0))
        if len(k):
            share = height[k] / (height[k] - height[k + 1])
            places = attained[k] + share[:, None] * (attained[k + 1] - attained[k])
            found[i] = places[int(np.argmin(norms(places - point)))]
    return found


def path_accuracy(points_m: npt.ArrayLike, attained_m: npt.ArrayLike) -> PathDeviation:
    """AT (clause 8.2): the largest distance from the commanded path to the barycentre line of the attained ones.

    AT_p = max_i sqrt((x_bar_i - x_ci)^2 + (y_bar_i - y_ci)^2 + (z_bar_i - z_ci)^2), x_bar_i = 1/n sum_j x_ij.
    points_m (m, 3), attained_m (n, m, 3) of `crossings`, n >= 1 (ten in the standard).
    """
    points, attained, used = _sections(points_m, attained_m, "path accuracy", 1)
    distance = norms(attained.mean(axis=0) - points)
    return PathDeviation(float(distance.max()), frozen(distance), frozen(points), int((~used).sum()))


def path_repeatability(points_m: npt.ArrayLike, attained_m: npt.ArrayLike) -> PathDeviation:
    """RT (clause 8.3): the largest radius, along the path, about the barycentre line.

    RT_p = max_i (l_bar_i + 3 S_li), l_ij = |p_ij - p_bar_i|, S_li = sqrt(sum_j (l_ij - l_bar_i)^2 / (n - 1)); n >= 2.
    """
    points, attained, used = _sections(points_m, attained_m, "path repeatability", 2)
    lengths = np.linalg.norm(attained - attained.mean(axis=0), axis=2)
    radius = lengths.mean(axis=0) + SIGMAS * lengths.std(axis=0, ddof=1)
    return PathDeviation(float(radius.max()), frozen(radius), frozen(points), int((~used).sum()))


def orientation_path_accuracy(commanded_rad: npt.ArrayLike, attained_rad: npt.ArrayLike) -> Array:
    """AT_a, AT_b, AT_c (clause 8.2): max_i |a_bar_i - a_ci| about each axis, (3,).

    commanded_rad (m, 3), attained_rad (n, m, 3). Path accuracy on reorientation (clause 8.4) is AT_p by
    `path_accuracy` on a straight path with alternating orientation.
    """
    wanted, attained = positions(commanded_rad, "orientation along the path"), np.asarray(attained_rad)
    if attained.ndim != 3 or attained.shape[1:] != wanted.shape or not np.isfinite(attained).all():
        raise Iso9283Error(
            f"orientation along the path: expected finite angles (n, {len(wanted)}, 3), got {attained.shape}"
        )
    turned = (attained - wanted + np.pi) % (2.0 * np.pi) - np.pi
    return frozen(np.abs(turned.mean(axis=0)).max(axis=0))


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

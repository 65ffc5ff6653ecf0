"""Shapes without a name: what a residual is tested against, so that an effect that is not in the list is noticed.

They are never reported as effects. Where one of them explains what is left, its words say where the gap is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calib.arrays import Array, frozen
from calib.points import Points

SIZE_rad = 0.003  # typical, at the shape's own scale
STEPS_COUNT = 24  # of times and of angles where something may have changed


@dataclass(frozen=True, slots=True)
class Shape:
    """Columns (c, m, n) that move joint `joint` (1-based) with `variable`; `words` say so."""

    joint: int
    variable: str
    words: str
    slope_rad: Array


def shapes(points: Points) -> tuple[Shape, ...]:
    """All of them for these poses; those that are constant here are left out."""
    found = []
    for j in range(points.joint_count):
        found += [
            *_of_angles(points, j),
            *_of_direction(points, j),
            *_of_time(points, j),
            *_of_load(points, j),
        ]
    return tuple(shape for shape in found if np.ptp(shape.slope_rad, axis=1).max() > 0.0)


def _shape(points: Points, j: int, variable: str, words: str, *courses: Array) -> Shape:
    """`courses` (m,) scaled to SIZE_rad, acting on joint j."""
    own = np.eye(points.joint_count)[j]
    scaled = [SIZE_rad * course / max(1e-12, float(np.abs(course).max())) for course in courses]
    return Shape(
        j + 1,
        variable,
        f"joint {j + 1}: {words}",
        frozen(np.stack([course[:, None] * own for course in scaled])),
    )


def _of_angles(points: Points, j: int) -> Iterator[Shape]:
    """Powers and harmonics of every angle, and products of two."""
    q = points.q_rad
    for i in range(points.joint_count):
        name, angle = f"q{i + 1}", q[:, i]
        yield _shape(points, j, name, f"follows q{i + 1} (linearly)", angle)
        yield _shape(points, j, name, f"follows the sine of q{i + 1}", np.sin(angle), np.cos(angle))
        yield _shape(points, j, name, f"follows the square of q{i + 1}", angle**2)
        yield _shape(points, j, name, f"follows the cube of q{i + 1}", angle**3)
        yield _shape(
            points, j, name, f"follows q{i + 1} twice per turn", np.sin(2 * angle), np.cos(2 * angle)
        )
        yield _shape(
            points, j, name, f"follows q{i + 1} three times per turn", np.sin(3 * angle), np.cos(3 * angle)
        )
        for edge in _edges(angle):
            yield _shape(
                points, j, name, f"steps where q{i + 1} passes {edge:.2f} rad", np.sign(angle - edge)
            )
    for i, k in combinations(range(points.joint_count), 2):
        yield _shape(points, j, f"q{i + 1}q{k + 1}", f"follows q{i + 1} times q{k + 1}", q[:, i] * q[:, k])


def _of_direction(points: Points, j: int) -> Iterator[Shape]:
    """Direction of the last motion of any joint, alone and with its own angle."""
    for i in range(points.joint_count):
        last = points.direction[:, i]
        yield _shape(points, j, f"dir{i + 1}", f"follows the last direction of joint {i + 1}", last)
    own = points.direction[:, j]
    yield _shape(
        points, j, f"dir{j + 1}", "follows its last direction times its angle", own * points.q_rad[:, j]
    )


def _of_time(points: Points, j: int) -> Iterator[Shape]:
    """Drifts and steps in time."""
    if not np.isfinite(points.t_s).all() or np.ptp(points.t_s) == 0.0:
        return
    time = (points.t_s - points.t_s.min()) / np.ptp(points.t_s)
    yield _shape(points, j, "time", "drifts with time", time)
    yield _shape(points, j, "time", "drifts with the square of time", time**2)
    for edge in _edges(points.t_s):
        yield _shape(points, j, "time", f"steps at {edge:.0f} s", np.sign(points.t_s - edge))


def _of_load(points: Points, j: int) -> Iterator[Shape]:
    """Stated payload and holding current."""
    if np.isfinite(points.payload_kg).all():
        yield _shape(points, j, "payload", "follows the payload", points.payload_kg)
    for i in range(points.joint_count):
        current = points.current_A[:, i]
        if np.isfinite(current).all():
            yield _shape(
                points, j, f"i{i + 1}", f"follows the square of the current of joint {i + 1}", current**2
            )


def _edges(values: Array) -> Array:
    """Quantiles between which a step is looked for."""
    return np.unique(np.quantile(values, np.linspace(0.0, 1.0, STEPS_COUNT + 2)[1:-1]))

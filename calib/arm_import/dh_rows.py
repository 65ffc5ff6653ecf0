"""DH rows from joint axes in space: the inverse of forward kinematics at joint angles zero.

Both conventions are the same sequence of screws Z(d, theta) X(L, alpha) Z(d, theta + q1) X ... Z, grouped by [Z X] (standard)
or [X Z] (modified). Z screws lie on the axes, X screws on the common normals of neighbouring axes. What comes before joint 1
and behind joint n becomes a fixed row if it is not nothing, so that any base and tip frame are held exactly.

Axes that are parallel but for a small angle have their common normal far away. Such a pair gets one fixed row between: the
joint's row reaches the next axis without a twist, the fixed row turns into it. No angle is rounded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arrays import Array
from control.kinematics.chain import link_transforms
from control.model.arm import Convention

PARALLEL: Final = 1e-12  # sine of the angle between two axes below which they are parallel
SAME_LINE_m: Final = 1e-12
FAR: Final = 20.0  # times the distance of two axes: beyond it, a common normal is no place on an arm
NEAR_m: Final = 1.0  # the least that counts as far, times FAR
ROUND: Final = 1e-13  # rounding of the closed forms: such a length is 0, such an angle the right one


@dataclass(frozen=True, slots=True)
class Axis:
    """A joint's axis in the base frame at joint angles zero: a point on it and its unit direction."""

    point_m: Array
    direction: Array


@dataclass(frozen=True, slots=True)
class Row:
    """A DH row; `joint` is 1-based, None for a fixed one."""

    joint: int | None
    d_m: float
    theta_rad: float
    L_m: float
    alpha_rad: float


@dataclass(frozen=True, slots=True)
class Screw:
    """A move along and a turn about an axis."""

    move_m: float = 0.0
    turn_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class ScrewPair:
    """Z, with joint `joint` if it turns there, then X."""

    joint: int | None
    z: Screw
    x: Screw = Screw()


def dh_rows(axes: Sequence[Axis], base_T_tip: Array, convention: Convention) -> tuple[Row, ...]:
    """The rows of an arm with these axes whose last frame at joint angles zero is `base_T_tip` (4, 4)."""
    pairs, frame = _to_line(np.eye(4), None, axes[0])
    for number, target in enumerate([*axes[1:], Axis(base_T_tip[:3, 3], base_T_tip[:3, 2])], start=1):
        more, frame = _to_line(frame, number, target)
        pairs += more
    rest = np.linalg.inv(frame) @ base_T_tip
    pairs.append(ScrewPair(None, _tidy(float(rest[2, 3]), math.atan2(rest[1, 0], rest[0, 0]))))
    rows = _standard(pairs) if convention == "standard" else _modified(pairs)
    return tuple(row for row in rows if row.joint is not None or any((row.d_m, row.theta_rad, row.L_m, row.alpha_rad)))


def frames_at_zero(rows: Sequence[Row], convention: Convention) -> Array:
    """The frames (rows, 4, 4) of the rows in the base frame, at joint angles zero."""
    dh = np.array([(r.d_m, r.theta_rad, r.L_m, r.alpha_rad) for r in rows])
    turns = [row.joint is not None for row in rows]
    frames: Array = link_transforms(dh, np.zeros((1, sum(turns))), turns, convention)[0][1:]
    return frames


def _standard(pairs: Sequence[ScrewPair]) -> list[Row]:
    return [Row(p.joint, p.z.move_m, p.z.turn_rad, p.x.move_m, p.x.turn_rad) for p in pairs]


def _modified(pairs: Sequence[ScrewPair]) -> list[Row]:
    before = [Screw(), *(pair.x for pair in pairs[:-1])]
    return [Row(p.joint, p.z.move_m, p.z.turn_rad, x.move_m, x.turn_rad) for p, x in zip(pairs, before, strict=True)]


def _to_line(frame: Array, joint: int | None, target: Axis) -> tuple[list[ScrewPair], Array]:
    """The pairs from a frame to one whose z lies on the target line, and that frame."""
    point, direction = _seen_from(frame, target)
    pair = _common_normal(joint, point, direction)
    if _is_far(pair, point, direction):
        level = _without_twist(joint, point, direction)
        reached = frame @ _matrix(level)
        turning = _common_normal(None, *_seen_from(reached, target))
        turning = ScrewPair(None, Screw(0.0, turning.z.turn_rad), Screw(0.0, turning.x.turn_rad))
        return [level, turning], reached @ _matrix(turning)
    return [pair], frame @ _matrix(pair)


def _seen_from(frame: Array, target: Axis) -> tuple[Array, Array]:
    back = frame[:3, :3].T
    return back @ (target.point_m - frame[:3, 3]), back @ target.direction


def _common_normal(joint: int | None, point: Array, direction: Array) -> ScrewPair:
    """Z and X along the common normal of the z axis and a line (both in the same frame)."""
    sine = math.hypot(direction[0], direction[1])
    if sine < PARALLEL:
        return _parallel(joint, point, direction)
    normal = np.array([-direction[1], direction[0], 0.0]) / sine
    length = float(normal @ point)
    # Heights of both feet: where the line, moved along the normal, meets the z axis.
    along = -float(point[:2] @ direction[:2]) / sine**2
    height = float(point[2] + along * direction[2])
    flip = length < -SAME_LINE_m or (abs(length) <= SAME_LINE_m and _turns_back(normal))
    sign = -1.0 if flip else 1.0
    theta = math.atan2(sign * normal[1], sign * normal[0])
    alpha = math.atan2(sign * sine, float(direction[2]))
    return ScrewPair(joint, _tidy(height, theta), _tidy(abs(length), alpha))


def _turns_back(normal: Array) -> bool:
    """Of the two normals of crossing axes, the one nearer to the frame's own x is taken."""
    return bool(normal[0] < -ROUND or (abs(normal[0]) <= ROUND and normal[1] < 0.0))


def _parallel(joint: int | None, point: Array, direction: Array) -> ScrewPair:
    """Without a unique common normal: the one at the frame's origin."""
    length = math.hypot(point[0], point[1])
    theta = math.atan2(point[1], point[0]) if length > SAME_LINE_m else 0.0
    alpha = 0.0 if direction[2] > 0.0 else math.pi
    return ScrewPair(joint, _tidy(0.0, theta), _tidy(length if length > SAME_LINE_m else 0.0, alpha))


def _is_far(pair: ScrewPair, point: Array, direction: Array) -> bool:
    sine = math.hypot(direction[0], direction[1])
    most = FAR * max(NEAR_m, float(np.linalg.norm(point)))
    return PARALLEL <= sine < 0.5 and abs(pair.z.move_m) > most


def _without_twist(joint: int | None, point: Array, direction: Array) -> ScrewPair:
    """To where a nearly parallel line meets the plane z = 0, as if it were parallel."""
    meets = point - direction * (point[2] / direction[2])
    return _parallel(joint, meets, direction)


def _tidy(move_m: float, turn_rad: float) -> Screw:
    """Without the closed forms' rounding: 6e-17 m is 0, an angle beside a multiple of a quarter turn is that."""
    quarter = 0.5 * math.pi * round(turn_rad / (0.5 * math.pi))
    turn = quarter if abs(turn_rad - quarter) < ROUND else turn_rad
    return Screw(0.0 if abs(move_m) < ROUND else move_m, (math.pi if turn == -math.pi else turn) + 0.0)


def _matrix(pair: ScrewPair) -> Array:
    c, s = math.cos(pair.z.turn_rad), math.sin(pair.z.turn_rad)
    about_z = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, pair.z.move_m], [0, 0, 0, 1]])
    c, s = math.cos(pair.x.turn_rad), math.sin(pair.x.turn_rad)
    about_x = np.array([[1, 0, 0, pair.x.move_m], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])
    product: Array = about_z @ about_x
    return product

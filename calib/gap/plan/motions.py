"""Motions of the joints that excite what time series can tell: ramps and reversals, multisines, shakes, wide swings.

Each is drawn around the middle of a room, checked against every limit of the arm, and slowed as a whole where one asks for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, Mask
from calib.design.candidates import body_points, joint_box, spread_poses
from calib.errors import CalibrationError
from control.dynamics.static_pose import gravity_Nm
from control.errors import MissingModel
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.motion.joint_limits import JointLimits
from control.motion.joint_path import JointPath
from control.motion.setpoint import SetPoint

# A box of joint angles in which the whole arm is clear of floor and board, whatever way it takes.
#
# Every straight joint move and every motion between two of its poses stays in the box, so that what is planned inside needs no
# ways around anything.

CLEARANCE_m = 0.06  # of an arm that is not calibrated and may be 3 cm off
LOOKED_AT = 3000  # poses spread over the box
CUT = 0.04  # of a joint's range, taken off one end at a time
LEAST_rad = 0.5  # of a joint's travel that a recording needs to tell anything
STARTS = 40  # boxes to begin with: cutting is greedy
NO_PULL_Nm = 0.02  # less is no pull


@dataclass(frozen=True, slots=True)
class CollisionFreeBox:
    """Lower and upper joint angles (n,) of the box."""

    lower_rad: Array
    upper_rad: Array

    @property
    def middle_rad(self) -> Array:
        """The box's middle (n,)."""
        return 0.5 * (self.lower_rad + self.upper_rad)

    @property
    def width_rad(self) -> Array:
        """By how much each joint may turn (n,)."""
        return self.upper_rad - self.lower_rad

    def at(self, share: Array) -> Array:
        """Poses (..., n) from shares of the box, 0 to 1."""
        return np.asarray(self.lower_rad + share * self.width_rad)

    def inset(self, margin_rad: float) -> CollisionFreeBox:
        """The same with so much kept free at every end."""
        return CollisionFreeBox(self.lower_rad + margin_rad, self.upper_rad - margin_rad)

    def holds(self, q_rad: Array) -> bool:
        """Whether all poses (..., n) are inside."""
        rounding = 1e-9
        return bool(((q_rad >= self.lower_rad - rounding) & (q_rad <= self.upper_rad + rounding)).all())


def collision_free_box(arm: Arm, clearance_m: float = CLEARANCE_m) -> CollisionFreeBox:
    """The best box that cutting ends off the joints' ranges leads to; the same every time.

    Best: wide, and with gravity pulling every joint both ways, so that a gear's flanks show. CalibrationError where a joint has
    no room left.
    """
    lower, upper = joint_box(arm)
    poses = spread_poses((lower, upper), LOOKED_AT)
    is_clear = clear(arm, poses, clearance_m)
    pull_Nm = _gravity_Nm(arm, poses)
    cut = CUT * (upper - lower)
    draw = np.random.default_rng(0)
    best: tuple[float, CollisionFreeBox] | None = None
    for start in range(STARTS):
        ends = draw.uniform(0.0, 0.4 if start else 0.0, (2, len(lower))) * (upper - lower)
        room = _grown_down(poses, is_clear, CollisionFreeBox(lower + ends[0], upper - ends[1]), cut)
        worth = -np.inf if room is None else _worth(room, poses, pull_Nm)
        if room is not None and (best is None or worth > best[0]):
            best = (worth, room)
    if best is None:
        raise CalibrationError(
            f"arm {arm.name}: no collision-free box of joint angles: expected {LEAST_rad:g} rad or more for each joint,"
            f" {1e3 * clearance_m:g} mm clear of floor and board"
        )
    return best[1]


def _worth(room: CollisionFreeBox, poses: Array, pull_Nm: Array | None) -> float:
    """Logarithm of the box's volume, and of the part of it in which gravity pulls the way that it seldom does."""
    worth = float(np.log(room.width_rad).sum())
    if pull_Nm is None:
        return worth
    inside = pull_Nm[((poses >= room.lower_rad) & (poses <= room.upper_rad)).all(axis=1)]
    pulled = np.abs(pull_Nm).max(axis=0) > NO_PULL_Nm
    up, down = (inside > NO_PULL_Nm).mean(axis=0), (inside < -NO_PULL_Nm).mean(axis=0)
    return worth + float(np.log(np.minimum(up, down) + 0.02)[pulled].sum())


def _gravity_Nm(arm: Arm, poses: Array) -> Array | None:
    """What gravity asks of the joints (m, n); None where the arm's file lacks masses."""
    try:
        return gravity_Nm(arm, poses)
    except MissingModel:
        return None


def _grown_down(poses: Array, is_clear: Mask, room: CollisionFreeBox, cut: Array) -> CollisionFreeBox | None:
    """Ends cut off until all of the box is clear; None where that leaves too little."""
    lower, upper = room.lower_rad, room.upper_rad
    while True:
        inside = ((poses >= lower) & (poses <= upper)).all(axis=1)
        bad = poses[inside & ~is_clear]
        if ((upper - lower) < LEAST_rad).any() or not inside.any():
            return None
        if not len(bad):
            return CollisionFreeBox(lower, upper)
        lower, upper = _cut(poses[inside & is_clear], bad, lower, upper, cut)


def clear(arm: Arm, q_rad: Array, clearance_m: float = CLEARANCE_m) -> Mask:
    """Which poses (m, n) keep every part that moves so far above floor and board (m,)."""
    heights = body_points(arm, q_rad)[:, :, 2]
    moves = np.ptp(heights, axis=0) > 1e-6 if len(heights) > 1 else np.ones(heights.shape[1], dtype=bool)
    return np.asarray((heights[:, moves] >= ground_m(arm) + clearance_m).all(axis=1))


def ground_m(arm: Arm) -> float:
    """Height of the board's top or of the floor that may be touched, whichever is higher."""
    board = arm.table
    top_m = board.origin_m[2] if board is not None and board.origin_m is not None else arm.limits.floor_z_m
    return max(arm.limits.floor_z_m + arm.limits.floor_clearance_m, top_m)


def _cut(good: Array, bad: Array, lower: Array, upper: Array, cut: Array) -> tuple[Array, Array]:
    """Take off the slice that costs the fewest clear poses for each that is not."""
    choices = []
    for j in range(len(lower)):
        for is_upper in (False, True):
            edge = upper[j] - cut[j] if is_upper else lower[j] + cut[j]
            cost, gone = (int(np.sum((q[:, j] > edge) == is_upper)) for q in (good, bad))
            if gone:
                choices.append((cost / gone, j, is_upper))
    if not choices:  # what is bad lies in the middle: take off where most of the box is left
        j = int(np.argmax(upper - lower))
        choices = [(0.0, j, bool(np.median(bad[:, j]) > 0.5 * (lower[j] + upper[j])))]
    _, j, is_upper = min(choices)
    new_lower, new_upper = lower.copy(), upper.copy()
    if is_upper:
        new_upper[j] -= cut[j]
    else:
        new_lower[j] += cut[j]
    return new_lower, new_upper


KNOT_s = 0.025  # quintics between knots follow 9 Hz within 2e-4 of the amplitude
EASE_s = 0.8  # in which a multisine begins and ends
USED = 0.9  # of a limit at most: the controller needs the rest
FILLED = 0.9  # of half the room's width at most
TURN_s = 0.2  # of a ramp: in which it takes up speed

Curve = tuple[Array, Array, Array]
"""Angle, speed and acceleration over time, (m,) each."""


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """What a motion is held to: the joints' limits, and the tip's speed with the kinematics that it takes."""

    joints: JointLimits
    tip_speed_m_s: float
    kinematics: ForwardKinematics

    @classmethod
    def of(cls, arm: Arm) -> MotionLimits:
        """Those of an arm."""
        return cls(JointLimits.of(arm), arm.limits.tip_speed_m_s, ForwardKinematics(arm))


def multisine(
    room: CollisionFreeBox, limits: MotionLimits, band_Hz: tuple[float, float], size: float, duration_s: float, seed: int
) -> JointPath:
    """Sums of five sines within a band, other phases and frequencies for every joint; `size`: of what room and limits allow."""
    draw = np.random.default_rng((seed, round(100 * band_Hz[0])))
    t = _times(duration_s)
    curves = []
    for j, middle in enumerate(room.middle_rad):
        w = 2.0 * np.pi * np.geomspace(*band_Hz, 5) * draw.uniform(0.93, 1.07, 5)
        curve = _eased(t, duration_s, _sines(t, w, 1.0 / w, draw.uniform(0.0, 2.0 * np.pi, 5)))
        half = FILLED * min(middle - room.lower_rad[j], room.upper_rad[j] - middle)
        q, v, a = (_room_for(curve, j, float(half), limits.joints) * size * values for values in curve)
        curves.append((middle + q, v, a))
    return slowed(_path(t, curves), limits)


def _room_for(curve: Curve, j: int, half_rad: float, limits: JointLimits) -> float:
    """The greatest factor with which the curve stays in half a room and below the joint's limits."""
    q, v, a = (max(float(np.abs(values).max()), 1e-12) for values in curve)
    jerk = max(float(np.abs(np.diff(curve[2])).max()) / KNOT_s, 1e-12)
    return min(
        half_rad / q,
        USED * limits.speed_rad_s[j] / v,
        USED * limits.acceleration_rad_s2[j] / a,
        USED * limits.jerk_rad_s3[j] / jerk,
    )


def shake(room: CollisionFreeBox, limits: MotionLimits, band_Hz: tuple[float, float], duration_s: float, seed: int) -> JointPath:
    """As fast as the limits on jerk and acceleration allow, past where the joints can be controlled; a few milliradians."""
    draw = np.random.default_rng((seed, 7))
    t = _times(duration_s)
    curves = []
    for j, middle in enumerate(room.middle_rad):
        w = 2.0 * np.pi * np.geomspace(*band_Hz, 7) * draw.uniform(0.95, 1.05, 7)
        jerk, acceleration = limits.joints.jerk_rad_s3[j], limits.joints.acceleration_rad_s2[j]
        amplitude = np.minimum(jerk / w**3, acceleration / w**2) * USED / len(w)
        q, v, a = _eased(t, duration_s, _sines(t, w, amplitude, draw.uniform(0.0, 2.0 * np.pi, 7)))
        curves.append((middle + q, v, a))
    return slowed(_path(t, curves), limits)


def ramps(
    room: CollisionFreeBox, limits: MotionLimits, shares: Sequence[float], leg_s: float, at: Sequence[float] = ()
) -> JointPath:
    """There and back at constant speeds, each for `leg_s`; every joint has them in another order.

    `shares` of the joints' speed limits; `at`: shares of the room where it is, the middle by default.
    """
    middle = room.at(np.array(at)) if len(at) else room.middle_rad
    joints = []
    for j, start in enumerate(middle.tolist()):
        reach = FILLED * float(min(start - room.lower_rad[j], room.upper_rad[j] - start))
        legs, base = [(np.zeros(1),) * 3], 0.0
        for k in range(len(shares)):
            # the time of a leg is the same for all joints, so that they stay in step
            way = min(shares[(k + j) % len(shares)] * limits.joints.speed_rad_s[j] * leg_s, reach)
            out = way if (k + j) % 2 == 0 else -way
            for turn in (out, -out):
                q, v, a = _leg(turn, leg_s)
                legs.append((q[1:] + base, v[1:], a[1:]))
                base += float(q[-1])
        q, v, a = (np.concatenate([leg[k] for leg in legs]) for k in range(3))
        joints.append((start + q, v, a))
    return slowed(_path(_times((len(joints[0][0]) - 1) * KNOT_s), joints), limits)


def slowed(path: JointPath, limits: MotionLimits, used: float = USED) -> JointPath:
    """The same motion in as much more time as its greatest demand asks for; as it is where it asks for nothing."""
    factor = demand(path, limits) / used
    if factor <= 1.0:
        return path
    times = [factor * t for t in path.times_s]
    knots = [
        SetPoint(knot.q_rad, tuple(v / factor for v in knot.speed_rad_s), tuple(a / factor**2 for a in knot.acceleration_rad_s2))
        for knot in path.knots
    ]
    return JointPath(times, knots)


def demand(path: JointPath, limits: MotionLimits) -> float:
    """By what factor the motion would have to be slower to meet every limit: below 1 it meets them."""
    q, v, a = (np.array([knot[k] for knot in path.knots]) for k in range(3))
    jerk = np.diff(a, axis=0) / np.diff(path.times_s)[:, None]
    tip = np.linalg.norm(np.einsum("mij,mj->mi", limits.kinematics.jacobians(q), v), axis=1)
    joints = limits.joints
    return max(
        float(np.max(np.abs(v) / joints.speed_rad_s)),
        math.sqrt(float(np.max(np.abs(a) / joints.acceleration_rad_s2))),
        float(np.cbrt(np.max(np.abs(jerk) / joints.jerk_rad_s3))),
        float(tip.max()) / limits.tip_speed_m_s,
    )


def poses_of(path: JointPath) -> Array:
    """Angles at the knots (k, n)."""
    return np.array([knot.q_rad for knot in path.knots])


def _times(duration_s: float) -> Array:
    count = math.ceil(duration_s / KNOT_s - 1e-9) + 1
    return np.asarray(KNOT_s * np.arange(count), dtype=np.float64)


def _sines(t: Array, w: Array, amplitude: Array, phase: Array) -> Curve:
    angle = np.outer(t, w) + phase
    return (
        np.asarray(np.sin(angle) @ amplitude),
        np.asarray(np.cos(angle) @ (amplitude * w)),
        np.asarray(-np.sin(angle) @ (amplitude * w**2)),
    )


def _eased(t: Array, duration_s: float, curve: Curve) -> Curve:
    """A curve that grows out of rest and sinks back to it: times a window with three continuous derivatives."""
    q, v, a = curve
    rise, fall = _smooth(t / EASE_s), _smooth((duration_s - t) / EASE_s)
    window = rise[0] * fall[0]
    slope = (rise[1] * fall[0] - rise[0] * fall[1]) / EASE_s
    bend = (rise[2] * fall[0] - 2.0 * rise[1] * fall[1] + rise[0] * fall[2]) / EASE_s**2
    return window * q, window * v + slope * q, window * a + 2.0 * slope * v + bend * q


def _smooth(s: Array) -> Curve:
    """s^4 (35 - 84 s + 70 s^2 - 20 s^3) from 0 to 1, with two derivatives."""
    s = np.clip(s, 0.0, 1.0)
    return (
        s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3),
        140.0 * (s * (1.0 - s)) ** 3,
        420.0 * (s * (1.0 - s)) ** 2 * (1.0 - 2.0 * s),
    )


def _leg(way_rad: float, leg_s: float) -> Curve:
    """From 0 to way_rad: speed taken up and given up within TURN_s each, v(s) = s - sin(2 pi s) / (2 pi) of the cruise."""
    t = _times(leg_s + TURN_s)
    total = float(t[-1])
    cruise = way_rad / (total - TURN_s)
    up, down = np.clip(t / TURN_s, 0.0, 1.0), np.clip((total - t) / TURN_s, 0.0, 1.0)
    v = cruise * (_risen(up) + _risen(down) - 1.0)
    a = cruise / TURN_s * ((1.0 - np.cos(2.0 * np.pi * up)) - (1.0 - np.cos(2.0 * np.pi * down)))
    gone = TURN_s * _risen_area(up) + np.maximum(t - TURN_s, 0.0)
    left = TURN_s * _risen_area(1.0 - down)
    return cruise * (gone - left), v, a


def _risen(s: Array) -> Array:
    return np.asarray(s - np.sin(2.0 * np.pi * s) / (2.0 * np.pi))


def _risen_area(s: Array) -> Array:
    """Integral of `_risen`: half at s = 1."""
    return np.asarray(0.5 * s * s + (np.cos(2.0 * np.pi * s) - 1.0) / (4.0 * np.pi**2))


def _path(t: Array, curves: Sequence[Curve]) -> JointPath:
    """One path of all joints; its ends are at rest to the last digit."""
    q, v, a = (np.column_stack([curve[k] for curve in curves]) for k in range(3))
    v[[0, -1]] = a[[0, -1]] = 0.0
    rows = zip(q.tolist(), v.tolist(), a.tolist(), strict=True)
    return JointPath(t.tolist(), [SetPoint(*map(tuple, row)) for row in rows])

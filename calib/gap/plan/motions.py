"""Motions of the joints that excite what time series can tell: ramps and reversals, multisines, shakes, wide swings.

Each is drawn around the middle of a room, checked against every limit of the arm, and slowed as a whole where one asks for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.plan.collision_free_box import CollisionFreeBox
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.motion.joint_limits import JointLimits
from control.motion.joint_path import JointPath
from control.motion.setpoint import SetPoint

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
    room: CollisionFreeBox,
    limits: MotionLimits,
    band_Hz: tuple[float, float],
    size: float,
    duration_s: float,
    seed: int,
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


def shake(
    room: CollisionFreeBox, limits: MotionLimits, band_Hz: tuple[float, float], duration_s: float, seed: int
) -> JointPath:
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
    room: CollisionFreeBox,
    limits: MotionLimits,
    shares: Sequence[float],
    leg_s: float,
    at: Sequence[float] = (),
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
        SetPoint(
            knot.q_rad,
            tuple(v / factor for v in knot.speed_rad_s),
            tuple(a / factor**2 for a in knot.acceleration_rad_s2),
        )
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

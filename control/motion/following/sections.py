"""A followed path as joint sections for the loop: quintics between as few of its samples as keep the tip on the path.

A section is halved until its quintic, which has angle, speed and acceleration of the samples at both ends, passes the samples
between them within half of the bound. So the loop evaluates polynomials, and neither iterates nor can fail on the way. At a
way-point where the path's acceleration steps, the mean of both sides is taken, and the sections beside it become short.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from control.motion.joint_path import JointPath, quintic
from control.motion.samples import Array, JointSamples, TipSamples
from control.motion.setpoint import SetPoint

BOUND_M, BOUND_RAD = 1e-6, 1e-5  # of the tip beside the path
LONGEST_S = 0.1  # the loop's guard looks at the knots of a path before it begins
_SHARE = 0.5  # of the bound, at the samples


@dataclass(frozen=True, slots=True)
class _Samples:
    """The path's samples, each way-point once."""

    times_s: Array
    q_rad: Array
    speed_rad_s: Array
    acceleration_rad_s2: Array
    jacobian: Array


@dataclass(frozen=True, slots=True)
class JointSections:
    """The path of the joints, and by how much the tip departs from the samples at most."""

    path: JointPath
    off_m: float
    off_rad: float


def joint_sections(tip: TipSamples, joints: JointSamples, jacobian: Array, stretch: float) -> JointSections:
    """The sections of a path from rest to rest, run `stretch` times slower than sampled; `jacobian` (m, 6, n)."""
    samples = _merged(tip, joints, jacobian, stretch)
    count = len(samples.times_s)
    is_knot = np.zeros(count, dtype=np.bool_)
    is_knot[[0, -1]] = True
    is_knot[
        np.searchsorted(samples.times_s, stretch * tip.times_s[np.flatnonzero(np.diff(tip.section)) + 1])
    ] = True
    while True:
        off_m, off_rad = _departures(samples, is_knot)
        knots = np.flatnonzero(is_knot)
        section = np.cumsum(is_knot)[:-1] - 1  # of the interval after each sample
        is_far = np.maximum(off_m / BOUND_M, off_rad / BOUND_RAD)[:-1] > _SHARE
        worst = np.zeros(len(knots) - 1, dtype=np.bool_)
        np.logical_or.at(worst, section, is_far)
        worst |= np.diff(samples.times_s[knots]) > LONGEST_S * 1.001
        middles = ((knots[:-1] + knots[1:]) // 2)[worst & (np.diff(knots) > 1)]
        if not middles.size:
            break
        is_knot[middles] = True
    path = JointPath(
        samples.times_s[knots].tolist(),
        (
            SetPoint(tuple(q), tuple(v), tuple(a))
            for q, v, a in zip(
                samples.q_rad[knots].tolist(),
                samples.speed_rad_s[knots].tolist(),
                samples.acceleration_rad_s2[knots].tolist(),
                strict=True,
            )
        ),
    )
    return JointSections(path, float(off_m.max()), float(off_rad.max()))


def _merged(tip: TipSamples, joints: JointSamples, jacobian: Array, stretch: float) -> _Samples:
    """Each way-point's two samples as one with the mean acceleration, and rest at both ends."""
    is_first = np.diff(tip.section, prepend=tip.section[0]) > 0
    twin = np.flatnonzero(is_first)
    speed = joints.speed_rad_s / stretch
    acceleration = joints.acceleration_rad_s2 / stretch**2
    for values in (speed, acceleration):
        values[twin] = 0.5 * (values[twin] + values[twin - 1])
        values[[0, -1]] = 0.0
    kept = np.ones(len(tip.times_s), dtype=np.bool_)
    kept[twin - 1] = False
    return _Samples(
        stretch * tip.times_s[kept], joints.q_rad[kept], speed[kept], acceleration[kept], jacobian[kept]
    )


def _departures(samples: _Samples, is_knot: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Distance [m] and angle [rad] (m,) of the tip at the quintics between the knots from the tip at the samples."""
    knots = np.flatnonzero(is_knot)
    section = np.minimum(np.cumsum(is_knot) - 1, len(knots) - 2)
    first, last = knots[section], knots[section + 1]
    h = (samples.times_s[last] - samples.times_s[first])[:, None]
    s = (samples.times_s[:, None] - samples.times_s[first][:, None]) / h
    q0, v0, a0 = (
        values[first] for values in (samples.q_rad, samples.speed_rad_s, samples.acceleration_rad_s2)
    )
    q1, v1, a1 = (
        values[last] for values in (samples.q_rad, samples.speed_rad_s, samples.acceleration_rad_s2)
    )
    c0, c1, c2, c3, c4, c5 = quintic(h, q0, v0, a0, q1, v1, a1)
    q = c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5))))
    moved = (samples.jacobian @ (q - samples.q_rad)[:, :, None])[:, :, 0]
    return np.linalg.norm(moved[:, :3], axis=1), np.linalg.norm(moved[:, 3:], axis=1)

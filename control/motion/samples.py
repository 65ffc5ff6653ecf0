"""Samples of a whole path for the checks before a motion: numpy batches, not used in the cycle."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from control.kinematics.kinematics import ForwardKinematics
from control.motion.spline import CartesianSpline

Array = NDArray[np.float64]
# Newton steps: seeds are a tenth of a section apart and convergence is quadratic, so five suffice.
_NEWTON_STEPS = 6
_CONVERGED_M = 1e-9
_LONGEST_STEP_RAD = 0.3


@dataclass(frozen=True, slots=True)
class TurnSamples:
    """The tip's rotation (m, 3, 3), angular velocity and acceleration (m, 3) in the base frame."""

    rotation: Array
    velocity_rad_s: Array
    acceleration_rad_s2: Array


@dataclass(frozen=True, slots=True)
class TipSamples:
    """Times (m,), section of each (m,), and tip position, velocity, acceleration (m, 3) in the base frame.

    Each section is sampled from end to end, so that way-points appear twice and both one-sided accelerations. `turn`: None if
    the orientation is free.
    """

    times_s: Array
    section: NDArray[np.int64]
    position_m: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    turn: TurnSamples | None = None


@dataclass(frozen=True, slots=True)
class JointSamples:
    """Joint angles, speeds and accelerations (m, n) at the samples; `is_solved` (m,): the pose exists.

    `off` (m, 6): where the joints cannot hold all, position [m] and orientation [rad] wanted minus actual; `jacobian` (m, 6, n).
    """

    q_rad: Array
    speed_rad_s: Array
    acceleration_rad_s2: Array
    smallest_singular_m: Array
    is_solved: NDArray[np.bool_]
    off: Array | None = None
    jacobian: Array | None = None


def sample_tip(spline: CartesianSpline, rate_Hz: float, least: int) -> TipSamples:
    """Sample each section at `rate_Hz` or at `least` points, whichever is more."""
    starts = np.array(spline.times_s)
    durations = np.diff(starts)
    counts = np.maximum(least, np.ceil(durations * rate_Hz).astype(np.int64) + 1)
    section = np.repeat(np.arange(len(durations)), counts)
    within = np.arange(len(section)) - np.repeat(np.cumsum(counts) - counts, counts)
    t = (within / (counts - 1)[section] * durations[section])[:, None]
    a = np.array(spline.coefficients).reshape(-1, 3, 4)[section]
    return TipSamples(
        times_s=starts[section] + t[:, 0],
        section=section,
        position_m=a[:, :, 0] + t * (a[:, :, 1] + t * (a[:, :, 2] + t * a[:, :, 3])),
        velocity_m_s=a[:, :, 1] + t * (2.0 * a[:, :, 2] + t * 3.0 * a[:, :, 3]),
        acceleration_m_s2=2.0 * a[:, :, 2] + t * 6.0 * a[:, :, 3],
    )


def solve_joints(kinematics: ForwardKinematics, tip: TipSamples, seeds_rad: Array) -> JointSamples:
    """Joint samples by Newton from seeds (m, 3), which must be on the branch and near."""
    q = seeds_rad.copy()
    for _ in range(_NEWTON_STEPS):
        error = tip.position_m - kinematics.tips(q)
        if np.abs(error).max() < _CONVERGED_M:
            break
        # A damped step cannot jump to another branch if a pose does not exist.
        q += np.clip(_solve(kinematics.jacobians(q), error), -_LONGEST_STEP_RAD, _LONGEST_STEP_RAD)
    jacobians = kinematics.jacobians(q)
    speed = _solve(jacobians, tip.velocity_m_s)
    bias = _bias(kinematics, q, speed)
    return JointSamples(
        q_rad=q,
        speed_rad_s=speed,
        acceleration_rad_s2=_solve(jacobians, tip.acceleration_m_s2 - bias),
        smallest_singular_m=np.asarray(np.linalg.svd(jacobians, compute_uv=False)[:, -1], dtype=np.float64),
        is_solved=np.abs(tip.position_m - kinematics.tips(q)).max(axis=1) < 1e3 * _CONVERGED_M,
    )


def interpolated(times_s: Array, known_s: Sequence[float], known_q_rad: Sequence[Sequence[float]]) -> Array:
    """Seeds (m, n) between known poses, linear in time."""
    columns = np.array(known_q_rad).T
    return np.stack([np.interp(times_s, known_s, column) for column in columns], axis=1)


def _solve(jacobians: Array, right: Array) -> Array:
    """Solve J x = right for each sample; if one is singular, by slightly damped least squares."""
    try:
        return _solved(jacobians, right)
    except np.linalg.LinAlgError:
        transposed = np.swapaxes(jacobians, 1, 2)
        damped = transposed @ jacobians + 1e-12 * np.eye(3)
        return _solved(damped, (transposed @ right[:, :, None])[:, :, 0])


def _solved(matrices: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(matrices, right[:, :, None])[:, :, 0], dtype=np.float64)


def _bias(kinematics: ForwardKinematics, q: Array, speed: Array) -> Array:
    """Jdot qd (m, 3) by a central difference of J along qd: 1e-9 relative, enough for a limit."""
    step = 1e-5 / np.maximum(np.abs(speed).max(axis=1, keepdims=True), 1e-9)
    change = kinematics.jacobians(q + step * speed) - kinematics.jacobians(q - step * speed)
    return np.asarray((change @ speed[:, :, None])[:, :, 0] / (2.0 * step), dtype=np.float64)

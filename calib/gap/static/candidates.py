"""Every effect that could move the tip of an arm at rest, with what it would do at each pose.

Laws and signs are those of control.model.effect_laws: joint angle = encoder angle + law. Each is linear in its coefficients
at a known pose; `parameters` turns coefficients into the parameters of formats.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from calib.arrays import Array, Mask, frozen
from calib.gap.finding import EffectName
from calib.points import Points
from control.errors import MissingModel
from control.model.arm import Arm
from control.model.effect_laws import backlash_rad, compliance_rad
from control.model.static_pose import CURRENT_NOISE_A, GRAVITY_ERROR, RestingPose, resting, torque_per_A

Parameters = Mapping[str, tuple[float, float]]
# Sizes that are common on self-built arms: the prior's standard deviation, and what `nameable` is judged for.
WIDTH_rad = 0.005
SCALE = 0.005
AMPLITUDE_rad = 0.003
SOFTNESS_rad_Nm = 1.0 / 800.0
RATIO = 0.01
DRIFT_rad = 0.003
TIME_CONSTANTS_s = tuple(np.geomspace(30.0, 30_000.0, 13))
NO_TORQUE_Nm = 1e-6
SHARE_STEP = 0.1
LINK_SHARES = tuple((SHARE_STEP * np.arange(11)).tolist())
DRIFT_SPAN_LEAST = (
    0.05  # of a drift's time constant that a session must last for it to differ from a constant
)


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect with c coefficients: `slope_rad` (c, m, n) moves joints, per unit; `size` (c,) is typical.

    Candidates of one name are shapes of one effect, of which at most one applies (`shape` says which). `is_positive`: its
    coefficients cannot be negative, a play or a softness. `unsure` (m,): poses in which nobody can tell what the effect does.
    """

    name: EffectName
    slope_rad: Array
    size: Array
    parameters: Callable[[Array, Array], Parameters]
    is_positive: bool = False
    shape: float = 0.0
    unsure: Mask | None = None


def candidates(arm: Arm, points: Points) -> tuple[Candidate, ...]:
    """All of them, those that need masses or times left out where there are none."""
    found = [*_of_the_encoder(points)]
    try:
        pose = resting(arm, points.q_rad, points.direction, points.current_A, _payload(points))
    except MissingModel:
        pose = None
    if pose is not None:
        found += _of_the_gear(points, pose, CURRENT_NOISE_A * torque_per_A(arm))
    if np.isfinite(points.t_s).all() and np.ptp(points.t_s) > 0.0:
        found += _of_the_time(points)
    return tuple(found)


def _payload(points: Points) -> Array:
    return np.nan_to_num(points.payload_kg)


def _of_the_encoder(points: Points) -> Iterator[Candidate]:
    """Scale, eccentricity, and the belt that couples joint 3 to joint 2."""
    q, n = points.q_rad, points.joint_count
    for j in range(n):
        own = np.eye(n)[j]
        yield _plain("encoder_scale", j + 1, q * own, SCALE, "scale")
        both = np.stack((np.sin(q) * own, np.cos(q) * own))
        size = np.full(2, AMPLITUDE_rad)
        yield Candidate(
            EffectName("encoder_eccentricity", j + 1), frozen(both), frozen(size), _amplitude_and_phase
        )
    if n >= 3:
        yield _plain("belt_coupling", None, q[:, 1:2] * np.eye(n)[2], RATIO, "ratio")


def _of_the_gear(points: Points, pose: RestingPose, noise_Nm: Array) -> Iterator[Candidate]:
    """Backlash and compliance, from what the gears transmit."""
    n = points.joint_count
    for j in range(n):
        own = np.eye(n)[j]
        for share, flank in _flanks(pose, j, noise_Nm[j]):
            slope = backlash_rad(flank, 1.0)[:, None] * own
            play = _plain("backlash", j + 1, slope, WIDTH_rad, "width_rad", is_positive=True)
            yield dataclasses.replace(play, shape=share, unsure=flank == 0.0)
        slope = compliance_rad(pose.gravity_Nm, 1.0) * own
        if np.abs(slope).max() > NO_TORQUE_Nm:
            size = np.array([SOFTNESS_rad_Nm])
            yield Candidate(
                EffectName("joint_compliance", j + 1),
                frozen(slope[None]),
                frozen(size),
                _stiffness,
                is_positive=True,
            )


def _flanks(pose: RestingPose, j: int, noise_Nm: float) -> Iterator[tuple[float, Array]]:
    """The flank of joint j in every pose, (m,), for a row of shares of its friction that act on the link's side.

    Nobody knows that share; it decides only poses where friction outweighs gravity. Joints that a hand led keep the flank that
    their motor shows. 0 where the torque is too small to have a sign.
    """
    told: list[Array] = []
    for share in LINK_SHARES:
        gravity, held = pose.gravity_Nm[:, j], pose.held_Nm[:, j]
        torque = gravity + share * held
        doubt = GRAVITY_ERROR * np.abs(gravity) + 0.5 * SHARE_STEP * np.abs(held) + 3.0 * share * noise_Nm
        driven = np.where(np.abs(torque) > doubt, np.sign(torque), 0.0)
        flank = np.where(pose.is_led[:, j], pose.flank[:, j], driven)
        if flank.any() and not any(np.array_equal(flank, other) for other in told):
            told.append(flank)
            yield share, flank


def _of_the_time(points: Points) -> Iterator[Candidate]:
    """A joint that warms up: 1 - exp(-t / T), for a row of time constants T."""
    elapsed = points.t_s - points.t_s.min()
    n = points.joint_count
    for j in range(n):
        for constant in TIME_CONSTANTS_s:
            if elapsed.max() < DRIFT_SPAN_LEAST * constant:
                continue
            course = 1.0 - np.exp(-elapsed / constant)
            yield Candidate(
                EffectName("thermal_drift", j + 1),
                frozen((course[:, None] * np.eye(n)[j])[None]),
                frozen([DRIFT_rad]),
                partial(_drift, float(constant)),
                shape=float(constant),
            )


def _drift(time_constant_s: float, value: Array, covariance: Array) -> Parameters:
    """The coefficient, and the time constant that was tried."""
    final = (float(value[0]), float(np.sqrt(covariance[0, 0])))
    return {"final_rad": final, "time_constant_s": (time_constant_s, float("nan"))}


def _plain(
    effect: str,
    joint: int | None,
    slope: Array,
    size: float,
    parameter: str,
    is_positive: bool = False,
) -> Candidate:
    """An effect whose only parameter is its coefficient."""
    return Candidate(
        EffectName(effect, joint),
        frozen(slope[None]),
        frozen([size]),
        lambda value, covariance: {parameter: (float(value[0]), float(np.sqrt(covariance[0, 0])))},
        is_positive,
    )


def _stiffness(value: Array, covariance: Array) -> Parameters:
    """1 / coefficient."""
    softness, sd = float(value[0]), float(np.sqrt(covariance[0, 0]))
    return {"stiffness_Nm_rad": (1.0 / softness, sd / softness**2)}


def _amplitude_and_phase(value: Array, covariance: Array) -> Parameters:
    """Of a sin q + b cos q = A sin(q + phase)."""
    a, b = float(value[0]), float(value[1])
    amplitude = float(np.hypot(a, b))
    by_amplitude, by_phase = np.array([a, b]) / amplitude, np.array([-b, a]) / amplitude**2
    return {
        "amplitude_rad": (amplitude, float(np.sqrt(by_amplitude @ covariance @ by_amplitude))),
        "phase_rad": (float(np.arctan2(b, a)), float(np.sqrt(by_phase @ covariance @ by_phase))),
    }

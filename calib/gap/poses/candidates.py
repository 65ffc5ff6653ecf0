"""Every effect that could move the tip of an arm at rest, with what it would do at each pose.

Laws and signs are those of control.dynamics.effect_laws: joint angle = encoder angle + law. Each is linear in its coefficients
at a known pose; what hangs on loads is in `loads`, what moves the frame of the measurement in `frame`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial

import numpy as np

from calib.arm_problem.joint_laws import LAWS
from calib.arrays import Array, Mask, frozen
from calib.gap.finding import EffectName
from calib.gap.poses.candidate import Candidate, Parameters, amplitude_and_phase, inverse, plain
from calib.gap.poses.frame import of_the_frame
from calib.gap.poses.loads import of_the_loads, stated_kg
from calib.points.points import Points
from control.dynamics.effect_laws import backlash_rad, compliance_rad
from control.dynamics.static_pose import CURRENT_NOISE_A, GRAVITY_ERROR, RestingPose, resting, torque_per_A
from control.errors import MissingModel
from control.model.arm import Arm

# Sizes that are common on self-built arms: the prior's standard deviation, and what `nameable` is judged for.
WIDTH_rad = 0.005
SCALE = 0.005
AMPLITUDE_rad = 0.003
SOFTNESS_rad_Nm = 1.0 / 800.0
RATIO = 0.01
DRIFT_rad = 0.003
TIME_CONSTANTS_s = tuple(np.geomspace(30.0, 30_000.0, 19))
NO_TORQUE_Nm = 1e-6
SHARE_STEP = 0.1
LINK_SHARES = tuple((SHARE_STEP * np.arange(11)).tolist())
WOUND_STEP = 0.05  # half of it times 1 N m on a gear of 400 N m/rad moves a tip by the noise of 30 frames
WOUND_SHARES = tuple((WOUND_STEP * np.arange(21)).tolist())  # of held friction that winds a soft gear up
DRIFT_TIMES_SPAN = 1.5  # of a session, up to which a time constant bends its course enough to be one


def candidates(arm: Arm, points: Points, loaded: Arm | None = None) -> tuple[Candidate, ...]:
    """All of them, those that need masses or times left out where there are none.

    `loaded`: the arm with the masses and torque constants that were found, whose gears and links feel them.
    """
    loaded = arm if loaded is None else loaded
    found = [*_of_the_encoder(points), *of_the_frame(arm, points)]
    try:
        pose = resting(loaded, points.q_rad, points.direction, points.current_A, stated_kg(points))
    except MissingModel:
        pose = None
    if pose is not None:
        found += _of_the_gear(points, pose, CURRENT_NOISE_A * torque_per_A(loaded))
    found += of_the_loads(arm, points, loaded)
    if np.isfinite(points.t_s).all() and np.ptp(points.t_s) > 0.0:
        found += _of_the_time(points)
    return tuple(_beside_known(arm, one) for one in found)


def _beside_known(arm: Arm, one: Candidate) -> Candidate:
    """With what the arm's file has of the same effect."""
    for effect in arm.effects:
        if (effect.effect, effect.joint) == (one.name.effect, one.name.joint) and effect.effect in LAWS:
            return one.beside(np.array(LAWS[effect.effect].linear(effect.parameters)))
    return one


def _of_the_encoder(points: Points) -> Iterator[Candidate]:
    """Scale, eccentricity, and the belt that couples joint 3 to joint 2."""
    q, n = points.q_rad, points.joint_count
    for j in range(n):
        own = np.eye(n)[j]
        yield plain("encoder_scale", j + 1, q * own, SCALE, "scale")
        both = np.stack((np.sin(q) * own, np.cos(q) * own))
        size = np.full(2, AMPLITUDE_rad)
        name = EffectName("encoder_eccentricity", j + 1)
        yield Candidate(name, frozen(both), frozen(size), amplitude_and_phase)
    if n >= 3:
        yield plain("belt_coupling", None, q[:, 1:2] * np.eye(n)[2], RATIO, "ratio")


def _of_the_gear(points: Points, pose: RestingPose, noise_Nm: Array) -> Iterator[Candidate]:
    """Backlash and compliance, from what the gears transmit."""
    n = points.joint_count
    for j in range(n):
        own = np.eye(n)[j]
        for share, flank, unsure in _flanks(pose, j, noise_Nm[j]):
            slope = backlash_rad(flank, 1.0)[:, None] * own
            play = plain("backlash", j + 1, slope, WIDTH_rad, "width_rad", is_positive=True)
            yield dataclasses.replace(play, shape=share, unsure=unsure)
        if np.abs(pose.gravity_Nm[:, j]).max() > NO_TORQUE_Nm:
            yield from _windings(pose, j)


def _windings(pose: RestingPose, j: int) -> Iterator[Candidate]:
    """A soft gear, for a row of shares of the held friction that wind it up: nobody knows that share."""
    own = np.eye(pose.gravity_Nm.shape[1])[j]
    name = EffectName("joint_compliance", j + 1)
    for share in WOUND_SHARES if pose.held_Nm[:, j].any() else WOUND_SHARES[:1]:
        slope = compliance_rad(pose.gravity_Nm + share * pose.held_Nm, 1.0) * own
        soft = frozen([SOFTNESS_rad_Nm])
        yield Candidate(name, frozen(slope[None]), soft, inverse("stiffness_Nm_rad"), True, share)


def _flanks(pose: RestingPose, j: int, noise_Nm: float) -> Iterator[tuple[float, Array, Mask]]:
    """The flank of joint j in every pose, (m,), and where it is a guess, for a row of shares of its friction on the link's side.

    Nobody knows that share; it decides only poses where friction outweighs gravity. Joints that a hand led keep the flank that
    their motor shows. Where the torque is too small to have a sign, its sign is a guess: it may count for a share, not in a fit.
    """
    told: list[Array] = []
    for share in LINK_SHARES:
        gravity, held = pose.gravity_Nm[:, j], pose.held_Nm[:, j]
        torque = gravity + share * held
        doubt = GRAVITY_ERROR * np.abs(gravity) + 0.5 * SHARE_STEP * np.abs(held) + 3.0 * share * noise_Nm
        flank = np.where(pose.is_led[:, j], pose.flank[:, j], np.sign(torque))
        flank = np.where(np.abs(torque) > NO_TORQUE_Nm, flank, 0.0)
        unsure = (flank == 0.0) | (~pose.is_led[:, j] & (np.abs(torque) <= doubt))
        if not unsure.all() and not any(np.array_equal(flank, other) for other in told):
            told.append(flank)
            yield share, flank, unsure


def _of_the_time(points: Points) -> Iterator[Candidate]:
    """A joint that warms up: 1 - exp(-t / T), for a row of time constants T.

    A link that warms and turns about its joint's axis is the same to poses.
    """
    elapsed = points.t_s - points.t_s.min()
    n = points.joint_count
    for j in range(n):
        for constant in TIME_CONSTANTS_s:
            if constant > DRIFT_TIMES_SPAN * elapsed.max():
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

"""Gears that are loose or soft: what they do depends on the torque that they transmit."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np
from scipy.special import erf

from calib.arrays import Array
from calib.gap.effects.record import (
    Bent,
    EffectRecord,
    InPoses,
    InSeries,
    NO_TORQUE_Nm,
    PoseScene,
    by_angle,
    by_load,
    harmonics,
    secants,
)
from calib.gap.finding import EffectName, Parameters
from calib.gap.posterior.constants import CLEAR_SHARE, WOUND_SHARE
from calib.gap.posterior.term import Term, Traits, like, parameters_of, smooth
from calib.gap.signals.terms import Form, Law
from control.dynamics.static_pose import CURRENT_NOISE_A, GRAVITY_ERROR, RestingPose, gravity_Nm, known_torque_per_A
from control.model.arm import Arm
from control.model.effects import backlash_rad, compliance_rad

TILT_rad = 0.003  # accuracy of a fitted link's direction: where gravity turns round, its sign is uncertain
BENDS = 3  # degree in which a stiffness follows the load's size
LEVELS = 16  # of constant friction on the link's side
LINK_SHARES = tuple(np.linspace(0.0, 1.0, 11).tolist())


def _play(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    """For every share of friction behind the gear that lays it on other flanks."""
    if scene.pose is None:
        return
    q = scene.points.q_rad
    is_measured = np.isfinite(scene.points.current_A).any(axis=0)  # what nobody measured has no noise, and needs no constants
    noise = np.where(is_measured, CURRENT_NOISE_A * np.nan_to_num(known_torque_per_A(scene.arm)), 0.0)
    for j in _joints_behind(record, scene):
        load = np.abs(scene.pose.gravity_Nm[:, j])
        ways = [*harmonics(q[:, j], 1, 2), *([load / load.max()] if load.max() > NO_TORQUE_Nm else [])]
        for share, flank, doubt in _flanks(scene.pose, np.nan_to_num(scene.points.direction[:, j]), j, noise[j]):
            law = backlash_rad(flank, 1.0)
            departs = like(law, [law * way for way in ways])
            term = record.on_joint(scene, j + 1, law, departs)
            yield dataclasses.replace(term, variant=share, doubt=0.25 * doubt)


def _joints_behind(record: EffectRecord, scene: PoseScene) -> Iterator[int]:
    """Joints (0-based) whose encoder is before the gear; one on the joint shows nothing of it."""
    joints = range(scene.points.joint_count)
    return (j for j in joints if scene.arm.is_behind_encoder(record.effect, j + 1))


def _flanks(pose: RestingPose, direction: Array, j: int, noise_Nm: float) -> Iterator[tuple[float, Array, Array]]:
    """The expected flank (m,) of joint j and its variance, for every share of friction on the link's side that matters.

    Poses in which the motor holds little friction may have been led by a hand, or not: both are tried.
    """
    distinct: list[Array] = []
    gravity, led = pose.gravity_Nm[:, j], pose.is_led[:, j]
    turned = TILT_rad * float(np.abs(gravity).max())
    for is_led in (np.zeros_like(led), led) if led.any() else (led,):
        for share, behind, doubt in _behind_the_gear(pose, direction, j, noise_Nm):
            torque = gravity + behind
            sd = np.maximum(0.5 * GRAVITY_ERROR * np.abs(gravity) + turned + doubt, NO_TORQUE_Nm)
            flank = np.where(np.abs(torque) > NO_TORQUE_Nm, erf(torque / (np.sqrt(2.0) * sd)), 0.0)
            flank = np.where(is_led, pose.flank[:, j], flank)
            if np.mean(flank**2) >= CLEAR_SHARE and not any(np.abs(flank - other).max() < 0.2 for other in distinct):
                distinct.append(flank)
                yield share, flank, 1.0 - flank**2


def _behind_the_gear(pose: RestingPose, direction: Array, j: int, noise_Nm: float) -> Iterator[tuple[float, Array, Array]]:
    """Friction on the link's side (m,) and its doubt (m,): a share of what the motor holds, or a constant in the last direction.

    Of constants only those differ between which poses change their flank; the last turns all that any may, as on an upright axis.
    What a motor holds may be less than its current's noise, but the way that a joint came is recorded.
    """
    gravity, held = pose.gravity_Nm[:, j], pose.held_Nm[:, j]
    for share in LINK_SHARES:
        yield share, share * held, 0.03 * np.abs(held) + share * noise_Nm
    last, most = np.where(direction != 0.0, np.sign(direction), np.sign(held)), float(np.abs(held).max())
    turning = np.sort(-(gravity * last)[(gravity * last < 0.0) & (-gravity * last < most)])
    inner = np.quantile(turning, np.linspace(0.0, 1.0, LEVELS + 2)[1:-1]).tolist() if len(turning) else []
    levels = np.unique([*inner, most])
    for k, level in enumerate(levels.tolist()):
        step = 0.5 * float(np.min(np.abs(np.diff(levels)[max(0, k - 1) : k + 1]))) if len(levels) > 1 else 0.0
        yield 2.0 + level, level * last, np.full_like(held, 0.5 * step)


def _compliance(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    if scene.pose is None:
        return
    unstated = tip_mass_Nm(scene)
    for j in _joints_behind(record, scene):
        torque, held = scene.pose.gravity_Nm[:, j], scene.pose.held_Nm[:, j]
        if np.abs(torque).max() <= NO_TORQUE_Nm:
            continue
        law = compliance_rad(torque, 1.0)
        harder = law * smooth(np.abs(torque), BENDS)  # or softer, with the load
        bent = [*harder, np.abs(law)]  # or one way
        departs = like(law, [*bent, compliance_rad(unstated[:, j], 1.0)])
        for more in _wound(held):
            term = record.on_joint(scene, j + 1, law, departs, more)
            yield dataclasses.replace(term, variant=float(len(more)))


def tip_mass_Nm(scene: PoseScene) -> Array:
    """What a mass at the tip that no file states adds to the joints' torques, (m, n): no part has the masses of its CAD."""
    q = scene.joint_rad
    return gravity_Nm(scene.arm, q, 1.0) - gravity_Nm(scene.arm, q, 0.0)


def _wound(held_Nm: Array) -> list[list[Array]]:
    """Ways in which friction behind a soft gear winds it up: none, a share of what the motor holds, or a constant besides."""
    if not held_Nm.any():
        return [[]]
    share = compliance_rad(WOUND_SHARE * held_Nm, 1.0)
    constant = compliance_rad(WOUND_SHARE * float(np.abs(held_Nm).mean()) * np.sign(held_Nm), 1.0)
    return [[], [share], [share, constant]]


COMPLIANCES_rad_Nm = (1 / 3000.0, 1 / 1200.0, 1 / 600.0, 1 / 300.0, 1 / 150.0)
WIDTHS_rad = (0.001, 0.002, 0.005, 0.010, 0.018)
DAMPING_Nm_s_rad = 0.8
COMPLIANCE = Bent(COMPLIANCES_rad_Nm, (DAMPING_Nm_s_rad, 0.0), (0.5, 0.5), (20.0, 1.0))
BACKLASH = Bent(WIDTHS_rad, (0.0,), (0.5,), (1.0,))
# What the current shows of a soft or loose gear follows how its angle changes: all of these.
GEAR_BLOCKS = ("load", "speed", "acceleration", "turned", "sensor")
# compliance, damping, and the share of friction behind the gear; width and that share
SPRING = Form(
    "joint_compliance",
    "spring",
    1e-4,
    count=3,
    counted=1,
    steps=(1e-5, 2e-2, 5e-2),
    lower=(1e-6, 0.0, 0.0),
    upper=(0.05, 20.0, 1.0),
)
LOOSE = Form("backlash", "play", 5e-4, count=2, counted=1, steps=(5e-5, 5e-2), lower=(0.0, 0.0), upper=(0.2, 1.0))


def _known_spring(series: InSeries, name: EffectName, parameters: Mapping[str, float]) -> Law:
    return Law(name, series.form, (1.0 / parameters["stiffness_Nm_rad"], parameters.get("damping_Nm_s_rad", 0.0), 0.0))


def _spring_parameters(arm: Arm, law: Law, covariance: Array) -> Parameters:
    """With the damping, however little is known of it: a file that says none says that the spring swings on and on."""
    spring = parameters_of("joint_compliance")(np.array(law.values), covariance)
    return {**spring, "damping_Nm_s_rad": (law.values[1], float(np.sqrt(max(covariance[1, 1], 0.0))))}


RECORDS = (
    EffectRecord(
        "backlash",
        role="angle",
        traits=Traits("direction", is_on_every_joint=True),
        poses=InPoses(
            0.005,
            _play,
            "the same poses from both approaches, some where gravity on that joint changes its sign",
            variable="q{j} and load",
            is_positive=True,
        ),
        series=InSeries(
            (LOOSE,),
            lambda sought: secants(sought, BACKLASH),
            "angle",
            departs=(by_angle,),
            variable="angle",
            blocks=("tip direction", *GEAR_BLOCKS),
        ),
    ),
    EffectRecord(
        "joint_compliance",
        role="angle",
        traits=Traits("load", is_on_every_joint=True),
        poses=InPoses(
            1.0 / 800.0, _compliance, "the same poses with and without a known payload", variable="load", is_positive=True
        ),
        series=InSeries(
            (SPRING,),
            lambda sought: secants(sought, COMPLIANCE),
            "angle",
            departs=(by_load,),
            variable="load",
            blocks=("tip load", *GEAR_BLOCKS),
            known=_known_spring,
            parameters=_spring_parameters,
        ),
    ),
)

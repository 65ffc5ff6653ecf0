"""The rigid arm nearest to one with play, soft gears or encoder errors: for programs that know rigid trees only.

In poses at rest all over the joints' ranges, approached from either side, the whole model of the file says where tip and last
link are, as the runtime and `verify` have it. Deviations x of the DH rows, in units of 5 mm and 2 deg (SpringerPlus 5:1771,
eq. (4)), let a rigid arm agree with that best:

    minimise |r(x)|^2 / v + |x|^2,   v the variance of what is left of r

r: tips, and orientations as they count in a calibration. What the poses do not determine stays as in the file. Joint angles stay
those of the encoders with the file's zeros: what play adds on average goes into the frames.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from calib.arm_problem.arm_model import ArmModel, dh_names
from calib.arm_problem.assembly import BASE, Choice, problem_of
from calib.arm_problem.parallel_axes import in_the_same_rows
from calib.arm_problem.posed import TARGET, whole_problem
from calib.arrays import Array, frozen, norms
from calib.design.candidates import joint_box, spread_poses, workspace_poses
from calib.points.points import FREE, Points, make_points
from calib.validation.verify import predicted_orientations, predicted_tips
from control.dynamics.dynamics import has_masses
from control.kinematics.rotation import logarithms, matrices, quaternions
from control.model.arm import Arm

POSES = 1000  # drawn; those below the floor are left out
ROUNDS = 5  # Gauss-Newton's: deviations of some mm have settled after three
OF_LOADS = ("backlash", "joint_compliance", "link_flexure")


@dataclass(frozen=True, slots=True)
class RigidArm:
    """`arm`: the file's, but for the DH rows, which are the rigid arm's; `notes`: sentences for the operator."""

    arm: Arm
    notes: tuple[str, ...] = ()


def nearest_rigid(arm: Arm, known: Collection[str] = ()) -> RigidArm:
    """For a program that knows the effects `known` besides rigid links."""
    own = tuple(effect for effect in arm.effects if effect.effect in known)
    how = "the links are those of the rigid arm nearest to this one with its effects", "with the file's links"
    return _nearest(arm, replace(arm, effects=own), (), how)


def nearest_zeros(arm: Arm, generic: Arm) -> RigidArm:
    """For a program that keeps the links of the `generic` arm, and learns the joints' zeros alone. ArmError: another arm."""
    arm, generic = in_the_same_rows(arm, generic)
    zeros, names, rows = ArmModel(arm).theta_places, dh_names(len(arm.links)), np.array(generic.dh)
    for place in zeros:
        rows.flat[place] = arm.dh.flat[place]
    fixed = set(names) - {names[place] for place in zeros}
    how = f"the zeros are those with which the links of {generic.name} come nearest to this arm", "with the file's zeros"
    return _nearest(arm, replace(arm.with_dh(rows), effects=()), fixed, how)


def _nearest(arm: Arm, rigid: Arm, fixed: Collection[str], how: tuple[str, str]) -> RigidArm:
    """Of a rigid arm to begin with, of which the DH parameters `fixed` stay; `how`: what the numbers are, and what they were."""
    model, notes = _with_sides(arm)
    rigid = replace(rigid, maps=(), tolerances=None, tool=replace(arm.tool, known=True))
    poses = _predicted(model, _poses(arm))
    as_rigid = _predicted(rigid, poses)
    if np.array_equal(as_rigid.tip_m, poses.tip_m) and np.array_equal(as_rigid.orientation, poses.orientation):
        return RigidArm(arm, notes)
    half = len(poses) // 4 * 2
    fitted, others = poses.chosen(np.arange(half)), poses.chosen(np.arange(half, len(poses)))
    problem = problem_of(rigid, fitted, Choice(fixed=(BASE, TARGET, *fixed)))
    whole, x = whole_problem(problem), np.zeros(len(problem.parameters))
    for _ in range(ROUNDS):
        residuals, jacobian = whole.residuals_and_jacobian(x)
        rows, variance = jacobian.reshape(-1, len(x)), float(np.mean(residuals**2))
        x = x - np.linalg.solve(rows.T @ rows + variance * np.eye(len(x)), rows.T @ residuals.ravel() + variance * x)
    dh = problem.solution(x).dh
    what, else_ = how
    after, before = (_in_words(_off(one, others)) for one in (rigid.with_dh(dh), rigid))
    sentence = f"{what}: at rest tip and orientation are off by {after} on average, {else_} by {before}"
    return RigidArm(arm.with_dh(dh), (*notes, sentence))


def _with_sides(arm: Arm) -> tuple[Arm, tuple[str, ...]]:
    """The arm as far as its file says what its effects do, and what it leaves open."""
    if has_masses(arm):
        return arm, ()
    effects = tuple(effect for effect in arm.effects if effect.effect not in OF_LOADS)
    maps = tuple(one for one in arm.maps if one.over != "load_Nm")
    if len(effects) == len(arm.effects) and len(maps) == len(arm.maps):
        return arm, ()
    return replace(arm, effects=effects, maps=maps), (
        "the file has no masses, from which the side follows on which a loose gear lies, and how far soft parts give way: the"
        " links are written for the middle of the play and for no load",
    )


def _poses(arm: Arm) -> Points:
    """Poses over the joints' ranges, above the floor; each twice, every joint approached from either side."""
    q = workspace_poses(arm, (), POSES)
    q = np.repeat(q if len(q) else spread_poses(joint_box(arm), POSES), 2, axis=0)
    direction = np.random.default_rng(0).choice((-1.0, 1.0), q.shape)
    direction[1::2] = -direction[::2]
    count = len(q)
    return make_points([FREE] * count, [""] * count, [1] * count, q, np.full((count, 3), np.nan), direction)


def _predicted(arm: Arm, poses: Points) -> Points:
    """The poses with tips and orientations as the arm's model has them."""
    return replace(
        poses, tip_m=frozen(predicted_tips(arm, poses)), orientation=frozen(quaternions(predicted_orientations(arm, poses)))
    )


def _off(arm: Arm, poses: Points) -> Array:
    """How far tips [m] and last links [rad] of an arm are from those of the poses, (m, 2)."""
    there = _predicted(arm, poses)
    turned = matrices(poses.orientation) @ np.swapaxes(matrices(there.orientation), 1, 2)
    return np.column_stack((norms(poses.tip_m - there.tip_m), norms(logarithms(turned))))


def _in_words(off: Array) -> str:
    """Errors of tips [m] and last links [rad], (m, 2)."""
    tip_m, turn_rad = off.T
    return f"{1e3 * tip_m.mean():.1f} mm (95 %: {1e3 * np.quantile(tip_m, 0.95):.1f}), {1e3 * turn_rad.mean():.1f} mrad"

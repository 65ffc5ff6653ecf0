"""The motors' holding currents as a second source: what they hold beyond the model's gravity.

Per joint: motor torque by the nominal constant minus gravity = a constant and a share of the load for each direction of the last
motion (friction, asymmetric friction, load friction, the sensor's offset: never named here) + what a candidate adds + scatter.
Levers may be off by LEVER_m, which is integrated out with the friction. The scatter is that of friction, which holds a joint
anywhere in its band; it is measured, not assumed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, Mask
from calib.gap.effects.record import stated_kg
from calib.gap.poses.linear import Fit
from calib.gap.posterior.term import Term
from calib.points.points import Points
from control.dynamics.static_pose import gravity_Nm, torque_per_A
from control.errors import MissingModel
from control.model.arm import Arm

SATURATED = 0.98  # of the drive's limit
CAUTION = 1.5  # neighbouring poses share their friction: fewer independent values than poses
POSES_LEAST = 24
RESOLUTION = 1e-3  # of a joint's largest torque: no motor current tells more
LEVER_m = 0.002  # what nominal lengths and centres of mass are off by: no torque constant is told beyond that
STEP = 1e-4  # of a derivative: of a bound, or in radians
SWAY = 3.0  # of a joint's largest torque: the prior of the friction's part


@dataclass(frozen=True, slots=True)
class Currents:
    """Motor torque beyond gravity over geometry and terms, as columns (K + p + 1, m, n) [N m], the values last; `usable` (m, n);
    friction (n, m, b) and the scatter sd_Nm (n,).
    """

    columns_Nm: Array
    usable: Mask
    friction: Array
    sd_Nm: Array

    def seen(self, rows: Mask) -> Array:
        """All columns at the poses `rows` (m,), joint after joint, in standard deviations; friction is integrated out."""
        blocks = [np.zeros((0, len(self.columns_Nm)))]
        for j, sd in enumerate(self.sd_Nm):
            keep = rows & self.usable[:, j]
            if keep.sum() >= POSES_LEAST and np.isfinite(sd):
                along, size, _ = np.linalg.svd(self.friction[j][keep] / sd, full_matrices=False)
                columns = self.columns_Nm[:, keep, j].T / sd
                blocks.append(columns + along @ (((1.0 + size**2) ** -0.5 - 1.0)[:, None] * (along.T @ columns)))
        return np.concatenate(blocks)


def holding_currents(fit: Fit, arm: Arm, points: Points, turn_rad: Array, terms: Sequence[Term]) -> Currents | None:
    """None where the arm's file lacks masses, or the data currents.

    Around a fitted geometry x and joint angles q, the encoders' and what the effects found so far turn, `turn_rad` (m, n):
      torque - gravity(x, q) + gravity_x x + gravity_q turn = gravity_x x' + sum of terms' (torque + gravity_q angle) + friction,
    with x' and the terms' coefficients around zero, as in `Linear`.
    """
    shaped, joint_rad = fit.shaped(arm), fit.problem.observed.q_rad + turn_rad
    try:
        gravity, per_A = gravity_Nm(shaped, joint_rad, stated_kg(points)), torque_per_A(arm)
    except MissingModel:
        return None
    limits = np.array([arm.drive(j + 1).current_limit_A for j in range(points.joint_count)])
    usable = np.isfinite(points.current_A) & (np.abs(points.current_A) < SATURATED * limits)
    if not (usable.sum(axis=0) >= POSES_LEAST).any():
        return None
    by_geometry = _by_geometry(fit, arm, points, joint_rad, gravity)
    by_joint = _by_joint(shaped, points, joint_rad, gravity)
    torque = np.where(usable, points.current_A * per_A - gravity, 0.0)
    y = torque + np.einsum("kmn,k->mn", by_geometry, fit.x) + np.einsum("mni,mi->mn", by_joint, turn_rad)
    slopes_Nm = [np.zeros((term.count, *torque.shape)) if term.slope_Nm is None else term.slope_Nm for term in terms]
    moved = [0.0 if term.slope_rad is None else np.einsum("mni,cmi->cmn", by_joint, term.slope_rad) for term in terms]
    target = 0 if fit.target is None else 3
    columns = np.concatenate([by_geometry, np.zeros((target, *torque.shape)), *map(np.add, slopes_Nm, moved), y[None]])
    unsure = _lever_errors_Nm(arm, points, gravity)
    friction = np.stack(
        [np.column_stack((_friction(points, gravity, torque, j), unsure[:, j])) for j in range(points.joint_count)]
    )
    laws = [term.slope_Nm[: term.laws] for term in terms if term.is_name and term.slope_Nm is not None]
    acting = np.concatenate([by_geometry, *laws])
    sd = np.array([_scatter(friction[j], acting[:, :, j], torque[:, j], usable[:, j]) for j in range(len(friction))])
    return Currents(columns, usable, friction, CAUTION * sd)


def _by_geometry(fit: Fit, arm: Arm, points: Points, joint_rad: Array, gravity: Array) -> Array:
    """How gravity's torques follow the unknowns of a fit, (K, m, n): lengths and angles of links, and the tool with its load."""
    slopes = np.zeros((len(fit.x), *gravity.shape))
    here = fit.problem.solution(fit.x)
    for k in range(len(fit.x)):
        there = dataclasses.replace(fit, x=fit.x + STEP * (np.arange(len(fit.x)) == k))
        solution = fit.problem.solution(there.x)
        if (solution.dh != here.dh).any() or (solution.tool_m != here.tool_m).any():
            slopes[k] = (gravity_Nm(there.shaped(arm), joint_rad, stated_kg(points)) - gravity) / STEP
    return slopes


def _by_joint(arm: Arm, points: Points, joint_rad: Array, gravity: Array) -> Array:
    """How gravity's torques follow the joints' angles, (m, n, n) [N m/rad]."""
    ahead = STEP * np.eye(points.joint_count)
    return np.stack([(gravity_Nm(arm, joint_rad + one, stated_kg(points)) - gravity) / STEP for one in ahead], axis=2)


def _friction(points: Points, gravity: Array, torque: Array, j: int) -> Array:
    """A constant for each direction, and friction that grows with the load, odd in direction, (m, b)."""
    last = points.direction[:, j]
    size = SWAY * max(float(np.abs(torque[:, j]).max()), 1e-6)
    sides = [size * (last == side) for side in (-1.0, 0.0, 1.0)]
    return np.column_stack((*sides, last * np.abs(gravity[:, j])))


def _lever_errors_Nm(arm: Arm, points: Points, gravity: Array) -> Array:
    """What LEVER_m on the lever of all that a joint carries does to its torque, (m, n): much on a short last link."""
    turning = [k for k, link in enumerate(arm.links) if link.joint == "revolute"]
    carried_kg = [sum(link.mass_kg or 0.0 for link in arm.links[k:]) for k in turning]
    weight_N = (np.array(carried_kg) + stated_kg(points).max()) * float(np.linalg.norm(arm.gravity_m_s2))
    most = np.maximum(np.abs(gravity).max(axis=0), 1e-9)
    return np.asarray(gravity * (LEVER_m * weight_N / most))


def _scatter(friction: Array, columns: Array, torque: Array, usable: Mask) -> float:
    """What all columns together leave of one joint's torque."""
    whole = np.column_stack((friction, columns.T))[usable]
    if len(whole) < POSES_LEAST:
        return float("nan")
    size, _, rank, _ = np.linalg.lstsq(whole, torque[usable], rcond=1e-9)
    residual = torque[usable] - whole @ size
    resolution = RESOLUTION * float(np.abs(torque[usable]).max())
    return max(float(np.sqrt(residual @ residual / max(1, len(residual) - int(rank)))), resolution) or float("nan")

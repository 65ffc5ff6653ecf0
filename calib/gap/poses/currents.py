"""The motors' holding currents as a second source: what they hold beyond the model's gravity.

Per joint: motor torque by the nominal constant minus gravity = a constant and a share of the load for each direction of the last
motion (friction, asymmetric friction, load friction, the sensor's offset: never named here) + what a candidate adds + scatter.
Levers may be off by LEVER_m, which is integrated out with the friction. The scatter is that of friction, which holds a joint
anywhere in its band; it is measured, not assumed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, Mask
from calib.gap.effects.pose_scene import stated_kg
from calib.points.points import Points
from control.dynamics.static_pose import gravity_Nm, torque_per_A
from control.errors import MissingModel
from control.model.arm import Arm

SATURATED = 0.98  # of the drive's limit
CAUTION = 1.5  # neighbouring poses share their friction: fewer independent values than poses
POSES_LEAST = 24
RESOLUTION = 1e-3  # of a joint's largest torque: no motor current tells more
LEVER_m = 0.002  # what nominal lengths and centres of mass are off by: no torque constant is told beyond that
SWAY = 3.0  # of a joint's largest torque: the prior of the friction's part


@dataclass(frozen=True, slots=True)
class Currents:
    """torque_Nm (m, n): motor torque minus gravity; `usable` (m, n); friction (n, m, b) and the scatter sd_Nm (n,); the model's
    gravity_Nm (m, n).
    """

    torque_Nm: Array
    usable: Mask
    friction: Array
    sd_Nm: Array
    gravity_Nm: Array

    def seen(self, columns_Nm: Array, rows: Mask) -> tuple[Array, Array]:
        """G (c, c) and h (c,) of columns (c, m, n) at the poses `rows` (m,); friction is integrated out."""
        gram, pull = np.zeros((len(columns_Nm), len(columns_Nm))), np.zeros(len(columns_Nm))
        for j, sd in enumerate(self.sd_Nm):
            keep = rows & self.usable[:, j]
            if keep.sum() >= POSES_LEAST and np.isfinite(sd):
                own = np.column_stack((columns_Nm[:, keep, j].T, self.torque_Nm[keep, j])) / sd
                square = _beside(self.friction[j][keep] / sd, own)
                gram, pull = gram + square[:-1, :-1], pull + square[:-1, -1]
        return gram, pull


def _beside(base: Array, columns: Array) -> Array:
    """C' (I + B B')^-1 C as a sum of squares, which keeps its sign where B all but explains C."""
    inner = np.linalg.cholesky(base.T @ base + np.eye(base.shape[1]))
    taken = np.linalg.solve(inner.T, np.linalg.solve(inner, base.T @ columns))
    rest = columns - base @ taken
    return np.asarray(rest.T @ rest + taken.T @ taken)


def holding_currents(arm: Arm, points: Points, columns_Nm: Array) -> Currents | None:
    """None where the arm's file lacks masses, or the data currents; columns_Nm (c, m, n) of all that may act."""
    try:
        gravity, per_A = gravity_Nm(arm, points.q_rad, stated_kg(points)), torque_per_A(arm)
    except MissingModel:
        return None
    limits = np.array([arm.drive(j + 1).current_limit_A for j in range(points.joint_count)])
    usable = np.isfinite(points.current_A) & (np.abs(points.current_A) < SATURATED * limits)
    torque = np.where(usable, points.current_A * per_A - gravity, 0.0)
    if not (usable.sum(axis=0) >= POSES_LEAST).any():
        return None
    unsure = _lever_errors_Nm(arm, points, gravity)
    friction = np.stack(
        [
            np.column_stack((_friction(points, gravity, torque, j), unsure[:, j]))
            for j in range(points.joint_count)
        ]
    )
    sd = np.array(
        [_scatter(friction[j], columns_Nm[:, :, j], torque[:, j], usable[:, j]) for j in range(len(friction))]
    )
    return Currents(torque, usable, friction, CAUTION * sd, gravity)


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
    found, _, rank, _ = np.linalg.lstsq(whole, torque[usable], rcond=1e-9)
    left = torque[usable] - whole @ found
    resolution = RESOLUTION * float(np.abs(torque[usable]).max())
    return max(float(np.sqrt(left @ left / max(1, len(left) - int(rank)))), resolution) or float("nan")

"""A pose to wait in: above the floor, bent, with little gravity torque."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from calib.arrays import Array
from control.dynamics.dynamics import Dynamics
from control.kinematics.chain import link_transforms
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm

POSES: Final = 3000
STEP_rad: Final = 0.05  # angles that a reader can set
EDGE: Final = 0.1  # share of the range kept from its ends
BENT: Final = 0.5  # of the best conditioning that is found
LOW_SHARE: Final = 0.1  # of the reach: how far above the floor every joint behind the second and the tip are


def rest_pose(arm: Arm, ranges: Sequence[tuple[float, float]], above_z_m: float) -> tuple[float, ...]:
    """Joint angles within the ranges, multiples of 0.05 rad where a range is wide enough."""
    low, high = np.array(ranges).T
    room = EDGE * (high - low)
    q = np.random.default_rng(1).uniform(low + room, high - room, (POSES, arm.joint_count))
    q[:, 0] = np.clip(0.0, low[0] + room[0], high[0] - room[0])  # forwards
    rounded = np.round(q / STEP_rad) * STEP_rad
    q = np.where((rounded > low) & (rounded < high), rounded, q)
    frames = link_transforms(arm.dh, q, arm.joints, arm.dh_convention)
    tips = ForwardKinematics(arm).tips(q)
    lowest = np.minimum(frames[:, 1 + _second(arm) :, 2, 3].min(axis=1), tips[:, 2])
    reach = float(np.linalg.norm(tips, axis=1).max())
    conditioning = _conditioning(arm, q)
    good = lowest >= min(above_z_m + LOW_SHARE * reach, float(np.quantile(lowest, 0.95)))
    good &= conditioning >= BENT * conditioning[good].max()
    effort = _effort(arm, q) + 0.02 * np.abs(q).sum(axis=1)  # of equal poses, the one nearer to zero
    chosen = int(np.argmin(np.where(good, effort, np.inf)))
    return tuple(round(float(angle), 6) + 0.0 for angle in q[chosen])


def _second(arm: Arm) -> int:
    """Index of the link that joint 2 moves, or of the only one."""
    turning = [index for index, turns in enumerate(arm.joints) if turns]
    return turning[min(1, len(turning) - 1)]


def _conditioning(arm: Arm, q: Array) -> Array:
    """Smallest singular value of the tip's Jacobian, in m: 0 stretched and in other singular poses."""
    rank = min(3, arm.joint_count)
    values = np.linalg.svd(ForwardKinematics(arm).jacobians(q), compute_uv=False)
    return np.asarray(values[:, rank - 1], dtype=np.float64)


def _effort(arm: Arm, q: Array) -> Array:
    """Gravity torques relative to the largest of each joint, summed."""
    if not any(link.mass_kg for link in arm.links):
        return np.zeros(len(q))
    torques = np.abs(Dynamics(arm).torques(q, 0.0 * q, 0.0 * q))
    total: Array = (torques / max(float(torques.max()), 1e-9)).sum(axis=1)
    return total

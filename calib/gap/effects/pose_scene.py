"""What the laws of effects act on: the arm as fitted so far, its loads, and the poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.points.points import Points
from control.dynamics.static_pose import RestingPose, gravity_Nm, resting
from control.errors import MissingModel
from control.model.arm import Arm


@dataclass(frozen=True, slots=True)
class PoseScene:
    """Poses of the arm at its fitted geometry under the loads found so far.

    `nominal`: the same geometry without those loads; `joint_rad` (m, n): the joints' angles, at which loads act, while
    encoders' errors follow those of the points; `pose`: what the gears transmit, None without masses.
    """

    nominal: Arm
    arm: Arm
    points: Points
    joint_rad: Array
    pose: RestingPose | None

    @classmethod
    def of(cls, nominal: Arm, arm: Arm, points: Points, joint_rad: Array) -> PoseScene:
        """With what the gears transmit, where the arm's file has masses and drives."""
        try:
            pose = resting(arm, joint_rad, points.direction, points.current_A, stated_kg(points))
        except MissingModel:
            pose = None
        return cls(nominal, arm, points, joint_rad, pose)

    @property
    def gravity_Nm(self) -> Array | None:
        """What holds the links, (m, n); None for an arm without masses."""
        return None if self.pose is None else self.pose.gravity_Nm


def stated_kg(points: Points) -> Array:
    """The payload that the data states, (m,); 0 where it is unknown."""
    return np.nan_to_num(points.payload_kg)


def load_of(arm: Arm, points: Points, joint_rad: Array | None = None) -> Array | None:
    """Gravity's torques (m, n) at joint angles (m, n), by default the encoders'; None for an arm without masses."""
    try:
        return gravity_Nm(arm, points.q_rad if joint_rad is None else joint_rad, stated_kg(points))
    except MissingModel:
        return None

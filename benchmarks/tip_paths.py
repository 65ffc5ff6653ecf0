"""Way-points around where an arm rests."""

import numpy as np

from control.kinematics import rotation
from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.pose_inverse import TipPose
from control.kinematics.pose_kinematics import PoseKinematics
from control.model.arm import Arm
from control.motion.waypoints import Waypoints


def tip_of(arm: Arm) -> TipPose:
    """Position and orientation of the tip in the rest pose."""
    assert arm.rest is not None
    tip = PoseKinematics(ForwardKinematics(arm)).batch([arm.rest.q_rad])
    return TipPose.of(tip.position_m[0], rotation.quaternions(tip.rotation)[0])


def circle_in_place(
    arm: Arm, radius_m: float = 0.05, tilt_rad: float | None = None, points: int = 12
) -> Waypoints:
    """A level circle that begins where the tip rests; the orientation is free, or rocks by `tilt_rad` on the way."""
    here = tip_of(arm)
    turn = np.linspace(0.0, 2.0 * np.pi, points + 1)
    around = radius_m * np.column_stack((np.cos(turn) - 1.0, np.sin(turn), 0.0 * turn)) + here.position_m
    orientations = None
    if tilt_rad is not None:
        rocked = tilt_rad * np.column_stack((0.0 * turn, np.sin(turn), 0.5 * np.sin(turn)))
        at = rotation.matrices(np.array([here.orientation]))
        turned = rotation.quaternions(rotation.exponentials(rocked) @ at)
        orientations = tuple(rotation.checked_quaternion(q) for q in turned)
    return Waypoints(tuple((float(x), float(y), float(z)) for x, y, z in around), None, (), orientations)


def turned_in_place(arm: Arm, angle_rad: float) -> Waypoints:
    """Turn about y in place, then back while the tip moves 10 mm."""
    here = tip_of(arm)
    assert here.orientation is not None
    at = rotation.matrices(np.array([here.orientation]))
    turned = rotation.quaternions(rotation.exponentials(np.array([[0.0, angle_rad, 0.0]])) @ at)[0]
    x, y, z = here.position_m
    orientations = (here.orientation, rotation.checked_quaternion(turned), here.orientation)
    return Waypoints(((x, y, z), (x, y, z), (x + 0.01, y, z)), None, (), orientations)

"""Targets of the replay: verification points on the three tilts, another trajectory, and free poses that show backlash."""

from typing import Final

import numpy as np

from calib.arrays import Array
from control.dynamics.static_pose import gravity_Nm
from control.kinematics.kinematics import ForwardKinematics
from control.model import table as tables
from control.model.arm import Arm, Table, Vector3

SETUPS: Final = ("normal", "roll", "pitch")
OTHER: Final = "other trajectory"
HEIGHT_m: Final = 0.05  # above the board: an uncalibrated arm is some 3 cm off
RADIUS_m: Final = 0.06
POINTS: Final = 6  # "points 1-6" of the paper's verification trajectory
STOPS: Final = 10
FREE: Final = 12
CANDIDATES: Final = 2000
FREE_HEIGHT_m: Final = 0.2  # of the tip above the base
SHARE_OF_RANGE: Final = 0.85
YAW_rad: Final = 1.2  # in front of the arm, visible to the camera
TURNING: Final = 0.25  # of a joint's largest gravity torque: above this, friction does not change the flank

Target = tuple[str, str, Vector3]  # setup, point, tip in the base frame


def verification_targets(table: Table) -> tuple[Target, ...]:
    """Between the cavities and above each tilt of the board; none of them is a calibration point."""
    found = []
    for setup in SETUPS:
        for number in range(POINTS):
            angle = 2.0 * np.pi * (number + 0.5) / POINTS
            place = (RADIUS_m * float(np.cos(angle)), RADIUS_m * float(np.sin(angle)), HEIGHT_m)
            found.append((setup, f"v{number + 1}", tables.to_base(table, setup, place)))
    return tuple(found)


def other_trajectory(table: Table) -> tuple[Target, ...]:
    """Stops on a slanting ellipse over the board, larger than it and higher: the paper's Table 6 and Fig. 10."""
    turn = 2.0 * np.pi * np.arange(STOPS) / STOPS
    place = np.column_stack((0.1 * np.cos(turn), 0.15 * np.sin(turn), 0.14 + 0.06 * np.sin(turn + 0.7)))
    centre = np.array(tables.board_origin(table))
    return tuple(
        (OTHER, f"t{k + 1}", (float(x), float(y), float(z))) for k, (x, y, z) in enumerate(centre + place)
    )


def free_poses(arm: Arm, seed: int = 0) -> Array:
    """Joint angles (FREE, n) spread over the workspace, including poses where gravity changes sign.

    Each next pose is the candidate farthest from those chosen, in joint angles and in gravity torques, where only
    those near 0 differ.
    """
    lower, upper = np.clip(np.array(arm.limits_rad), -np.pi, np.pi).T
    middle, half = 0.5 * (lower + upper), 0.5 * SHARE_OF_RANGE * (upper - lower)
    half[0] = min(half[0], YAW_rad)
    q = np.random.default_rng(seed).uniform(middle - half, middle + half, (CANDIDATES, arm.joint_count))
    q = q[ForwardKinematics(arm).tips(q)[:, 2] > FREE_HEIGHT_m]
    gravity = gravity_Nm(arm, q)
    scale = np.maximum(TURNING * np.abs(gravity).max(axis=0), 1e-6)
    turning = np.clip(gravity / scale, -1.0, 1.0)
    features = np.hstack(((q - middle) / half, turning))
    taken = [int(np.argmin(np.linalg.norm(features, axis=1)))]
    distance = np.full(len(q), np.inf)
    while len(taken) < FREE:
        distance = np.minimum(distance, np.linalg.norm(features - features[taken[-1]], axis=1))
        taken.append(int(np.argmax(distance)))
    return np.asarray(q[taken])

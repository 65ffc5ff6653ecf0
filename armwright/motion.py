"""Paths of the tip: planned and checked before anything moves, and sampled as followed by the loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.errors import BadTarget, PathError
from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.rotation import checked_quaternion
from control.model.arm import Arm
from control.motion.plan import PlannedPath
from control.motion.plan import plan_path as planned
from control.motion.waypoints import Waypoints, read_waypoints

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Samples:
    """A trajectory at m times: t_s (m,); joint_rad, speed_rad_s, acceleration_rad_s2 (m, n); tip_m (m, 3), base frame."""

    t_s: Array
    joint_rad: Array
    speed_rad_s: Array
    acceleration_rad_s2: Array
    tip_m: Array


@dataclass(frozen=True, slots=True, repr=False)
class Trajectory:
    """A path that `arm` can run within its limits, from rest to rest; `RunningArm.run` takes it."""

    arm: Arm
    path: PlannedPath

    def __repr__(self) -> str:
        """In one line: an interactive session prints what an expression gives."""
        return f"<Trajectory of arm {self.arm.name}: {len(self.path.q_waypoints_rad)} way-points in {self.duration_s:.2f} s>"

    @property
    def duration_s(self) -> float:
        """Time from start to end."""
        return self.path.duration_s

    @property
    def start_rad(self) -> tuple[float, ...]:
        """Joint angles at the first way-point."""
        return self.path.q_start_rad

    @property
    def slowdowns(self) -> tuple[str, ...]:
        """A sentence for each section that the arm's limits make slower than requested."""
        return tuple(map(str, self.path.slowdowns))

    def sample(self, t_s: ArrayLike) -> Samples:
        """Set-points at the times (m,) [s] after the start; times before the start or after the end are clamped to them."""
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        if times.ndim != 1 or not np.isfinite(times).all():
            raise BadTarget(f"times: expected finite numbers of shape (m,), got shape {times.shape}")
        points = [self.path.joints.at(t) for t in times.tolist()]
        joint_rad = _stacked([point.q_rad for point in points], self.arm.joint_count)
        return Samples(
            times,
            joint_rad,
            _stacked([point.speed_rad_s for point in points], self.arm.joint_count),
            _stacked([point.acceleration_rad_s2 for point in points], self.arm.joint_count),
            ForwardKinematics(self.arm).tips(joint_rad),
        )


def plan_path(
    arm: Arm,
    waypoints_m: ArrayLike | str | Path,
    speed_m_s: float | Sequence[float] | None = None,
    near_rad: Sequence[float] | None = None,
) -> Trajectory:
    """Plan the path of the tip through `waypoints_m` and check all of it against the arm's limits. Nothing moves.

    Args:
        arm: its geometry, limits and calibration table are respected.
        waypoints_m: (m, 3) in the base frame, or (m, 7) with the unit quaternion w, x, y, z of the last link frame. Or a CSV
            file: columns x_m, y_m, z_m and, optionally, qw, qx, qy, qz and speed_m_s.
        speed_m_s: one speed for all sections or one for each way-point; None takes the file's, else 0.1 m/s.
        near_rad: (n,) the posture nearest to this is chosen; by default the arm's rest pose.

    Raises:
        PathError: names the way-point, the obstacle and the amount.
        ArmError: a number is not usable.
    """
    waypoints = read_waypoints(waypoints_m) if isinstance(waypoints_m, str | Path) else _listed(waypoints_m)
    return Trajectory(arm, planned(arm, waypoints, speed_m_s, q_near_rad=near_rad))


def _listed(waypoints_m: ArrayLike) -> Waypoints | list[list[float]]:
    """PathError for another shape than (m, 3) or (m, 7)."""
    try:
        array = np.asarray(waypoints_m, dtype=np.float64)
    except (TypeError, ValueError):
        raise PathError("way-points: expected numbers of shape (m, 3)") from None
    if array.ndim != 2 or array.shape[1] not in (3, 7):
        raise PathError(f"way-points: expected shape (m, 3), or (m, 7) with orientations, got {array.shape}")
    listed: list[list[float]] = array.tolist()
    if array.shape[1] == 3:
        return listed
    points = tuple((x, y, z) for x, y, z, *_ in listed)
    return Waypoints(points, None, (), tuple(checked_quaternion(row[3:]) for row in listed))


def _stacked(rows: Sequence[Sequence[float]], width: int) -> Array:
    return np.array(rows, dtype=np.float64).reshape(-1, width)

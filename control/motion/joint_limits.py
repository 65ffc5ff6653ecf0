"""Joint limits for the planners: range, speed, acceleration and jerk of all joints."""

import math
from dataclasses import dataclass, replace

from control.dynamics.joint_side import usable_range_rad
from control.errors import MissingModel
from control.model.arm import Arm
from control.motion.errors import MotionError


@dataclass(frozen=True, slots=True)
class JointLimits:
    """One float per joint in each tuple; the range may be infinite, the others are positive and finite.

    Within the range, joint and encoder are both within the limits of arm.toml.
    """

    lower_rad: tuple[float, ...]
    upper_rad: tuple[float, ...]
    speed_rad_s: tuple[float, ...]
    acceleration_rad_s2: tuple[float, ...]
    jerk_rad_s3: tuple[float, ...]

    @staticmethod
    def of(arm: Arm) -> "JointLimits":
        """The limits in the arm's [[drive]] sections; MissingModel names a joint without them."""
        drives = [arm.drive(joint) for joint in range(1, arm.joint_count + 1)]
        for drive in drives:
            for quantity in ("speed_limit_rad_s", "acceleration_limit_rad_s2", "jerk_limit_rad_s3"):
                if not math.isfinite(getattr(drive, f"joint_{quantity}")):
                    raise MissingModel(
                        f"arm {arm.name}: to move, joint {drive.joint} needs joint_{quantity} in its [[drive]]"
                    )
        room = usable_range_rad(arm)
        return JointLimits(
            lower_rad=tuple(lower for lower, _ in room),
            upper_rad=tuple(upper for _, upper in room),
            speed_rad_s=tuple(drive.joint_speed_limit_rad_s for drive in drives),
            acceleration_rad_s2=tuple(drive.joint_acceleration_limit_rad_s2 for drive in drives),
            jerk_rad_s3=tuple(drive.joint_jerk_limit_rad_s3 for drive in drives),
        )

    def scaled(self, fraction: float) -> "JointLimits":
        """Limits for the same motion in 1/fraction of the time: powers 1, 2, 3 for speed, acceleration, jerk.

        Only for motions that start at rest: braking from a greater speed would take far too long.

        Raises:
            MotionError: `fraction` is not in 0 .. 1, zero excluded.
        """
        if not 0.0 < fraction <= 1.0:
            raise MotionError(f"speed fraction: expected a number above 0 and at most 1, got {fraction}")
        return replace(
            self,
            speed_rad_s=tuple(v * fraction for v in self.speed_rad_s),
            acceleration_rad_s2=tuple(a * fraction**2 for a in self.acceleration_rad_s2),
            jerk_rad_s3=tuple(j * fraction**3 for j in self.jerk_rad_s3),
        )

    def slower(self, fraction: float) -> "JointLimits":
        """Limit only the speed to `fraction`, for a motion from a moving state; errors as `scaled`."""
        return replace(self, speed_rad_s=self.scaled(fraction).speed_rad_s)

    def braking(self, acceleration: float, jerk: float) -> "JointLimits":
        """Multiply acceleration and jerk by these factors, for harder stops."""
        return replace(
            self,
            acceleration_rad_s2=tuple(a * acceleration for a in self.acceleration_rad_s2),
            jerk_rad_s3=tuple(j * jerk for j in self.jerk_rad_s3),
        )

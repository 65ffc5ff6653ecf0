"""Joint limits for the planners: range, speed, acceleration and jerk of all joints."""

import math
from dataclasses import dataclass, replace

from control.dynamics.joint_side import usable_range_rad
from control.errors import MissingModel, MotionError
from control.model.arm import Arm


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
                    raise MissingModel(f"arm {arm.name}: to move, joint {drive.joint} needs joint_{quantity} in its [[drive]]")
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

    def braking(self, acceleration: float, jerk: float) -> "JointLimits":
        """Multiply acceleration and jerk by these factors, for harder stops."""
        return replace(
            self,
            acceleration_rad_s2=tuple(a * acceleration for a in self.acceleration_rad_s2),
            jerk_rad_s3=tuple(j * jerk for j in self.jerk_rad_s3),
        )


# For a joint without a zero, whose range is unknown: an end stop is reached slowly and with half of the current.
UNHOMED_SPEED_rad_s = 0.1
# The tip takes about 0.2 s from rest to speed; more if the joints cannot follow.
TIP_ACCELERATION_m_s2, TIP_JERK_m_s3 = 1.5, 30.0
# Slow enough to watch; the tip's speed limit holds for what is 0.5 m from it. The same 0.2 s to speed.
TURN_SPEED_rad_s, TURN_ACCELERATION_rad_s2, TURN_JERK_rad_s3 = 0.5, 3.0, 60.0


@dataclass(frozen=True, slots=True)
class JogLimits:
    """joints: range, acceleration and jerk as for every motion, speeds of a jog; of_motion: all of every motion.

    tip_speed_m_s: of the tip jog. silence_s: how long a jog continues without renewal.
    """

    joints: JointLimits
    of_motion: JointLimits
    tip_speed_m_s: float
    silence_s: float

    @staticmethod
    def of(arm: Arm) -> "JogLimits":
        """The limits of an arm; a single joint's speed keeps the tip's limit with the arm fully stretched."""
        limits = JointLimits.of(arm)
        tip_m_s = min(arm.limits.jog_tip_speed_m_s, arm.limits.tip_speed_m_s)
        speeds = tuple(min(speed, tip_m_s / reach) for speed, reach in zip(limits.speed_rad_s, reaches_m(arm), strict=True))
        return JogLimits(_with_speed(limits, speeds), limits, tip_m_s, arm.limits.jog_silence_s)

    def unhomed(self) -> "JogLimits":
        """The limits for joints without a zero: no range, slow."""
        count = len(self.joints.speed_rad_s)
        slow = tuple(min(speed, UNHOMED_SPEED_rad_s) for speed in self.joints.speed_rad_s)
        limits = _with_speed(self.joints, slow)
        endless = JointLimits(
            (-math.inf,) * count, (math.inf,) * count, limits.speed_rad_s, limits.acceleration_rad_s2, limits.jerk_rad_s3
        )
        return JogLimits(endless, endless, self.tip_speed_m_s, self.silence_s)


def reaches_m(arm: Arm) -> tuple[float, ...]:
    """For each joint, an upper bound of the tip's distance from its axis: the sum of the link lengths beyond it."""
    lengths = _lengths_m(arm)
    first = [i for i, turns in enumerate(arm.joints) if turns]
    return tuple(max(sum(lengths[i:]), 1e-3) for i in first)


def reach_m(arm: Arm) -> float:
    """An upper bound of the tip's distance from the base frame's origin: the sum of all link lengths."""
    return sum(_lengths_m(arm))


def _lengths_m(arm: Arm) -> list[float]:
    """The length of each link, with the tool's as part of the last."""
    lengths = [math.hypot(link.d_m, link.L_m) for link in arm.links]
    lengths[-1] += math.hypot(*arm.tool.position_m)
    return lengths


def _with_speed(limits: JointLimits, speed_rad_s: tuple[float, ...]) -> JointLimits:
    return JointLimits(limits.lower_rad, limits.upper_rad, speed_rad_s, limits.acceleration_rad_s2, limits.jerk_rad_s3)

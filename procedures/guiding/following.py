"""One arm follows another: jogs of the follower that lead to the leader's joint angles, as they are or mirrored.

The follower is jogged, so that all that holds for jogs holds here: reduced speed, the joints' ranges, floor, table and the other
arms, and it comes to rest when its client falls silent.
"""

import itertools
import math
import random
from collections.abc import Callable, Sequence

import numpy as np

from control.errors import ArmError
from control.kinematics.kinematics import Kinematics
from control.model.cell import Placed
from control.motion.jog_limits import JogLimits
from control.server.channel import Message
from control.server.client import ArmClient, ArmFaulted, MotionStopped, RequestRefused, fault_text

PERIOD_S = 0.02  # of the requests; a jog must be renewed at 10 Hz
GAIN_per_s = 6.0  # of the distance: it is halved in 0.12 s
APPROACH_SPEED = 0.3  # of the joints' limits, to where the leader is
NEAR_rad = 0.02  # of the leader's pose: no approach is needed
MIRRORED_WITHIN_m = 0.02  # between a mirrored tip and the follower's: two calibrated arms differ by some mm
POSES = 12  # at which that is compared
LOST = ("OFF", "FAULT")  # modes of a leader that is not followed


def mirror_signs(leader: Placed, follower: Placed) -> tuple[float, ...]:
    """Signs of the follower's joints for which its tip is the mirror image of the leader's. ArmError if there are none.

    The mirror is the plane halfway between the two bases, perpendicular to the line between them.
    """
    require_alike(leader, follower)
    one, other = np.array(leader.origin_m), np.array(follower.origin_m)
    length_m = float(np.linalg.norm(other - one))
    if length_m < MIRRORED_WITHIN_m:
        raise ArmError(
            f"follow: arms {leader.name!r} and {follower.name!r} stand at one place: there is no plane between them"
        )
    normal, middle = (other - one) / length_m, 0.5 * (one + other)
    poses = _poses(leader)
    wanted = []
    for q_rad in poses:
        tip = np.array(leader.in_cell(Kinematics(leader.arm).tip(*q_rad)))
        wanted.append(tip - 2.0 * normal * float(normal @ (tip - middle)))
    found = Kinematics(follower.arm)

    def off_m(signs: Sequence[float]) -> float:
        tips = (
            follower.in_cell(found.tip(*(s * q for s, q in zip(signs, pose, strict=True)))) for pose in poses
        )
        return max(math.dist(tip, want) for tip, want in zip(tips, wanted, strict=True))

    best = min(itertools.product((1.0, -1.0), repeat=follower.arm.joint_count), key=off_m)
    if off_m(best) > MIRRORED_WITHIN_m:
        raise ArmError(
            f"follow: arms {leader.name!r} and {follower.name!r} are no mirror images of each other in this cell: the tips miss"
            f" by {off_m(best):.3f} m (at most {MIRRORED_WITHIN_m} m); without --mirrored the joints take the same angles"
        )
    return best


def require_alike(leader: Placed, follower: Placed) -> None:
    """ArmError unless both arms have as many joints."""
    counts = leader.arm.joint_count, follower.arm.joint_count
    if counts[0] != counts[1]:
        raise ArmError(
            f"follow: expected arms with as many joints, got {counts[0]} ({leader.name}) and {counts[1]} ({follower.name})"
        )


def _poses(placed: Placed) -> list[tuple[float, ...]]:
    source = random.Random(0)
    limits = [(max(lower, -math.pi), min(upper, math.pi)) for lower, upper in placed.arm.limits_rad]
    return [tuple(source.uniform(*ends) for ends in limits) for _ in range(POSES)]


class Following:
    """A follower on its leader's heels. `signs`: of the follower's joint angles over the leader's."""

    def __init__(
        self, leader: ArmClient, follower: ArmClient, placed: Placed, signs: Sequence[float]
    ) -> None:
        """`placed`: the follower."""
        self._leader, self._follower, self._signs = leader, follower, tuple(signs)
        self._most_rad_s = JogLimits.of(placed.arm).joints.speed_rad_s
        self._range_rad = placed.arm.limits_rad
        self._is_jogging = False
        self.limited = ""

    def approach(self) -> None:
        """Move the follower to where the leader's pose puts it, by a planned motion. RequestRefused, MotionStopped."""
        target = self._target_rad(self._read(self._leader))
        away_rad = max(
            abs(a - b) for a, b in zip(target, self._read(self._follower)["joint_set_rad"], strict=True)
        )
        if away_rad > NEAR_rad:
            self._follower.move_joints(target, APPROACH_SPEED)

    def step(self) -> None:
        """One request: the leader's speed, and what brings the follower nearer. ArmFaulted or MotionStopped end it."""
        leader, follower = self._read(self._leader), self._read(self._follower)
        if self._is_jogging and follower["mode"] != "JOGGING":
            raise MotionStopped(f"following has ended: the follower was stopped and is {follower['mode']}")
        speeds = [
            min(max(sign * speed + GAIN_per_s * (wanted - q), -most), most)
            for sign, speed, wanted, q, most in zip(
                self._signs, leader["speed_rad_s"], self._target_rad(leader), follower["joint_set_rad"], self._most_rad_s,
                strict=True,
            )
        ]  # fmt: skip
        try:
            self.limited = str(self._follower.ask("jog", joint_speed_rad_s=speeds)["limited"])
        except RequestRefused as refusal:
            if not self._is_jogging:
                raise
            raise MotionStopped(f"following has ended: {refusal}") from None
        self._is_jogging = True

    def run(self, on_step: Callable[[], bool]) -> None:
        """Follow until `on_step`, called after each request, is false."""
        self.approach()
        self.step()
        while on_step():
            self._follower.wait(PERIOD_S)
            self.step()

    def _read(self, client: ArmClient) -> Message:
        status = client.status()
        if status["mode"] == "FAULT":
            raise ArmFaulted(fault_text(status))
        if status["mode"] in LOST or not status["is_homed"]:
            homed = "homed" if status["is_homed"] else "not homed"
            raise ArmError(
                f"follow: arm {status['arm']!r} is {status['mode']} and {homed}: enable and home both arms first"
            )
        return status

    def _target_rad(self, leader: Message) -> tuple[float, ...]:
        """The follower's joint angles, within its range."""
        return tuple(
            min(max(sign * q, lower), upper)
            for sign, q, (lower, upper) in zip(self._signs, leader["joint_rad"], self._range_rad, strict=True)
        )

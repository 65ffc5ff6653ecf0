"""The person beside a mock arm: reads true joint angles with the accuracy of an inclinometer, and supports links on request."""

import random
import sys

from hil_mocks.rig import SteppedRig

READING_SD_RAD = 0.002  # a tenth of a degree, an inclinometer's
SEEN_RAD = 0.01  # the smallest visible turn


class MockOperator:
    """`procedures.bringup.operator.Operator` for a stepped rig. Its answers are printed."""

    def __init__(self, rig: SteppedRig, seed: int = 0, is_silent: bool = False) -> None:
        self._rig = rig
        self._random = random.Random(f"operator {seed}")
        self._is_silent = is_silent
        self._look()

    def say(self, text: str) -> None:
        """Print it."""
        if not self._is_silent:
            sys.stdout.write(f"{text}\n")

    def allow(self, what: str) -> bool:
        """Always True; notes the joint angles before the motion."""
        self.say(f"  {what}  [mock operator: go]")
        self._look()
        return True

    def _look(self) -> None:
        """Note the joint angles and the speeds at which the joints sink."""
        self._before, self._seen_s = self._rig.joint_rad(), self._rig.clock.now_s()
        self._sinking_rad_s = self._rig.robot.plant.joint_speed_rad_s()

    def wants_stop(self) -> bool:
        """Never."""
        return False

    def what_moved(self, joint_count: int) -> tuple[int, int] | None:
        """The joint that has turned most since the last motion was allowed."""
        span_s = self._rig.clock.now_s() - self._seen_s
        places = zip(self._before, self._rig.joint_rad(), self._sinking_rad_s, strict=True)
        turned = [now - before - sinking * span_s for before, now, sinking in places]
        joint = max(range(joint_count), key=lambda j: abs(turned[j]))
        answer = (joint + 1, 1 if turned[joint] > 0.0 else -1) if abs(turned[joint]) > SEEN_RAD else None
        words = (
            f"joint {answer[0]}, {'positive' if answer[1] > 0 else 'negative'}" if answer else "nothing moved"
        )
        self.say(f"  Which joint moved, and in which direction?  [mock operator: {words}]")
        return answer

    def angle_rad(self, joint: int) -> float | None:
        """The true angle with a small reading error."""
        return self._rig.joint_rad()[joint - 1] + self._random.gauss(0.0, READING_SD_RAD)

    def support(self, joint: int) -> None:
        """Hold all links but one."""
        for other in range(len(self._rig.joint_rad())):
            self._rig.robot.plant.block(other, other != joint - 1, "operator")

    def let_go(self) -> None:
        """Release all links."""
        for other in range(len(self._rig.joint_rad())):
            self._rig.robot.plant.block(other, False, "operator")

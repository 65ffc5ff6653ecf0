"""The person beside a mock arm: reads true joint angles with the accuracy of an inclinometer, and supports links on request."""

import random
import sys

from hil_mocks.rig import SteppedRig

READING_SD_RAD = 0.002  # a tenth of a degree, an inclinometer's
SEEN_RAD = 0.01  # the smallest visible turn


class MockOperator:
    """`procedures.bringup.operator.BringupOperator` for a stepped rig. Its answers are printed."""

    def __init__(self, rig: SteppedRig, seed: int = 0, is_silent: bool = False) -> None:
        self._rig = rig
        self._random = random.Random(f"operator {seed}")
        self._is_silent = is_silent
        self._before = rig.joint_rad()
        self.let_go()

    def say(self, text: str) -> None:
        """Print it."""
        if not self._is_silent:
            sys.stdout.write(f"{text}\n")

    def allow(self, what: str) -> bool:
        """Always True; notes the joint angles before the motion."""
        self.say(f"  {what}  [mock operator: go]")
        self._before = self._rig.joint_rad()
        return True

    def wants_stop(self) -> bool:
        """Never."""
        return False

    def what_moved(self, joint_count: int) -> tuple[int, int] | None:
        """The joint that has turned most since the last motion was allowed."""
        turned = [now - before for before, now in zip(self._before, self._rig.joint_rad(), strict=True)]
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
        """Hold all links but one, whose weight its motor carries."""
        self._hold(joint)

    def let_go(self) -> None:
        """Carry the weight of all links, which may turn."""
        self._hold(None)

    def _hold(self, free: int | None) -> None:
        plant = self._rig.robot.plant
        plant.carry(free is None)
        for j in range(plant.joints):
            plant.block(j, free is not None and j != free - 1, "operator")

"""A gripper on a board with a position loop and a force limit of its own, such as a smart servo: places and forces, no voltages.

The place runs ahead of the fingers at the speed limit, and no further than LEAD_SHARE of the travel, where the board pushes with
the wanted force.
"""

import math
from typing import Final, Protocol

from control.end_effector.grip_state import GripState
from control.end_effector.gripper import GripperControl
from control.hardware.gripper_board import GripperHardware
from control.model.end_effector import Gripper

LEAD_SHARE: Final = 0.15  # of the travel: a position loop of usual gain then gives all that it may


class PlacedHardware(GripperHardware, Protocol):
    """A motor that goes to places."""

    def place(self, moved_m: float | None, force_A: float, now_s: float) -> None:
        """Go to where the fingers have moved by so much, with at most this current; None: let go."""
        ...


class PlacedGripper(GripperControl):
    """As `GripperControl`; what it commands are places."""

    def __init__(self, described: Gripper, board: PlacedHardware) -> None:
        super().__init__(described, board)
        self._placed = board
        self._aim_m = math.nan  # `moved_m` of the place that it goes to

    def _command(self, elapsed_s: float, now_s: float) -> None:
        self._placed.place(self._place_m(elapsed_s), self._force_A(), now_s)

    def _place_m(self, elapsed_s: float) -> float | None:
        moved_m, goal = self.feedback.moved_m, self.goal
        is_let_go = self.state is GripState.RELEASED or (
            self.state is GripState.FAILED and self.described.on_fault == "release"
        )
        if is_let_go or math.isnan(moved_m):
            return None
        if self.state is GripState.GRIPPED and goal is not None and self._has_slipped(goal):
            self._go_on(goal)
        if self.state is GripState.MOVING and goal is not None:
            left_m = self._looked(goal, elapsed_s)
            if self.state is GripState.MOVING:
                return self._ahead(moved_m, left_m, goal.sign, elapsed_s)
        if self.state is GripState.GRIPPED:
            return self._aim_m
        self._aim_m = math.nan
        if self._hold_m is None:
            self._take_place()
        return moved_m if self._hold_m is None else self._hold_m

    def _ahead(self, moved_m: float, left_m: float, sign: int, elapsed_s: float) -> float:
        """The next place on its way; an end is pushed into, another goal is not passed."""
        gripper = self.described
        lead_m = LEAD_SHARE * gripper.travel_m
        step_m = sign * gripper.speed_limit_m_s * elapsed_s
        aim_m = (moved_m if math.isnan(self._aim_m) else self._aim_m) + step_m
        aim_m = min(max(aim_m, moved_m - lead_m), moved_m + lead_m)
        is_end = self.goal is None or self.goal.opening_m in (None, 0.0, gripper.travel_m)
        if not is_end and abs(aim_m - moved_m) > abs(left_m):
            aim_m = moved_m + left_m
        self._aim_m = aim_m
        return aim_m

"""What carries the boards' outputs to the motors, and what is wrong with it: polarity, broken wires, jams, the supply."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hil_mocks.devices.motor_inputs import OPEN, Output
from hil_mocks.plant.gripper import GripperPlant
from hil_mocks.plant.plant import Plant
from hil_mocks.scenario import FaultTable


class MotorWires:
    """Motors of the joints, 0-based; after them that of a gripper, if there is one.

    `applied`, `limits_A`: each motor's last output and current limit. `polarity`: 1, or -1 where it turns backwards.
    """

    def __init__(self, plant: Plant, gripper: GripperPlant | None, directions: Sequence[int]) -> None:
        self._plant, self._gripper, self._directions = plant, gripper, tuple(directions)
        self._dead: set[int] = set()  # motors with a broken wire
        self.polarity = list(directions)
        self.applied: list[Output] = [OPEN for _ in directions]
        self.limits_A = [math.inf for _ in directions]

    def apply(self, j: int, output: Output, limit_A: float) -> None:
        """Apply a board's output to a motor."""
        plant = self._plant
        self.limits_A[j] = limit_A
        kind, value = self.applied[j] = output
        if (gripper := self._gripper_at(j)) is not None:
            gripper.drive("open" if j in self._dead else kind, self.polarity[j] * value, limit_A)
            return
        plant.bridges.limit_current(j, limit_A)
        if j in self._dead:
            plant.drive_open(j)
        elif kind == "voltage":
            plant.drive_voltage(j, self.polarity[j] * value)
        elif kind == "current":
            plant.drive_current(j, self.polarity[j] * value)
        else:
            plant.drive_open(j)

    def switch(self, fault: FaultTable, j: int, is_on: bool) -> bool:
        """Begin or end a fault between any board and its motor; False if it is another sort."""
        if fault.kind == "swapped_polarity":
            self.polarity[j] = self._directions[j] * (-1 if is_on else 1)
            self.apply(j, self.applied[j], self.limits_A[j])
        elif fault.kind == "dead_motor":
            (self._dead.add if is_on else self._dead.discard)(j)
            self.apply(j, self.applied[j], self.limits_A[j])
        elif fault.kind == "stuck_joint":
            self._jam(j, is_on)
        elif fault.kind == "supply":
            self._supply(j, fault.value if is_on else None)
        else:
            return False
        return True

    def _gripper_at(self, j: int) -> GripperPlant | None:
        return self._gripper if j == self._plant.joints else None

    def _jam(self, j: int, is_on: bool) -> None:
        if (gripper := self._gripper_at(j)) is not None:
            gripper.is_jammed = is_on
        else:
            self._plant.block(j, is_on)

    def _supply(self, j: int, supply_V: float | None) -> None:
        if (gripper := self._gripper_at(j)) is not None:
            gripper.set_supply(supply_V)
        else:
            self._plant.bridges.set_supply(j, supply_V)

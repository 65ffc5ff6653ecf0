"""Wiring between boards and motors, and its errors: swapped plugs, broken wires, jams, another gear, a loose coupling."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import replace

from control.model.description import Arm, Drive
from hil_mocks.devices.motor_inputs import OPEN, Output
from hil_mocks.errors import ScenarioError
from hil_mocks.plant.gripper import GripperPlant
from hil_mocks.plant.plant import Plant
from hil_mocks.scenario import FaultTable, Scenario

LOOSE_PART = 0.05  # default share of motion lost by a loose coupling
_SLIP_TURNS = 0.3  # motor turns, on average, between slips of a loose coupling


def as_built(arm: Arm, scenario: Scenario) -> Arm:
    """The arm as wired by the scenario's faults. Raises ScenarioError if a fault names a missing part."""
    drives = list(arm.drives)
    for fault in scenario.fault:
        if fault.kind == "reversed_encoder":
            drives = [_reversed(drive) if _is_on(drive, fault) else drive for drive in drives]
        elif fault.kind == "wrong_gear":
            ratio = float(fault.value or 0.0)
            drives = [replace(d, gear_ratio=ratio) if _drives(d, fault) else d for d in drives]
        elif fault.kind == "swapped_motors":
            drives = _with_swapped_motors(drives, fault)
    return replace(arm, drives=tuple(drives))


def _is_on(drive: Drive, fault: FaultTable) -> bool:
    board = "encoder" + (str(drive.encoder_board + 1) if drive.encoder_board > 0 else "")
    return fault.board == board and drive.encoder_channel == fault.channel


def _drives(drive: Drive, fault: FaultTable) -> bool:
    return fault.board == f"motor{drive.motor_node}"


def _reversed(drive: Drive) -> Drive:
    return replace(drive, encoder_direction=-drive.encoder_direction)


def _with_swapped_motors(drives: Sequence[Drive], fault: FaultTable) -> list[Drive]:
    first, second = int(fault.board.removeprefix("motor")), int(fault.value or 0)
    if second not in {drive.motor_node for drive in drives}:
        raise ScenarioError(f'fault "swapped_motors": there is no motor board with node {second}.')
    other = {first: second, second: first}
    return [replace(d, motor_node=other.get(d.motor_node, d.motor_node)) for d in drives]


class LooseCoupling:
    """An encoder that slips on its shaft: at random times (seeded) it loses part of the motion."""

    def __init__(self, part: float, turn_rad: float, seed: str) -> None:
        """`part`: of the motion, on average; `turn_rad`: one motor turn, in joint angles."""
        self._part, self._mean_rad = part, _SLIP_TURNS * turn_rad
        self._random = random.Random(f"coupling {seed}")
        self._from_rad: float | None = None
        self._next_rad = self._random.expovariate(1.0 / self._mean_rad)
        self.slip_rad = 0.0

    def reading_rad(self, shaft_rad: float) -> float:
        """The encoder angle for a shaft angle."""
        if self._from_rad is None:
            self._from_rad = shaft_rad
        turned_rad = shaft_rad - self._from_rad
        if abs(turned_rad) > self._next_rad:
            self.slip_rad -= turned_rad * min(1.0, 2.0 * self._part * self._random.random())
            self._from_rad = shaft_rad
            self._next_rad = self._random.expovariate(1.0 / self._mean_rad)
        return shaft_rad + self.slip_rad


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

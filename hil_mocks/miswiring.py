"""Wiring and assembly errors of a scenario: swapped plugs, another gear, a loose coupling."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace

from control.model.description import Arm, Drive
from hil_mocks.errors import ScenarioError
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

"""The gripper of a mock arm, from arm.toml and the scenario, and the wires between pins of motor boards."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from control.model.description import Arm, Gripper
from hil_mocks.devices.motor_inputs import MotorBoardHardware, MotorBoardSetup
from hil_mocks.errors import RigError, ScenarioError
from hil_mocks.firmware.choice import motor_board_class
from hil_mocks.plant.gripper import GripperParts, GripperPlant
from hil_mocks.plant.parts import rotor_inertia_kg_m2
from hil_mocks.scenario import Scenario
from hil_mocks.wiring import MOTOR_BOARD_SERIAL, OWN_INPUT, limit_switches

_RATING_mA = 8000
_NO_ENCODER_COUNTS = 4  # a board says some number, whether an encoder is connected or not


def build_gripper(gripper: Gripper, scenario: Scenario) -> GripperPlant:
    """The physics."""
    table = scenario.gripper
    turns_per_m = 1.0 / gripper.travel_per_turn_m
    parts = GripperParts(
        travel_m=gripper.travel_m,
        constant_N_A=2.0 * math.pi * gripper.torque_constant_Nm_A * turns_per_m,
        resistance_ohm=gripper.resistance_ohm,
        supply_V=gripper.supply_V,
        rotor_kg=rotor_inertia_kg_m2(gripper) * (2.0 * math.pi * turns_per_m) ** 2,
        friction_N=table.friction_N,
        start_m=table.start * gripper.travel_m,
        counts_per_m=gripper.encoder_counts_per_rev * turns_per_m,
        travel_per_turn_m=gripper.travel_per_turn_m,
    )
    plant = GripperPlant(parts, scenario.plant.timestep_s)
    if table.object_m is not None:
        plant.object_m = (table.object_m, table.object_N_m)
    return plant


def build_gripper_board(gripper: Gripper, scenario: Scenario, plant: GripperPlant) -> MotorBoardHardware:
    """Its motor board, which reads the encoder of its motor."""
    setup = MotorBoardSetup(
        node=gripper.motor_node,
        serial_number=gripper.motor_serial_number or MOTOR_BOARD_SERIAL + gripper.motor_node,
        counts_per_turn=gripper.encoder_counts_per_rev or _NO_ENCODER_COUNTS,
        rating_mA=_RATING_mA,
        current_noise_A=scenario.motor_board.current_noise_A,
        current_step_A=scenario.motor_board.current_step_A,
        supply_noise_V=scenario.motor_board.supply_noise_V,
        period_us=min(1000, round(scenario.tick_s * 1e6)),
        digital_pins=scenario.motor_board.digital_pins,
        seed=scenario.seed,
    )
    return motor_board_class(scenario)(setup, lambda: gripper.motor_direction * plant.count())


class PinWires:
    """What is connected to the pins of all boards, by name: wires from outputs to inputs, and levels from outside."""

    def __init__(self, arm: Arm, scenario: Scenario, boards: Sequence[MotorBoardHardware]) -> None:
        by_node = {board.setup.node: board for board in boards}
        self._places: Mapping[str, tuple[MotorBoardHardware, int]] = {
            pin.name: (by_node[pin.board], pin.pin) for pin in arm.digital if pin.board in by_node
        }
        self._wires = [(self._place(a), self._place(b)) for a, b in scenario.wire.items()]
        # of each limit switch its pin, joint, place, the side on which it is active, and the level of an active one
        self._limits = [
            (self._place(name), j, at_rad, side, drive.limit_switches.active == "high")
            for j, drive in enumerate(arm.drives)
            for name, at_rad, side in limit_switches(drive)
            if drive.limit_switches is not None and name != OWN_INPUT
        ]

    def set_level(self, name: str, level: bool) -> None:
        """Put a level on an input from outside; its limit switch changes by hand from then on. RigError for an unknown name."""
        if name not in self._places:
            raise RigError(f'mock arm: no pin "{name}"; there are {", ".join(self._places) or "none"}.')
        place = self._places[name]
        self._limits = [limit for limit in self._limits if limit[0] != place]
        self._put(place, level)

    def levels(self) -> dict[str, bool]:
        """Levels at all named pins."""
        return {name: bool(board.pins.levels >> pin & 1) for name, (board, pin) in self._places.items()}

    def tick(self, joint_rad: Sequence[float]) -> None:
        """Let levels pass through the wires, and joints press their limit switches."""
        for place, j, at_rad, side, is_active_high in self._limits:
            self._put(place, ((joint_rad[j] - at_rad) * side >= 0.0) is is_active_high)
        for (source, pin), target in self._wires:
            self._put(target, bool(source.pins.levels >> pin & 1))

    def _place(self, name: str) -> tuple[MotorBoardHardware, int]:
        if name not in self._places:
            raise ScenarioError(
                f'scenario: [wire]: no pin "{name}"; arm.toml has {", ".join(self._places) or "none"}.'
            )
        return self._places[name]

    @staticmethod
    def _put(place: tuple[MotorBoardHardware, int], level: bool) -> None:
        board, pin = place
        board.pins.outside = board.pins.outside & ~(1 << pin) | level << pin

"""Wiring of motors, encoders and boards of a mock arm, by arm.toml, faults and seed; swapped plugs and broken wires."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace

from control.model.arm import Arm, Drive
from hil_mocks.devices.motor_inputs import OPEN, Output
from hil_mocks.errors import ScenarioError
from hil_mocks.plant.gripper import GripperPlant
from hil_mocks.plant.plant import Plant
from hil_mocks.scenario import FaultTable, Scenario

ENCODER_BOARD_SERIAL = 0xE0001  # default of the first encoder board
MOTOR_BOARD_SERIAL = 0xD0000  # plus the node


@dataclass(frozen=True, slots=True)
class JointWiring:
    """Wiring of one joint's encoder and motor."""

    encoder_board: int
    encoder_channel: int
    encoder_direction: int
    motor_node: int
    motor_direction: int
    motor_serial_number: int
    counts_per_turn: int  # true counts of the encoder
    said_counts_per_turn: int  # reported by its encoder board
    motor_counts_per_turn: int  # reported by its motor board
    has_second_encoder: bool  # on the motor, beside that of the joint
    counts_per_rad: float  # of joint angle
    motor_counts_per_rad: float  # of joint angle, of what the motor board counts; 0: nothing
    phase_count: float  # phase between two edges at joint angle zero
    index_rad: float  # joint angle of one of its index pulses
    switch_rad: float  # joint angle where the home switch changes
    switch_side: float  # the side on which it is active: that of the index by the arm's file, upwards where both are one
    zero_count: int

    def raw_count(self, encoder_rad: float) -> int:
        """Edges counted by the encoder, without wrap; direction as wired."""
        return math.floor(self.encoder_direction * encoder_rad * self.counts_per_rad + self.phase_count)

    def motor_count(self, motor_rad: float) -> int:
        """The count at the motor board: a positive voltage counts up."""
        return math.floor(self.motor_direction * motor_rad * self.motor_counts_per_rad + self.phase_count)

    def is_at_switch(self, joint_rad: float) -> bool:
        """Whether the home switch is active; a missing one never is."""
        return (joint_rad - self.switch_rad) * self.switch_side >= 0.0

    def index_count(self) -> int:
        """Raw count of an index pulse."""
        return self.raw_count(self.index_rad)


LIMIT_BEHIND_rad = 0.02  # the end of the range, where nothing else is said; end stops are at 0.05
OWN_INPUT = "drive"


def limit_switches(drive: Drive) -> list[tuple[str, float, float]]:
    """Of each limit switch of a joint its pin, where it changes, and the side on which it is active."""
    if (switches := drive.limit_switches) is None:
        return []
    ends = (
        (switches.lower, switches.lower_rad, drive.joint_lower_rad, -1.0),
        (switches.upper, switches.upper_rad, drive.joint_upper_rad, 1.0),
    )
    return [
        (pin, end_rad + side * LIMIT_BEHIND_rad if given_rad is None else given_rad, side)
        for pin, given_rad, end_rad, side in ends
        if pin
    ]


def wiring_of(arm: Arm, scenario: Scenario) -> list[JointWiring]:
    """Wiring of all joints. Raises ScenarioError for a swap with a missing channel."""
    source = random.Random(f"wiring {scenario.seed}")
    wiring = [_joint(arm, j, scenario, source) for j in range(len(arm.drives))]
    for fault in scenario.fault:
        if fault.kind == "swapped_channels":
            wiring = _swapped(wiring, fault.channel, int(fault.value or 0))
    return wiring


def _joint(arm: Arm, j: int, scenario: Scenario, source: random.Random) -> JointWiring:
    drive = arm.drives[j]
    counts = reported = drive.encoder_counts_per_rev
    for fault in scenario.fault:
        if fault.board == "encoder" and fault.channel == drive.encoder_channel:
            if fault.kind == "wrong_counts":
                counts = reported = int(fault.value or counts)
            elif fault.kind == "wrong_encoder":
                counts = int(fault.value or counts)
    error_rad = scenario.encoder_board.index_error_rad
    home = drive.home
    is_on_motor = drive.encoder_on == "motor"
    of_motor = drive.gear_ratio * (drive.motor_counts_per_rev or 0) / (2.0 * math.pi)
    counts_per_rad = (drive.gear_ratio if is_on_motor else 1.0) * drive.encoder_ratio * counts / (2.0 * math.pi)
    return JointWiring(
        encoder_board=drive.encoder_board,
        encoder_channel=drive.encoder_channel,
        encoder_direction=drive.encoder_direction,
        motor_node=drive.motor_node,
        motor_direction=drive.motor_direction,
        motor_serial_number=drive.motor_serial_number or MOTOR_BOARD_SERIAL + drive.motor_node,
        counts_per_turn=counts,
        said_counts_per_turn=reported,
        motor_counts_per_turn=reported if is_on_motor else drive.motor_counts_per_rev or 1,
        has_second_encoder=not is_on_motor and not drive.board,
        counts_per_rad=counts_per_rad,
        motor_counts_per_rad=counts_per_rad if is_on_motor or drive.board else of_motor,
        phase_count=source.random(),
        index_rad=(home.index_rad if home else 0.0) + source.uniform(-error_rad, error_rad),
        switch_rad=home.switch_rad if home and home.switch == "own" else math.nan,
        switch_side=-1.0 if home and home.index_rad < home.switch_rad else 1.0,
        zero_count=drive.zero_count,
    )


def _swapped(wiring: list[JointWiring], first: int, second: int) -> list[JointWiring]:
    """Swap two plugs of an encoder board."""
    if not {first, second} <= {w.encoder_channel for w in wiring}:
        raise ScenarioError(f'fault "swapped_channels": there are no encoder channels {first} and {second}.')
    other = {first: second, second: first}
    return [replace(w, encoder_channel=other.get(w.encoder_channel, w.encoder_channel)) for w in wiring]


class Channels:
    """The inputs of one encoder board: counts and home switches by channel."""

    def __init__(self, board: int, wiring: list[JointWiring], channels: int) -> None:
        self._count = channels
        # (joint, channel, counts a radian with sign, phase, switch, sign of its active side; a missing switch is nan)
        self._inputs = [
            (j, w.encoder_channel, w.encoder_direction * w.counts_per_rad, w.phase_count, w.switch_rad, w.switch_side)
            for j, w in enumerate(wiring)
            if w.encoder_board == board
        ]

    def seen(self, encoder_rad: Sequence[float], joint_rad: Sequence[float]) -> tuple[list[int], list[bool]]:
        """Raw counts without wrap, and whether the home switch is active."""
        raw, is_home = [0] * self._count, [False] * self._count
        for j, channel, counts_per_rad, phase, switch_rad, side in self._inputs:
            raw[channel] = math.floor(encoder_rad[j] * counts_per_rad + phase)
            is_home[channel] = (joint_rad[j] - switch_rad) * side >= 0.0
        return raw, is_home


LOOSE_PART = 0.05  # default share of motion lost by a loose coupling
_SLIP_TURNS = 0.3  # motor turns, on average, between slips of a loose coupling


def as_built(arm: Arm, scenario: Scenario) -> Arm:
    """The arm as wired by the scenario's faults. Raises ScenarioError if a fault names a missing part."""
    drives = list(arm.drives)
    for fault in scenario.fault:
        if fault.kind == "reversed_encoder":
            drives = [
                replace(drive, encoder_direction=-drive.encoder_direction) if _is_on(drive, fault) else drive for drive in drives
            ]
        elif fault.kind == "wrong_gear":
            ratio = float(fault.value or 0.0)
            drives = [replace(d, gear_ratio=ratio) if fault.board == f"motor{d.motor_node}" else d for d in drives]
        elif fault.kind == "swapped_motors":
            drives = _with_swapped_motors(drives, fault)
    return replace(arm, drives=tuple(drives))


def _is_on(drive: Drive, fault: FaultTable) -> bool:
    board = "encoder" + (str(drive.encoder_board + 1) if drive.encoder_board > 0 else "")
    return fault.board == board and drive.encoder_channel == fault.channel


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

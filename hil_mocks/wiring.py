"""Wiring of motors, encoders and boards of a mock arm, from arm.toml, the scenario's faults and its seed."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace

from control.model.description import Arm
from hil_mocks.errors import ScenarioError
from hil_mocks.scenario import Scenario

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
    said_counts_per_turn: int  # reported by its boards
    counts_per_rad: float  # of joint angle
    phase_count: float  # phase between two edges at joint angle zero
    index_rad: float  # joint angle of one of its index pulses
    switch_rad: float  # joint angle where the home switch changes
    switch_side: float  # the side on which it is active: that of the index by the arm's file, upwards where both are one
    zero_count: int

    def raw_count(self, encoder_rad: float) -> int:
        """Edges counted by the encoder, without wrap; direction as wired."""
        return math.floor(self.encoder_direction * encoder_rad * self.counts_per_rad + self.phase_count)

    def motor_count(self, encoder_rad: float) -> int:
        """The count at the motor board: a positive voltage counts up."""
        return math.floor(self.motor_direction * encoder_rad * self.counts_per_rad + self.phase_count)

    def is_at_switch(self, joint_rad: float) -> bool:
        """Whether the home switch is active; a missing one never is."""
        return (joint_rad - self.switch_rad) * self.switch_side >= 0.0

    def index_count(self) -> int:
        """Raw count of an index pulse."""
        return self.raw_count(self.index_rad)


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
    return JointWiring(
        encoder_board=drive.encoder_board,
        encoder_channel=drive.encoder_channel,
        encoder_direction=drive.encoder_direction,
        motor_node=drive.motor_node,
        motor_direction=drive.motor_direction,
        motor_serial_number=drive.motor_serial_number or MOTOR_BOARD_SERIAL + drive.motor_node,
        counts_per_turn=counts,
        said_counts_per_turn=reported,
        counts_per_rad=drive.gear_ratio * counts / (2.0 * math.pi),
        phase_count=source.random(),
        index_rad=(home.index_rad if home else 0.0) + source.uniform(-error_rad, error_rad),
        switch_rad=home.switch_rad if home else math.nan,
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
            (
                j,
                w.encoder_channel,
                w.encoder_direction * w.counts_per_rad,
                w.phase_count,
                w.switch_rad,
                w.switch_side,
            )
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

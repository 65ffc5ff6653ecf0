"""What bring-up asks of the boards, whatever their kind, and what it is told in each cycle."""

import math
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

from control.errors import ArmError
from control.model.arm import Drive
from firmware_iface.clock import Clock
from procedures.bringup.operator import BringupOperator

Channel = tuple[int, int]
"""Encoder board and channel on it, both from 0."""


class SafetyTrip(ArmError):
    """A limit of bring-up was exceeded, or a board stopped reporting: the drive was switched off at once."""


@dataclass(frozen=True, slots=True)
class DriveLimits:
    """Limits of a motor's drive, and of its encoder's speed and travel."""

    current_A: float
    voltage_V: float
    speed_count_s: float = math.inf
    travel_count: float = math.inf


@dataclass(frozen=True, slots=True)
class Sample:
    """One cycle: all channels, and the driven motor (board's sign)."""

    t_s: float
    counts: dict[Channel, int]
    flags: dict[Channel, int]
    speed_count_s: dict[Channel, float]
    volts: float
    current_A: float
    is_limited: bool
    """The board reduced the voltage to one of its limits."""


class Workbench(Protocol):
    """The open boards. `driving` enables one motor; within it, `cycle` sends a voltage and waits for the replies."""

    clock: Clock
    operator: BringupOperator
    look_s: float  # between two looks at a home switch, beyond those of an encoder board
    has_index: bool  # index pulses are latched
    limits_current: bool  # the boards keep to the current of bring-up
    has_volts: bool  # a board applies the voltage; else it closes its own loop, and a voltage means the speed that it makes

    def prepare(self) -> None:
        """The operator has allowed a motion: boards that hold their joints begin to."""
        ...

    def observe(self, duration_s: float) -> Sample:
        """Read all boards for a while; nothing is driven."""
        ...

    def driving(self, node: int, limits: DriveLimits) -> AbstractContextManager[None]:
        """Enable one motor at 0 V under these limits; on every exit, it stands still."""
        ...

    def cycle(self, volts: float) -> Sample:
        """Send a voltage (board's sign), wait for the next cycle, read all boards. Raises SafetyTrip or Stopped."""
        ...

    def arm_index(self, at: Channel) -> None:
        """Arm the index latch."""
        ...

    def index_latch(self, at: Channel) -> int | None:
        """The unwrapped count that the index latched since `arm_index`, or None."""
        ...

    def motor_count(self, node: int) -> int:
        """The motor board's own count of its encoder."""
        ...

    def counts_per_turn(self, at: Channel) -> int | None:
        """What a board says of an encoder, None if nothing."""
        ...

    def serials(self) -> dict[int, int]:
        """Serial numbers of reference motor boards, by node."""
        ...


def node_of(drive: Drive) -> int:
    """What bring-up calls the motor of a drive: a reference board's node; on a bought board, its joint in the draft."""
    return drive.joint if drive.board else drive.motor_node


def channel_of(drive: Drive) -> Channel:
    """What bring-up calls the encoder of a drive: a reference board's channel; on a bought board, that of its joint."""
    return (0, drive.joint - 1) if drive.board else (drive.encoder_board, drive.encoder_channel)


def named(drive: Drive) -> str:
    """The board of a drive in messages."""
    return (
        f'board "{drive.board}" (output {drive.board_channel})'
        if drive.board
        else f"motor board {drive.motor_node}"
    )

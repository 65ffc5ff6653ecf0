"""The CAN bus of motor boards: its load by joints, gripper and pins of all arms on it, and the rate that it leaves the loop."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Final, Protocol

from control.model.board_kinds import BoardKind
from control.model.drive import Drive
from control.model.end_effector import Digital, Gripper
from control.model.rules import ONE_OR_MORE

FRAME_bits: Final = 135  # 8 bytes with worst stuffing (docs/motor_board.md)


USUAL_LOAD: Final = 0.7  # of a CAN bus, at most; `doctor` expects it


RATE_STEP_Hz: Final = 50.0


GRIPPER_FRAMES: Final = 4  # a COMMAND, a question for the count, and their answers


GRIPPER_PERIOD_s: Final = 0.01  # its frames in this time are 5 % of a bus of 1 Mbit/s


PIN_FRAMES: Final = 2  # a DIGITAL_COMMAND and its reply, for each board with pins


PIN_PERIOD_s: Final = 0.02  # between questions: 1.4 % of a bus of 1 Mbit/s for each board with pins


@dataclass(frozen=True, slots=True)
class CanBus:
    """The bus of the motor boards, in python-can's terms."""

    interface: Annotated[str, "socketcan, slcan, ..."]
    channel: Annotated[str, "can0, /dev/ttyACM1, ..."]
    bitrate: Annotated[int, ONE_OR_MORE, "of the bus, in bit/s"] = 1_000_000
    options: Annotated[Mapping[str, str | int | float | bool], "passed to the interface unchanged"] = field(default_factory=dict)


class OnBus(Protocol):
    """What an arm has on its bus."""

    @property
    def can(self) -> CanBus | None: ...
    @property
    def motors(self) -> tuple[Drive, ...]: ...
    @property
    def gripper(self) -> Gripper | None: ...
    @property
    def digital(self) -> tuple[Digital, ...]: ...
    @property
    def boards_rate_Hz(self) -> float: ...
    def kind_of(self, drive: Drive) -> BoardKind: ...


def bus_load(arms: Sequence[OnBus], rate_Hz: float, with_unasked: bool = True) -> float:
    """Worst-case share of the busiest CAN bus, for all that its boards are sent and send, or only for what they are asked."""
    loads: dict[tuple[str, str], float] = {}
    for arm in arms:
        if arm.can is not None:
            bus = (arm.can.interface, arm.can.channel)
            on_can = [kind for kind in map(arm.kind_of, arm.motors) if kind.line == "can"]
            cycle_bits = sum(kind.cycle_bits for kind in on_can) + max((kind.shared_bits for kind in on_can), default=0)
            bits_s = cycle_bits * rate_Hz + _end_frames_Hz(arm) * FRAME_bits
            bits_s += with_unasked * sum(kind.sent_bits_s for kind in on_can)
            loads[bus] = loads.get(bus, 0.0) + bits_s / arm.can.bitrate
    return max(loads.values(), default=0.0)


def good_rate_Hz(arms: Sequence[OnBus], rate_Hz: float) -> float:
    """The highest rate with a good load, by the load at any `rate_Hz`; infinite where no board is asked in each cycle."""
    fixed = bus_load(arms, 0.0)
    asked = bus_load(arms, rate_Hz) - fixed
    return max(0.0, (USUAL_LOAD - fixed) / asked * rate_Hz) if asked > 0.0 else math.inf


def usual_rate_Hz(arms: Sequence[OnBus]) -> float:
    """The loop's rate if none is asked for: what the slowest boards of all arms carry, and their buses.

    What bought boards send unasked comes at rates of their own, which a slower loop does not change: `serve` tells of it.
    """
    rate_Hz = min(arm.boards_rate_Hz for arm in arms)
    while bus_load(arms, rate_Hz, with_unasked=False) > USUAL_LOAD and rate_Hz > RATE_STEP_Hz:
        rate_Hz = max(RATE_STEP_Hz, RATE_STEP_Hz * math.ceil(rate_Hz / RATE_STEP_Hz - 1.0))
    return rate_Hz


def _end_frames_Hz(arm: OnBus) -> float:
    """Frames a second for gripper and pins, whatever the rate of the loop."""
    is_on_node = arm.gripper is not None and not arm.gripper.board
    grips = GRIPPER_FRAMES / GRIPPER_PERIOD_s if is_on_node else 0.0
    return grips + PIN_FRAMES * len({pin.board for pin in arm.digital}) / PIN_PERIOD_s

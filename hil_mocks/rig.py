"""Mock arms with links: the Protocol of both rigs, and the stepped one, in one process.

The stepped rig's clock is the simulation's: waiting on it advances plant, boards and camera, in ticks, to that
time. Bytes and frames go through pyserial and python-can, so the host's drivers are the real ones: over wires within the process,
or through the kernel, which costs time and changes no byte.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from control.model.arm import Arm
from control.model.description import load_arm
from firmware_iface.clock import Clock
from firmware_iface.link import Closing
from hil_mocks.plant.hand import Point
from hil_mocks.protocol_mock import CAN_INTERFACE, SerialLine, register
from hil_mocks.robot import MockRobot
from hil_mocks.scenario import FaultTable, Scenario, load_scenario
from hil_mocks.wires import OnWires, Pty, SerialWire, Wires

_channels = itertools.count(1)  # a virtual bus is shared by all users of its channel in the process
_SLACK_S = 1e-9  # rounding of sums of ticks


class MockHand(Protocol):
    """The operator's hand."""

    def seat(self, point_m: Sequence[float]) -> float:
        """Grip the tip, drag it to a point in the base frame and hold it there; returns the duration in s."""
        ...

    def let_go(self) -> None:
        """Leave the tip to the arm."""
        ...

    def residual_m(self) -> float:
        """Distance of the tip from the hand."""
        ...

    @property
    def state(self) -> str:
        """away, dragging, holding or cannot reach."""
        ...


class MockPorts(Protocol):
    """Where the host finds the boards and the camera of a mock arm."""

    @property
    def encoder_urls(self) -> list[str]: ...
    @property
    def board_urls(self) -> dict[str, str]: ...
    @property
    def can_interface(self) -> str: ...
    @property
    def can_channel(self) -> str: ...
    @property
    def can_options(self) -> dict[str, int]: ...
    @property
    def camera_port(self) -> int: ...


@dataclass(frozen=True, slots=True)
class ArmPorts:
    """Meets MockPorts: one arm of a mock cell."""

    encoder_urls: list[str]
    board_urls: dict[str, str]
    can_interface: str
    can_channel: str
    can_options: dict[str, int]
    camera_port: int


class SimulatedArm(MockPorts, Protocol):
    """Interface of a mock arm for host and operator. Times in s, lengths in m, angles in rad, base frame."""

    @property
    def clock(self) -> Clock: ...
    @property
    def hand(self) -> MockHand: ...
    def tip_m(self) -> Point: ...
    def joint_rad(self) -> tuple[float, ...]: ...
    def set_payload(self, mass_kg: float) -> None: ...
    def set_tool(self, name: str) -> None: ...
    def set_object(self, width_m: float | None) -> None: ...
    def gripper(self) -> tuple[float, float]: ...
    def set_pin(self, name: str, level: bool) -> None: ...
    def pins(self) -> dict[str, bool]: ...
    def inject(self, fault: FaultTable) -> None: ...
    def clear_faults(self) -> None: ...
    def close(self) -> None: ...


class Ticking(OnWires, Protocol):
    """What the stepped clock advances: an arm, or a cell of arms."""

    tick_s: float

    @property
    def now_s(self) -> float: ...
    def tick(self) -> None: ...


class SteppedClock:
    """The simulation's time, which passes only by waiting. Exact in ticks: a wait ends at the first tick at or after `t`."""

    def __init__(self, robot: Ticking, wires: Wires) -> None:
        self._robot, self._wires = robot, wires

    def now_s(self) -> float:
        """Simulated time since power-up."""
        return self._robot.now_s

    def wait_until_s(self, t: float) -> None:
        """Process the host's bytes, then advance everything to `t`."""
        robot, wires = self._robot, self._wires
        end_s = t - _SLACK_S
        if robot.now_s >= end_s:
            return
        wires.from_host(robot)
        while robot.now_s < end_s:
            if robot.now_s + robot.tick_s >= end_s:
                # The host reads only after this returns, so data of the last tick may enter a pty
                # before the physics runs: the kernel transfers it meanwhile.
                wires.serial_to_host(robot, robot.tick_s)
            robot.tick()
        wires.to_host(robot)
        wires.settle()


class SteppedRig(Closing):
    """A mock arm in this process, deterministic: the same arm, scenario and host give the same bytes.

    `through_kernel`: over a pty and python-can's virtual bus.
    """

    def __init__(self, arm: Arm | str | Path, scenario: Scenario | str | Path = "ideal", through_kernel: bool = False) -> None:
        as_built = arm if isinstance(arm, Arm) else load_arm(arm)
        self.scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
        self.robot = MockRobot(as_built, self.scenario)
        name = f"armwright-{os.getpid()}-{next(_channels)}"
        lines = range(self.robot.serial_lines)
        serial_wires: list[SerialWire]
        if through_kernel:
            serial_wires, self.can_interface = [Pty() for _ in lines], "virtual"
        else:
            register()
            serial_wires, self.can_interface = [SerialLine(f"{name}-{k}") for k in lines], CAN_INTERFACE
        self.can_channel = name
        self.wires = Wires(serial_wires, self.can_interface, name, [self.robot.camera.transport], self.robot.can_formats)
        self.can_options = self.wires.can_options
        (self.camera_port,) = self.wires.camera_ports
        paths = [wire.path for wire in self.wires.serial]
        self._name_ports(paths)
        self.clock: Clock = SteppedClock(self.robot, self.wires)

    @property
    def hand(self) -> MockHand:
        """The operator's hand."""
        return self.robot.hand

    def tip_m(self) -> Point:
        """True tip."""
        return self.robot.tip_m()

    def joint_rad(self) -> tuple[float, ...]:
        """True joint angles."""
        return self.robot.joint_rad()

    def set_payload(self, mass_kg: float) -> None:
        """Set the point mass at the tip."""
        self.robot.plant.set_payload(mass_kg)

    def set_tool(self, name: str) -> None:
        """Mount another of the arm's tools."""
        self.robot.set_tool(name)

    def set_object(self, width_m: float | None) -> None:
        """Put an object between the gripper's fingers, or remove it (None)."""
        self.robot.set_object(width_m)

    def gripper(self) -> tuple[float, float]:
        """True opening [m] of the gripper, and its force on the object [N]."""
        return self.robot.gripper_truth()

    def set_pin(self, name: str, level: bool) -> None:
        """Put a level on an input from outside."""
        self.robot.pins.set_level(name, level)

    def pins(self) -> dict[str, bool]:
        """Levels at all named pins."""
        return self.robot.pins.levels()

    def inject(self, fault: FaultTable) -> None:
        """Inject a fault."""
        self.robot.inject(fault)

    def clear_faults(self) -> None:
        """End all faults that can end."""
        self.robot.clear_faults()

    def plug_in(self) -> None:
        """Plug in again every serial port that has vanished; `encoder_urls` and `board_urls` may change."""
        self.wires.plug_in()
        self._name_ports([wire.path for wire in self.wires.serial])

    def _name_ports(self, paths: list[str]) -> None:
        self.encoder_urls = paths[: len(self.robot.encoder_boards)]
        self.board_urls = dict(zip(self.robot.bought.ports, paths[len(self.encoder_urls) :], strict=True))

    def close(self) -> None:
        """Close all links."""
        self.wires.close()

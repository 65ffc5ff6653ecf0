"""Mock arms with links: the Protocol of both rigs; the stepped one, in this process; and the one in real time, a process of its
own, reached by pty, UDP multicast and a Unix socket.

The stepped rig's clock is the simulation's: waiting on it advances plant, boards and camera, in ticks, to that
time. Bytes and frames go through pyserial and python-can, so the host's drivers are the real ones: over wires within the process,
or through the kernel, which costs time and changes no byte.
"""

from __future__ import annotations

import itertools
import json
import os
import select
import socket
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import msgspec

from control.model.arm import Arm
from control.model.description import load_arm
from firmware_iface.clock import Clock, MonotonicClock
from firmware_iface.installation import command
from firmware_iface.interrupts import held
from firmware_iface.link import Closing
from hil_mocks.errors import RigError
from hil_mocks.plant.plant import Point
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


_START_LIMIT_S = 300.0  # Python, MuJoCo and a busy machine; a process that ends is detected at once
_ANSWER_LIMIT_S = 15.0
_END_LIMIT_S = 5.0


class _Hand:
    """The operator's hand, over the socket."""

    def __init__(self, rig: RealTimeRig) -> None:
        self._rig = rig

    def seat(self, point_m: Sequence[float]) -> float:
        """Grip the tip, drag it to a point and hold it there; returns the duration in s."""
        return float(self._rig.ask("seat", point_m=[float(value) for value in point_m])["duration_s"])

    def let_go(self) -> None:
        """Leave the tip to the arm."""
        self._rig.ask("let_go")

    def residual_m(self) -> float:
        """Distance of the tip from the hand."""
        return float(self._rig.ask("hand")["residual_m"])

    @property
    def state(self) -> str:
        """away, dragging, holding or cannot reach."""
        return str(self._rig.ask("hand")["state"])


class MockProcess(Closing):
    """A mock in a process of its own, which ends with `close` or when this process dies."""

    def __init__(self, *options: str) -> None:
        with held():
            self._process = subprocess.Popen(
                command("hil_mocks.serve", *options),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env=os.environ | {"MUJOCO_GL": "disable"},  # else it starts a Python that looks for windows
            )
        try:
            announcement = self._announcement()
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self._socket.settimeout(_ANSWER_LIMIT_S)
            self._socket.connect(announcement["socket"])
        except BaseException:
            self._end_process()
            raise
        self._lines = self._socket.makefile("rb")
        self.clock: Clock = MonotonicClock()
        can = {key: announcement[key] for key in ("can_interface", "can_channel", "can_options")}
        self.ports = {name: ArmPorts(**own, **can) for name, own in announcement["arms"].items()}

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def status(self) -> dict[str, float]:
        """time_s of the simulation, overruns, lost_s and worst_late_s of its pacing."""
        return self.ask("status")

    def ask(self, do: str, **arguments: object) -> dict[str, Any]:
        """Send one request of `hil_mocks.serve` and return its answer. Raises RigError."""
        try:
            self._socket.sendall(json.dumps({"do": do, **arguments}).encode() + b"\n")
            line = self._lines.readline()
        except OSError as error:
            raise RigError(f'mock arm: no answer to "{do}": {error}.') from error
        if not line:
            raise RigError(f'mock arm: its process ended before it answered "{do}": {self._last_words()}')
        answer: dict[str, Any] = json.loads(line)
        if not answer.pop("ok"):
            raise RigError(str(answer["error"]))
        return answer

    def close_pipe(self) -> None:
        """Close its standard input, as when this process dies."""
        if self._process.stdin is not None:
            self._process.stdin.close()

    def wait_for_end(self, limit_s: float | None = _END_LIMIT_S) -> int:
        """Wait for the process to end; return its exit status. Waits indefinitely without a limit."""
        return self._process.wait(limit_s)

    def close(self) -> None:
        """End its process and wait for it."""
        self._lines.close()
        self._socket.close()
        self._end_process()

    def _announcement(self) -> dict[str, Any]:
        out = self._process.stdout
        if out is None or not select.select([out], [], [], _START_LIMIT_S)[0]:
            raise RigError(f"mock arm: its process did not start within {_START_LIMIT_S:g} s.")
        line = out.readline()
        if not line:
            raise RigError(f"mock arm: its process ended at once: {self._last_words()}")
        announcement: dict[str, Any] = json.loads(line)
        return announcement

    def _last_words(self) -> str:
        """What a process that has ended left on its standard error."""
        words = self._process.stderr.read().decode(errors="replace").strip() if self._process.stderr else ""
        return words or "no message"

    def _end_process(self) -> None:
        process = self._process
        self.close_pipe()
        try:
            process.wait(_END_LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        for pipe in (process.stdout, process.stderr):
            if pipe is not None:
                pipe.close()


class RealTimeCell(MockProcess):
    """Mock arms of a cell in one world; requests name the arm: `ask("truth", arm="left")`."""

    def __init__(self, cell: str | Path, scenario: str | Path = "ideal") -> None:
        super().__init__("--cell", str(cell), "--scenario", str(scenario))

    def joint_rad(self, arm: str) -> tuple[float, ...]:
        """True joint angles of an arm."""
        return tuple(self.ask("truth", arm=arm)["joint_rad"])


class RealTimeRig(MockProcess):
    """A mock arm in a separate process."""

    def __init__(self, arm: str | Path, scenario: str | Path = "ideal") -> None:
        super().__init__("--arm", str(arm), "--scenario", str(scenario))
        (ports,) = self.ports.values()
        self.encoder_urls, self.board_urls = ports.encoder_urls, ports.board_urls
        self.can_interface, self.can_channel = ports.can_interface, ports.can_channel
        self.can_options, self.camera_port = ports.can_options, ports.camera_port
        self.hand: MockHand = _Hand(self)

    def tip_m(self) -> Point:
        """True tip."""
        x, y, z = self.ask("truth")["tip_m"]
        return x, y, z

    def joint_rad(self) -> tuple[float, ...]:
        """True joint angles."""
        return tuple(self.ask("truth")["joint_rad"])

    def set_payload(self, mass_kg: float) -> None:
        """Set the point mass at the tip."""
        self.ask("payload", mass_kg=mass_kg)

    def set_tool(self, name: str) -> None:
        """Mount another of the arm's tools."""
        self.ask("tool", name=name)

    def set_object(self, width_m: float | None) -> None:
        """Put an object between the gripper's fingers, or remove it (None)."""
        self.ask("object", width_m=width_m)

    def gripper(self) -> tuple[float, float]:
        """True opening [m] of the gripper, and its force on the object [N]."""
        answer = self.ask("gripper")
        return float(answer["opening_m"]), float(answer["force_N"])

    def set_pin(self, name: str, level: bool) -> None:
        """Put a level on an input from outside."""
        self.ask("pin", name=name, level=level)

    def pins(self) -> dict[str, bool]:
        """Levels at all named pins."""
        levels: dict[str, bool] = self.ask("pins")["levels"]
        return levels

    def inject(self, fault: FaultTable) -> None:
        """Inject a fault."""
        self.ask("inject", fault=msgspec.to_builtins(fault))

    def clear_faults(self) -> None:
        """End all faults that can end."""
        self.ask("clear_faults")

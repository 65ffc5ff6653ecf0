"""The mock arm in real time: a separate process, reached by pty, UDP multicast and a Unix socket."""

from __future__ import annotations

import json
import os
import select
import socket
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from firmware_iface.clock import Clock, MonotonicClock
from firmware_iface.installation import command
from firmware_iface.interrupts import held
from firmware_iface.link import Closing
from hil_mocks.errors import RigError
from hil_mocks.plant.hand import Point
from hil_mocks.rig import ArmPorts, MockHand
from hil_mocks.scenario import FaultTable

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

"""The mock arm in real time: a process of its own, reached by pty, UDP multicast and a Unix socket."""

from __future__ import annotations

import json
import select
import socket
import subprocess
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

from firmware_iface.clock import Clock, MonotonicClock
from firmware_iface.installation import command
from hil_mocks.errors import RigError
from hil_mocks.plant.hand import Point
from hil_mocks.rig import MockArm, MockHand, SteppedRig
from hil_mocks.scenario import FaultTable

_START_LIMIT_S = 60.0  # Python, MuJoCo and a busy machine; a process that ends is noticed at once
_ANSWER_LIMIT_S = 15.0
_END_LIMIT_S = 5.0


class _Hand:
    """The human at the arm, over the socket."""

    def __init__(self, rig: RealTimeRig) -> None:
        self._rig = rig

    def seat(self, point_m: Sequence[float]) -> float:
        """Take the tip, drag it to a point and hold it there; returns how long that takes, in s."""
        return float(self._rig.ask("seat", point_m=[float(value) for value in point_m])["duration_s"])

    def let_go(self) -> None:
        """Leave the tip to the arm."""
        self._rig.ask("let_go")

    def residual_m(self) -> float:
        """Distance of the tip from where the hand is."""
        return float(self._rig.ask("hand")["residual_m"])

    @property
    def state(self) -> str:
        """away, dragging, holding or cannot reach."""
        return str(self._rig.ask("hand")["state"])


class RealTimeRig:
    """A mock arm in a process of its own. Ends with `close`, and by itself when this process dies."""

    def __init__(self, arm: str | Path, scenario: str | Path = "ideal") -> None:
        self._process = subprocess.Popen(
            command("hil_mocks.serve", "--arm", str(arm), "--scenario", str(scenario)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        try:
            said = self._announcement()
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self._socket.settimeout(_ANSWER_LIMIT_S)
            self._socket.connect(said["socket"])
        except BaseException:
            self._end_process()
            raise
        self._lines = self._socket.makefile("rb")
        self.clock: Clock = MonotonicClock()
        self.encoder_urls: list[str] = said["encoder_urls"]
        self.can_interface: str = said["can_interface"]
        self.can_channel: str = said["can_channel"]
        self.can_options: dict[str, int] = said["can_options"]
        self.camera_port: int = said["camera_port"]
        self.hand: MockHand = _Hand(self)

    @property
    def pid(self) -> int:
        """Number of its process."""
        return self._process.pid

    @property
    def encoder_url(self) -> str:
        """Path of the (first) encoder board's port."""
        return self.encoder_urls[0]

    def tip_m(self) -> Point:
        """True tip."""
        x, y, z = self.ask("truth")["tip_m"]
        return x, y, z

    def joint_rad(self) -> tuple[float, ...]:
        """True joint angles."""
        return tuple(self.ask("truth")["joint_rad"])

    def set_payload(self, mass_kg: float) -> None:
        """Hang a point mass at the tip."""
        self.ask("payload", mass_kg=mass_kg)

    def inject(self, fault: FaultTable) -> None:
        """A fault from now on."""
        self.ask("inject", fault=msgspec.to_builtins(fault))

    def clear_faults(self) -> None:
        """End all faults that can end."""
        self.ask("clear_faults")

    def status(self) -> dict[str, float]:
        """time_s of the simulation, overruns, lost_s and worst_late_s of its pacing."""
        return self.ask("status")

    def ask(self, do: str, **arguments: object) -> dict[str, Any]:
        """One request of docs/mock_robot.md and its answer. Raises RigError."""
        try:
            self._socket.sendall(json.dumps({"do": do, **arguments}).encode() + b"\n")
            line = self._lines.readline()
        except OSError as error:
            raise RigError(f'mock arm: no answer to "{do}": {error}.') from error
        if not line:
            raise RigError(f'mock arm: its process ended before it answered "{do}".')
        answer: dict[str, Any] = json.loads(line)
        if not answer.pop("ok"):
            raise RigError(str(answer["error"]))
        return answer

    def close_pipe(self) -> None:
        """What the process sees when this one dies: its standard input ends."""
        if self._process.stdin is not None:
            self._process.stdin.close()

    def wait_for_end(self, limit_s: float | None = _END_LIMIT_S) -> int:
        """Exit status of the process once it has ended by itself; without a limit for as long as it takes."""
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
            said = self._process.stderr.read().decode(errors="replace") if self._process.stderr else ""
            raise RigError(f"mock arm: its process ended at once: {said.strip() or 'it said nothing'}")
        announcement: dict[str, Any] = json.loads(line)
        return announcement

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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_mock_arm(arm: str | Path, scenario: str | Path = "ideal", is_realtime: bool = False) -> MockArm:
    """A mock arm by either clock; whoever opens it closes it."""
    return RealTimeRig(arm, scenario) if is_realtime else SteppedRig(arm, scenario)

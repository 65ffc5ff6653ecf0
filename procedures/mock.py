"""A mock arm with its runtime for any procedure: stepped in this process, or several arms of a cell.

In: an arm.toml, a cell.toml, a scenario. Out: a bench with clients, whose scenario is saved beside its
recordings, so that a recording goes on with the same arm.
"""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from calib.arm_problem.observations import rotation_of
from calib.errors import CalibrationError
from control.errors import ArmError
from control.files import write_whole
from control.hardware.connect import CellConnection, Connection, connect, connect_cell
from control.kinematics.rotation import quaternion_of
from control.loop.runtime import Runtime
from control.model.arm import Arm, Camera, CanBus, EncoderBoardPort, Vector3
from control.model.can_bus import usual_rate_Hz
from control.model.cell import Cell, Placed
from control.model.description import arm_text, save_arm
from control.recording.record import FileSink, about_cell, about_columns, layout_of
from control.server.assemble import CellAssembly, assemble, assemble_cell
from control.server.channel import RuntimeGone, SocketChannel
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from firmware_iface.installation import command
from firmware_iface.interrupts import ends_with_parent, held
from hil_mocks.cell import SteppedCell
from hil_mocks.rig import MockHand, MockPorts, RealTimeRig, SimulatedArm, SteppedRig
from hil_mocks.scenario import Scenario
from procedures.folders import free_folder
from procedures.ports import move_together
from procedures.tour import Bench

# The mock's boards and the loop share this machine with other programs, and a virtual machine may stall either for some
# tenths of a second. Real boards are not stalled, so 20 ms of silence matter there; a mock arm is harmless.
SHARED_MACHINE_STALE_S = 0.3
SHARED_MACHINE_WATCHDOG_S = 0.5
SHARED_MACHINE_LAG_S = 0.5


def on_wires(arm: Arm, rig: MockPorts) -> Arm:
    """The arm on the mock's wires. Its limits stay: on the stepped clock no program keeps the boards waiting."""
    boards = dict(enumerate(arm.encoder_boards))
    return replace(
        arm,
        encoder_boards=tuple(
            replace(boards.get(i, EncoderBoardPort(f"enc{i}", url)), port=url) for i, url in enumerate(rig.encoder_urls)
        ),
        boards=tuple(replace(board, port=rig.board_urls.get(board.port, board.port)) for board in arm.boards),
        can=CanBus(rig.can_interface, rig.can_channel, options=rig.can_options),
    )


def wired_to(arm: Arm, rig: MockPorts) -> Arm:
    """The arm on the mock's wires and camera port, with longer timeouts for boards on a shared machine."""
    return replace(
        on_wires(arm, rig),
        camera=(arm.camera or Camera()).on_this_machine(rig.camera_port),
        limits=replace(
            arm.limits,
            stale_s=max(arm.limits.stale_s, SHARED_MACHINE_STALE_S),
            watchdog_s=max(arm.limits.watchdog_s, SHARED_MACHINE_WATCHDOG_S),
            following_error_per_speed_s=max(arm.limits.following_error_per_speed_s, SHARED_MACHINE_LAG_S),
        ),
    )


# A mock arm on the bench, and the runtime that is connected to it: stepped in this process, or in real time
# in others.


START_LIMIT_S = 300.0  # on a busy machine; a runtime that ends is detected at once


class MockBench(Protocol):
    """A mock arm and, after `start`, a runtime connected to it."""

    @property
    def rig(self) -> SimulatedArm: ...

    @property
    def speed(self) -> float:
        """Fraction of the joints' limits for joint moves."""
        ...

    def start(self, arm: Arm) -> ArmClient:
        """Start a runtime with the model `arm`; drives are off."""
        ...

    def wait(self, duration_s: float) -> None:
        """Let time pass."""
        ...

    def stop(self) -> Path:
        """Drives off, runtime ended; returns its recording."""
        ...

    def close(self) -> None:
        """End the mock arm."""
        ...


class SteppedBench:
    """A bench in this process; time passes only during waits, much faster than real time."""

    speed = 1.0

    def __init__(self, arm: Arm, scenario: Scenario | Path, log_folder: Path, through_kernel: bool = False) -> None:
        self.rig: SimulatedArm = SteppedRig(arm, scenario, through_kernel)
        self._log_folder = log_folder
        self._period_s = 1.0 / arm.usual_rate_Hz
        self._connection: Connection | None = None
        self._channel: InProcessChannel | None = None
        self._sink: FileSink | None = None
        self._client: ArmClient | None = None
        self._recordings: list[Path] = []

    def start(self, arm: Arm) -> ArmClient:
        """Connect and make a runtime in this process."""
        self._connection = connect(wired_to(arm, self.rig), self.rig.clock, self._period_s, self.rig.camera_port)
        self._log_folder.mkdir(parents=True, exist_ok=True)
        path = self._log_folder / f"run-{len(self._recordings) + 1}.armlog"
        header = layout_of(arm).header(
            {"arm": arm.name, "arm_toml": arm_text(arm), "period_s": self._period_s, **about_columns(arm)}
        )
        self._sink = FileSink(path, header)
        assembly = assemble(
            arm,
            self._connection.hardware,
            self._period_s,
            self._connection.camera,
            self._sink,
            self.rig.clock.now_s,
            {"recording": str(path)},
        )
        self._recordings.append(path)
        self._channel = InProcessChannel(assembly, self.rig.clock)
        self._client = ArmClient(self._channel)
        self._client.wait(0.05)
        return self._client

    def wait(self, duration_s: float) -> None:
        """Run cycles for `duration_s`."""
        if self._channel is not None:
            self._channel.wait(duration_s)

    def stop(self) -> Path:
        """Drives off, links closed."""
        if self._client is None or self._connection is None or self._sink is None:
            raise ArmError("the bench has no runtime to stop")
        self._client.off(quit_runtime=True)
        self._disconnect()
        return self._recordings[-1]

    def _disconnect(self) -> None:
        if self._connection is not None and self._sink is not None:
            self._connection.close()
            self._sink.close()
        self._connection = self._sink = None

    def close(self) -> None:
        """End the runtime, if it still runs, and the mock arm."""
        self._disconnect()
        self.rig.close()


class RealTimeBench:
    """The mock arm in one process and the runtime in another, as with a real arm.

    Joint moves are slower: a desktop sometimes pauses programs for a tenth of a second, and an arm that continues at
    its last voltage must not move far meanwhile.
    """

    speed = 0.4

    def __init__(self, arm: Path | str, scenario: Path, log_folder: Path) -> None:
        self.rig: SimulatedArm = RealTimeRig(arm, scenario)
        self._log_folder = log_folder
        self._folder = tempfile.TemporaryDirectory(prefix="armwright-demo-")
        self._runtime: subprocess.Popen[bytes] | None = None
        self._client: ArmClient | None = None
        self._recording = log_folder
        self._starts = 0

    def start(self, arm: Arm) -> ArmClient:
        """Start `armwright serve` and wait until it answers."""
        self._starts += 1
        arm_file = Path(self._folder.name) / f"arm-{self._starts}.toml"
        save_arm(wired_to(arm, self.rig), arm_file)
        line = command("console.main", "serve", "--arm", str(arm_file), "--socket", str(self.socket_path))
        with held():
            self._runtime = subprocess.Popen(
                [*line, "--log", str(self._log_folder)],
                stdout=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C goes to the demo, which then ends the runtime
                preexec_fn=ends_with_parent(signal.SIGTERM),  # noqa: PLW1509  it makes system calls only, so threads do no harm
            )
        self._client = ArmClient(self._connected())
        self._recording = Path(self._client.status()["recording"])
        return self._client

    @property
    def socket_path(self) -> Path:
        """Socket path of the last runtime started."""
        return Path(self._folder.name) / f"{self._starts}.sock"

    @property
    def runtime_pid(self) -> int:
        """Process id of the runtime. ArmError if none runs."""
        if self._runtime is None:
            raise ArmError("the bench has no runtime")
        return self._runtime.pid

    def _connected(self) -> SocketChannel:
        deadline_s = time.monotonic() + START_LIMIT_S
        while True:
            with contextlib.suppress(RuntimeGone):
                return SocketChannel(self.socket_path)
            if self._runtime is not None and self._runtime.poll() is not None:
                raise ArmError(f"the runtime ended at once with status {self._runtime.returncode}; its message is above")
            if time.monotonic() > deadline_s:
                raise ArmError(f"the runtime did not open its socket within {START_LIMIT_S:g} s")
            time.sleep(0.05)

    def wait(self, duration_s: float) -> None:
        """Wait on the host's clock."""
        time.sleep(duration_s)

    def stop(self) -> Path:
        """Drives off, the runtime's process ended."""
        if self._client is None or self._runtime is None:
            raise ArmError("the bench has no runtime to stop")
        self._client.off(quit_runtime=True)
        self._runtime.wait(START_LIMIT_S)
        return self._recording

    def close(self) -> None:
        """End the runtime, if it still runs, and the mock arm."""
        if self._runtime is not None and self._runtime.poll() is None:
            self._runtime.terminate()
            try:
                self._runtime.wait(START_LIMIT_S)
            except subprocess.TimeoutExpired:
                self._runtime.kill()
                self._runtime.wait()
        self.rig.close()
        self._folder.cleanup()


Wired = Callable[[Arm, MockPorts], Arm]
SHIFT_m, TURN_rad = 0.004, 0.007  # a base that was placed by tape measure, against its file


class CellBench:
    """A bench with several arms; `standing` is where their bases truly stand. Time passes only during waits."""

    def __init__(self, standing: Cell, scenario: Scenario, log_folder: Path, wired: Wired = wired_to) -> None:
        """`wired`: an arm with the mock's ports, and with the limits that the drives are to have."""
        self.period_s = 1.0 / usual_rate_Hz([placed.arm for placed in standing.arms])
        self.standing, self._log_folder, self._wired = standing, log_folder, wired
        self.rig = SteppedCell(standing, scenario)
        self.clients: Mapping[str, ArmClient] = {}
        self._connection: CellConnection | None = None
        self.channels: list[InProcessChannel] = []
        self.runtimes: Mapping[str, Runtime] = {}
        self._sinks: list[FileSink] = []
        self._starts = 0

    def start(self, cell: Cell) -> Mapping[str, ArmClient]:
        """Connect a runtime that knows `cell`; a client for each arm. Drives are off."""
        self._starts += 1
        wired = cell.with_arms([self._wired(placed.arm, self.rig.ports[placed.name]) for placed in cell.arms])
        ports = {name: one.camera_port for name, one in self.rig.ports.items()}
        self._connection = connect_cell(wired, self.rig.clock, self.period_s, ports)
        self.runtimes = (assembly := self._assembled(wired, self._connection)).runtime.runtimes
        self.channels = []
        for number, name in enumerate(cell.names, 1):
            loop = self.channels[0].loop if self.channels else None
            self.channels.append(InProcessChannel(assembly, self.rig.clock, loop, number, name))
        self.clients = {name: ArmClient(channel) for name, channel in zip(cell.names, self.channels, strict=True)}
        self.wait(0.05)
        return self.clients

    def home(self, cell: Cell) -> None:
        """Start a runtime that knows `cell`, and home one arm after the other."""
        for client in self.start(cell).values():
            client.enable()
        for client in self.clients.values():
            client.home()

    def _assembled(self, cell: Cell, connection: CellConnection) -> CellAssembly:
        self.recording.mkdir(parents=True)
        of_arms = {}
        for placed in cell.arms:
            arm, path = placed.arm, self.recording / f"{placed.name}.armlog"
            about = {"arm": arm.name, "arm_toml": arm_text(arm), "period_s": self.period_s}
            header = layout_of(arm).header({**about, **about_cell(cell, arm.name), **about_columns(arm)})
            self._sinks.append(FileSink(path, header))
            opened = connection.of_arms[arm.name]
            of_arms[arm.name] = assemble(
                arm, opened.hardware, self.period_s, opened.camera, self._sinks[-1], self.rig.clock.now_s
            )
        return assemble_cell(cell, of_arms)

    @property
    def recording(self) -> Path:
        """The folder of the last runtime's recordings."""
        return self._log_folder / f"{self.standing.name}-{self._starts}"

    def wait(self, duration_s: float) -> None:
        """Run cycles for `duration_s`."""
        self.channels[0].wait(duration_s)

    def together(self, poses_rad: Mapping[str, Sequence[float]], speed: float = 1.0) -> None:
        """A joint move of several arms, which begin and end together; ArmError if it is refused."""
        moves = {name: {"q_rad": list(q_rad), "speed": speed} for name, q_rad in poses_rad.items()}
        move_together(self.clients, moves)

    def hand(self, name: str) -> MockHand:
        """The operator's hand at an arm's tip; its places are in the arm's base frame."""
        return self.rig.mock.robots[name].hand

    def tip_m(self, name: str) -> Vector3:
        """The true tip of an arm in the frame of the cell."""
        return self.standing.placed(name).in_cell(self.rig.mock.robots[name].tip_m())

    def stop(self) -> Path:
        """Drives off, links closed; the folder of the recordings."""
        if self._connection is None:
            raise ArmError("the bench has no runtime to stop")
        next(iter(self.clients.values())).off(quit_runtime=True)
        self._end()
        return self.recording

    def _end(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        for sink in self._sinks:
            sink.close()
        self._sinks = []

    def close(self) -> None:
        """End the runtime and the mock."""
        self._end()
        self.rig.close()


def as_bolted_down(cell: Cell, seed: int) -> Cell:
    """The cell as it truly stands: every base but the first some millimetres and tenths of a degree off (seeded)."""
    draw = np.random.default_rng(seed)
    moved = [cell.arms[0]]
    for placed in cell.arms[1:]:
        x, y, z = (np.array(placed.origin_m) + draw.normal(0.0, SHIFT_m, 3)).tolist()
        rows = rotation_of(draw.normal(0.0, TURN_rad, 3)) @ np.array(placed.rotation)
        moved.append(Placed(placed.arm, (x, y, z), quaternion_of(rows.tolist())))
    return dataclasses.replace(cell, arms=tuple(moved))


def seeded_scenario(name: str, seed: int | None, was_homed: bool) -> bytes:
    """The scenario with its seed as the text of a file, saved beside the results so that the run can be repeated.

    If the arm's file has no homing parameters, the boards start with their zeros set (`was_homed`).
    """
    import msgspec

    from hil_mocks.scenario import load_scenario

    scenario = load_scenario(name)
    if seed is not None:
        scenario = msgspec.structs.replace(scenario, seed=seed)
    if was_homed:
        scenario = msgspec.structs.replace(scenario, start=msgspec.structs.replace(scenario.start, homed=True))
    return scenario_bytes(scenario)


def scenario_bytes(scenario: Scenario) -> bytes:
    """A scenario as the text of a file."""
    import msgspec

    document = msgspec.to_builtins(scenario)
    del document["path"]
    return msgspec.toml.encode(_without_none(document))


def _without_none(value: object) -> object:
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_without_none(item) for item in value]
    return value


# A mock arm in this process whose scenario is saved beside its recordings, so that a recording can be
# resumed.


@contextmanager
def saved_mock(arm: Arm, scenario: str, seed: int | None, out: Path, speed: float = 1.0) -> Iterator[Bench]:
    """The bench of a mock of `arm`, homed and holding. Shut down on exit.

    scenario.toml and the recordings in log are saved in `out`. CalibrationError if it holds another scenario.
    """
    drawn = seeded_scenario(scenario, seed, was_homed=not arm.can_home)
    out.mkdir(parents=True, exist_ok=True)
    file = out / "scenario.toml"
    if file.exists() and file.read_bytes() != drawn:
        raise CalibrationError(f"{file}: contains the records of another mock arm: choose another folder with --out")
    write_whole(file, drawn)
    log = free_folder(out / "log")
    mock = SteppedBench(arm, file, log)
    try:
        client = mock.start(arm)
        client.enable()
        client.home()
        yield Bench(client, next(log.glob("*.armlog")), mock.rig.set_payload, speed=speed)
        if arm.rest is not None:
            client.move_joints(arm.rest.q_rad, speed)
        mock.stop()
    finally:
        mock.close()

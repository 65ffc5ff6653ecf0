"""A mock arm on the bench, and the runtime that is connected to it: stepped in this process, or in real time in others."""

import contextlib
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Protocol

from control.errors import ArmError
from control.hardware.connect import Connection, connect
from control.model.arm import Arm
from control.model.description import arm_text, save_arm
from control.recording.layout import about_columns, layout_of
from control.recording.record import FileSink
from control.server.assemble import assemble
from control.server.channel import RuntimeGone, SocketChannel
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from firmware_iface.installation import command
from firmware_iface.interrupts import held
from hil_mocks.realtime import RealTimeRig
from hil_mocks.rig import MockArm, SteppedRig
from hil_mocks.scenario import Scenario
from procedures.child_process import ends_with_parent
from procedures.mock.arm import wired_to

START_LIMIT_S = 300.0  # on a busy machine; a runtime that ends is detected at once


class Bench(Protocol):
    """A mock arm and, after `start`, a runtime connected to it."""

    @property
    def rig(self) -> MockArm: ...

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

    def __init__(
        self, arm: Arm, scenario: Scenario | Path, log_folder: Path, through_kernel: bool = False
    ) -> None:
        self.rig: MockArm = SteppedRig(arm, scenario, through_kernel)
        self._log_folder = log_folder
        self._period_s = 1.0 / arm.usual_rate_Hz
        self._connection: Connection | None = None
        self._channel: InProcessChannel | None = None
        self._sink: FileSink | None = None
        self._client: ArmClient | None = None
        self._recordings: list[Path] = []

    def start(self, arm: Arm) -> ArmClient:
        """Connect and make a runtime in this process."""
        self._connection = connect(
            wired_to(arm, self.rig), self.rig.clock, self._period_s, self.rig.camera_port
        )
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
        while self._channel is not None and self._channel.is_running:
            self._channel.wait(self._period_s)
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
        self.rig: MockArm = RealTimeRig(arm, scenario)
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
                raise ArmError(
                    f"the runtime ended at once with status {self._runtime.returncode}; its message is above"
                )
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

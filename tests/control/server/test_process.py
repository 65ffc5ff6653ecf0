"""`armwright serve` as a process of its own, against the mock boards in real time: signals, killed processes, lost rows."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from control.model.arm import Arm
from control.model.description import save_arm
from control.recording.reading import Recording
from control.recording.recorder_state import has_part, next_part
from control.safety.modes import Mode
from control.server.channel import RuntimeGone, SocketChannel
from control.server.client import ArmClient, RequestRefused
from hil_mocks.rig import RealTimeRig
from procedures.mock import wired_to
from tests.cell import RIGHT
from tests.thirds import third_of

pytestmark = pytest.mark.realtime
LIMIT_s = 300.0  # of anything here; a busy machine is slow, a broken program never ends
SCENARIO = """
[start]
homed = true
[plant]
timestep_s = 0.001
[[effect]]
effect = "coulomb_friction"
joint = 1
parameters = { torque_Nm = 1.0 }
[[effect]]
effect = "coulomb_friction"
joint = 2
parameters = { torque_Nm = 2.5 }
[[effect]]
effect = "coulomb_friction"
joint = 3
parameters = { torque_Nm = 1.5 }
"""


@dataclass
class Served:
    """A mock arm and a runtime in processes of their own, and a client."""

    rig: RealTimeRig
    process: subprocess.Popen[str]
    client: ArmClient
    recording: Path
    arm_file: Path

    def until(self, is_so: Callable[[], bool]) -> None:
        end_s = time.monotonic() + LIMIT_s
        while not is_so():
            assert time.monotonic() < end_s, "not so within the limit"
            time.sleep(0.05)

    def begin_to_move(self) -> None:
        """Start a slow move that outlives its client, and wait until it moves."""
        enable(self.client)
        self.client.home()
        begun = self.rig.joint_rad()[0]
        to_rad = 1.0 if begun < 0.5 else 0.0
        self.client.ask("move_joints", q_rad=[to_rad, 0.15, 0.75], speed=0.1, detached=True)
        self.until(lambda: abs(self.rig.joint_rad()[0] - begun) > 0.02)

    def is_still(self) -> bool:
        """Whether no joint turns within 0.2 s of the mock arm's own time."""
        before, after_s = self.rig.joint_rad(), self.rig.status()["time_s"] + 0.2
        self.until(lambda: self.rig.status()["time_s"] >= after_s)
        return max(abs(a - b) for a, b in zip(before, self.rig.joint_rad(), strict=True)) < 2e-3


def enable(client: ArmClient) -> None:
    """Drives on; asked again where the machine paused for longer than a mock board may take to answer."""
    end_s = time.monotonic() + LIMIT_s
    while True:
        try:
            client.enable()
            return
        except RequestRefused as refusal:
            if "no report" not in str(refusal) or time.monotonic() > end_s:
                raise


def patient(arm: Arm) -> Arm:
    """Limits that a machine which pauses for a fraction of a second does not reach."""
    return replace(arm, limits=replace(arm.limits, watchdog_s=1.0, stale_s=0.5, following_error_rad=0.2))


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with serving(tmp_path) as served:
        yield served


@contextmanager
def serving(tmp_path: Path) -> Iterator[Served]:
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(SCENARIO)
    with RealTimeRig("right", scenario) as rig:
        save_arm(patient(wired_to(RIGHT, rig)), tmp_path / "arm.toml")
        path = tmp_path / "arm.sock"
        process = started(
            [
                sys.executable,
                "-m",
                "console.main",
                "serve",
                "--arm",
                str(tmp_path / "arm.toml"),
                "--socket",
                str(path),
                "--log",
                str(tmp_path / "log"),
                "--rate",
                "250",
            ],
            path,
        )
        try:
            client = ArmClient(SocketChannel(path, LIMIT_s))
            yield Served(rig, process, client, Path(client.status()["recording"]), tmp_path / "arm.toml")
            client.close()
        finally:
            process.kill()
            process.communicate()


def started(command: list[str], path: Path) -> subprocess.Popen[str]:
    """The runtime, serving; again when the machine paused for so long that a mock board could not answer in time."""
    said = []
    for _ in range(4):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
        end_s = time.monotonic() + LIMIT_s
        while time.monotonic() < end_s and process.poll() is None:
            if path.is_socket():
                return process
            time.sleep(0.05)
        process.kill()
        said.append(process.communicate())
    pytest.fail(f"no runtime: {said}")


def rows_of(recording: Path) -> list[dict[str, float]]:
    opened = Recording.open(recording)
    return [dict(zip(opened.layout.names, row, strict=True)) for row in opened.rows()]


def test_ctrl_c_while_moving_stops_lowers_and_ends_with_status_0(served: Served) -> None:
    served.begin_to_move()
    os.killpg(served.process.pid, signal.SIGINT)  # as a terminal does: the writer hears it too
    out, error = served.process.communicate(timeout=LIMIT_s)
    assert (served.process.returncode, error) == (0, "")
    assert "serving arm 'right'" in out
    assert served.is_still()
    modes = [Mode(list(Mode)[int(row["mode"])]) for row in rows_of(served.recording)]
    passed = [mode for k, mode in enumerate(modes) if k == 0 or modes[k - 1] is not mode]
    assert passed[-5:] == [Mode.MOVING, Mode.STOPPING, Mode.HOLDING, Mode.BRAKED, Mode.OFF]
    last = rows_of(served.recording)[-1]
    assert {int(last[f"statusword{j}"]) & 0x6F for j in (1, 2, 3)} == {0x40}  # SWITCH ON DISABLED
    with pytest.raises(RuntimeGone):
        served.client.status()


def test_a_loop_that_is_killed_leaves_an_arm_that_its_boards_brake_and_a_recording_up_to_then(served: Served) -> None:
    served.begin_to_move()
    asked = served.client.status()
    served.process.kill()
    served.process.wait(LIMIT_s)
    served.until(served.is_still)
    assert abs(served.rig.joint_rad()[0]) < 0.95  # it did not arrive
    served.until(lambda: any(row["t_s"] >= asked["t_s"] for row in rows_of(served.recording)[-1:]))  # first it may be empty
    rows = rows_of(served.recording)
    assert [row["cycle"] for row in rows] == list(range(int(rows[0]["cycle"]), int(rows[0]["cycle"]) + len(rows)))


def children_of(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def writers_of(served: Served) -> tuple[int, int]:
    """The supervisor of the writer, and the writer."""
    (supervisor,) = (
        child
        for child in children_of(served.process.pid)
        if b"control.recording.writer" in Path(f"/proc/{child}/cmdline").read_bytes()
    )
    served.until(lambda: bool(children_of(supervisor)))
    return supervisor, children_of(supervisor)[0]


def test_a_killed_writer_is_replaced_by_one_that_continues_in_a_new_file(served: Served) -> None:
    served.begin_to_move()
    served.until(lambda: Recording.open(served.recording).row_count > 0)
    _, writer = writers_of(served)
    os.kill(writer, signal.SIGKILL)
    second = next_part(served.recording)
    served.until(lambda: has_part(second) and Recording.open(second).row_count > 100)
    assert served.client.status()["recorder"]["file"] == str(second)
    assert served.client.status()["lost_rows"] == 0
    served.client.off(quit_runtime=True)
    _, error = served.process.communicate(timeout=LIMIT_s)
    assert served.process.returncode == 0
    assert "the writer was killed (signal 9); recording continues in" in error
    before, after = rows_of(served.recording), rows_of(second)
    assert 0 < after[0]["cycle"] - before[-1]["cycle"] < 200  # at most a chunk that the first one had read
    assert [row["cycle"] for row in after] == [after[0]["cycle"] + k for k in range(len(after))]


def test_without_its_writer_the_loop_goes_on_and_says_that_rows_are_lost(served: Served) -> None:
    served.begin_to_move()
    for pid in writers_of(served):  # the supervisor first, which would replace the writer
        os.kill(pid, signal.SIGKILL)
    served.until(lambda: served.client.status()["lost_rows"] > 10)
    status = served.client.status()
    assert status["mode"] in ("MOVING", "STOPPING", "HOLDING")
    assert any("not recorded" in warning for warning in status["warnings"])
    served.until(lambda: served.client.status()["mode"] == "HOLDING")  # nothing moves unrecorded
    assert served.client.status()["was_stopped"]
    served.client.off(quit_runtime=True)
    assert served.process.wait(LIMIT_s) == 0


def test_a_second_serve_of_the_same_arm_is_refused_and_the_first_one_does_not_notice(served: Served, tmp_path: Path) -> None:
    enable(served.client)
    arguments = [
        "serve",
        "--arm",
        str(tmp_path / "arm.toml"),
        "--socket",
        str(tmp_path / "arm.sock"),
        "--log",
        str(tmp_path / "two"),
    ]
    second = subprocess.run(
        [sys.executable, "-m", "console.main", *arguments], capture_output=True, text=True, check=False, timeout=LIMIT_s
    )
    assert second.returncode == 2
    assert second.stderr.startswith("armwright: a runtime already serves at")
    assert second.stderr.count("\n") == 1
    assert not (tmp_path / "two").exists()
    assert served.client.status()["mode"] == "HOLDING"


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """One for all who must not disturb it."""
    with serving(tmp_path_factory.mktemp("undisturbed")) as served:
        yield served


@pytest.mark.parametrize(
    "command",
    third_of(
        [
            ("check",),
            ("doctor", "--seconds", "0.1"),
            ("serve", "--socket", "another.sock", "--log", "another"),
            ("bringup", "--out", "wired.toml", "--yes"),
            ("tune", "--out", "tuned.toml", "--yes"),
        ]
    ),
    ids=lambda command: str(command[0]),
)
def test_a_command_that_would_open_the_boards_of_a_moving_arm_names_who_has_them_and_the_arm_moves_on(
    undisturbed: Served, tmp_path: Path, command: tuple[str, ...]
) -> None:
    served = undisturbed
    served.client.stop()
    served.until(lambda: served.client.status()["mode"] != "STOPPING")
    served.begin_to_move()
    arguments = [sys.executable, "-m", "console.main", *command, "--arm", str(served.arm_file)]
    path = os.pathsep.join(sys.path)
    other = subprocess.run(
        arguments,
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT_s,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert other.returncode == (1 if command[0] == "doctor" else 2), other.stderr
    said = f"in use by process {served.process.pid} "
    assert said in other.stdout + other.stderr
    assert "serve --arm" in other.stdout + other.stderr
    status = served.client.status()
    assert status["mode"] in ("MOVING", "HOLDING")
    assert (status["was_stopped"], status["faults"]) == (False, [])

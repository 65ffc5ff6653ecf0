"""`armwright console` in a terminal, over a runtime and a mock arm in processes of their own: keys, and what a kill does."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from control.server.client import ArmClient
from procedures.mock import RealTimeBench
from tests.cell import RIGHT
from tests.control.server.test_process import enable, patient

pytestmark = pytest.mark.realtime
LIMIT_s = 300.0  # a busy machine is slow, a broken program never ends
RIGHT_ARROW = b"\x1b[C"
REPEAT_s = 0.03
SLOWLY = 0.02  # of the joints' speed: the move outlasts a console that a busy machine keeps waiting
SCENARIO = """
[start]
homed = true
q_rad = [0.1, -0.6, 0.2]
[plant]
timestep_s = 0.001
[[effect]]
effect = "coulomb_friction"
joint = 1
parameters = { torque_Nm = 1.0 }
[[effect]]
effect = "coulomb_friction"
joint = 2
parameters = { torque_Nm = 6.5 }  # it stays where it is when the drives go off
[[effect]]
effect = "coulomb_friction"
joint = 3
parameters = { torque_Nm = 2.5 }
"""


class Terminal:
    """A console in a pseudo-terminal of 80 by 24 characters."""

    def __init__(self, socket: str, folder: Path) -> None:
        self.screen, terminal = pty.openpty()
        fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        command = [sys.executable, "-m", "console.main", "console", "--socket", socket, "--keep", str(folder / "kept.txt")]
        self.process = subprocess.Popen(
            command,
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
            env={**os.environ, "TERM": "xterm-256color"},
            start_new_session=True,
        )
        os.close(terminal)
        self.drawn = b""

    def read(self, duration_s: float) -> None:
        """What it draws meanwhile."""
        end_s = time.monotonic() + duration_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            if not select.select([self.screen], [], [], left_s)[0]:
                return
            try:
                self.drawn += os.read(self.screen, 1 << 16)
            except OSError:  # nobody is at the other end any more
                time.sleep(min(left_s, REPEAT_s))

    def until(self, is_so: Callable[[], bool]) -> None:
        end_s = time.monotonic() + LIMIT_s
        while not is_so():
            assert time.monotonic() < end_s, self.drawn[-2000:]
            self.read(0.05)

    def hold(self, key: bytes, until: Callable[[], bool]) -> None:
        """Repeats of a key until something is so."""
        end_s = time.monotonic() + LIMIT_s
        while not until():
            assert time.monotonic() < end_s, "the key had no effect"
            os.write(self.screen, key)
            self.read(REPEAT_s)


def mode(client: ArmClient) -> str:
    return str(client.ask("mode")["mode"])


def test_keys_jog_a_real_time_arm_space_stops_it_and_a_killed_console_leaves_it_held(tmp_path: Path) -> None:
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(SCENARIO)
    bench = RealTimeBench("right", scenario, tmp_path / "log")
    terminal: Terminal | None = None
    client = bench.start(patient(RIGHT))
    try:
        enable(client)
        terminal = Terminal(str(bench.socket_path), tmp_path)
        terminal.until(lambda: b"HOLDING" in terminal.drawn)
        start_rad = client.status()["q_rad"][0]
        terminal.hold(RIGHT_ARROW, lambda: client.status()["q_rad"][0] > start_rad + 0.03)
        terminal.until(lambda: mode(client) == "HOLDING")  # nobody repeats the key any more

        client.move_joints((1.2, -0.2, 0.9), SLOWLY, waits=False)
        terminal.until(lambda: b"MOVING" in terminal.drawn)
        os.write(terminal.screen, b" ")
        terminal.until(lambda: mode(client) == "HOLDING")
        assert client.status()["was_stopped"], client.status()

        before = len(terminal.drawn)
        terminal.hold(RIGHT_ARROW, lambda: b" JOGGING " in terminal.drawn[before:])
        # when the head shows it, the console has heard that the arm rests: spaces are letters again
        terminal.until(lambda: b" HOLDING " in terminal.drawn[terminal.drawn.rindex(b" JOGGING ") :])
        os.write(terminal.screen, f":move --joints 1.0 -0.9 0.2 --speed {SLOWLY}\r".encode())
        terminal.until(lambda: mode(client) == "MOVING")  # by a process of the console's
        os.kill(terminal.process.pid, signal.SIGKILL)
        terminal.process.wait()
        terminal.until(lambda: mode(client) == "HOLDING")
        status = client.status()
        assert status["was_stopped"], status
        assert status["faults"] == []
    finally:
        if terminal is not None and terminal.process.poll() is None:
            terminal.process.kill()
            terminal.process.wait()
        client.close()
        bench.close()

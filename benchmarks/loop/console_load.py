"""Load of the console on the loop: lateness with and without it, alternating, and its share of a processor.

`armwright serve` on a mock arm in real time, holding; `armwright console` in a pseudo-terminal of 120 by 40 characters, whose
output is read and discarded. Alternating, because a machine's own load changes over minutes: each phase without
the console is paired with one with it. Lateness is taken from the recording.
"""

import fcntl
import os
import pty
import select
import struct
import subprocess
import sys
import tempfile
import termios
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.loop.realtime import cycles_of, runtime
from benchmarks.table import BenchRow
from control.errors import ArmError
from control.server.client import ArmClient

RATE_Hz = 500
TURNS, PHASE_S = 5, 10.0
SETTLE_S = 3.0  # a console that starts imports for a while
COLUMNS, ROWS = 120, 40
LATER_MOST, SHARE_MOST = 1.2, 0.15


def rows() -> list[BenchRow]:
    """Return the measured rows."""
    try:
        return _rows()
    except ArmError as error:  # a long pause of this machine stopped the arm
        return [BenchRow("console: ended early", float("nan"), "", str(error).replace("\n", " "), passed=False)]


def _rows() -> list[BenchRow]:
    spans: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    shares: list[float] = []
    with tempfile.TemporaryDirectory() as name, runtime(Path(name), RATE_Hz) as client:
        client.enable()
        for _ in range(TURNS):
            spans[False].append(_phase(client))
            with_console, share = _phase_with_console(client, Path(name))
            spans[True].append(with_console)
            shares.append(share)
        status = client.status()
        client.off(quit_runtime=True)
        cycles = cycles_of(Path(status["recording"]))
    without_us, with_us = (_p99_us(cycles, spans[is_open]) for is_open in (False, True))
    rights = "SCHED_FIFO" if status["rights"] == "granted" else "without real-time rights"
    ratio = with_us / without_us
    return [
        BenchRow(f"lateness p99 at {RATE_Hz} Hz, holding, no console, {rights}", without_us, "us"),
        BenchRow(
            "lateness p99 with the console open",
            with_us,
            "us",
            "without it",
            without_us,
            ratio,
            f"at most {LATER_MOST}",
            ratio <= LATER_MOST,
        ),
        BenchRow(
            f"console: processor time, {COLUMNS} x {ROWS}, status at 20 Hz",
            100.0 * float(np.median(shares)),
            "%",
            "of one processor",
            target=f"at most {100 * SHARE_MOST:.0f}",
            passed=float(np.median(shares)) <= SHARE_MOST,
        ),
    ]


def _phase(client: ArmClient) -> tuple[float, float]:
    """Hold for some seconds; return start and end on the loop's clock."""
    begun_s = client.status()["t_s"]
    time.sleep(PHASE_S)
    return begun_s, client.status()["t_s"]


def _phase_with_console(client: ArmClient, folder: Path) -> tuple[tuple[float, float], float]:
    """Hold with the console open; also return its share of a processor."""
    screen, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
    command = [
        sys.executable,
        "-m",
        "console.main",
        "console",
        "--arm",
        str(folder / "arm.toml"),
        "--socket",
        str(folder / "bench.sock"),
    ]
    environment = {**os.environ, "TERM": "xterm-256color"}
    console = subprocess.Popen(command, stdin=terminal, stdout=terminal, stderr=terminal, env=environment, start_new_session=True)
    os.close(terminal)
    try:
        _read_for(screen, SETTLE_S, console)
        begun_s, used_s, wall_s = client.status()["t_s"], _processor_s(console.pid), time.monotonic()
        _read_for(screen, PHASE_S, console)
        share = (_processor_s(console.pid) - used_s) / (time.monotonic() - wall_s)
        return (begun_s, client.status()["t_s"]), share
    finally:
        console.terminate()
        console.wait()
        os.close(screen)


def _read_for(screen: int, duration_s: float, console: "subprocess.Popen[bytes]") -> None:
    """Read the console's output like a terminal. ArmError if it has ended."""
    end_s = time.monotonic() + duration_s
    while (left_s := end_s - time.monotonic()) > 0.0:
        if select.select([screen], [], [], left_s)[0]:
            os.read(screen, 1 << 16)
        if console.poll() is not None:
            raise ArmError(f"the console ended with status {console.returncode}")


def _processor_s(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _p99_us(cycles: NDArray[np.float64], spans: list[tuple[float, float]]) -> float:
    """Median over the phases of each phase's 99th percentile: one pause of the host spoils one phase."""
    time_s, _, late_s, _ = cycles
    parts = [late_s[(time_s >= start) & (time_s <= end)] for start, end in spans]
    return 1e6 * float(np.median([np.percentile(part, 99.0) for part in parts]))

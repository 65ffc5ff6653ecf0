"""The loop in its own process against the wall clock, over the mock boards in theirs: missed cycles, lateness, age of counts.

`armwright serve --rate` over a pty and CAN frames in UDP multicast, holding for 20 s and then around the circle for as long.
Both are taken from the recording: the delay of each cycle's start after its deadline, its wait for the report included.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.loop.jobs import circle_path, go_to_start, reference_arm
from benchmarks.table import BenchRow, compared
from control.errors import ArmError
from control.model.description import save_arm
from control.recording.reading import Recording
from control.recording.record import Layout
from control.server.channel import RuntimeGone, SocketChannel
from control.server.client import ArmClient
from hil_mocks.rig import RealTimeRig
from procedures.mock import wired_to

APPROACH_SPEED = 0.3  # so that an arm does not move far at its last voltage if the host pauses
RATES_Hz = (1000, 500)
HOLDING_S = 20.0
TURNS = 5  # of 3.8 s
START_LIMIT_S = 20.0
SCENARIO = 'name = "bench"\n[start]\nhomed = true\n'  # noise, but no friction; zeros known
AGE_ASKED_us = 300.0  # at 500 Hz
PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}


def rows() -> Iterator[BenchRow]:
    """Yield the rows as they are measured."""
    for rate_Hz in RATES_Hz:
        yield from _rows_or_reason(rate_Hz)


def _rows_or_reason(rate_Hz: int) -> list[BenchRow]:
    """The rows of a rate; or one row with the reason if a long pause of this machine stopped the arm."""
    try:
        return _rows_at(rate_Hz)
    except ArmError as error:
        reason = str(error).replace("\n", " ")
        return [BenchRow(f"real time, {rate_Hz} Hz: ended early", float("nan"), "", reason, passed=False)]


def _rows_at(rate_Hz: int) -> list[BenchRow]:
    arm = reference_arm()
    path = circle_path(arm, TURNS)
    spans: dict[str, tuple[float, float]] = {}

    def timed(client: ArmClient, name: str, work: Callable[[], None]) -> None:
        start_s = client.status()["t_s"]
        work()
        spans[name] = start_s, client.status()["t_s"]

    with tempfile.TemporaryDirectory() as folder, runtime(Path(folder), rate_Hz) as client:
        go_to_start(client, path, APPROACH_SPEED)
        timed(client, "holding", lambda: time.sleep(HOLDING_S))
        timed(client, "circle", lambda: client.run_path(path.to_message()))
        status = client.status()
        client.off(quit_runtime=True)
        cycles, row_bytes = cycles_of(Path(status["recording"])), row_bytes_of(Path(status["recording"]))
    packed_bytes = Layout.of(arm.joint_count).packing.size
    recorded = compared(
        f"real time, {rate_Hz} Hz: recorded an hour",
        3.6e-3 * rate_Hz * row_bytes,
        "MB",
        "packed rows",
        3.6e-3 * rate_Hz * packed_bytes,
        "a fifth",
        0.2,
    )
    class_ = "SCHED_FIFO" if status["rights"] == "granted" else "without real-time rights"
    timely = [
        row
        for name, span in spans.items()
        for row in _rows_of(f"real time, {rate_Hz} Hz, {name}", 1.0 / rate_Hz, cycles, span, class_)
    ]
    return [*timely, recorded]


def _rows_of(name: str, period_s: float, cycles: NDArray[np.float64], span: tuple[float, float], remark: str) -> list[BenchRow]:
    time_s, missed, late_s, age_s = cycles
    chosen = (time_s >= span[0]) & (time_s <= span[1])
    lost = float(missed[chosen][-1] - missed[chosen][0])
    due = int(chosen.sum() + lost)
    period_us = 1e6 * period_s
    late_us, age_us = (
        {what: 1e6 * float(np.nanpercentile(values[chosen], part)) for what, part in PERCENTILES.items()}
        for values in (late_s, age_s)
    )
    return [
        BenchRow(f"{name}: missed cycles", lost, "cycles", f"of those due, {remark}", due, lost / due),
        *(
            BenchRow(f"{name}: lateness {what}", value, "us", "the period", period_us, value / period_us)
            for what, value in late_us.items()
        ),
        *(
            BenchRow(f"{name}: age of counts {what}", value, "us", "asked", AGE_ASKED_us, value / AGE_ASKED_us)
            for what, value in age_us.items()
        ),
    ]


def cycles_of(recording: Path) -> NDArray[np.float64]:
    """Time, missed cycles so far, lateness and age of counts of every recorded cycle (4, cycles)."""
    opened = Recording.open(recording)
    wanted = [opened.layout.names.index(name) for name in ("t_s", "missed", "late_s", "age_s")]
    return np.array([[row[i] for i in wanted] for row in opened.rows()]).T


def row_bytes_of(recording: Path) -> float:
    """What a row takes in the file."""
    opened = Recording.open(recording)
    return (recording.stat().st_size - opened.offset) / opened.row_count


@contextmanager
def runtime(folder: Path, rate_Hz: float) -> Iterator[ArmClient]:
    """`armwright serve` on a mock arm in real time, both in processes of their own; a client of it."""
    scenario, arm_file, socket_path = folder / "bench.toml", folder / "arm.toml", folder / "bench.sock"
    scenario.write_text(SCENARIO, encoding="utf-8")
    with RealTimeRig("right", scenario) as rig:
        save_arm(wired_to(reference_arm(), rig), arm_file)
        command = [
            sys.executable,
            "-m",
            "console.main",
            "serve",
            "--arm",
            str(arm_file),
            "--socket",
            str(socket_path),
            "--log",
            str(folder),
            "--rate",
            str(rate_Hz),
        ]
        runtime = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
        try:
            with closing(ArmClient(_connected(socket_path, runtime))) as client:
                yield client
            runtime.wait(START_LIMIT_S)
        finally:
            if runtime.poll() is None:
                runtime.terminate()
                runtime.wait(START_LIMIT_S)


def _connected(socket_path: Path, runtime: "subprocess.Popen[bytes]") -> SocketChannel:
    deadline_s = time.monotonic() + START_LIMIT_S
    while True:
        try:
            return SocketChannel(socket_path)
        except RuntimeGone:
            if runtime.poll() is not None or time.monotonic() > deadline_s:
                raise ArmError("the runtime did not open its socket") from None
            time.sleep(0.05)

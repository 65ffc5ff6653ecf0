"""One whole control cycle without waiting: `Runtime.cycle` on the Cartesian circle, every DH parameter of the arm off nominal.

Only the call of `cycle` is timed: boards and clock run between the cycles. Once over links in memory whose boards
are a script (benchmarks.loop.memory_rig), once over a pty and a python-can bus with the mock boards behind them; both in turn.
"""

import gc
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from statistics import median, quantiles
from time import perf_counter_ns
from typing import ParamSpec, TypeVar

from benchmarks.loop.jobs import circle_path, go_to_start, known_geometry
from benchmarks.loop.kinematics import calibrated_arm, hand_inlined
from benchmarks.loop.memory_rig import Delivery, MemoryRig
from benchmarks.table import BenchRow, seconds_a_call
from control.hardware.connect import connect
from control.hardware.interface import Hardware
from control.loop.cell import Looped
from control.loop.runtime import Runtime
from control.model.arm import Arm
from control.recording.record import PipeSink
from control.server.assemble import assemble
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from control.server.scheduling import FIFO_PRIORITY
from firmware_iface.clock import Clock
from hil_mocks.rig import SteppedRig
from procedures.mock import wired_to

PERIOD_S = 0.002
ROUNDS = 7
MEMORY_RUNS = 3  # a round: short ones, so that some meet the machine undisturbed
TARGET_us = 100.0
PARTS = ("read", "watch", "advance", "drive", "record")
WHOLE = "whole"
HAND, HAND_CALLS = "a call of hand-inlined forward kinematics", 2000
Durations = dict[str, list[float]]  # microseconds of each cycle, of the whole or of each part
P = ParamSpec("P")
R = TypeVar("R")


class Stopwatch:
    """Times calls while it is on."""

    def __init__(self) -> None:
        self.took_us: Durations = {}
        self.is_on = False

    def timed(self, name: str, work: Callable[P, R]) -> Callable[P, R]:
        """Wrap `work` with timing."""
        took_us = self.took_us.setdefault(name, [])

        def run(*given: P.args, **named: P.kwargs) -> R:
            start = perf_counter_ns()
            result = work(*given, **named)
            if self.is_on:
                took_us.append(1e-3 * (perf_counter_ns() - start))
            return result

        return run

    def time_cycles(self, runtime: Looped, afterwards: Callable[[], None]) -> None:
        """Time every cycle of a runtime, but not the work after it."""
        timed = self.timed(WHOLE, runtime.cycle)

        def cycle(now_s: float, late_s: float, missed: int, missed_in_row: int) -> bool:
            is_running = timed(now_s, late_s, missed, missed_in_row)
            afterwards()
            return is_running

        setattr(runtime, "cycle", cycle)  # noqa: B010  (a method is no variable, says mypy)

    def time_parts(self, runtime: Runtime) -> None:
        """Time the parts of a cycle; timing a part costs about 0.3 us."""
        for name in (f"_{part}" for part in PARTS):
            setattr(runtime, name, self.timed(name[1:], getattr(runtime, name)))


class DrainedPipe:
    """The pipe to a writer, without the writer: drained between the cycles."""

    def __init__(self) -> None:
        self._out, into = os.pipe()
        self.sink = PipeSink(into)

    def drain(self) -> None:
        """Drain the pipe."""
        os.read(self._out, 1 << 16)

    def close(self) -> None:
        """Close both ends."""
        self.sink.close()
        os.close(self._out)


def rows() -> list[BenchRow]:
    """Return the measured rows."""
    arm = calibrated_arm()
    script = _recorded(arm)
    memory: list[Durations] = []
    wires: list[Durations] = []
    memory_parts: list[Durations] = []
    wire_parts: list[Durations] = []
    hand_us = math.inf
    for _ in range(ROUNDS):
        memory += [_over_memory(arm, script, False) for _ in range(MEMORY_RUNS)]
        wires.append(_over_wires(arm, False))
        memory_parts.append(_over_memory(arm, script, True))
        wire_parts.append(_over_wires(arm, True))
        hand_us = min(hand_us, _hand_inlined_us())
    return [
        *_rows_of("links in memory", memory, memory_parts, hand_us, f"at most {TARGET_us:g} us"),
        *_rows_of("pty and python-can", wires, wire_parts, hand_us, ""),
    ]


def _rows_of(where: str, whole: Sequence[Durations], parts: Sequence[Durations], hand_us: float, target: str) -> list[BenchRow]:
    """One wiring's rows; the unit of the ratios is a call of the hand-written kinematics, on the same machine."""

    def row(name: str, us: float, target: str = "", passed: bool | None = None) -> BenchRow:
        return BenchRow(name, us, "us", HAND, hand_us, us / hand_us, target, passed)

    p50_us = [median(durations[WHOLE]) for durations in whole]
    p99_us = [quantiles(durations[WHOLE], n=100)[98] for durations in whole]
    passed = min(p50_us) <= TARGET_us if target else None
    return [
        row(f"control cycle over {where}, p50, fastest run", min(p50_us), target, passed),
        row(f"control cycle over {where}, p50, median run", median(p50_us)),
        row(f"control cycle over {where}, p99, fastest run", min(p99_us)),
        *(row(f"  of it: {part}, p50", min(median(durations[part]) for durations in parts)) for part in PARTS),
    ]


def _hand_inlined_us() -> float:
    def work() -> None:
        for _ in range(HAND_CALLS):
            hand_inlined(0.3, -0.8, 0.2)

    return 1e6 * seconds_a_call(work, HAND_CALLS)


def _recorded(arm: Arm) -> Sequence[Delivery]:
    """Record the boards' output while the arm runs the circle."""
    rig = MemoryRig(arm, known_geometry(has_friction=True, seed=1), PERIOD_S)
    _run_circle(arm, rig.hardware, rig.clock, False)
    return rig.script


def _over_memory(arm: Arm, script: Sequence[Delivery], in_parts: bool) -> Durations:
    rig = MemoryRig(arm, known_geometry(has_friction=True, seed=1), PERIOD_S, script)
    return _run_circle(arm, rig.hardware, rig.clock, in_parts)


def _over_wires(arm: Arm, in_parts: bool) -> Durations:
    with SteppedRig(arm, known_geometry(has_friction=True, seed=1)) as rig:
        connection = connect(wired_to(arm, rig), rig.clock, PERIOD_S)
        took_us = _run_circle(arm, connection.hardware, rig.clock, in_parts)
        connection.close()
    return took_us


def _run_circle(arm: Arm, hardware: Hardware, clock: Clock, in_parts: bool) -> Durations:
    """Run the circle once; every cycle's duration, all of it with recording into a pipe."""
    pipe, stopwatch = DrainedPipe(), Stopwatch()
    assembly = assemble(arm, hardware, PERIOD_S, sink=pipe.sink)
    if in_parts:
        stopwatch.time_parts(assembly.runtime)
    stopwatch.time_cycles(assembly.runtime, pipe.drain)
    client = ArmClient(InProcessChannel(assembly, clock))
    client.wait(0.05)
    path = circle_path(arm)
    go_to_start(client, path)
    with as_the_loop_runs():
        stopwatch.is_on = True
        client.run_path(path.to_message())
        stopwatch.is_on = False
    pipe.close()
    return stopwatch.took_us


@contextmanager
def as_the_loop_runs() -> Iterator[None]:
    """Without garbage collection, and in a real-time class where that is allowed (control.server.scheduling); for a second."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
        yield
    finally:
        os.sched_setscheduler(0, *before)
        gc.enable()
        gc.unfreeze()

"""One control cycle by joints and kinds of boards, and of two arms in one loop: joint moves on the mock, within this process.

Only the call of `cycle` is timed, with all hidden errors off: physics, boards and wires run between the cycles. Encoders of the
light arms are absolute or were zeroed earlier.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from statistics import median, quantiles

import msgspec

from benchmarks.arms import RIGHT, SEVEN, SIX
from benchmarks.loop.control_cycle import PARTS, WHOLE, DrainedPipe, Durations, Stopwatch, as_the_loop_runs
from benchmarks.table import BenchRow
from control.hardware.connect import connect, connect_cell
from control.model.arm import Arm
from control.model.can_bus import usual_rate_Hz
from control.model.cell import Cell, load_cell
from control.server.assemble import assemble, assemble_cell
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from hil_mocks.cell import SteppedCell
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import Start, load_scenario
from procedures.mock import wired_to
from procedures.on_boards import on_boards

ROUNDS = 5
AWAY_rad, SPEED = (0.25, 0.3)  # of each joint from where it rests, and of the arm's full speed: some two seconds there and back


@dataclass(frozen=True, slots=True)
class Case:
    """An arm, or two in one loop of which one moves, and what half of the cycles may take."""

    name: str
    arms: Arm | Cell
    target_us: float | None = None


CASES = (
    Case("3 joints, reference boards", RIGHT, 70.0),
    Case("6 joints, reference boards", SIX, 120.0),
    Case("7 joints, reference boards", SEVEN, 140.0),
    Case("3 joints, CiA 402", on_boards(RIGHT, "cia402")),
    Case("3 joints, servos", on_boards(RIGHT, "dynamixel")),
    Case("2 arms of 3 joints, reference boards", load_cell("pair")),
)


def rows() -> Iterator[BenchRow]:
    """The rows of each case as it is measured: its fastest run of some, and the same of its parts."""
    for case in CASES:
        whole = [_timed(case.arms)[WHOLE] for _ in range(ROUNDS)]
        p50_us = min(median(took_us) for took_us in whole)
        p99_us = min(quantiles(took_us, n=100)[98] for took_us in whole)
        name, most_us = f"control cycle, {case.name}", case.target_us
        if most_us is None:
            yield BenchRow(f"{name}, p50", p50_us, "us")
        else:
            target = f"at most {most_us:g} us"
            yield BenchRow(f"{name}, p50", p50_us, "us", target=target, passed=p50_us <= most_us)
        yield BenchRow(f"{name}, p99", p99_us, "us", "its p50", p50_us, p99_us / p50_us)
        if isinstance(case.arms, Arm):
            parts = [_timed(case.arms, in_parts=True) for _ in range(ROUNDS)]
            for part in PARTS:
                yield BenchRow(f"  of it: {part}, p50", min(median(took_us[part]) for took_us in parts), "us")


def _timed(arms: Arm | Cell, in_parts: bool = False) -> Durations:
    """Microseconds of every cycle of two joint moves, there and back."""
    pipe, stopwatch = DrainedPipe(), Stopwatch()
    with ExitStack() as ending:
        ending.callback(pipe.close)
        if isinstance(arms, Cell):
            clients = _cell_clients(arms, pipe, stopwatch, ending)
        else:
            clients = [_client(arms, pipe, stopwatch, ending, in_parts)]
        for client in clients:
            client.enable()
        for client in clients:
            client.home()
        here = {client: list(client.status()["joint_rad"]) for client in clients}
        with as_the_loop_runs():
            stopwatch.is_on = True
            for client, q_rad in here.items():  # the others hold
                client.move_joints([q_rad[0] + AWAY_rad, *(q - 0.5 * AWAY_rad for q in q_rad[1:])], SPEED)
                client.move_joints(q_rad, SPEED)
            stopwatch.is_on = False
    return stopwatch.took_us


def _client(arm: Arm, pipe: DrainedPipe, stopwatch: Stopwatch, ending: ExitStack, in_parts: bool) -> ArmClient:
    period_s = 1.0 / arm.usual_rate_Hz
    start = Start(q_rad=None if arm.rest is None else arm.rest.q_rad, homed=True)
    rig = ending.enter_context(SteppedRig(arm, msgspec.structs.replace(load_scenario("ideal"), start=start)))
    connection = connect(wired_to(arm, rig), rig.clock, period_s)
    ending.callback(connection.close)
    assembly = assemble(arm, connection.hardware, period_s, sink=pipe.sink)
    if in_parts:
        stopwatch.time_parts(assembly.runtime)
    stopwatch.time_cycles(assembly.runtime, pipe.drain)
    client = ArmClient(InProcessChannel(assembly, rig.clock))
    client.wait(0.05)
    return client


def _cell_clients(cell: Cell, pipe: DrainedPipe, stopwatch: Stopwatch, ending: ExitStack) -> list[ArmClient]:
    """Both arms' rows go into one pipe, which nobody reads as a recording."""
    period_s = 1.0 / usual_rate_Hz([placed.arm for placed in cell.arms])
    rig = ending.enter_context(SteppedCell(cell))
    wired = cell.with_arms([wired_to(placed.arm, rig.ports[placed.name]) for placed in cell.arms])
    connection = connect_cell(wired, rig.clock, period_s, {name: at.camera_port for name, at in rig.ports.items()})
    ending.callback(connection.close)
    assembly = assemble_cell(
        wired,
        {
            placed.arm.name: assemble(placed.arm, connection.of_arms[placed.arm.name].hardware, period_s, sink=pipe.sink)
            for placed in wired.arms
        },
    )
    stopwatch.time_cycles(assembly.runtime, pipe.drain)
    channels = [InProcessChannel(assembly, rig.clock, None, 1, cell.names[0])]
    for number, name in enumerate(cell.names[1:], 2):
        channels.append(InProcessChannel(assembly, rig.clock, channels[0].loop, number, name))
    channels[0].wait(0.05)
    return [ArmClient(channel) for channel in channels]

"""Tip tracking on the Cartesian circle: the plant's true tip against that of the set-point by control's model.

Evaluated every cycle. The arm's geometry is that of arm.toml, so only tracking errors remain.
"""

from collections.abc import Iterator, Sequence
from statistics import median
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from benchmarks.loop.jobs import PidMode, circle_path, go_to_start, known_geometry, reference_arm
from benchmarks.table import BenchRow
from control.hardware.connect import connect
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.recording.record import Layout, NoSink, layout_of
from control.safety.modes import Mode
from control.server.assemble import assemble
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from hil_mocks.rig import SimulatedArm, SteppedRig
from procedures.mock import wired_to

PERIOD_S = 0.002
SEEDS = (12, 1, 2)  # the demo's first
TARGET_mm = {False: 0.5, True: 1.5}
MOVING = list(Mode).index(Mode.MOVING)
Points = NDArray[np.float64]


class TruthSink(NoSink):
    """A recording sink that saves the set-points of motions with the mock's true tip at the same time."""

    def __init__(self, rig: SimulatedArm, layout: Layout) -> None:
        self.q_set_rad: list[tuple[float, ...]] = []
        self.tip_m: list[tuple[float, ...]] = []
        self.run: list[float] = []
        self._rig, self._unpack = rig, layout.packing.unpack
        names = layout.names
        self._mode, self._run = names.index("mode"), names.index("run")
        self._q_set = [names.index(f"q{joint}_set_rad") for joint in range(1, layout.joint_count + 1)]

    def write(self, row: bytes) -> bool:
        """Store the row of the cycle that has just ended; no time has passed since its start."""
        values = self._unpack(row)
        if values[self._mode] == MOVING:
            self.run.append(values[self._run])
            self.q_set_rad.append(tuple(values[i] for i in self._q_set))
            self.tip_m.append(self._rig.tip_m())
        return True

    def close(self) -> None:
        """Nothing to close."""


def rows() -> Iterator[BenchRow]:
    """Yield the rows as they are measured."""
    for has_friction in (False, True):
        for mode in get_args(PidMode):
            runs = [tip_errors_m(reference_arm(mode), has_friction, seed) for seed in SEEDS]
            yield from _rows_of(mode, has_friction, runs)


def _rows_of(mode: str, has_friction: bool, runs: Sequence[Points]) -> list[BenchRow]:
    what = "friction and backlash" if has_friction else "no friction, no backlash"
    rms_mm = [1e3 * float(np.sqrt(np.mean(np.sum(error**2, axis=1)))) for error in runs]
    most_mm = [1e3 * float(np.linalg.norm(error, axis=1).max()) for error in runs]
    target_mm = TARGET_mm[has_friction]
    worst_mm, limit = max(rms_mm), f"at most {target_mm:g} mm"
    name = f"tip tracking, {what}, {mode} mode"
    return [
        BenchRow(
            f"{name}, RMS, worst of {len(runs)} seeds",
            worst_mm,
            "mm",
            "the limit",
            target_mm,
            worst_mm / target_mm,
            limit,
            worst_mm <= target_mm,
        ),
        BenchRow(f"{name}, RMS, median seed", median(rms_mm), "mm"),
        BenchRow(f"{name}, max", max(most_mm), "mm"),
    ]


def tip_errors_m(arm: Arm, has_friction: bool, seed: int) -> Points:
    """True minus set-point tip (cycles, 3) in m, once around the circle, in the base frame."""
    with SteppedRig(arm, known_geometry(has_friction, seed)) as rig:
        connection = connect(wired_to(arm, rig), rig.clock, PERIOD_S)
        sink = TruthSink(rig, layout_of(arm))
        assembly = assemble(arm, connection.hardware, PERIOD_S, sink=sink, stopwatch_s=rig.clock.now_s)
        client = ArmClient(InProcessChannel(assembly, rig.clock))
        client.wait(0.05)
        path = circle_path(arm)
        go_to_start(client, path)
        client.run_path(path.to_message())
        run = client.status()["run"]
        connection.close()
    chosen = np.array(sink.run) == run
    wanted_m = ForwardKinematics(arm).tips(np.array(sink.q_set_rad)[chosen])
    error_m: Points = np.array(sink.tip_m)[chosen] - wanted_m
    return error_m

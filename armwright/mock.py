"""A mock arm for testing programs: boards and physics are simulated, the control loop is the real one."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armwright.connection import RunningArm
from control.model.arm import Arm
from control.model.description import load_arm, save_arm
from control.server.client import ArmClient
from hil_mocks.rig import SimulatedArm as Rig
from procedures.mock import MockBench, RealTimeBench, SteppedBench

Array = NDArray[np.float64]


class MockArm(RunningArm):
    """A running mock arm, which also gives its true state."""

    def __init__(self, client: ArmClient, arm: Arm, rig: Rig) -> None:
        super().__init__(client, arm)
        self._rig = rig

    def true_tip_m(self) -> Array:
        """The true tip position (3,) [m] in the base frame."""
        return np.array(self._rig.tip_m(), dtype=np.float64)

    def true_joint_rad(self) -> Array:
        """The true joint angles (n,) [rad]."""
        return np.array(self._rig.joint_rad(), dtype=np.float64)

    def set_payload(self, mass_kg: float) -> None:
        """Attach a mass to the tip; 0 removes it."""
        self._rig.set_payload(mass_kg)

    def put_between_fingers(self, width_m: float | None) -> None:
        """Put an object of this width between the gripper's fingers; None removes it."""
        self._rig.set_object(width_m)

    def true_grip(self) -> tuple[float, float]:
        """The true opening [m] of the gripper, and its force on the object [N]."""
        return self._rig.gripper()

    def set_input(self, name: str, level: bool) -> None:
        """Put a level on a digital input from outside."""
        self._rig.set_pin(name, level)

    def mount(self, tool: str) -> None:
        """Mount another of the arm's tools; `tool()` tells the loop."""
        self._rig.set_tool(tool)


@contextmanager
def mock_arm(
    arm: Arm | str | Path = "right", scenario: str | Path = "ideal", *, realtime: bool = False, folder: str | Path | None = None
) -> Iterator[MockArm]:
    """Start a mock of `arm` with a control loop, connect, and end both afterwards. The drives are off at first.

    Args:
        arm: an Arm, the path of an arm.toml, or the name of a supplied arm.
        scenario: what the mock hides from the loop: "ideal", "demo", "paper", or a file (docs/mock_robot.md).
        realtime: False simulates in this process on a stepped clock, faster than real time; time passes only while a method
            waits. True starts boards and loop as separate processes, as with a real arm.
        folder: for the recordings; without it they are deleted at the end.

    Raises:
        ArmFileError, MockError: the arm's file or the scenario is not usable.
        LinkError: the mock boards did not come up.
    """
    described = arm if isinstance(arm, Arm) else load_arm(arm)
    with ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="armwright-mock-")))
        log = Path(folder).resolve() if folder is not None else work / "log"
        bench = _bench(described, Path(scenario), log, work, realtime)
        stack.callback(bench.close)
        running = MockArm(bench.start(described), described, bench.rig)
        stack.callback(running.close)
        stack.callback(bench.stop)
        yield running


def _bench(arm: Arm, scenario: Path, log: Path, work: Path, realtime: bool) -> MockBench:
    if not realtime:
        return SteppedBench(arm, scenario, log)
    file = work / "mock.toml"
    save_arm(arm, file)
    return RealTimeBench(file, scenario, log)

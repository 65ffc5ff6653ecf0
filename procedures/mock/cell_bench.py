"""A mock cell on the bench, stepped in this process, and the runtime that is connected to it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from calib.arm_problem.frames import rotation_of
from control.end_effector.bus_load import usual_rate_Hz
from control.errors import ArmError
from control.hardware.shared_bus import CellConnection, connect_cell
from control.kinematics.rotation import quaternion_of
from control.loop.runtime import Runtime
from control.model.arm import Arm, Vector3
from control.model.cell import Cell, Placed
from control.model.description import arm_text
from control.recording.layout import about_cell, about_columns, layout_of
from control.recording.record import FileSink
from control.server.assemble import CellAssembly, assemble, assemble_cell
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from hil_mocks.cell import SteppedCell
from hil_mocks.rig import MockHand, MockPorts
from hil_mocks.scenario import Scenario
from procedures.mock.arm import wired_to
from procedures.ports import move_together

Wired = Callable[[Arm, MockPorts], Arm]
SHIFT_m, TURN_rad = 0.004, 0.007  # a base that was placed by tape measure, against its file


class CellBench:
    """A bench with several arms; `standing` is where their bases truly stand. Time passes only during waits."""

    def __init__(self, standing: Cell, scenario: Scenario, log_folder: Path, wired: Wired = wired_to) -> None:
        """`wired`: an arm with the mock's ports, and with the limits that the drives are to have."""
        self.period_s = 1.0 / usual_rate_Hz(standing)
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
        self.clients = {
            name: ArmClient(channel) for name, channel in zip(cell.names, self.channels, strict=True)
        }
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
        while self.channels[0].is_running:
            self.wait(self.period_s)
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

"""The supplied pair of arms as mocks in one world on the stepped clock, with one runtime and a client for each arm."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from control.hardware.connect import connect_cell
from control.loop.runtime import Runtime
from control.model.cell import Cell, load_cell
from control.safety.modes import Mode
from control.server.assemble import CellAssembly, assemble, assemble_cell
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from hil_mocks.cell import SteppedCell
from hil_mocks.robot import MockRobot
from hil_mocks.scenario import FaultTable, Scenario
from tests.cell import FRICTION, scenario, wired_to

PERIOD_S = 0.004  # half as many cycles as one arm's tests take
PAIR = load_cell("pair")
APART = (0.0, 0.15, 0.75)  # upright: the arms are half a metre apart
FREE = (0.6, 0.1, 0.7)


@dataclass
class Pair:
    """A mock cell, the runtime that is connected to it, and clients by arm."""

    rig: SteppedCell
    assembly: CellAssembly
    channels: Mapping[str, InProcessChannel]
    clients: Mapping[str, ArmClient]

    def runtime(self, arm: str) -> Runtime:
        return self.assembly.runtime.runtimes[arm]

    def mode(self, arm: str) -> Mode:
        return self.runtime(arm).monitor.mode

    def faults(self, arm: str) -> list[tuple[str, str]]:
        """Code and place of each fault of an arm."""
        return [(fault.code, fault.where) for fault in self.runtime(arm).monitor.faults]

    def robot(self, arm: str) -> MockRobot:
        return self.rig.mock.robots[arm]

    def run(self, duration_s: float) -> None:
        next(iter(self.clients.values())).wait(duration_s)

    def until(self, is_so: Callable[[], bool], limit_s: float) -> None:
        """Run until something is so. AssertionError when it takes longer."""
        end_s = self.rig.clock.now_s() + limit_s
        while not is_so():
            self.run(PERIOD_S)
            assert self.rig.clock.now_s() <= end_s, {arm: (self.mode(arm), self.faults(arm)) for arm in self.clients}

    def inject(self, arm: str, kind: str, board: str, **keys: Any) -> None:
        self.robot(arm).inject(FaultTable(kind, board, **keys))

    def refusal(self, by: str, /, **request: Any) -> str:
        """The error of a request that is refused."""
        answer = self.channels[by].request(request)
        assert not answer["ok"], answer
        return str(answer["error"])

    def start_move(self, arm: str, *q_rad: float, speed: float = 1.0) -> float:
        """Start a joint move and come back at once; returns its duration."""
        return float(self.clients[arm].ask("move_joints", q_rad=q_rad, speed=speed)["duration_s"])


@contextmanager
def open_pair(hidden: Scenario | None = None, cell: Cell = PAIR, period_s: float = PERIOD_S) -> Iterator[Pair]:
    """Connect a runtime to mocks of a cell's arms; drives are off."""
    with SteppedCell(cell, hidden or scenario(APART, effect=FRICTION)) as rig:
        arms = [wired_to(placed.arm, rig.ports[placed.name]) for placed in cell.arms]
        wired = cell.with_arms(arms)
        ports = {name: one.camera_port for name, one in rig.ports.items()}
        connection = connect_cell(wired, rig.clock, period_s, ports)
        of_arms = {
            arm.name: assemble(arm, connection.of_arms[arm.name].hardware, period_s, stopwatch_s=rig.clock.now_s) for arm in arms
        }
        assembly = assemble_cell(wired, of_arms)
        channels: dict[str, InProcessChannel] = {}
        loop = None
        for number, name in enumerate(cell.names, 1):
            channels[name] = InProcessChannel(assembly, rig.clock, loop, number, name)
            loop = channels[name].loop
        pair = Pair(rig, assembly, channels, {name: ArmClient(channel) for name, channel in channels.items()})
        try:
            pair.run(10 * period_s)
            yield pair
        finally:
            connection.close()


@contextmanager
def holding_pair(hidden: Scenario | None = None, cell: Cell = PAIR) -> Iterator[Pair]:
    """The same, every arm HOLDING where it stands."""
    with open_pair(hidden, cell) as pair:
        for client in pair.clients.values():
            client.enable()
        yield pair

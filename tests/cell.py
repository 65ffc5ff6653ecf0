"""A mock arm on the stepped clock with a whole runtime connected to it: what tests of the loop and the console stand on."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from control.errors import ArmError
from control.hardware.connect import Connection, connect
from control.loop.runtime import Runtime
from control.model.arm import Arm
from control.model.description import load_arm
from control.model.end_effector import Gripper
from control.recording.record import RowSink
from control.safety.modes import Mode
from control.server.assemble import Assembly, assemble
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from control.server.messages import asked
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import EffectTable, FaultTable, Scenario, Start, load_scenario
from procedures.mock import on_wires as wired_to

PERIOD_S = 0.002
RIGHT = load_arm("right")
GRIPPER = Gripper(
    motor_node=4,
    travel_m=0.08,
    travel_per_turn_m=0.004,
    torque_constant_Nm_A=0.02,
    resistance_ohm=2.0,
    supply_V=24.0,
    current_limit_A=2.0,
    speed_limit_m_s=0.16,
    encoder_counts_per_rev=2048,
    rotor_inertia_kg_m2=4e-7,
)
STRETCHED = (0.1, -0.6, 0.2)  # gravity pulls joint 2 with 6 Nm here
FRICTION = tuple(
    EffectTable("coulomb_friction", joint, {"torque_Nm": torque}) for joint, torque in ((1, 1.0), (2, 1.2), (3, 0.7))
)


def scenario(q_rad: Sequence[float] | None = STRETCHED, homed: bool = True, base: str = "ideal", **changed: Any) -> Scenario:
    """A shipped scenario that starts at `q_rad`, its zero known unless told otherwise; one physics step a tick."""
    shipped = load_scenario(base)
    coarse = msgspec.structs.replace(shipped.plant, timestep_s=1e-3)
    start = Start(q_rad=tuple(q_rad) if q_rad else None, homed=homed)
    return msgspec.structs.replace(shipped, start=start, plant=coarse, **changed)


@dataclass
class Cell:
    """A rig, the runtime that is connected to it, and a client. `watchers` are called after every cycle."""

    rig: SteppedRig
    connection: Connection
    assembly: Assembly
    channel: InProcessChannel
    client: ArmClient
    watchers: list[Callable[[], None]] = field(default_factory=list)

    @property
    def runtime(self) -> Runtime:
        return self.assembly.runtime

    @property
    def mode(self) -> Mode:
        return self.runtime.monitor.mode

    @property
    def faults(self) -> list[tuple[str, str]]:
        """Code and place of each fault."""
        return [(fault.code, fault.where) for fault in self.runtime.monitor.faults]

    def run(self, duration_s: float) -> None:
        self.client.wait(duration_s)

    def until(self, is_so: Callable[[], bool], limit_s: float) -> float:
        """Run until something is so; returns how long it took. AssertionError when it takes longer."""
        begun_s = self.rig.clock.now_s()
        while not is_so():
            self.run(PERIOD_S)
            taken_s = self.rig.clock.now_s() - begun_s
            assert taken_s <= limit_s, f"still {self.mode} {self.faults} after {taken_s:.3f} s"
        return self.rig.clock.now_s() - begun_s

    def until_fault(self, limit_s: float) -> float:
        return self.until(lambda: self.mode is Mode.FAULT, limit_s)

    def torques(self) -> list[bool]:
        """Whether each motor is driven, as the plant has it: shorted and open windings are not."""
        return [kind in ("voltage", "current") and value != 0.0 for kind, value in self.rig.robot.outputs]

    def inject(self, kind: str, board: str, **keys: Any) -> None:
        self.rig.inject(FaultTable(kind, board, **keys))

    def refusal(self, **request: Any) -> str:
        """The error of a request that is refused."""
        answer = self.channel.request(request)
        assert not answer["ok"], answer
        return str(answer["error"])

    def start_move(self, q_rad: Sequence[float], speed: float = 1.0) -> float:
        """Start a joint move and come back at once; returns its duration."""
        return float(self.client.ask("move_joints", q_rad=list(q_rad), speed=speed)["duration_s"])

    def true_speeds(self) -> list[float]:
        """Grows while cycles run: the largest true joint speed of each cycle, in rad/s."""
        speeds: list[float] = []
        last = [self.rig.joint_rad(), self.rig.clock.now_s()]

        def watch() -> None:
            q_rad, now_s = self.rig.joint_rad(), self.rig.clock.now_s()
            if now_s > last[1]:
                steps = [abs(q - p) for q, p in zip(q_rad, last[0], strict=True)]
                speeds.append(max(steps) / (now_s - last[1]))
                last[:] = [q_rad, now_s]

        self.watchers.append(watch)
        return speeds


@contextmanager
def open_cell(
    hidden: Scenario | None = None,
    arm: Arm = RIGHT,
    sink: RowSink | None = None,
    believed: Arm | None = None,
    period_s: float = PERIOD_S,
) -> Iterator[Cell]:
    """Connect a runtime that believes in `believed` to a mock of `arm`; drives are off."""
    with SteppedRig(arm, hidden or scenario()) as rig:
        model = wired_to(believed or arm, rig)
        connection = connect(model, rig.clock, period_s, rig.camera_port)
        assembly = assemble(model, connection.hardware, period_s, connection.camera, sink, rig.clock.now_s)
        channel = InProcessChannel(assembly, rig.clock)
        cell = Cell(rig, connection, assembly, channel, ArmClient(channel))
        original = assembly.runtime.cycle

        def cycle(*timing: Any) -> bool:
            goes_on = original(*timing)
            for watcher in cell.watchers:
                watcher()
            return goes_on

        assembly.runtime.cycle = cycle  # type: ignore[method-assign]
        try:
            cell.run(10 * period_s)
            yield cell
        finally:
            connection.close()


@contextmanager
def restarted(cell: Cell, arm: Arm, period_s: float = PERIOD_S, away_s: float = 1.0) -> Iterator[Cell]:
    """The runtime of `cell` is killed; another one connects to the same boards after a while. `arm`: as of `open_cell`."""
    cell.connection.close()
    clock = cell.rig.clock
    clock.wait_until_s(clock.now_s() + away_s)
    model = wired_to(arm, cell.rig)
    connection = connect(model, clock, period_s, cell.rig.camera_port)
    try:
        assembly = assemble(model, connection.hardware, period_s, connection.camera, None, clock.now_s)
        channel = InProcessChannel(assembly, clock)
        yield Cell(cell.rig, connection, assembly, channel, ArmClient(channel))
    finally:
        connection.close()


@contextmanager
def holding_cell(hidden: Scenario | None = None, arm: Arm = RIGHT, **keys: Any) -> Iterator[Cell]:
    """The same, HOLDING where the arm stands."""
    with open_cell(hidden, arm, **keys) as cell:
        cell.client.enable()
        yield cell


def with_drives(arm: Arm, **changes: Any) -> Arm:
    """The arm with keys of every [[drive]] changed."""
    return replace(arm, drives=tuple(replace(drive, **changes) for drive in arm.drives))


def with_drive(arm: Arm, joint: int, **changes: Any) -> Arm:
    """The arm with keys of one [[drive]] changed; joint from 1."""
    drives = tuple(replace(d, **changes) if d.joint == joint else d for d in arm.drives)
    return replace(arm, drives=drives)


def run_numbers(rows: Sequence[dict[str, str]]) -> list[str]:
    """The runs of an exported log, in order."""
    return [run for run, _ in itertools.groupby(row["run"] for row in rows)]


def handled(cell: Cell, request: Mapping[str, Any], client: int = 0) -> dict[str, Any]:
    """The answer to a request of a client by its number, through the same bytes as over the socket."""
    try:
        request_ = asked(json.dumps(request).encode())
    except ArmError as error:
        return {"ok": False, "error": str(error)}
    return cell.assembly.requests.handle(request_, client)

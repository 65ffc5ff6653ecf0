"""The stage of a drill: a mock arm on the stepped clock with the whole runtime, and the true way of its tip.

What nobody asked for is measured against a twin: the same arm, scenario and motion without the fault.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise

import msgspec

from control.errors import ArmError
from control.hardware.connect import Connection, connect
from control.model.arm import Arm, CanBus
from control.model.description import load_arm
from control.model.end_effector import Gripper
from control.safety.table import Mode
from control.server.assemble import Assembly, assemble
from control.server.channel import Message
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from firmware_iface.errors import LinkError
from hil_mocks.plant.hand import Point
from hil_mocks.rig import MockPorts, SteppedRig
from hil_mocks.scenario import FaultTable, GripperTable, Scenario, Start, load_scenario

PERIOD_S = 0.002
FROM_rad, TO_rad = (-0.8, -0.6, 0.2), (0.8, -0.3, 0.6)
UNDER_WAY_S = 0.35  # of the motion when the fault comes: joint 1 is at full speed
SETTLED_S = 0.4  # at rest before the fault
SEARCHED_S = 0.6  # of homing when the fault comes: the first joint searches its switch
THINNED = 4  # cycles: 10 mm of way at full speed, whose chord is 0.03 mm off its arc
REST, MOVE, HOME, SESSION = "at rest", "in motion", "homing", "in a session"


GRIPPER = Gripper(
    motor_node=4, travel_m=0.08, travel_per_turn_m=0.004, torque_constant_Nm_A=0.02, resistance_ohm=2.0, supply_V=24.0,
    current_limit_A=2.0, speed_limit_m_s=0.16, encoder_counts_per_rev=2048, rotor_inertia_kg_m2=4e-7,
)  # fmt: skip
HELD_m = 0.03  # the width of what it holds


@dataclass(slots=True)
class Stage:
    """One arm, one runtime; `way` grows while time passes: (time [s], true tip [m]).

    It is the channel of its client: whenever the client waits, cycles run, and are noted. `each_cycle` is called after each
    of them; `undo` is what ends with the fault.
    """

    arm: Arm
    rig: SteppedRig
    connection: Connection
    assembly: Assembly
    channel: InProcessChannel
    way: list[tuple[float, Point]] = field(default_factory=list)
    each_cycle: list[Callable[[], None]] = field(default_factory=list)
    undo: ExitStack = field(default_factory=ExitStack)
    noticed_s: float | None = None
    found: tuple[str, ...] = ()
    message: str = ""

    @property
    def client(self) -> ArmClient:
        """A client of the runtime."""
        return ArmClient(self)

    def request(self, message: Message) -> Message:
        """Serve a request between two cycles."""
        return self.channel.request(message)

    def wait(self, duration_s: float) -> None:
        """Let time pass for a client."""
        self.run(duration_s)

    def close(self) -> None:
        """Disconnect the client."""
        self.channel.close()

    @property
    def now_s(self) -> float:
        """The simulation's time."""
        return self.rig.clock.now_s()

    @property
    def mode(self) -> Mode:
        """The arm's mode."""
        return self.assembly.runtime.monitor.mode

    def inject(self, kind: str, board: str, **keys: float) -> None:
        """Inject a fault of docs/mock_robot.md."""
        self.rig.inject(msgspec.convert({"kind": kind, "board": board, **keys}, FaultTable))

    def run(self, duration_s: float) -> None:
        """Run cycles, and note tip and faults after each."""
        end_s = self.now_s + duration_s
        while self.now_s < end_s - 1e-9:
            self.channel.wait(PERIOD_S)
            self._note()
            for happens in tuple(self.each_cycle):
                happens()

    def away(self, duration_s: float) -> None:
        """Let time pass without the loop: it is paused, or dead."""
        end_s = self.now_s + duration_s
        while self.now_s < end_s - 1e-9:
            self.rig.clock.wait_until_s(self.now_s + PERIOD_S)
            self.way.append((self.now_s, self.rig.tip_m()))

    def _note(self) -> None:
        self.way.append((self.now_s, self.rig.tip_m()))
        monitor = self.assembly.runtime.monitor
        if monitor.faults and self.noticed_s is None:
            self.noticed_s, self.message = self.now_s, str(monitor.faults[0])
        if monitor.faults:
            self.found = tuple(dict.fromkeys((*self.found, *(fault.code for fault in monitor.faults))))

    def begin(self, during: str) -> None:
        """Bring the arm to where the fault finds it."""
        self.client.enable()
        if self.assembly.runtime.parts.gripper is not None:
            self.client.grip("close")
        self.run(SETTLED_S)
        if during == MOVE:
            self.client.move_joints(TO_rad, waits=False)
            self.run(UNDER_WAY_S)
        elif during == HOME:
            self.client.ask("home", again=True)
            self.run(SEARCHED_S)

    def mend(self) -> None:
        """The cause is gone."""
        self.undo.close()
        self.each_cycle.clear()
        self.rig.clear_faults()

    def recover(self) -> str:
        """The cause is mended, the operator acknowledges and holds the arm; why that was refused, as text."""
        self.mend()
        self.run(0.2)
        refusal = ""
        try:
            if self.mode is Mode.FAULT:
                self.client.acknowledge()
            self.client.hold()
        except (ArmError, LinkError) as error:
            refusal = str(error)
        self.run(0.3)
        return refusal

    def restart(self) -> None:
        """The runtime is ended and started again; a port that had vanished is there again."""
        with suppress(LinkError):
            self.connection.close()
        self.rig.plug_in()
        self.connection, self.assembly = _started(self.arm, self.rig)
        self.channel = InProcessChannel(self.assembly, self.rig.clock)
        self.run(0.02)

    def grip_N(self) -> float:
        """True force on what the gripper holds; 0 without a gripper."""
        return self.rig.gripper()[1] if self.assembly.runtime.parts.gripper is not None else 0.0

    def wrong_rad(self) -> float:
        """By how much an arm that takes itself for homed is elsewhere than it says; 0 if it does not."""
        runtime = self.assembly.runtime
        if not runtime.monitor.is_homed or runtime.monitor.mode is Mode.FAULT:
            return 0.0
        measured = runtime.parts.measurement.q_rad
        return max(abs(true - said) for true, said in zip(self.rig.joint_rad(), measured, strict=True))


def drill_scenario() -> Scenario:
    """The demo's arm, homed, with its friction and play."""
    demo = load_scenario("demo")
    return msgspec.structs.replace(demo, start=Start(q_rad=FROM_rad, homed=True))


@contextmanager
def gripping_stage() -> Iterator[Stage]:
    """A stage whose arm has a gripper with an object between its fingers, which `begin` closes."""
    held = msgspec.structs.replace(drill_scenario(), gripper=GripperTable(object_m=HELD_m))
    with stage(replace(load_arm("right"), gripper=GRIPPER), held) as opened:
        yield opened


@contextmanager
def stage(arm: Arm | None = None, scenario: Scenario | None = None) -> Iterator[Stage]:
    """Open a stage; its drives are off. Limits are those of a real arm."""
    built = arm or load_arm("right")
    with SteppedRig(built, scenario or drill_scenario()) as rig:
        connection, assembly = _started(built, rig)
        opened = Stage(built, rig, connection, assembly, InProcessChannel(assembly, rig.clock))
        with opened.undo:
            try:
                opened.run(0.02)
                yield opened
            finally:
                with suppress(LinkError):
                    opened.connection.close()


def _started(arm: Arm, rig: SteppedRig) -> tuple[Connection, Assembly]:
    model = wired_as_real(arm, rig)
    period_s = 1.0 / arm.usual_rate_Hz
    connection = connect(model, rig.clock, period_s)
    return connection, assemble(model, connection.hardware, period_s, stopwatch_s=rig.clock.now_s)


def wired_as_real(arm: Arm, rig: MockPorts) -> Arm:
    """The arm on the rig's wires. Its limits stay: on the stepped clock no program keeps the boards waiting."""
    boards = tuple(
        replace(board, port=url) for board, url in zip(arm.encoder_boards, rig.encoder_urls, strict=True)
    )
    return replace(
        arm, encoder_boards=boards, can=CanBus(rig.can_interface, rig.can_channel, options=rig.can_options),
        boards=tuple(replace(board, port=rig.board_urls.get(board.port, board.port)) for board in arm.boards),
    )  # fmt: skip


@cache
def asked_way(during: str, duration_s: float) -> tuple[Point, ...]:
    """The true way of the twin's tip, from a little before the fault on."""
    with stage() as twin:
        twin.begin(during)
        twin.way = twin.way[-10:]
        twin.run(duration_s)
        return tuple(tip for _, tip in twin.way[::THINNED])


def off_way_m(tip: Point, way: Sequence[Point]) -> float:
    """Distance of a point from a polyline."""
    if len(way) == 1:
        return math.dist(tip, way[0])
    return min(_from_section_m(tip, start, end) for start, end in pairwise(way))


def _from_section_m(tip: Point, start: Point, end: Point) -> float:
    along = [b - a for a, b in zip(start, end, strict=True)]
    length2 = sum(value * value for value in along)
    if length2 == 0.0:
        return math.dist(tip, start)
    share = sum((p - a) * d for p, a, d in zip(tip, start, along, strict=True)) / length2
    share = min(max(share, 0.0), 1.0)
    return math.dist(tip, [a + share * d for a, d in zip(start, along, strict=True)])

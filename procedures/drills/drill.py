"""A drill: what is promised about a fault, the stage that it is played on, what came of it, and the table of outcomes.

The stage is a mock arm on the stepped clock with the whole runtime. A room of drills (`boards`, `pair`, `session`, `files`) gives
`Promise`s; `catalogue` lists them all.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise

import msgspec

from control.errors import ArmError
from control.hardware.connect import Connection, connect
from control.model.arm import Arm
from control.model.description import load_arm
from control.model.end_effector import Gripper
from control.safety.modes import Mode
from control.server.assemble import Assembly, assemble
from control.server.channel import Message
from control.server.client import ArmClient
from control.server.in_process import InProcessChannel
from firmware_iface.errors import LinkError
from hil_mocks.plant.plant import Point
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import FaultTable, GripperTable, Scenario, Start, load_scenario
from procedures.mock import on_wires

STANDS_m_s = 0.005
WRONG_rad = 0.003  # between an arm that takes itself for homed and its encoders: play and index error included
GOES_ON = frozenset[str]()


@dataclass(frozen=True, slots=True)
class Promise:
    """One fault: what is done, when, and what is promised about it."""

    name: str
    says: str
    during: str
    codes: frozenset[str]  # faults of which one is found; none: nothing is reported, and the arm goes on
    within_s: float = 0.3
    most_mm: float = 5.0  # off the asked path

    def run(self) -> "DrillOutcome":
        """Run it on a fresh mock arm."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class DrillOutcome:
    """What the arm did. Lengths in mm, times in s from the fault."""

    drill: Promise
    off_path_mm: float
    ran_on_mm: float
    noticed_s: float | None
    stood_s: float | None
    lost: str
    found: tuple[str, ...]
    message: str
    wrong_mrad: float
    wrong_after: str = ""  # what was wrong once the cause was mended

    @property
    def broken(self) -> tuple[str, ...]:
        """The promises that were not kept, as text."""
        drill, broken = self.drill, []
        if drill.codes and not drill.codes & set(self.found):
            broken.append(f"expected {' or '.join(sorted(drill.codes))}")
        if not drill.codes and self.found:
            broken.append("expected to go on")
        if drill.codes and self.noticed_s is not None and self.noticed_s > drill.within_s:
            broken.append(f"noticed after {drill.within_s * 1e3:.0f} ms")
        if self.off_path_mm > drill.most_mm:
            broken.append(f"more than {drill.most_mm:g} mm off its path")
        if self.wrong_mrad > WRONG_rad * 1e3:
            broken.append(f"{self.wrong_mrad:.0f} mrad wrong, and homed")
        if self.lost.endswith("records"):
            broken.append(f"{self.lost} lost")
        if self.wrong_after:
            broken.append(self.wrong_after)
        return tuple(broken)


def stood_s(way: Sequence[tuple[float, Point]], begun_s: float, looked: int) -> float | None:
    """When the tip had come to rest, by every `looked` place; None if it had not. A gear that settles in its play is at rest."""
    stood_s: float | None = None
    for (before_s, before), (now_s, now) in pairwise(way[::looked]):
        if math.dist(before, now) > STANDS_m_s * (now_s - before_s):
            stood_s = None
        elif stood_s is None:
            stood_s = before_s - begun_s
    return stood_s


def length_m(way: Sequence[tuple[float, Point]]) -> float:
    """The length of a way."""
    return sum(math.dist(a, b) for (_, a), (_, b) in pairwise(way))


# The stage of a drill: a mock arm on the stepped clock with the whole runtime, and the true way of its tip.
#
# What nobody asked for is measured against a twin: the same arm, scenario and motion without the fault.


PERIOD_S = 0.002
FROM_rad, TO_rad = (-0.8, -0.6, 0.2), (0.8, -0.3, 0.6)
UNDER_WAY_S = 0.35  # of the motion when the fault comes: joint 1 is at full speed
SETTLED_S = 0.4  # at rest before the fault
SEARCHED_S = 0.6  # of homing when the fault comes: the first joint searches its switch
THINNED = 4  # cycles: 10 mm of way at full speed, whose chord is 0.03 mm off its arc
REST, MOVE, HOME, SESSION = "at rest", "in motion", "homing", "in a session"


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
    model = on_wires(arm, rig)
    period_s = 1.0 / arm.usual_rate_Hz
    connection = connect(model, rig.clock, period_s)
    return connection, assemble(model, connection.hardware, period_s, stopwatch_s=rig.clock.now_s)


@cache
def asked_way(during: str) -> tuple[Point, ...]:
    """The true way of the twin's tip, from a little before the fault on."""
    with stage() as twin:
        twin.begin(during)
        twin.way = twin.way[-10:]
        twin.run(WATCHED_S)
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


WATCHED_S = 2.0  # after the fault
KEPT = 0.5  # of the grip's force: less holds no part
LOOKED = 10  # cycles between two looks at the speed of the tip


def _nothing(played: Stage) -> None:
    """No fault."""


def _as_it_is(arm: Arm) -> Arm:
    """No other arm."""
    return arm


@dataclass(frozen=True, slots=True)
class Drill(Promise):
    """A fault that is injected into a stage."""

    inject: Callable[[Stage], None] = field(default=_nothing)
    arm: Callable[[Arm], Arm] = field(default=_as_it_is)  # where the fault is built in
    is_refused: bool = False  # the arm must not be acknowledged into operation
    has_gripper: bool = False  # with an object in it

    def run(self) -> DrillOutcome:
        """Run it on a fresh arm, and let the arm recover."""
        with gripping_stage() if self.has_gripper else stage(self.arm(load_arm("right"))) as played:
            if self.arm is not _as_it_is:
                self._prepare(played)
            played.begin(self.during)
            begun_s, grip_N = played.now_s, played.grip_N()
            played.way = played.way[-1:]
            self.inject(played)
            played.run(max(0.0, begun_s + WATCHED_S - played.now_s))
            has_dropped = played.grip_N() < KEPT * grip_N
            way, noticed_s, codes, message = played.way.copy(), played.noticed_s, played.found, played.message
            refusal = played.recover()
            asked = asked_way(self.during)
            return DrillOutcome(
                self,
                max(off_way_m(tip, asked) for _, tip in (*way[::THINNED], way[-1])) * 1e3,
                length_m(way) * 1e3,
                None if noticed_s is None else noticed_s - begun_s,
                stood_s(way, begun_s, LOOKED),
                self._lost(played, codes, has_dropped),
                codes,
                message,
                played.wrong_rad() * 1e3,
                "" if bool(refusal) or not self.is_refused else "the other board was not refused",
            )

    def _prepare(self, played: Stage) -> None:
        """Home, and go to where every drill begins."""
        played.client.enable()
        played.client.home()
        played.client.move_joints(FROM_rad)

    def _lost(self, played: Stage, codes: tuple[str, ...], has_dropped: bool) -> str:
        lost = []
        if not played.assembly.runtime.monitor.is_homed:
            lost.append("the zero")
        elif self.during == MOVE and codes:
            lost.append("the motion")
        return ", ".join((*lost, *(["the grip"] if has_dropped else []))) or "nothing"


HEADER = ("drill", "during", "noticed", "stood", "off path", "ran on", "lost", "found")
WIDTHS = (26, 12, 9, 9, 9, 9, 11, 0)


def header() -> str:
    """The head of the table, with its units."""
    return f"{_line(HEADER)}\n{_line(('', '', '[ms]', '[ms]', '[mm]', '[mm]', '', ''))}"


def row(outcome: DrillOutcome) -> str:
    """One drill; a promise that was not kept follows in capitals."""
    promised = [code for code in outcome.found if code in outcome.drill.codes]
    reaction = next(iter((*promised, *outcome.found)), "goes on")
    if outcome.broken:
        reaction = f"{reaction}   BROKEN: {'; '.join(outcome.broken)}"
    return _line(
        (
            outcome.drill.name,
            outcome.drill.during,
            _ms(outcome.noticed_s),
            _ms(outcome.stood_s, f"> {WATCHED_S * 1e3:.0f}"),
            f"{outcome.off_path_mm:.1f}",
            f"{outcome.ran_on_mm:.0f}",
            outcome.lost,
            reaction,
        )
    )


def verdict(outcomes: Iterable[DrillOutcome]) -> str:
    """The last line of the table."""
    every = list(outcomes)
    broken = sum(bool(outcome.broken) for outcome in every)
    kept = f"{len(every)} drills, {len(every) - broken} as promised"
    return f"{kept}, {broken} not" if broken else kept


def in_words(outcome: DrillOutcome) -> str:
    """One drill for a reader."""
    drill = outcome.drill
    lines = [
        f"drill {drill.name}: {drill.says}, {drill.during}",
        f"  noticed     {_ms(outcome.noticed_s)} ms after the fault"
        if outcome.noticed_s is not None
        else "  noticed     nothing to report",
        "  stood       "
        + (f"not within {WATCHED_S:g} s" if outcome.stood_s is None else f"{_ms(outcome.stood_s)} ms after the fault"),
        f"  off path    {outcome.off_path_mm:.1f} mm at most, from the path that was asked for",
        f"  ran on      {outcome.ran_on_mm:.0f} mm since the fault",
        f"  lost        {outcome.lost}",
    ]
    if outcome.message:
        lines.append(f"  message     {outcome.message}")
    lines.append(f"  promise     {'kept' if not outcome.broken else 'NOT kept: ' + '; '.join(outcome.broken)}")
    return "\n".join(lines)


def _ms(value_s: float | None, none: str = "-") -> str:
    return none if value_s is None else f"{value_s * 1e3:.0f}"


def _line(cells: tuple[str, ...]) -> str:
    return " ".join(cell.ljust(width) for cell, width in zip(cells, WIDTHS, strict=True)).rstrip()


def listing(every: Iterable[Promise]) -> str:
    """The names of drills, with what each does."""
    return "\n".join(f"{drill.name.ljust(WIDTHS[0])} {drill.says}" for drill in every)

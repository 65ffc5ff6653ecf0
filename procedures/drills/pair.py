"""Drills of two arms on one runtime: what befalls one, or their client, while both move, and what both do."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path

import msgspec

from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model.cell import Cell, cell_of_one, load_cell
from control.model.description import load_arm
from control.safety.collision import ArmBody, least_gap, pairs_between
from control.safety.modes import Mode
from control.server.client import ArmClient
from firmware_iface.errors import LinkError
from hil_mocks.plant.plant import Point
from hil_mocks.scenario import FaultTable, Start, load_scenario
from procedures.drills import drill
from procedures.guiding import PERIOD_S as FOLLOWS_S
from procedures.guiding import Following
from procedures.mock import CellBench, on_wires

PAIR = "both move"  # the situation
FROM_rad, TO_rad = (0.0, -0.4, 0.4), (0.8, -0.3, 0.6)  # of both: they stay half a metre apart
ACROSS_rad = {"left": (-0.6, -0.8, 0.0), "right": (0.6, -0.8, 0.0)}  # both forearms in the middle
WATCHED_S = 1.0  # after the fault
CAUGHT_UP_S = 1.0
SLOWLY, RUNS_ON_m = 0.2, 0.03  # speed of a joint motion that one arm ends; what a stop from it takes at most
FOLLOWING_SPEED = 0.2  # of the leader, in its limits: jogs are slow
FOLDED_rad = (0.0, -0.4, -1.6)  # the forearm of `thick_arm` on its shoulder
INTO_SPEED = 0.2  # of the limits: a hand has the time to get into the way
JOG_rad_s = 0.5  # share of the way there a second
JOGGED_mm, JOGGED_S = 900.0, 3.0  # it is meant to move, and jogs are slow
FOLLOWS_m = 1e-3  # an arm follows its set-points, whose links may touch
TOUCHED_m = 0.02  # a third of the pair's clearance: stops on a path take room
Way = list[tuple[float, Point]]


@dataclass(slots=True)
class PairStage:
    """The supplied pair on the stepped clock; `ways` of the true tips grow while time passes."""

    bench: CellBench
    ways: dict[str, Way] = field(default_factory=dict)
    noticed_s: float | None = None
    found: dict[str, tuple[str, ...]] = field(default_factory=dict)
    message: str = ""
    each_cycle: list[Callable[[], None]] = field(default_factory=list)
    complaint: str = ""  # what the cause itself found wrong

    @property
    def now_s(self) -> float:
        """The simulation's time."""
        return self.bench.rig.clock.now_s()

    def run(self, duration_s: float) -> None:
        """Run cycles; note tips and faults after each."""
        end_s = self.now_s + duration_s
        while self.now_s < end_s - 1e-9:
            self.bench.wait(self.bench.period_s)
            for name, runtime in self.bench.runtimes.items():
                self.ways.setdefault(name, []).append((self.now_s, self.bench.tip_m(name)))
                if runtime.monitor.mode is Mode.FAULT and name not in self.found:
                    self.found[name] = tuple(fault.code for fault in runtime.monitor.faults)
                    self.noticed_s = self.noticed_s or self.now_s
                    self.message = self.message or f"arm {name!r}: {runtime.monitor.faults[0].message}"
            for happens in tuple(self.each_cycle):
                happens()

    def move_both(self, speed: float = 1.0, names: tuple[str, ...] = ("left", "right")) -> None:
        """Begin a motion, and go on until the fault comes."""
        moves = {name: {"q_rad": list(TO_rad), "speed": speed} for name in names}
        if len(names) == 1:
            self.bench.clients[names[0]].move_joints(TO_rad, speed, waits=False)
        else:
            self.bench.clients["left"].ask("move_together", moves=moves)
        self.run(drill.UNDER_WAY_S)

    def watch_gap(self) -> Callable[[], None]:
        """Complains when the arms, as they truly stand, come nearer than TOUCHED_m to each other."""
        cell = self.bench.standing
        bodies = tuple(ArmBody(placed, cell.tool_length_m) for placed in cell.arms)
        pairs = pairs_between(*bodies)

        def look() -> None:
            robots = self.bench.rig.mock.robots
            first, second = (body.at(robots[name].joint_rad()) for body, name in zip(bodies, cell.names, strict=True))
            gap_m = least_gap(first, second, pairs, TOUCHED_m).gap_m
            if gap_m < TOUCHED_m:
                self.complaint = self.complaint or f"the arms came within {1e3 * gap_m:.0f} mm"

        return look

    def wrong_rad(self) -> float:
        """By how much an arm that takes itself for homed is elsewhere than it says."""
        off = [0.0]
        for name, runtime in self.bench.runtimes.items():
            if runtime.monitor.is_homed and runtime.monitor.mode is not Mode.FAULT:
                true = self.bench.rig.mock.robots[name].joint_rad()
                off += [abs(a - b) for a, b in zip(true, runtime.parts.measurement.q_rad, strict=True)]
        return max(off)


def both_move(played: PairStage) -> None:
    """Both are under way."""
    played.move_both()


def both_move_slowly(played: PairStage) -> None:
    """Both are under way, and far from the end."""
    played.move_both(SLOWLY)


def right_in_the_middle(played: PairStage) -> None:
    """Both hold, the right arm across the table."""
    played.bench.clients["right"].move_joints(ACROSS_rad["right"], waits=True)
    played.run(drill.SETTLED_S)


def one_follows(played: PairStage) -> None:
    """A program moves the left arm, and the right one follows until its client is told that it is over."""
    clients = played.bench.clients
    placed = played.bench.standing.placed("right")
    following = Following(clients["left"], clients["right"], placed, (1.0,) * placed.arm.joint_count)
    next_s = [played.now_s]

    def step() -> None:
        if played.now_s >= next_s[0]:
            next_s[0] = played.now_s + FOLLOWS_S
            try:
                following.step()
            except ArmError:
                played.each_cycle.remove(step)

    played.each_cycle.append(step)
    played.move_both(FOLLOWING_SPEED, ("left",))
    played.run(CAUGHT_UP_S)


def fault_of(arm: str, kind: str, board: str) -> Callable[[PairStage], None]:
    """A fault of docs/mock_robot.md on a board of one arm."""

    def inject(played: PairStage) -> None:
        played.bench.rig.mock.robots[arm].inject(msgspec.convert({"kind": kind, "board": board}, FaultTable))

    return inject


def stop_pressed(played: PairStage) -> None:
    """By a client of the right arm."""
    played.bench.clients["right"].stop()


def ended_at_one(**request: object) -> Callable[[PairStage], None]:
    """Another client ends the motion at the right arm alone; the left one may not run on."""

    def inject(played: PairStage) -> None:
        if not (answer := played.bench.channels[1].request(request))["ok"]:
            played.complaint = f"refused: {answer['error']}"
        begun_m = played.bench.tip_m("left")

        def look() -> None:
            if (ran_m := math.dist(begun_m, played.bench.tip_m("left"))) > RUNS_ON_m:
                played.complaint = f"the left arm ran on by {1e3 * ran_m:.0f} mm"

        played.each_cycle.append(look)

    return inject


def client_gone(played: PairStage) -> None:
    """The client that began the motion of both."""
    played.bench.channels[0].close()


def refused_ways(played: PairStage) -> None:
    """Motions that would meet the other arm, alone and together."""
    alone = {"do": "move_joints", "q_rad": list(ACROSS_rad["left"])}
    moves = {name: {"q_rad": list(ACROSS_rad[name]), "speed": 1.0} for name in ACROSS_rad}
    for request in (alone, {"do": "move_together", "moves": moves}):
        if played.bench.channels[0].request(request)["ok"]:
            played.complaint = f"served: {request}"


def left_goes_to_the_middle(played: PairStage) -> None:
    """The left arm is under way to where the right one could reach it."""
    played.bench.clients["left"].move_joints(ACROSS_rad["left"], INTO_SPEED, waits=False)
    played.run(drill.UNDER_WAY_S)


def jogged_into(played: PairStage) -> None:
    """The left arm is jogged towards the right one, which holds in the middle, for as long as the drill is watched."""
    client = played.bench.clients["left"]
    speed = [JOG_rad_s * (to - at) for to, at in zip(ACROSS_rad["left"], FROM_rad, strict=True)]
    client.ask("jog", joint_speed_rad_s=speed)
    played.each_cycle += [lambda: renewed(client), played.watch_gap()]


def renewed(client: ArmClient) -> None:
    """Go on with a jog; refused once it has ended."""
    with suppress(ArmError):
        client.ask("jog_on")


def guided_into(played: PairStage) -> None:
    """A hand takes the right arm to the middle, and lets go when the runtime has stopped the left one."""
    placed, hand = played.bench.standing.placed("right"), played.bench.hand("right")
    played.bench.clients["right"].guide(True)
    hand.seat(ForwardKinematics(placed.arm).tip(*ACROSS_rad["right"]))

    def let_go() -> None:
        if played.found:
            hand.let_go()
            with suppress(ArmError):
                played.bench.clients["right"].hold()
            played.each_cycle.remove(let_go)

    played.each_cycle += [let_go, played.watch_gap()]


def one_holds(played: PairStage) -> None:
    """An arm that stands alone holds."""
    played.run(drill.SETTLED_S)


def folded(played: PairStage) -> None:
    """A move that would fold the arm onto itself, then a jog there."""
    channel, client = played.bench.channels[0], played.bench.clients["left"]
    if channel.request({"do": "move_joints", "q_rad": list(FOLDED_rad)})["ok"]:
        played.complaint = "a move through itself was served"
    client.ask("jog", joint_speed_rad_s=[JOG_rad_s * (to - at) for to, at in zip(FOLDED_rad, FROM_rad, strict=True)])
    body = ArmBody(played.bench.standing.arms[0], 0.0)

    def look() -> None:
        at = body.at(played.bench.rig.mock.robots["left"].joint_rad())
        if (gap_m := least_gap(at, at, body.own_pairs, 0.0).gap_m) < -FOLLOWS_m:
            played.complaint = played.complaint or f"two links are {-1e3 * gap_m:.0f} mm in each other"

    played.each_cycle += [lambda: renewed(client), look]


def thick_arm() -> Cell:
    """The left arm alone, its shoulder beside axis 1, with thick links and an elbow that folds further."""
    arm = load_arm("left")
    links = [replace(link, radius_m=0.06) for link in arm.links]
    links[0] = replace(links[0], L_m=0.15)
    drives = list(arm.drives)
    drives[2] = replace(drives[2], joint_lower_rad=-2.4)
    return cell_of_one(replace(arm, links=tuple(links), drives=tuple(drives)))


def the_pair() -> Cell:
    """The supplied pair."""
    return load_cell("pair")


AT_REST = (right_in_the_middle, one_holds)  # no motion is under way


@dataclass(frozen=True, slots=True)
class PairDrill(drill.Promise):
    """Off its path, and at rest, is an arm without a fault; one with a fault may brake, and sink."""

    begin: Callable[[PairStage], None] = both_move
    inject: Callable[[PairStage], None] = stop_pressed
    cell: Callable[[], Cell] = the_pair
    watched_s: float = WATCHED_S

    def run(self) -> drill.DrillOutcome:
        """Run it on a fresh pair."""
        with pair_stage(self.cell) as played:
            self.begin(played)
            begun_s = played.now_s
            played.ways = {name: way[-1:] for name, way in played.ways.items()}
            self.inject(played)
            played.run(self.watched_s)
            asked = asked_ways(self.begin, self.cell)
            sound = {name: way for name, way in played.ways.items() if name not in played.found}
            off_m = [
                max(drill.off_way_m(tip, asked[name]) for _, tip in (*way[:: drill.THINNED], way[-1]))
                for name, way in sound.items()
            ]
            stood = [drill.stood_s(way, begun_s, drill.LOOKED) for way in sound.values()]
            is_standing = all(rest_s is not None for rest_s in stood)
            runtimes = played.bench.runtimes.values()
            lost = [] if all(runtime.monitor.is_homed for runtime in runtimes) else ["the zero"]
            lost += ["the motion"] if self.begin not in AT_REST else []
            return drill.DrillOutcome(
                self,
                1e3 * max(off_m, default=0.0),
                1e3 * max((drill.length_m(way) for way in sound.values()), default=0.0),
                None if played.noticed_s is None else played.noticed_s - begun_s,
                max((rest_s for rest_s in stood if rest_s is not None), default=None) if is_standing else None,
                ", ".join(lost) or "nothing",
                tuple(code for codes in played.found.values() for code in codes),
                played.message,
                1e3 * played.wrong_rad(),
                played.complaint or ("" if is_standing else "an arm did not come to rest"),
            )

    @staticmethod
    def all() -> Iterator[PairDrill]:
        """Every drill of two arms."""
        goes_on = partial(PairDrill, codes=drill.GOES_ON, most_mm=2.0)
        jogged = partial(PairDrill, during=drill.REST, codes=drill.GOES_ON, most_mm=JOGGED_mm, watched_s=JOGGED_S)
        says, trips = "a motor board of the left arm trips", frozenset({"drive_fault"})
        yield PairDrill("over-temperature-pair", says, PAIR, trips, inject=fault_of("left", "over_temperature", "motor2"))
        yield goes_on("stop-pair", "stop pressed at the right arm", PAIR)
        yield goes_on("client-gone-pair", "the client of both dies", PAIR, inject=client_gone)
        says, revoked = "control of the right arm revoked by another client", ended_at_one(do="control", revoke=True)
        yield goes_on("revoke-pair", says, PAIR, begin=both_move_slowly, inject=revoked, watched_s=JOGGED_S)
        says = "moves that would meet the other arm"
        yield goes_on("meeting-pair", says, drill.REST, begin=right_in_the_middle, inject=refused_ways)
        yield jogged("itself-rest", "an arm moved, and jogged, onto itself", begin=one_holds, inject=folded, cell=thick_arm)
        yield jogged("jogged-into-pair", "an arm jogged towards the other", begin=right_in_the_middle, inject=jogged_into)
        says, meets = "a hand guides an arm into the way of the other", frozenset({"collision"})
        met = partial(jogged, during="one moves", codes=meets, within_s=JOGGED_S)
        yield met("guided-into-pair", says, begin=left_goes_to_the_middle, inject=guided_into)
        says, gone = "the left arm's encoder board unplugged, the right one follows it", frozenset({"encoder_stale", "link"})
        unplugged = fault_of("left", "silent", "encoder")
        yield PairDrill("leader-unplugged-pair", says, PAIR, gone, begin=one_follows, inject=unplugged)


@contextmanager
def pair_stage(cell: Callable[[], Cell]) -> Iterator[PairStage]:
    """A cell, homed and holding; its arms are those of the demo."""
    demo = load_scenario("demo")
    scenario = msgspec.structs.replace(demo, start=Start(q_rad=FROM_rad, homed=True))
    with tempfile.TemporaryDirectory(prefix="armwright-drill-") as folder:
        bench = CellBench(cell(), scenario, Path(folder), on_wires)
        try:
            for client in bench.start(bench.standing).values():
                client.enable()
            yield PairStage(bench)
        finally:
            with suppress(LinkError):
                bench.close()


@cache
def asked_ways(begin: Callable[[PairStage], None], cell: Callable[[], Cell]) -> dict[str, tuple[Point, ...]]:
    """The true ways of the twins' tips, from a little before the fault on."""
    with pair_stage(cell) as twin:
        begin(twin)
        twin.ways = {name: way[-10:] for name, way in twin.ways.items()}
        twin.run(WATCHED_S)
        return {name: tuple(tip for _, tip in way[:: drill.THINNED]) for name, way in twin.ways.items()}

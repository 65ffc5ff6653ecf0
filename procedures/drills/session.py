"""Drills inside a calibration session: a mock arm records points, the fault comes on its way or while it measures, and the
same session is resumed afterwards.

Every record is written to the disk before the session goes on; each that was reported is looked for at the end.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from calib.errors import CalibrationError
from calib.points.writer import Key, Record
from calib.session.conduct import Boards, Station, conduct
from calib.session.conversation import GO, Recorded
from calib.session.folder import SessionFolder
from calib.session.moves import ArmGeometry, ClearPaths
from calib.session.plan import SessionPlan, board_targets, fingerprint
from calib.session.residual_watch import ResidualWatch
from control.errors import ArmError
from control.safety.modes import Mode
from firmware_iface.errors import LinkError
from hil_mocks.plant.plant import Point
from procedures.drills import drill
from procedures.ports import HandPort, MockHandSeat, RuntimePort

POINTS = ("1", "5")
LOOKED = 10  # cycles between two looks at the speed of the tip
TRAVELS_S = 0.15  # into the way to the second point
SEATED_rad = 1e-3  # between two seatings of the tip in one cavity: noise of the hand, play of the gears


@dataclass(slots=True)
class DrilledSession:
    """What was said to be recorded, and when the fault came."""

    path: Path
    played: drill.Stage
    records: dict[Key, Record] = field(default_factory=dict)
    begun_s: float | None = None
    by_hand_s: set[float] = field(default_factory=set)

    def play(self) -> None:
        """Begin or resume, and go on until all points are recorded. ArmError, LinkError, CalibrationError end it."""
        played, arm = self.played, self.played.arm
        plan = SessionPlan(arm.name, fingerprint(arm), arm.joint_count, board_targets(["normal"], POINTS))
        with SessionFolder(self.path, plan) as folder:
            boards, geometry = Boards(arm, plan), ArmGeometry(arm)
            hand = MockHandSeat(HandPort(played.rig.hand, played.run), boards.reference_m)
            port = RuntimePort(played.client)
            watch, ways = ResidualWatch(arm), ClearPaths(arm, geometry)
            talk = conduct(folder, Station(port, geometry, boards, watch, hand, ways=ways))
            try:
                saying = next(talk)
                while folder.state.left():
                    if isinstance(saying, Recorded):
                        self.records[saying.record.key] = saying.record
                    saying = talk.send(GO)
                if isinstance(saying, Recorded):
                    self.records[saying.record.key] = saying.record
            finally:
                talk.close()

    def lost(self) -> int:
        """How many records were reported, and are not on the disk as reported."""
        joints = self.played.arm.joint_count
        with SessionFolder(self.path) as folder:
            points = folder.points()
        if points is None:
            return len(self.records)
        names = zip(points.setup, points.point, points.repeat, points.q_rad.tolist(), strict=True)
        on_disk = {(setup, point, int(repeat)): q_rad for setup, point, repeat, q_rad in names}
        return sum(
            key not in on_disk or any(abs(on_disk[key][j] - record.q_rad[j]) > 1e-8 for j in range(joints))
            for key, record in self.records.items()
        )


@dataclass(frozen=True, slots=True)
class SessionDrill(drill.Promise):
    """A fault in a session: on the way to its second point, or while it measures that."""

    inject: Callable[[drill.Stage], None] = field(default=lambda played: None)
    while_measuring: bool = False

    def run(self) -> drill.DrillOutcome:
        """Record until the fault ends it, mend it, resume, and look at what is on the disk."""
        with drill.stage() as played, tempfile.TemporaryDirectory(prefix="armwright-drill-") as folder:
            session = DrilledSession(Path(folder) / "session", played)
            played.client.enable()
            played.each_cycle.append(self._injector(session))
            ending = _ended_by(session)
            begun_s = session.begun_s if session.begun_s is not None else played.now_s
            if played.found:
                played.run(max(0.0, begun_s + drill.WATCHED_S - played.now_s))
            way = [place for place in played.way if begun_s - 1e-9 <= place[0] <= begun_s + drill.WATCHED_S]
            of_arm = [tip for at_s, tip in way if at_s not in session.by_hand_s] or [way[0][1]]
            noticed_s, codes, message = played.noticed_s, played.found, played.message or ending
            resumed = _resumed(session)
            asked, undisturbed = _undisturbed()
            return drill.DrillOutcome(
                self,
                max(drill.off_way_m(tip, asked) for tip in (*of_arm[:: drill.THINNED], of_arm[-1])) * 1e3,
                drill.length_m(way) * 1e3,
                None if noticed_s is None else noticed_s - begun_s,
                drill.stood_s(way, begun_s, LOOKED),
                _lost(session),
                codes,
                message,
                _wrong_rad(session.records, undisturbed) * 1e3,
                resumed,
            )

    def _injector(self, session: DrilledSession) -> Callable[[], None]:
        """Called after each cycle: breaks once, when it is time."""
        played = session.played
        under_way_s = 0.0

        def inject_once() -> None:
            nonlocal under_way_s
            if played.mode is Mode.GUIDING:
                session.by_hand_s.add(played.now_s)
            if not session.records or session.begun_s is not None:
                return
            runtime = played.assembly.runtime
            if self.while_measuring:
                is_time = runtime.averaging is not None and runtime.averaging.result is None
            else:
                under_way_s = under_way_s + drill.PERIOD_S if runtime.monitor.mode is Mode.MOVING else 0.0
                is_time = under_way_s >= TRAVELS_S
            if is_time:
                session.begun_s = played.now_s
                self.inject(played)

        return inject_once


def _ended_by(session: DrilledSession) -> str:
    """Play; the error that ended it, as text."""
    try:
        session.play()
    except (ArmError, LinkError, CalibrationError) as error:
        return str(error)
    return ""


def _resumed(session: DrilledSession) -> str:
    """Mend, acknowledge, home where the zero is lost, resume; what failed, as text."""
    played = session.played
    played.recover()
    try:
        if played.mode is not Mode.HOLDING:
            played.restart()
            played.client.enable()
        played.client.home()
    except (ArmError, LinkError) as error:
        return f"the arm did not recover: {error}"
    said = _ended_by(session)
    return f"not resumed: {said}" if said else ""


def _lost(session: DrilledSession) -> str:
    lost = session.lost()
    return f"{lost} records" if lost else "nothing"


def _wrong_rad(records: dict[Key, Record], undisturbed: dict[Key, Record]) -> float:
    """By how much a record differs from the one without the fault."""
    off = [abs(a - b) for key, record in records.items() for a, b in zip(record.q_rad, undisturbed[key].q_rad, strict=True)]
    worst = max(off, default=0.0)
    return worst if worst > SEATED_rad else 0.0


@cache
def _undisturbed() -> tuple[tuple[Point, ...], dict[Key, Record]]:
    """The true way of the tip, and the records, of a session without a fault."""
    with drill.stage() as played, tempfile.TemporaryDirectory(prefix="armwright-drill-") as folder:
        session = DrilledSession(Path(folder) / "session", played)
        played.client.enable()
        session.play()
        return tuple(tip for _, tip in played.way[:: drill.THINNED]), session.records

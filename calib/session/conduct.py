"""Positions of the cavities: from arm.toml, from the camera, or unknown."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from calib.arm_problem.assembly import base_frame_of
from calib.arrays import norms
from calib.boards import FEWEST_TO_NAME, BoardPose, Markers, Registration, markers_text, register_boards, write_boards
from calib.design.candidates import OTHER_TILTS, tilted
from calib.errors import RegistrationError, SessionError
from calib.points.points import FREE, STREAM_FRAME, Points
from calib.points.writer import Record, replace_file
from calib.results import made_today
from calib.session.conversation import (
    Answer,
    Conversation,
    Message,
    Recorded,
    Saying,
    SessionCommand,
    SessionQuestion,
    SmallMove,
    Talk,
    jogged,
)
from calib.session.folder import SessionFolder
from calib.session.moves import ArmGeometry, ClearPaths, JogPort, NoClearPath, TipSensor, Transfers, Vector
from calib.session.plan import Board, SessionPlan, Target
from calib.session.residual_watch import RecordVerdict, ResidualWatch, TipObservation
from calib.session.take import SessionSettings, take
from control.errors import ArmError
from control.model import table as tables
from control.model.arm import Arm

UP: Vector = (0.0, 0.0, 1.0)


class Boards:
    """The cavities of a session's setups. A measured board becomes known once enough of its cavities were measured.

    `poses` are in the arm's own base frame, for moving; table and camera may use another base frame, given by the arm's
    `base_frame` effect.
    """

    def __init__(self, arm: Arm, plan: SessionPlan) -> None:
        """SessionError if the arm's table lacks a cavity, MissingModel if its pose or the table is missing."""
        self.kind: Board = plan.board
        self.cavities_m: dict[str, Vector] = {}
        self.poses: dict[str, BoardPose] = {}
        self._references: dict[str, BoardPose] = {}
        self._base = base_frame_of(arm)
        setups = dict.fromkeys(target.setup for target in plan.targets if not target.is_free)
        if not setups:
            return
        table = tables.table_of(arm)
        self.cavities_m = tables.board_cavities(table)
        _require_cavities(plan.targets, self.cavities_m)
        if self.kind == "known":
            origin = np.array(tables.board_origin(table))
            for setup in setups:
                _require_tilt(setup)
                self._place(setup, BoardPose(tilted(table, setup), origin))

    def is_placed(self, setup: str) -> bool:
        """Whether the arm can be sent to the cavities of this setup."""
        return setup in self.poses

    def tip_m(self, target: Target) -> Vector:
        """A cavity in the arm's base frame."""
        return self._cavity_m(self.poses, target)

    def reference_m(self, target: Target) -> Vector:
        """A cavity in the base frame of table and camera, as in a record."""
        return self._cavity_m(self._references, target)

    def _cavity_m(self, poses: Mapping[str, BoardPose], target: Target) -> Vector:
        x, y, z = poses[target.setup].to_base(np.array([self.cavities_m[target.point]]))[0].tolist()
        return x, y, z

    def _place(self, setup: str, pose: BoardPose) -> None:
        base = self._base
        self._references[setup] = pose
        origin_m = base.to_base(pose.origin_m[None])[0]
        self.poses[setup] = BoardPose(np.asarray(base.rotation @ pose.rotation), origin_m)

    def origin_m(self, setup: str) -> Vector:
        """The board's origin in the base frame."""
        x, y, z = self.poses[setup].origin_m.tolist()
        return x, y, z

    def normal(self, setup: str) -> Vector:
        """The board's normal in the base frame; up if unknown."""
        if setup not in self.poses:
            return UP
        x, y, z = self.poses[setup].rotation[:, 2].tolist()
        return x, y, z

    def needs_seeing(self, setup: str) -> bool:
        """Whether cavities of this setup must be measured by the camera first."""
        return self.kind == "measured" and setup not in self.poses

    def best_to_see(self, remaining: Sequence[Target], points: Points | None, setup: str) -> Target:
        """Of the remaining targets in a setup, the cavity farthest from those measured."""
        here = [target for target in remaining if target.setup == setup]
        seen = {*self._seen(points, setup).marker} if points is not None else set()
        places = np.array([self.cavities_m[name] for name in seen] or [np.mean([*self.cavities_m.values()], axis=0)])

        def distance_m(target: Target) -> float:
            return float(np.min(np.linalg.norm(places - self.cavities_m[target.point], axis=1)))

        return max(here, key=distance_m)

    def register(self, points: Points, setup: str, is_last: bool) -> Registration | None:
        """Place the board by the tips that the camera saw, if they are enough; with fewer than five only if
        no more can come (`is_last`). RegistrationError where they do not agree with the board.
        """
        seen = self._seen(points, setup)
        names = set(seen.marker)
        if len(names) < 3 or (len(names) < FEWEST_TO_NAME and not is_last):
            return None
        registration = register_boards(seen, self.cavities_m)[setup]
        if len(names) - len(registration.outliers) < 3:
            raise RegistrationError(f"setup {setup}: fewer than three markers agree; measure them again")
        self._place(setup, BoardPose(registration.rotation, registration.origin_m))
        return registration

    def _seen(self, points: Points, setup: str) -> Markers:
        return markers_of(points.chosen([k for k in range(len(points)) if points.setup[k] == setup]))


def markers_of(points: Points) -> Markers:
    """The measured tips in cavities, as markers."""
    rows = np.flatnonzero(np.isfinite(points.tip_m).all(axis=1) & (np.array(points.setup) != FREE))
    chosen = points.chosen(rows)
    return Markers(chosen.setup, chosen.point, chosen.tip_m)


def _require_tilt(setup: str) -> None:
    tilts = (*tables.SETUPS, *OTHER_TILTS)
    if setup not in tilts:
        raise SessionError(f'setup of a board with a known pose: expected one of {", ".join(tilts)}, got "{setup}"')


def _require_cavities(targets: Sequence[Target], cavities_m: Mapping[str, Vector]) -> None:
    for target in targets:
        if not target.is_free and target.point not in cavities_m:
            some = ", ".join(list(cavities_m)[:8])
            raise SessionError(f"the table has no cavity {target.point} ({target.name}); it has {some}, ...")


class AutomaticHand(Protocol):
    """An automatic hand: the mock arm's, which knows the true board pose."""

    def grip(self) -> None:
        """Return when the hand supports the arm, so that the drives may be released."""

    def seat(self, target: Target) -> None:
        """Return when the tip is seated in the cavity."""

    def let_go(self) -> None:
        """Release the arm."""


@dataclass(frozen=True, slots=True)
class Station:
    """Resources of a session. hand: None if the operator seats the tip, on request."""

    arm: JogPort
    geometry: ArmGeometry
    boards: Boards
    watch: ResidualWatch
    hand: AutomaticHand | None = None
    camera: TipSensor | None = None
    ways: ClearPaths | None = None
    settings: SessionSettings = field(default_factory=SessionSettings)


def conduct(folder: SessionFolder, station: Station) -> Talk:
    """Record the remaining targets. Ends on the operator's request; the arm then holds.

    SessionError if the arm does not come to rest, ArmError if it cannot execute a motion.
    """
    return _Conductor(folder, station).run()


class _Conductor(Conversation):
    def __init__(self, folder: SessionFolder, station: Station) -> None:
        super().__init__(folder, station.watch)
        self._station = station
        self._arm, self._boards = station.arm, station.boards
        self._survey = BoardSurvey(folder, station.boards, station.watch)

    def _begin(self) -> Talk:
        """Restore from disk, and find out whether the tip is at a point."""
        yield from self._survey.resume()
        self._walk = Transfers(
            self._station.geometry,
            self._arm,
            self._station.settings.approach_m,
            self._station.settings.window_s,
            self._station.ways,
        )
        if setup := self._folder.is_at_point:
            self._walk.stands_at(self._boards.normal(setup))
        else:
            for setup in self._boards.poses:
                self._walk.stands_over(self._boards.origin_m(setup), self._boards.normal(setup))
        if self._walk.is_at_point:
            yield Message("the tip may be at a point: the arm first retracts it along the board's normal")

    def _next(self) -> Target | None:
        target = super()._next()
        if target is None or target.is_free or not self._boards.needs_seeing(target.setup):
            return target
        return self._boards.best_to_see(self._folder.state.left(), self._folder.points(), target.setup)

    def _visit(self, target: Target) -> Talk:
        """Record one target, as far as the operator allows."""
        if target.is_free and target.q_rad is not None:
            has_pictures = self._folder.plan.has_pictures
            if (
                (yield from self._ask(SessionQuestion.NEXT, target))
                and (yield from self._go(target, target.q_rad))
                and (not has_pictures or (yield from self._ask(SessionQuestion.PICTURE, target)))
            ):
                yield from self._record(target)
            return
        if target.setup != self._standing and not (yield from self._set_up(target)):
            return
        if self._boards.is_placed(target.setup) and not (yield from self._send(target)):
            return
        if self._station.hand is not None:
            yield from self._seated_by(self._station.hand, target)
        elif self._folder.plan.seat == "jog":
            yield from self._jogged_in(target)
        else:
            yield from self._guided_in(target)

    def _set_up(self, target: Target) -> Answer:
        """Move away from the board, and wait until it is in the target's setup."""
        if self._walk.is_at_point:
            if not (yield from self._ask(SessionQuestion.NEXT, target)):
                return False
            self._lift()
        if not (yield from self._ask(SessionQuestion.BOARD, target)):
            return False
        self._standing = target.setup
        return True

    def _send(self, target: Target) -> Answer:
        """Move the arm above the point; a point out of reach is skipped."""
        normal = self._boards.normal(target.setup)
        try:
            above = self._walk.plan(
                self._boards.tip_m(target), normal, target.approach, self._folder.plan.approaches, target.q_rad
            )
        except ArmError as error:
            return (yield from self._skip(target, error))
        return (yield from self._ask(SessionQuestion.NEXT, target)) and (yield from self._go(target, above))

    def _seated_by(self, hand: AutomaticHand, target: Target) -> Talk:
        """The mock hand seats the tip; if the arm was not moved before, the operator is asked first."""
        if not self._boards.is_placed(target.setup) and not (yield from self._ask(SessionQuestion.TAKE, target)):
            return
        hand.grip()
        try:
            with self._at_point(target):
                hand.seat(target)
                self._hold()
                yield from self._record(target)
        finally:
            hand.let_go()

    def _guided_in(self, target: Target) -> Talk:
        """The operator takes the tip, the drives are released, the operator confirms that it is seated."""
        if not (yield from self._ask(SessionQuestion.TAKE, target)):
            return
        with self._at_point(target):
            if (yield from self._ask(SessionQuestion.SEATED, target)):
                self._hold()
                yield from self._record(target)

    def _jogged_in(self, target: Target) -> Talk:
        """The operator jogs the tip down; the drives hold it throughout."""
        self._arrive(target)
        if (yield from self._ask(SessionQuestion.SEATED, target)):
            yield from self._record(target)

    @contextmanager
    def _at_point(self, target: Target) -> Iterator[None]:
        """Release the drives, and hold again on every exit."""
        self._arrive(target)
        self._is_released = True
        try:
            self._arm.release()
            yield
        finally:
            self._hold()

    def _hold(self) -> None:
        self._arm.hold()
        self._is_released = False

    def _arrive(self, target: Target) -> None:
        """Note before the tip goes down, for a resumption after a kill."""
        self._folder.at_point(target.key)
        self._walk.stands_at(self._boards.normal(target.setup))

    def _lift(self) -> None:
        if self._walk.lift():
            self._folder.lifted(self._standing or self._folder.standing)

    def _go(self, target: Target, q_rad: tuple[float, ...]) -> Answer:
        """Move, if there is a collision-free path; a target without one is skipped."""
        self._lift()
        board = self._boards.poses.get(self._standing or self._folder.standing)
        try:
            self._walk.go(q_rad, board)
        except NoClearPath as error:
            return (yield from self._skip(target, error))
        return True

    def _record(self, target: Target) -> Talk:
        """Measure, check, save; then report."""
        station = self._station
        cavity: Vector | None = None
        if not target.is_free and self._boards.kind == "known":
            cavity = self._boards.reference_m(target)
        record = take(target, cavity, self._arm, station.settings, station.camera)
        if self._folder.plan.has_pictures:  # which say later where the tip was
            yield Recorded(self._folder.record(record), RecordVerdict(np.full(3, np.nan)))
            return
        observation = self._survey.observation(record)
        verdict = station.watch.judge(observation)
        record_with_take = self._folder.record(record)
        station.watch.add(record_with_take.key, observation)
        yield Recorded(record_with_take, verdict)
        if not target.is_free:
            yield from self._survey.place(target.setup)

    def _jog(self, jog: SmallMove) -> None:
        self._arm.creep_to_q(jogged(jog, self._arm, self._station.geometry))


# Board poses from the records so far, and checks of new records.
MARKERS, BOARDS = "markers.csv", "boards.json"


class BoardSurvey:
    """Registers boards that the camera measures, and feeds the watch."""

    def __init__(self, folder: SessionFolder, boards: Boards, watch: ResidualWatch) -> None:
        self._folder, self._boards, self._watch = folder, boards, watch
        self._found: dict[str, Registration] = {}

    def resume(self) -> Generator[Saying, SessionCommand, None]:
        """Process the records of a resumed session."""
        points = self._folder.points()
        if points is None or self._folder.plan.has_pictures:
            return
        for key, observation in _observations(points, self._boards):
            self._watch.add(key, observation)
        for setup in dict.fromkeys(points.setup):
            yield from self.place(setup)

    def observation(self, record: Record) -> TipObservation:
        """A record as an observation for the watch."""
        if record.tip_m is not None:
            is_unplaced = self._folder.plan.pose_frame == STREAM_FRAME
            return TipObservation(record.setup, record.q_rad, record.tip_m, is_unplaced)
        return TipObservation(record.setup, record.q_rad, self._boards.cavities_m[record.point], True)

    def place(self, setup: str) -> Generator[Saying, SessionCommand, None]:
        """Register a board measured by the camera, and write its pose."""
        points = self._folder.points()
        if self._boards.kind != "measured" or setup == FREE or points is None:
            return
        replace_file(self._folder.path / MARKERS, markers_text(markers_of(points)).encode())
        is_last = not any(target.setup == setup for target in self._folder.state.left())
        try:
            registration = self._boards.register(points, setup, is_last)
        except RegistrationError as error:
            yield Message(str(error), is_warning=True)
            return
        if registration is None:
            return
        before = self._found.get(setup)
        self._found[setup] = registration
        write_boards(self._folder.path / BOARDS, self._folder.plan.arm, self._found, made_today())
        if before is None or before.outliers != registration.outliers:
            yield Message(_described(setup, registration), is_warning=bool(registration.outliers))


def _observations(points: Points, boards: Boards) -> list[tuple[object, TipObservation]]:
    """The records of a file, by key, in order."""
    observations: list[tuple[object, TipObservation]] = []
    for k in range(len(points)):
        setup, point, repeat = points.setup[k], points.point[k], points.repeat[k]
        x, y, z = points.tip_m[k].tolist()
        is_unknown = x != x
        place: Vector = boards.cavities_m[point] if is_unknown else (x, y, z)
        is_unplaced = is_unknown or points.in_camera_frame
        observation = TipObservation(setup, tuple(points.q_rad[k].tolist()), place, is_unplaced)
        observations.append(((setup, point, repeat), observation))
    return observations


def _described(setup: str, registration: Registration) -> str:
    worst = max(zip(norms(registration.residual_m), registration.names, strict=True))
    text = (
        f"board {setup}: pose from {len(registration.names)} cavities, residual {1e3 * registration.noise_m:.2f} mm per axis,"
        f" largest {1e3 * float(worst[0]):.2f} mm at {worst[1]}"
    )
    if registration.outliers:
        text += f"; not used: {', '.join(registration.outliers)} (`redo` them)"
    return "; ".join((text, *registration.notes))

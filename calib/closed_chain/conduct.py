"""A session of two arms in contact: led from contact to contact together, brought together by hand or jogged, recorded.

The files are those of every session (calib.session.folder); points.csv is a contacts.csv (calib.closed_chain.pair_problem).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from calib.arm_problem.arm_model import prior_sd
from calib.arm_problem.observations import Frame
from calib.arrays import Array, frozen
from calib.closed_chain.pair_problem import Contacts, PairProblem
from calib.closed_chain.planning import Poses, SharedRoom
from calib.errors import SessionError
from calib.points.writer import DISTANCE, Record
from calib.session.conversation import Conversation, Message, Recorded, SessionQuestion, SmallMove, Talk, jogged
from calib.session.folder import SessionFolder
from calib.session.moves import ArmGeometry, JogPort
from calib.session.plan import Seating, SessionPlan, Target
from calib.session.residual_watch import NOISE_m, RecordVerdict, weights_of
from calib.session.take import SessionSettings, take, wait_for_rest
from control.errors import ArmError
from control.model.arm import Arm
from control.server.channel import RuntimeGone
from control.server.client import ArmFaulted

BACK_OFF, LEAD = 0.1, 1.0  # speeds, of the session's


class PairHand(Protocol):
    """Automatic hands at both tips: the mock's."""

    def seat(self, target: Target) -> None:
        """Return when both tips are where they touch, and both arms hold."""

    def let_go(self) -> None:
        """Release both arms."""


@dataclass(frozen=True, slots=True)
class PairStation:
    """Resources of a session of two arms. hand: None if the operator brings the tips together, on request.

    `together`: a joint move of both, which begin and end together, at a fraction of the session's speed.
    """

    names: tuple[str, str]
    arms: tuple[JogPort, JogPort]
    geometry: tuple[ArmGeometry, ArmGeometry]
    together: Callable[[Poses, float], None]
    room: SharedRoom
    watch: ContactWatch
    hand: PairHand | None = None
    settings: SessionSettings = field(default_factory=SessionSettings)


def contact_plan(names: tuple[str, str], fingerprint: str, contacts: Contacts, seat: Seating) -> SessionPlan:
    """A session of planned contacts, in their order. SessionError for joined tools, which cannot back off from each other."""
    if any(contacts.joined):
        raise SessionError(
            "the arms back off from each contact, and joined tools cannot: guide both by hand, and note their joint angles"
        )
    poses = zip(contacts.first_rad.tolist(), contacts.second_rad.tolist(), strict=True)
    targets = tuple(
        Target(setup, point, repeat, 1, (*first, *second), distance_m)
        for (setup, point, repeat), (first, second), distance_m in zip(
            contacts.keys, poses, contacts.distance_m.tolist(), strict=True
        )
    )
    count = contacts.first_rad.shape[1] + contacts.second_rad.shape[1]
    return SessionPlan(" and ".join(names), fingerprint, count, targets, "contact", seat)


def conduct(folder: SessionFolder, station: PairStation) -> Talk:
    """Record the remaining contacts. Ends on the operator's request; both arms then hold.

    SessionError if an arm does not come to rest, ArmError if one cannot execute a motion.
    """
    return _Conductor(folder, station).run()


class _Conductor(Conversation):
    def __init__(self, folder: SessionFolder, station: PairStation) -> None:
        super().__init__(folder, station.watch)
        self._station = station
        self._is_touching = bool(folder.is_at_point)
        self._came_from: Poses | None = None  # where both stood before the tips were brought together

    def _begin(self) -> Talk:
        if (points := self._folder.points()) is not None:
            keys = zip(points.setup, points.point, points.repeat, strict=True)
            for key, q_rad, distance in zip(keys, points.q_rad.tolist(), points.extra[DISTANCE], strict=True):
                self._station.watch.add(key, q_rad, float(distance))
        if self._is_touching:
            yield Message("the tips may touch: both arms first back off along their last links")

    def _visit(self, target: Target) -> Talk:
        away = self._station.room.backed_off(self._poses_of(target))
        if away is None:
            yield from self._skip(target, ArmError("an arm cannot back off from there along its last link"))
            return
        if not (yield from self._ask(SessionQuestion.NEXT, target)):
            return
        self._standing = target.setup
        try:
            self._lift()
            self._lead(away)
            self._came_from = away
        except (ArmFaulted, RuntimeGone):
            raise
        except ArmError as error:
            yield from self._skip(target, error)
            return
        if self._station.hand is not None:
            yield from self._seated_by(self._station.hand, target)
        elif self._folder.plan.seat == "jog":
            self._arrive(target)
            if (yield from self._ask(SessionQuestion.SEATED, target)):
                yield from self._record(target)
        else:
            yield from self._guided(target)

    def _lead(self, goal_rad: Poses) -> None:
        """Move both on a way that is clear. ArmError, and nothing moves, if there is none."""
        way = self._station.room.way(self._poses_now(), goal_rad)
        if way is None:
            raise ArmError("no way there on which the arms are clear of each other")
        for poses in way:
            self._station.together(poses, LEAD)

    def _lift(self) -> None:
        if not self._is_touching:
            return
        along = self._station.room.backed_off(self._poses_now())
        refused: ArmError | None = None
        for off in (self._came_from, along):  # the way they came was clear, whatever the arms' models say here
            if off is None:
                continue
            try:
                self._station.together(off, BACK_OFF)
                break
            except (ArmFaulted, RuntimeGone):
                raise
            except ArmError as error:
                refused = error
        else:
            why = f": {refused}" if refused else " along their last links"
            raise SessionError(f"the arms cannot back off from each other{why}. Jog one of them away, then resume")
        self._came_from, self._is_touching = None, False
        self._folder.lifted(self._standing or self._folder.standing)

    def _seated_by(self, hand: PairHand, target: Target) -> Talk:
        self._arrive(target)
        try:
            with self._held():
                hand.seat(target)
            yield from self._record(target)
        finally:
            hand.let_go()

    def _guided(self, target: Target) -> Talk:
        """The operator takes one tip to the contact, then the other; drives hold what a hand does not."""
        with self._held():
            for name, arm in zip(self._station.names, self._station.arms, strict=True):
                if not (yield from self._ask(SessionQuestion.TAKE, target, name)):
                    return
                self._arrive(target)
                self._is_released = True
                arm.release()
                if not (yield from self._ask(SessionQuestion.SEATED, target, name)):
                    return
                arm.hold()
                self._is_released = False
            yield from self._record(target)

    @contextmanager
    def _held(self) -> Iterator[None]:
        """Both arms hold again on every exit."""
        try:
            yield
        finally:
            for arm in self._station.arms:
                arm.hold()
            self._is_released = False

    def _arrive(self, target: Target) -> None:
        """Note before the tips meet, for a resumption after a kill."""
        if not self._is_touching:
            self._folder.at_point(target.key)
        self._is_touching = True

    def _record(self, target: Target) -> Talk:
        """Measure both arms, check, save; then report."""
        record = self._taken(target)
        verdict = self._station.watch.judge(record.q_rad, target.distance_m)
        saved = self._folder.record(record)
        self._station.watch.add(saved.key, saved.q_rad, target.distance_m)
        yield Recorded(saved, verdict)

    def _taken(self, target: Target) -> Record:
        """One record of both arms: first both rest, then each is averaged."""
        station, how = self._station, self._station.settings
        for arm in station.arms:
            wait_for_rest(arm, how.still_limit_rad, how.still_s, how.patience_s, how.window_s)
        first, second = (take(target, None, arm, how, None) for arm in station.arms)
        return replace(
            first,
            q_rad=first.q_rad + second.q_rad,
            q_sd_rad=first.q_sd_rad + second.q_sd_rad,
            direction=first.direction + second.direction,
            current_A=first.current_A + second.current_A,
            temperature_C=first.temperature_C + second.temperature_C,
            more={DISTANCE: f"{target.distance_m:g}"},
        )

    def _jog(self, jog: SmallMove) -> None:
        names = self._station.names
        if jog.arm not in names:
            got = jog.arm or "none"
            raise SessionError(f"jog: expected one of {', '.join(names)} first, as `jog {names[0]} z -5`, got {got}")
        k = names.index(jog.arm)
        arm = self._station.arms[k]
        arm.creep_to_q(jogged(replace(jog, arm=""), arm, self._station.geometry[k]))

    def _poses_now(self) -> Poses:
        return [arm.average(self._station.settings.window_s).q_rad for arm in self._station.arms]

    def _poses_of(self, target: Target) -> Poses:
        q_rad, count = target.q_rad or (), len(self._station.room.rest_rad[0])
        return [q_rad[:count], q_rad[count:]]


# Checks new contacts against earlier ones, to detect at once tips that did not touch, or joints of another contact.
#
# As calib.session.residual_watch: from the earlier contacts, the most likely deviations of both arms are estimated (Gauss-
# Newton, a normal prior of half the usual bounds), and from them the new contact and its covariance are predicted.

FEWEST = 6  # contacts before a verdict: they place the second base
PRIOR = 0.5  # of the bounds
PRIOR_BASE = 10.0  # the second base, in its own units: anywhere
STEPS = 3


@dataclass(frozen=True, slots=True)
class _Seen:
    q_rad: tuple[float, ...]
    distance_m: float


class ContactWatch:
    """Stores contacts and checks new ones; `base`: where the second base stands in the first, by the cell's file."""

    def __init__(self, arms: tuple[Arm, Arm], base: Frame) -> None:
        self._arms, self._base = arms, base
        self._seen: dict[object, _Seen] = {}

    def add(self, key: object, q_rad: Sequence[float], distance_m: float) -> None:
        """Add a contact: joint angles of the first arm, then of the second."""
        self._seen[key] = _Seen(tuple(q_rad), distance_m)

    def forget(self, key: object) -> None:
        """Remove a contact."""
        self._seen.pop(key, None)

    def judge(self, q_rad: Sequence[float], distance_m: float) -> RecordVerdict:
        """Compare a contact with the earlier ones. error_m: how far it is from closing by the files, along the first axis."""
        before = [*self._seen.values()]
        problem = PairProblem(self._arms, self._contacts([*before, _Seen(tuple(q_rad), distance_m)]), self._base)
        open_m = float(problem.errors_m(np.zeros(len(problem.parameters)))[-1])
        error_m = frozen(np.array([open_m, 0.0, 0.0]))
        if len(before) < FEWEST:
            return RecordVerdict(error_m)
        return RecordVerdict.of(error_m, *_predicted(problem))

    def _contacts(self, seen: Sequence[_Seen]) -> Contacts:
        count = self._arms[0].joint_count
        q_rad = np.array([contact.q_rad for contact in seen])
        names = tuple(str(k) for k in range(len(seen)))
        distance_m = np.array([contact.distance_m for contact in seen])
        return Contacts(names, names, frozen(q_rad[:, :count]), frozen(q_rad[:, count:]), frozen(distance_m))


def _predicted(problem: PairProblem) -> tuple[Array, Array]:
    """Of the last contact: its innovation (3,) [m] and covariance (3, 3) [m2], by all others."""
    prior = prior_sd(problem.parameters, PRIOR, PRIOR_BASE) ** -2.0
    x = np.zeros(len(prior))
    for _ in range(STEPS):
        residual, slopes = problem.of_contacts(x)
        weights = weights_of(residual[:-1], NOISE_m) / NOISE_m**2
        information = np.einsum("m,mik,mil->kl", weights, slopes[:-1], slopes[:-1]) + np.diag(prior)
        aim = slopes[:-1] @ x - residual[:-1]
        x = np.linalg.solve(information, np.einsum("m,mik,mi->k", weights, slopes[:-1], aim))
    residual, slopes = problem.of_contacts(x)
    covariance = slopes[-1] @ np.linalg.solve(information, slopes[-1].T)
    return residual[-1], covariance + NOISE_m**2 * np.eye(3)

"""What every session with an operator does: target after target, questions and commands, and a clean end.

A session is a generator: it yields sayings and is sent a `SessionCommand` for every `Ask`. It reads no keyboard and prints
nothing, so that a terminal, a script and a screen run the same session. Nothing moves, and no drive is released, before an Ask
was answered with GO. On every exit the hand has released the arm and the drives hold.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from calib.errors import RegistrationError, SessionError
from calib.points.writer import Key, Record
from calib.session.folder import SessionFolder, continues
from calib.session.moves import ArmGeometry, ArmPort, Vector
from calib.session.plan import AFTER, SessionState, Target, TargetEvent
from calib.session.residual_watch import RecordVerdict
from control.errors import ArmError
from control.server.channel import RuntimeGone
from control.server.client import ArmFaulted


class SessionQuestion(Enum):
    """Conditions that the session waits for. The answer GO confirms."""

    BOARD = "the board is placed for this setup"
    NEXT = "nobody touches the arm; it may move"
    TAKE = "a hand supports the tip; the drives may release"
    SEATED = "the tip is seated in the cavity"
    PICTURE = "the picture of this pose is taken"
    DONE = "the session may end"


@dataclass(frozen=True, slots=True)
class Ask:
    """The session waits for an answer: a Command. `arm`: which of two it is about."""

    question: SessionQuestion
    target: Target | None
    arm: str = ""


@dataclass(frozen=True, slots=True)
class Recorded:
    """A record was saved; with its verdict."""

    record: Record
    verdict: RecordVerdict


@dataclass(frozen=True, slots=True)
class Message:
    """A message for the operator; `is_warning` for a problem."""

    text: str
    is_warning: bool = False


Saying = Ask | Recorded | Message


class Do(Enum):
    """Commands of an operator."""

    GO = "go"
    REDO = "redo"
    SKIP = "skip"
    BAD = "bad"
    NOTE = "note"
    JOG = "jog"
    QUIT = "quit"


@dataclass(frozen=True, slots=True)
class SmallMove:
    """A small move: along x, y or z of the base frame [m], or of a joint j1, j2, ... [rad]; `arm`: which of two."""

    axis: str
    step: float
    arm: str = ""


@dataclass(frozen=True, slots=True)
class SessionCommand:
    """One command. REDO, SKIP, BAD without a point refer to the last record, or for SKIP to the present target."""

    do: Do
    setup: str = ""
    point: str = ""
    repeat: int | None = None
    text: str = ""
    jog: SmallMove | None = None


GO = SessionCommand(Do.GO)


EVENTS = {Do.SKIP: TargetEvent.SKIP, Do.REDO: TargetEvent.REDO, Do.BAD: TargetEvent.BAD}


def done_to(folder: SessionFolder, command: SessionCommand, asked: Target | None, standing: str) -> list[Key]:
    """Execute a command; return the affected targets. SessionError, without effect, if it is invalid."""
    event = EVENTS[command.do]
    keys = _meant(folder.state, event, command, asked, standing)
    for key in keys:
        folder.happen(event, key)
    return keys


def _meant(state: SessionState, event: TargetEvent, command: SessionCommand, asked: Target | None, standing: str) -> list[Key]:
    """Keys of a command. A point without a repeat means all its repeats for which the event is valid."""
    if not command.point:
        return [_unnamed(state, event, asked)]
    setup = command.setup or standing or (asked.setup if asked else "")
    keys = state.named(setup, command.point, command.repeat)
    possible = [key for key in keys if (state.marks[key], event) in AFTER]
    if not possible:
        state.after(event, keys[0])  # raises with the reason
    return possible


def _unnamed(state: SessionState, event: TargetEvent, asked: Target | None) -> Key:
    key = (asked.key if asked else None) if event is TargetEvent.SKIP else state.last
    if key is None:
        raise SessionError(f"{event.value}: no point given; type {event.value} [setup] point [repeat]")
    return key


LONGEST_m, LONGEST_rad = 0.05, 0.1  # a typing error must not cause a collision
WINDOW_s = 0.02
AXES = "xyz"


def jogged(jog: SmallMove, arm: ArmPort, geometry: ArmGeometry) -> Sequence[float]:
    """Joint angles after the step. SessionError for an invalid step, ArmError if it is out of reach."""
    if jog.arm:
        raise SessionError(f"jog: this session has one arm: expected an axis and a step, got {jog.arm!r} first")
    q_rad = arm.average(WINDOW_s).q_rad
    if jog.axis in AXES and jog.axis:
        _require_small(jog, LONGEST_m, "m")
        x, y, z = geometry.tip(q_rad)
        step = [jog.step if axis == jog.axis else 0.0 for axis in AXES]
        tip: Vector = (x + step[0], y + step[1], z + step[2])
        return geometry.nearest(tip, q_rad)
    joint = re.fullmatch(r"j([1-9]\d?)", jog.axis)
    if joint is None or int(joint[1]) > len(q_rad):
        raise SessionError(f"jog: expected x, y, z or j1 to j{len(q_rad)}, got {jog.axis!r}")
    _require_small(jog, LONGEST_rad, "rad")
    number = int(joint[1]) - 1
    return [q + jog.step if k == number else q for k, q in enumerate(q_rad)]


def _require_small(jog: SmallMove, longest: float, unit: str) -> None:
    if not abs(jog.step) <= longest:
        raise SessionError(f"jog {jog.axis}: a step is {longest:g} {unit} at most, got {jog.step:g} {unit}")


Talk = Generator[Saying, SessionCommand, None]
Answer = Generator[Saying, SessionCommand, bool]


def unattended(talk: Talk) -> Iterator[Saying]:
    """What is said when every question is answered with GO, for mocks."""
    try:
        saying = next(talk)
        while True:
            yield saying
            saying = talk.send(GO)
    except StopIteration:
        return
    finally:
        talk.close()


class Forgetting(Protocol):
    """A watch that earlier records can be taken from."""

    def forget(self, key: object) -> None: ...


class Conversation(ABC):
    """A session of a folder's targets; a subclass says how one is visited, and what a jog moves."""

    def __init__(self, folder: SessionFolder, watch: Forgetting) -> None:
        self._folder, self._kept = folder, watch
        self._standing = ""  # the present setup
        self._is_released = False

    def run(self) -> Talk:
        """The whole session."""
        try:
            yield from self._begin()
            while True:
                target = self._next()
                if target is not None:
                    yield from self._visit(target)
                elif (yield from self._ask(SessionQuestion.DONE, None)):
                    self._lift()
                    return
        except _Quit:
            if left := len(self._folder.state.left()):
                yield Message(f"stopped; left: {left} of {len(self._folder.plan.targets)}; {continues(self._folder.path)}")

    @abstractmethod
    def _begin(self) -> Talk:
        """Restore from disk, and find out whether the tip is at a point."""

    @abstractmethod
    def _visit(self, target: Target) -> Talk:
        """Record one target, as far as the operator allows."""

    @abstractmethod
    def _lift(self) -> None:
        """Bring the tip away from a point, if it is at one."""

    @abstractmethod
    def _jog(self, jog: SmallMove) -> None:
        """One small move; SessionError if it is invalid."""

    def _next(self) -> Target | None:
        return self._folder.state.next(self._standing or self._folder.standing)

    def _skip(self, target: Target, reason: ArmError) -> Answer:
        self._folder.skip(target.key, str(reason))
        yield Message(f"{target.name} is skipped: {reason}", is_warning=True)
        return False

    def _ask(self, question: SessionQuestion, target: Target | None, arm: str = "") -> Answer:
        """Ask until the answer is GO (True), or another target is due (False)."""
        while True:
            command = yield Ask(question, target, arm)
            if command.do is Do.GO:
                return True
            if command.do is Do.QUIT:
                raise _Quit
            try:
                yield from self._obey(command, target)
            except (ArmFaulted, RuntimeGone):
                raise
            except (SessionError, RegistrationError, ArmError) as refusal:
                yield Message(str(refusal), is_warning=True)
            if self._next() != target:
                return False

    def _obey(self, command: SessionCommand, target: Target | None) -> Talk:
        if command.do is Do.NOTE:
            self._folder.note(command.text, target.key if target else None)
            yield Message("noted")
        elif command.jog is not None:
            if self._is_released:
                raise SessionError("the drives are off: move the arm by hand; jog needs the drives on")
            self._jog(command.jog)
        else:
            changed = done_to(self._folder, command, target, self._standing or self._folder.standing)
            for key in changed:
                self._kept.forget(key)
            names = ", ".join(self._folder.state.targets[key].name for key in changed)
            yield Message(f"{command.do.value}: {names}")


class _Quit(Exception):
    """The operator ended the session."""

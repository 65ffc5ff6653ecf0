"""What every session with an operator does: target after target, questions and commands, and a clean end.

A session is a generator: it yields messages (`calib.session.dialogue`) and is sent a Command for every Ask. It reads no
keyboard and prints nothing, so that a terminal, a script and a screen run the same session. Nothing moves, and no drive is
released, before an Ask was answered with GO. On every exit the hand has released the arm and the drives hold.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator
from typing import Protocol

from calib.errors import RegistrationError, SessionError
from calib.session.commands import done_to
from calib.session.dialogue import GO, Ask, Command, Do, Jog, Message, Question, Saying
from calib.session.folder import SessionFolder, continues
from calib.session.plan import Target
from control.errors import ArmError
from control.server.channel import RuntimeGone
from control.server.client import ArmFaulted

Talk = Generator[Saying, Command, None]
Answer = Generator[Saying, Command, bool]


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
                elif (yield from self._ask(Question.DONE, None)):
                    self._lift()
                    return
        except _Quit:
            if left := len(self._folder.state.left()):
                yield Message(
                    f"stopped; left: {left} of {len(self._folder.plan.targets)}; {continues(self._folder.path)}"
                )

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
    def _jog(self, jog: Jog) -> None:
        """One small move; SessionError if it is invalid."""

    def _next(self) -> Target | None:
        return self._folder.state.next(self._standing or self._folder.standing)

    def _skip(self, target: Target, reason: ArmError) -> Answer:
        self._folder.skip(target.key, str(reason))
        yield Message(f"{target.name} is skipped: {reason}", is_warning=True)
        return False

    def _ask(self, question: Question, target: Target | None, arm: str = "") -> Answer:
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

    def _obey(self, command: Command, target: Target | None) -> Talk:
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

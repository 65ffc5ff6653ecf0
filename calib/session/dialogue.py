"""Messages between a session and its operator; the front end (a terminal, a script, a screen) turns them into text."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from calib.points.writer import Record
from calib.session.plan import Target
from calib.session.residual_watch import Verdict


class Question(Enum):
    """Conditions that the session waits for. The answer GO confirms."""

    BOARD = "the board is placed for this setup"
    NEXT = "nobody touches the arm; it may move"
    TAKE = "a hand supports the tip; the drives may release"
    SEATED = "the tip is seated in the cavity"
    DONE = "the session may end"


@dataclass(frozen=True, slots=True)
class Ask:
    """The session waits for an answer: a Command. `arm`: which of two it is about."""

    question: Question
    target: Target | None
    arm: str = ""


@dataclass(frozen=True, slots=True)
class Recorded:
    """A record was saved; with its verdict."""

    record: Record
    verdict: Verdict


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
class Jog:
    """A small move: along x, y or z of the base frame [m], or of a joint j1, j2, ... [rad]; `arm`: which of two."""

    axis: str
    step: float
    arm: str = ""


@dataclass(frozen=True, slots=True)
class Command:
    """One command. REDO, SKIP, BAD without a point refer to the last record, or for SKIP to the present target."""

    do: Do
    setup: str = ""
    point: str = ""
    repeat: int | None = None
    text: str = ""
    jog: Jog | None = None


GO = Command(Do.GO)

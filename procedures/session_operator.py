"""The operator's side of a session: commands as text, questions as text or as JSON lines, the board drawn in characters.

In: lines from a terminal, a pipe or a script. Out: text, or for a program such as the console's screen one JSON object a line:

{"ask": "SEATED", "prompt": "...", "setup": "normal", "point": "13", "done": 12, "left": 87,
 "board": [{"name": "13", "x_m": 0.02, "y_m": 0.0, "mark": "now"}, ...]}
{"recorded": "normal 13", "text": "...", "error_mm": 20.77, "deviation_mm": 1.22, "deviation_sd": 0.8, "is_suspect": false}
{"message": "...", "is_warning": false}

"""

from __future__ import annotations

import json
import math
import shlex
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from calib.errors import SessionError
from calib.points.points import FREE
from calib.points.writer import DISTANCE, Record
from calib.session.conversation import GO, Ask, Do, Recorded, Saying, SessionCommand, SessionQuestion, SmallMove, Talk
from calib.session.folder import POINTS, SessionFolder
from calib.session.moves import Vector
from calib.session.plan import Mark, SessionPlan, SessionState, Target
from calib.vision.poses import picture_name
from control.errors import ArmError
from control.model.arm import Table
from control.plain_text import folded
from control.server.channel import Message
from control.server.client import ArmClient, ArmFaulted, fault_text

HELP = """\
  Enter                      confirm and continue
  skip [[SETUP] POINT [N]]   skip a point (without a name: this one)
  redo [[SETUP] POINT [N]]   measure a point again (without a name: the last); the journal keeps the withdrawn record
  bad  [[SETUP] POINT [N]]   withdraw a record; N is the repeat (default: all repeats)
  note TEXT                  record a remark
  jog [ARM] AXIS STEP        x, y or z in mm, j1, j2, ... in degrees: jog z -5; ARM: which of two
  status, board              progress; a drawing of the board
  auto [N]                   mock arm only: answer N questions, or all, with Enter
  quit                       stop here; the same command continues
"""
WORDS = {do.value: do for do in (Do.SKIP, Do.REDO, Do.BAD, Do.NOTE, Do.JOG, Do.QUIT)}
MM, DEGREE = 1e-3, math.pi / 180.0


class OperatorView(Enum):
    """A view requested by the operator; it changes nothing."""

    HELP = "help"
    STATUS = "status"
    BOARD = "board"


@dataclass(frozen=True, slots=True)
class Auto:
    """Answer the next questions with Enter: `count` of them, or all."""

    count: int | None


class BadCommand(Exception):
    """A line that is not a valid command; the text states what was expected."""


def parse_command(line: str) -> SessionCommand | OperatorView | Auto:
    """The command of a line. BadCommand if it is not valid."""
    text = line.strip()
    if not text:
        return GO
    word, _, rest = text.partition(" ")
    word, rest = word.lower(), rest.strip()
    if word in ("help", "?"):
        return OperatorView.HELP
    if word in (OperatorView.STATUS.value, OperatorView.BOARD.value) and not rest:
        return OperatorView(word)
    if word == "auto":
        return Auto(_count(rest) if rest else None)
    do = WORDS.get(word)
    if do is Do.NOTE:
        if not rest:
            raise BadCommand("note: expected a text")
        return SessionCommand(do, text=rest)
    if do is Do.JOG:
        return SessionCommand(do, jog=_jog(rest))
    if do is Do.QUIT and not rest:
        return SessionCommand(do)
    if do in (Do.SKIP, Do.REDO, Do.BAD):
        return _about_point(do, rest)
    raise BadCommand(f"unknown command: {text!r}; `help` lists the commands")


def _about_point(do: Do, rest: str) -> SessionCommand:
    """Nothing, a point, a setup and a point, and with both a repeat."""
    try:
        names = shlex.split(rest)
    except ValueError as error:
        raise BadCommand(f"{do.value}: {error}") from None
    if len(names) > 3:
        raise BadCommand(f"{do.value}: expected [[SETUP] POINT [N]], got {rest!r}")
    if not names:
        return SessionCommand(do)
    if len(names) == 1:
        return SessionCommand(do, point=names[0])
    return SessionCommand(do, names[0], names[1], _count(names[2]) if len(names) == 3 else None)


def _jog(rest: str) -> SmallMove:
    words = rest.split()
    try:
        *arm, axis, number = words
        step = float(number)
    except ValueError:
        arm, axis, step = [], "", math.nan
    if len(arm) > 1 or not math.isfinite(step):
        raise BadCommand(
            "jog: expected an axis and a step, such as `jog z -5` (mm) or `jog j2 0.5` (degrees), with two arms `jog left z -5`"
        )
    axis = axis.lower()
    return SmallMove(axis, (MM if axis in ("x", "y", "z") else DEGREE) * step, *arm)


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise BadCommand(f"expected a number from 1, got {text!r}")
    return int(text)


WIDTH, HEIGHT = 61, 25  # a character is twice as high as wide
SIGNS = {"done": "#", "partly": "+", "now": "O", "left": ".", "skipped": "-", "bad": "x"}
LEGEND = "# done  + some repeats  O now  . left  - skipped  x bad"


def board_text(state: SessionState, cavities_m: Mapping[str, Vector], setup: str, current: Target | None) -> str:
    """The cavities of one setup, seen from above, the board's x axis to the right."""
    shown = board(state, cavities_m, setup, current.point if current is not None else "")
    if not shown:
        return f"setup {setup}: this session has no cavities there\n"
    xs_m, ys_m = [cavity.x_m for cavity in shown], [cavity.y_m for cavity in shown]
    left_m, right_m, low_m, high_m = min(xs_m), max(xs_m), min(ys_m), max(ys_m)
    per_column = max((right_m - left_m) / (WIDTH - 1), (high_m - low_m) / (2 * (HEIGHT - 1)), 1e-6)
    rows = round((high_m - low_m) / (2 * per_column)) + 1
    grid = [[" "] * WIDTH for _ in range(rows)]
    for cavity in shown:
        grid[round((high_m - cavity.y_m) / (2 * per_column))][round((cavity.x_m - left_m) / per_column)] = SIGNS[cavity.mark]
    drawn = "\n".join("  " + "".join(line).rstrip() for line in grid)
    now = f"; now: {current.name}" if current is not None else ""
    return f"setup {setup}{now}\n{drawn}\n  {LEGEND}\n"


class Cavity(NamedTuple):
    """A cavity of the present setup: its place on the board, and a key of SIGNS."""

    name: str
    x_m: float
    y_m: float
    mark: str


def board(state: SessionState, cavities_m: Mapping[str, Vector], setup: str, now: str) -> list[Cavity]:
    """Each cavity of a setup that the session uses."""
    cavities = []
    for name, (x, y, _) in cavities_m.items():
        marks = {state.marks[key] for key in state.targets if key[:2] == (setup, name)}
        if marks:
            mark = "now" if name == now else marks.pop().value if len(marks) == 1 else "partly"
            cavities.append(Cavity(name, x, y, mark))
    return cavities


def status_text(state: SessionState) -> str:
    """How many points of each setup are done, left, skipped and bad."""
    lines = []
    for setup in dict.fromkeys(target.setup for target in state.targets.values()):
        marks = [state.marks[key] for key in state.targets if key[0] == setup]
        counts = ", ".join(f"{sum(m is mark for m in marks)} {mark.value}" for mark in Mark if mark in marks)
        names = _names(state, setup)
        what = "free poses" if setup == FREE else f"setup {setup}"
        lines.append(f"  {what}: {counts}{names}")
    return "\n".join(lines) + "\n"


def _names(state: SessionState, setup: str) -> str:
    """Skipped and bad points by name: they are few."""
    parts = []
    for mark in (Mark.SKIPPED, Mark.BAD):
        keys = [key for key, one in state.marks.items() if key[0] == setup and one is mark]
        if keys:
            parts.append(f"{mark.value}: {', '.join(_short(keys))}")
    return f" ({'; '.join(parts)})" if parts else ""


def _short(keys: Iterable[tuple[str, str, int]]) -> list[str]:
    return [point if repeat == 1 else f"{point} (repeat {repeat})" for _, point, repeat in keys]


class Words(Protocol):
    """Of one kind of session. `cavities_m`: of its board, for a drawing."""

    cavities_m: Mapping[str, Vector]

    def question(self, ask: Ask, target: Target) -> str:
        """The request to the operator."""

    def check(self, record: Record) -> str:
        """What to look at when a record departs from the others."""


class BoardWords:
    """At the cavities of a board, and at free poses."""

    def __init__(self, plan: SessionPlan, cavities_m: Mapping[str, Vector], table: Table | None) -> None:
        self._plan, self.cavities_m, self._table = plan, cavities_m, table

    def question(self, ask: Ask, target: Target) -> str:
        """The request to the operator."""
        if ask.question is SessionQuestion.BOARD:
            return f"set the board to {self._tilt(target.setup)}; Enter when it is in place"
        if ask.question is SessionQuestion.NEXT:
            side = f" from side {target.approach}" if self._plan.approaches > 1 and not target.is_free else ""
            where = "the pose" if target.is_free else f"above the cavity{side}"
            return f"hands off; Enter moves the arm to {where}"
        if ask.question is SessionQuestion.PICTURE:
            name = picture_name(target.setup, target.point, target.repeat)
            return f"take the picture {name}.png; Enter records the angles, `skip` if the board is not in it"
        if ask.question is SessionQuestion.TAKE:
            return "hold the arm by hand; Enter turns its drives off"
        if self._plan.seat == "jog":
            return f"jog the tip into cavity {target.point} (`jog z -5`); Enter when it is seated"
        return f"seat the tip in cavity {target.point} and hold it there; Enter when it is seated"

    def check(self, record: Record) -> str:
        """What to look at when a record departs from the others."""
        return f"that the tip is seated in {record.point}, the right cavity"

    def _tilt(self, setup: str) -> str:
        if self._table is None:
            return setup
        angles = {
            "normal": "normal: level",
            "roll": f"roll: {np.degrees(self._table.roll_tilt_rad):.1f} deg about its x axis",
            "pitch": f"pitch: {np.degrees(self._table.pitch_tilt_rad):.1f} deg about its y axis",
        }
        return angles.get(setup, setup)


class ContactWords:
    """Of two arms whose tips are brought together."""

    cavities_m: Mapping[str, Vector] = {}

    def __init__(self, plan: SessionPlan, names: tuple[str, str]) -> None:
        self._plan, self._names = plan, names

    def question(self, ask: Ask, target: Target) -> str:
        """The request to the operator."""
        far = f"{1e3 * target.distance_m:g} mm from the other" if target.distance_m else "where the other's is"
        if ask.question is SessionQuestion.NEXT:
            return "hands off both arms; Enter moves them to where their tips can meet"
        if ask.question is SessionQuestion.TAKE:
            return f"hold arm {ask.arm} by hand; Enter turns its drives off"
        if self._plan.seat == "jog":
            return f"jog the tips together, one {far} (`jog {self._names[0]} z -5`); Enter when they are in contact"
        place = "its place of the contact" if ask.arm == self._names[0] else far
        return f"bring the tip of {ask.arm} to {place} and hold it there; Enter turns its drives on"

    def check(self, record: Record) -> str:
        """What to look at when a record departs from the others."""
        distance_m = float(record.more[DISTANCE])
        return f"that both tips were in contact{f', {1e3 * distance_m:g} mm apart' if distance_m else ''}"


Say = Callable[[str], None]


class SessionOperator:
    """Prints the messages of a session and answers from lines. When they end, the answer is `quit`."""

    def __init__(self, folder: SessionFolder, words: Words, lines: Iterator[str], say: Say, may_auto: bool = False) -> None:
        """`may_auto`: a mock hand seats the tip, so questions may be answered automatically."""
        self._folder, self._words, self._lines, self._say = folder, words, lines, say
        self._may_auto = may_auto
        self._times_s: list[float] = []  # of the records
        self._auto: int | None = 0  # questions still to be answered automatically, None: all

    def run(self, talk: Talk) -> None:
        """Conduct the dialogue to its end."""
        try:
            saying = next(talk)
            while True:
                saying = talk.send(self._answer(saying))
        except StopIteration:
            return
        finally:
            talk.close()

    def _answer(self, saying: Saying) -> SessionCommand:
        if isinstance(saying, Ask):
            return self._asked(saying)
        if isinstance(saying, Recorded):
            self._say(self._recorded(saying))
            if saying.verdict.is_suspect:
                self._auto = 0
        else:
            self._say(f"{'! ' if saying.is_warning else ''}{saying.text}")
        return GO

    def _asked(self, ask: Ask) -> SessionCommand:
        """Show the question and read lines until one is an answer."""
        self._say(f"{self._prompt(ask)} >")
        while True:
            if self._auto is None and ask.question is not SessionQuestion.DONE:
                return GO
            if self._auto:
                self._auto -= 1
                return GO
            line = next(self._lines, self._answer_at_end(ask))
            try:
                command = parse_command(line)
                if isinstance(command, SessionCommand):
                    return command
                if isinstance(command, OperatorView):
                    self._show(command, ask)
                else:
                    self._start_auto(command)
            except BadCommand as error:
                self._say(f"! {error}")

    def _answer_at_end(self, ask: Ask) -> str:
        """The answer after the last line: the end of a mock session, or `quit`."""
        return "" if ask.question is SessionQuestion.DONE and self._may_auto else "quit"

    def _start_auto(self, command: Auto) -> None:
        if not self._may_auto:
            raise BadCommand("auto: only a session with a mock arm can answer automatically")
        self._auto = command.count

    def _show(self, view: OperatorView, ask: Ask) -> None:
        state = self._folder.state
        if view is OperatorView.HELP:
            self._say(HELP)
        elif view is OperatorView.STATUS:
            self._say(status_text(state))
        else:
            setup = ask.target.setup if ask.target is not None else self._folder.standing
            self._say(board_text(state, self._words.cavities_m, setup, ask.target))

    def _prompt(self, ask: Ask) -> str:
        state, target = self._folder.state, ask.target
        if target is None:
            return (
                f"All points are done ({state.count(Mark.DONE)} recorded). Enter ends the session, `redo` measures a point again"
            )
        done = len(state.targets) - len(state.left())
        where = f"[{done + 1}/{len(state.targets)}] {target.name}"
        return f"{where}: {self._words.question(ask, target)}"

    def _time_left(self, now_s: float) -> str:
        """How long the rest takes at the pace so far; nothing before the third record."""
        self._times_s.append(now_s)
        remaining, paces = len(self._folder.state.left()), len(self._times_s) - 1
        if paces < 2 or not remaining:
            return ""
        return f"; about {math.ceil((now_s - self._times_s[0]) / paces * remaining / 60.0)} min left"

    def _recorded(self, recorded: Recorded) -> str:
        """The record, the model error, and its agreement with earlier records."""
        record, verdict = recorded.record, recorded.verdict
        text = f"{self._folder.state.targets[record.key].name} recorded"
        if np.isfinite(verdict.error_m).all():
            text += f"; model error {1e3 * float(np.linalg.norm(verdict.error_m)):.2f} mm"
        if np.isfinite(verdict.off_sd):
            text += f", {1e3 * verdict.off_m:.2f} mm from the prediction of the earlier points"
        text += self._time_left(record.t_s)
        if verdict.is_suspect:
            text = (
                f"! {text}: {verdict.off_sd:.0f} standard deviations. Check {self._words.check(record)}. `redo` measures again,"
                " Enter keeps the record"
            )
        return text


def report(message: Mapping[str, object]) -> None:
    """Print a message as one line, flushed."""
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def tell(text: str) -> None:
    """Report a text of the session as a message."""
    is_warning = text.startswith("! ")
    report({"message": text.removeprefix("! ").rstrip("\n"), "is_warning": is_warning})


class Reporter(SessionOperator):
    """An `SessionOperator` whose questions and records are messages. Its `say` is `tell`."""

    def _answer(self, saying: Saying) -> SessionCommand:
        if not isinstance(saying, Recorded):
            return super()._answer(saying)
        verdict = saying.verdict
        report(
            {
                "recorded": self._folder.state.targets[saying.record.key].name,
                "point": saying.record.point,
                "text": self._recorded(saying).removeprefix("! "),
                "error_mm": _mm(float(np.linalg.norm(verdict.error_m))),
                "deviation_mm": _mm(verdict.off_m),
                "deviation_sd": _finite(verdict.off_sd),
                "is_suspect": verdict.is_suspect,
            }
        )
        if verdict.is_suspect:
            self._auto = 0
        return GO

    def _asked(self, ask: Ask) -> SessionCommand:
        state, target = self._folder.state, ask.target
        setup, now = (target.setup, target.point) if target is not None else (self._folder.standing, "")
        cavities = board(state, self._words.cavities_m, setup, now)
        report(
            {
                "ask": ask.question.name,
                "prompt": self._prompt(ask),
                "setup": setup,
                "point": now,
                "done": state.count(Mark.DONE),
                "left": state.count(Mark.LEFT),
                "board": [cavity._asdict() for cavity in cavities],
            }
        )
        return super()._asked(ask)


def _mm(length_m: float) -> float | None:
    return _finite(1e3 * length_m)


def _finite(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None


SPEED = 0.5  # of the joints' limits, for moves near people


@dataclass(frozen=True, slots=True)
class Interface:
    """The source of answers, the output and its form."""

    lines: Iterator[str]
    say: Callable[[str], None]
    operator: type[SessionOperator]

    @staticmethod
    def of(args: Namespace) -> Interface:
        """By the options --json and --replay."""
        say, operator = (tell, Reporter) if args.json else (_say, SessionOperator)
        lines = _replayed(Path(args.replay), say) if args.replay else _typed()
        return Interface(lines, say, operator)

    def introduce(self, folder: SessionFolder, how: str) -> None:
        """Say what session this is; `how`: of its board and seating."""
        plan, state = folder.plan, folder.state
        what = "resumed" if folder.is_resumed else "begun"
        self.say(
            f"session {folder.path} {what}: {len(plan.targets)} points, {state.count(Mark.DONE)} recorded; {how}; `help`"
            " lists the commands"
        )
        for warning in folder.warnings:
            self.say(f"! {warning}")

    def conduct(self, folder: SessionFolder, words: Words, talk: Talk, may_auto: bool) -> None:
        """The whole dialogue, then how many points there are."""
        self.operator(folder, words, self.lines, self.say, may_auto).run(talk)
        done, left = folder.state.count(Mark.DONE), folder.state.count(Mark.LEFT)
        self.say(f"{done} points recorded, {left} left: {folder.path / POINTS}")


def ready(client: ArmClient, name: str = "") -> Message:
    """Status of the homed and holding arm. ArmFaulted or ArmError say what is missing."""
    status, option = client.status(), f" --arm {name}" if name else ""
    if status["mode"] == "FAULT":
        raise ArmFaulted(fault_text(status))
    if not status["is_homed"]:
        raise ArmError(
            f"the arm {name}{' ' if name else ''}is not homed, so its joint angles are unknown: run `armwright enable{option}`,"
            f" then `armwright home{option}`"
        )
    if status["mode"] in ("GUIDING", "BRAKED"):  # a session was killed during hand guiding
        client.hold()
    elif status["mode"] != "HOLDING":
        raise ArmError(
            f"the arm {name}{' ' if name else ''}is {status['mode']}, expected HOLDING: run `armwright enable{option}`"
        )
    return status


def since_start_s(folder: SessionFolder, status: Message) -> float:
    """What to add to the runtime's clock, so that times count from the start of the session, by the host's clock."""
    return time.time() - datetime.fromisoformat(folder.started).timestamp() - float(status["t_s"])


def last_s(folder: SessionFolder) -> float:
    """When the last record was taken: a mock arm's clock restarts."""
    points = folder.points()
    return float(points.t_s.max()) if points is not None else 0.0


def require_same(folder: SessionFolder, fingerprint: str) -> None:
    """SessionError if the session belongs to other arm files."""
    if folder.plan.arm_sha256 != fingerprint:
        raise SessionError(
            f"{folder.path}: this session was started with arm {folder.plan.arm!r} and another version of its file:"
            " give that file with --arm, or --cell for two arms in contact"
        )


def _typed() -> Iterator[str]:
    """Lines from a terminal or a pipe."""
    while line := sys.stdin.readline():
        yield line


def _replayed(script: Path, say: Callable[[str], None]) -> Iterator[str]:
    """Lines of a script, echoed as they are used; `#` starts a comment."""
    try:
        text = script.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise SessionError(f"{script}: not UTF-8 text (byte {error.start})") from None
    return (_echoed(line, say) for line in text.splitlines() if not line.lstrip().startswith("#"))


def _echoed(line: str, say: Callable[[str], None]) -> str:
    if line.strip():
        say(f"  < {line.strip()}")
    return line


def _say(text: str) -> None:
    sys.stdout.write(folded(text if text.endswith("\n") else f"{text}\n", sys.stdout))
    sys.stdout.flush()

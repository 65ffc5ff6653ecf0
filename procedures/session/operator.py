"""The dialogue of a session as lines of text, from a terminal, a pipe or a script."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from calib.session.conversation import Talk
from calib.session.dialogue import GO, Ask, Command, Question, Recorded, Saying
from calib.session.folder import SessionFolder
from calib.session.state import Mark
from procedures.session.dialogue import HELP, Auto, BadCommand, View, parse_command
from procedures.session.drawing import board_text, status_text
from procedures.session.words import Words

Say = Callable[[str], None]


class Operator:
    """Prints the messages of a session and answers from lines. When they end, the answer is `quit`."""

    def __init__(
        self,
        folder: SessionFolder,
        words: Words,
        lines: Iterator[str],
        say: Say,
        may_auto: bool = False,
    ) -> None:
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

    def _answer(self, saying: Saying) -> Command:
        if isinstance(saying, Ask):
            return self._asked(saying)
        if isinstance(saying, Recorded):
            self._say(self._recorded(saying))
            if saying.verdict.is_suspect:
                self._auto = 0
        else:
            self._say(f"{'! ' if saying.is_warning else ''}{saying.text}")
        return GO

    def _asked(self, ask: Ask) -> Command:
        """Show the question and read lines until one is an answer."""
        self._say(f"{self._prompt(ask)} >")
        while True:
            if self._auto is None and ask.question is not Question.DONE:
                return GO
            if self._auto:
                self._auto -= 1
                return GO
            line = next(self._lines, self._answer_at_end(ask))
            try:
                command = parse_command(line)
                if isinstance(command, Command):
                    return command
                if isinstance(command, View):
                    self._show(command, ask)
                else:
                    self._start_auto(command)
            except BadCommand as error:
                self._say(f"! {error}")

    def _answer_at_end(self, ask: Ask) -> str:
        """The answer after the last line: the end of a mock session, or `quit`."""
        return "" if ask.question is Question.DONE and self._may_auto else "quit"

    def _start_auto(self, command: Auto) -> None:
        if not self._may_auto:
            raise BadCommand("auto: only a session with a mock arm can answer automatically")
        self._auto = command.count

    def _show(self, view: View, ask: Ask) -> None:
        state = self._folder.state
        if view is View.HELP:
            self._say(HELP)
        elif view is View.STATUS:
            self._say(status_text(state))
        else:
            setup = ask.target.setup if ask.target is not None else self._folder.standing
            self._say(board_text(state, self._words.cavities_m, setup, ask.target))

    def _prompt(self, ask: Ask) -> str:
        state, target = self._folder.state, ask.target
        if target is None:
            return (
                f"All points are done ({state.count(Mark.DONE)} recorded). Enter ends the session, `redo` measures a"
                " point again"
            )
        done = len(state.targets) - len(state.left())
        where = f"[{done + 1}/{len(state.targets)}] {target.name}"
        return f"{where}: {self._words.question(ask, target)}"

    def _time_left(self, now_s: float) -> str:
        """How long the rest takes at the pace so far; nothing before the third record."""
        self._times_s.append(now_s)
        left, paces = len(self._folder.state.left()), len(self._times_s) - 1
        if paces < 2 or not left:
            return ""
        return f"; about {math.ceil((now_s - self._times_s[0]) / paces * left / 60.0)} min left"

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

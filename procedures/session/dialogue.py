"""The operator's commands as text: what `armwright session` accepts from a terminal, a pipe or a script."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from enum import Enum

from calib.session.dialogue import GO, Command, Do, Jog

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


class View(Enum):
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


def parse_command(line: str) -> Command | View | Auto:
    """The command of a line. BadCommand if it is not valid."""
    text = line.strip()
    if not text:
        return GO
    word, _, rest = text.partition(" ")
    word, rest = word.lower(), rest.strip()
    if word in ("help", "?"):
        return View.HELP
    if word in (View.STATUS.value, View.BOARD.value) and not rest:
        return View(word)
    if word == "auto":
        return Auto(_count(rest) if rest else None)
    do = WORDS.get(word)
    if do is Do.NOTE:
        if not rest:
            raise BadCommand("note: expected a text")
        return Command(do, text=rest)
    if do is Do.JOG:
        return Command(do, jog=_jog(rest))
    if do is Do.QUIT and not rest:
        return Command(do)
    if do in (Do.SKIP, Do.REDO, Do.BAD):
        return _about_point(do, rest)
    raise BadCommand(f"unknown command: {text!r}; `help` lists the commands")


def _about_point(do: Do, rest: str) -> Command:
    """Nothing, a point, a setup and a point, and with both a repeat."""
    try:
        names = shlex.split(rest)
    except ValueError as error:
        raise BadCommand(f"{do.value}: {error}") from None
    if len(names) > 3:
        raise BadCommand(f"{do.value}: expected [[SETUP] POINT [N]], got {rest!r}")
    if not names:
        return Command(do)
    if len(names) == 1:
        return Command(do, point=names[0])
    return Command(do, names[0], names[1], _count(names[2]) if len(names) == 3 else None)


def _jog(rest: str) -> Jog:
    words = rest.split()
    try:
        *arm, axis, number = words
        step = float(number)
    except ValueError:
        arm, axis, step = [], "", math.nan
    if len(arm) > 1 or not math.isfinite(step):
        raise BadCommand(
            "jog: expected an axis and a step, such as `jog z -5` (mm) or `jog j2 0.5` (degrees), with two arms"
            " `jog left z -5`"
        )
    axis = axis.lower()
    return Jog(axis, (MM if axis in ("x", "y", "z") else DEGREE) * step, *arm)


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise BadCommand(f"expected a number from 1, got {text!r}")
    return int(text)

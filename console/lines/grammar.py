"""The grammar of operator lines in scripts and the console's command box: a subcommand and its options.

`move --joints 0 -0.8 0` does the same as `armwright move --joints 0 -0.8 0`. A line may end with `&`: the motion starts, and the
next line follows at once (`wait` waits for it). Empty lines and what follows a `#` are remarks.
"""

import argparse
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NoReturn

from console import options
from console.options import CommandSpec
from console.specs.end_effector import END_EFFECTOR
from console.specs.operating import OPERATING
from control.errors import ArmError

# These run until they are ended, read lines themselves, or command other arms than that of the lines.
NOT_HERE = ("serve", "mock", "console", "script", "view", "together", "follow")
IN_BACKGROUND = ("move", "go", "run")
BACKGROUND = "&"


class LineError(ArmError):
    """A line that is not a command, or not allowed here; the message states what was expected."""


@dataclass(frozen=True, slots=True)
class Line:
    """A parsed line: the command's name and its parsed options."""

    text: str
    command: str
    given: argparse.Namespace


class _Parser(argparse.ArgumentParser):
    """Raises an error instead of ending the program."""

    def error(self, message: str) -> NoReturn:
        raise LineError(message)


class Grammar:
    """Parses lines. `defaults` (arm, socket) apply unless a line gives its own."""

    def __init__(self, commands: tuple[CommandSpec, ...], defaults: Mapping[str, object]) -> None:
        self._specs = {spec.name: spec for spec in commands if spec.name not in NOT_HERE}
        self._elsewhere = {spec.name for spec in commands if spec.name in NOT_HERE}
        self._defaults = dict(defaults)
        self._moving = {spec.name for spec in (*OPERATING, *END_EFFECTOR)}

    @property
    def names(self) -> tuple[str, ...]:
        """The commands that a line may start with."""
        return tuple(self._specs)

    def line(self, text: str) -> Line | None:
        """The command of a line; None for a comment. LineError."""
        try:
            words = shlex.split(text, comments=True)
        except ValueError as error:
            raise LineError(f"{text.strip()!r}: {error}") from None
        if words[:1] == ["armwright"]:  # copied from a shell
            words = words[1:]
        if not words:
            return None
        in_background = words[-1] == BACKGROUND
        name, *rest = (words[:-1] if in_background else words) or [BACKGROUND]
        if in_background and name not in IN_BACKGROUND:
            raise LineError(f"{name}: `&` is only for motions: {', '.join(IN_BACKGROUND)}")
        given = self._parser(name).parse_args(rest)
        self._check_arm(name, given)
        given.command, given.module, given.waits = name, self._specs[name].module_name, not in_background
        text = shlex.join([name, *rest]) + (f" {BACKGROUND}" if in_background else "")
        return Line(text, name, given)

    def _check_arm(self, name: str, given: argparse.Namespace) -> None:
        """LineError for another arm: lines share one runtime, and a motion planned for another arm must not run on it."""
        if name not in self._moving:
            return
        for key in ("arm", "socket"):
            wanted = self._defaults.get(key)
            if key in self._defaults and getattr(given, key, wanted) != wanted:
                raise LineError(
                    f"{name}: --{key} {getattr(given, key)}, but all lines use --{key} {wanted or 'of the arm'}: omit"
                    " it"
                )

    def _parser(self, name: str) -> argparse.ArgumentParser:
        if name in self._elsewhere:
            raise LineError(f"{name}: not available here: run it in its own terminal")
        spec = self._specs.get(name)
        if spec is None:
            raise LineError(f"{name}: unknown command; expected one of {', '.join(self._specs)}")
        parser = _Parser(prog=name, add_help=False)
        options.add(parser, spec.options)
        known = {action.dest for action in parser._actions}
        parser.set_defaults(**{key: value for key, value in self._defaults.items() if key in known})
        return parser

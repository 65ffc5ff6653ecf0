"""Operator lines: the lines of a script and of the console's command box, and running them in order."""

from __future__ import annotations

import argparse
import contextlib
import io
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import NoReturn, TextIO

from console import options
from console.options import CommandSpec, runner
from console.specs.operating import END_EFFECTOR, OPERATING
from control.errors import ArmError
from control.server.client import ArmClient

# The grammar of operator lines in scripts and the console's command box: a subcommand and its options.
#
# `move --joints 0 -0.8 0` does the same as `armwright move --joints 0 -0.8 0`. A line may end with `&`: the
# motion starts, and the next line follows at once (`wait` waits for it). Empty lines and what follows a `#`
# are remarks.


# These run until they are ended, read lines themselves, or command other arms than that of the lines.
NOT_HERE = ("serve", "mock", "console", "script", "view", "together", "follow")
IN_BACKGROUND = ("move", "go", "run")
BACKGROUND = "&"


class LineError(ArmError):
    """A line that is not a command, or not allowed here; the message states what was expected."""


@dataclass(frozen=True, slots=True)
class ParsedLine:
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

    def line(self, text: str) -> ParsedLine | None:
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
        args = self._parser(name).parse_args(rest)
        self._check_arm(name, args)
        args.command, args.module, args.waits = name, self._specs[name].module_name, not in_background
        text = shlex.join([name, *rest]) + (f" {BACKGROUND}" if in_background else "")
        return ParsedLine(text, name, args)

    def _check_arm(self, name: str, args: argparse.Namespace) -> None:
        """LineError for another arm: lines share one runtime, and a motion planned for another arm must not run on it."""
        if name not in self._moving:
            return
        for key in ("arm", "socket"):
            wanted = self._defaults.get(key)
            if key in self._defaults and getattr(args, key, wanted) != wanted:
                raise LineError(
                    f"{name}: --{key} {getattr(args, key)}, but all lines use --{key} {wanted or 'of the arm'}: omit it"
                )

    def _parser(self, name: str) -> argparse.ArgumentParser:
        if name in self._elsewhere:
            raise LineError(f"{name}: not available here: run it in its own terminal")
        spec = self._specs.get(name)
        if spec is None:
            near = get_close_matches(name, self._specs, 2)
            meant = f" (did you mean {' or '.join(near)}?)" if near else ""
            raise LineError(f"{name[:40]}: unknown command{meant}; `help` and `armwright --help` list them")
        parser = _Parser(prog=name, add_help=False)
        options.add(parser, spec.options)
        known = {action.dest for action in parser._actions}
        parser.set_defaults(**{key: value for key, value in self._defaults.items() if key in known})
        return parser


NAMED_MOST = 5  # invalid lines of a script


@dataclass(frozen=True, slots=True)
class LineOutcome:
    """The outcome of a line: its number in the file, the subcommand's exit status, its output, its duration.

    `transcript` is standard output and error; `output` is standard output only, as errors were shown immediately.
    """

    number: int
    line: str
    status: int
    transcript: str
    output: str
    took_s: float


def parse_lines(lines: Iterable[str], grammar: Grammar) -> list[tuple[int, ParsedLine]]:
    """All lines with their numbers, from 1. LineError names the invalid ones, before anything is done."""
    parsed: list[tuple[int, ParsedLine]] = []
    wrong: list[str] = []
    for number, text in enumerate(lines, 1):
        try:
            line = grammar.line(text)
        except LineError as error:
            wrong.append(f"line {number}: {error}")
            continue
        if line is not None:
            parsed.append((number, line))
    if wrong:
        more = [f"and {len(wrong) - NAMED_MOST} more"] if len(wrong) > NAMED_MOST else []
        raise LineError("\n  ".join(wrong[:NAMED_MOST] + more))
    return parsed


def replay(lines: Iterable[tuple[int, ParsedLine]], connect: Callable[[], ArmClient], say: Callable[[LineOutcome], None]) -> int:
    """Run lines until the first that fails; returns its exit status, or 0.

    They share one connection, opened by the first that needs it: a motion started by a line belongs to the script. When
    the script ends, the motion is stopped.
    """
    shared = _SharedClient(connect)
    try:
        for number, line in lines:
            outcome = _run(number, line, shared)
            say(outcome)
            if outcome.status:
                return outcome.status
    finally:
        shared.close()
    return 0


class _SharedClient:
    """The script's connection, opened on first use."""

    def __init__(self, connect: Callable[[], ArmClient]) -> None:
        self._connect = connect
        self._client: ArmClient | None = None

    def __call__(self) -> ArmClient:
        if self._client is None:
            self._client = self._connect()
        return self._client

    def close(self) -> None:
        if self._client is not None:
            self._client.close()


def _run(number: int, line: ParsedLine, connect: Callable[[], ArmClient]) -> LineOutcome:
    from console.main import run

    line.given.connect = connect
    transcript, output = io.StringIO(), io.StringIO()
    begun_s = time.monotonic()
    stdout, stderr = _Tee(transcript, output), _Tee(transcript, sys.stderr)
    with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        status = run(runner(line.given.module, line.command), line.given)
    return LineOutcome(number, line.text, status, transcript.getvalue(), output.getvalue(), time.monotonic() - begun_s)


class _Tee(io.TextIOBase):
    """Writes to two streams."""

    def __init__(self, first: TextIO, second: TextIO) -> None:
        self._first, self._second = first, second

    def write(self, text: str) -> int:
        self._second.write(text)
        return self._first.write(text)

    def flush(self) -> None:
        self._second.flush()

    def isatty(self) -> bool:
        return False

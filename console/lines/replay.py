"""Runs operator lines one after the other over one connection, and stops at the first that fails."""

import contextlib
import importlib
import io
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TextIO

from console.lines.grammar import Grammar, Line, LineError
from control.server.client import ArmClient


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a line: its number in the file, exit status as of the subcommand, what it wrote, how long it took.

    `said` is all of it; `output` what it wrote to standard output, as errors have been seen when they came.
    """

    number: int
    line: str
    status: int
    said: str
    output: str
    took_s: float


def parse_lines(lines: Iterable[str], grammar: Grammar) -> list[tuple[int, Line]]:
    """All lines with their numbers, from 1. LineError names every line that is wrong, before anything is done."""
    found: list[tuple[int, Line]] = []
    wrong: list[str] = []
    for number, text in enumerate(lines, 1):
        try:
            line = grammar.line(text)
        except LineError as error:
            wrong.append(f"line {number}: {error}")
            continue
        if line is not None:
            found.append((number, line))
    if wrong:
        raise LineError("\n  ".join(wrong))
    return found


def replay(
    lines: Iterable[tuple[int, Line]], connect: Callable[[], ArmClient], say: Callable[[Outcome], None]
) -> int:
    """Run lines until the first that fails; returns its exit status, or 0.

    They share one connection, made for the first that needs it: a motion that a line began belongs to the script. When
    the script ends, so does the motion.
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
    """The script's connection, made when it is first wanted."""

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


def _run(number: int, line: Line, connect: Callable[[], ArmClient]) -> Outcome:
    from console.main import run

    line.given.connect = connect
    said, output = io.StringIO(), io.StringIO()
    begun_s = time.monotonic()
    with contextlib.redirect_stdout(_Tee(said, output)), contextlib.redirect_stderr(_Tee(said, sys.stderr)):
        module = importlib.import_module(f"console.commands.{line.given.module}")
        status = run(module.run, line.given)
    return Outcome(number, line.text, status, said.getvalue(), output.getvalue(), time.monotonic() - begun_s)


class _Tee(io.TextIOBase):
    """Writes to two streams."""

    def __init__(self, one: TextIO, other: TextIO) -> None:
        self._one, self._other = one, other

    def write(self, text: str) -> int:
        self._other.write(text)
        return self._one.write(text)

    def flush(self) -> None:
        self._other.flush()

    def isatty(self) -> bool:
        return False

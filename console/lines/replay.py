"""Runs operator lines in order over one connection, and stops at the first failure."""

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

NAMED_MOST = 5  # invalid lines of a script


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a line: its number in the file, the subcommand's exit status, its output, its duration.

    `transcript` is standard output and error; `output` is standard output only, as errors were shown immediately.
    """

    number: int
    line: str
    status: int
    transcript: str
    output: str
    took_s: float


def parse_lines(lines: Iterable[str], grammar: Grammar) -> list[tuple[int, Line]]:
    """All lines with their numbers, from 1. LineError names the invalid ones, before anything is done."""
    parsed: list[tuple[int, Line]] = []
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


def replay(
    lines: Iterable[tuple[int, Line]], connect: Callable[[], ArmClient], say: Callable[[Outcome], None]
) -> int:
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


def _run(number: int, line: Line, connect: Callable[[], ArmClient]) -> Outcome:
    from console.main import run

    line.given.connect = connect
    transcript, output = io.StringIO(), io.StringIO()
    begun_s = time.monotonic()
    stdout, stderr = _Tee(transcript, output), _Tee(transcript, sys.stderr)
    with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        module = importlib.import_module(f"console.commands.{line.given.module}")
        status = run(module.run, line.given)
    return Outcome(
        number, line.text, status, transcript.getvalue(), output.getvalue(), time.monotonic() - begun_s
    )


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

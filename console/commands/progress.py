"""What a command tells its user: its result, warnings, and its progress, as a bar with the remaining time on a terminal."""

import argparse
import contextlib
import select
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

from control.plain_text import aligned, folded
from control.server.channel import Message, RuntimeGone
from control.server.client import ArmClient, RequestRefused

LINES = 10  # of a job, without a terminal


def to_type(*words: object) -> str:
    """The command line of these words, as a shell takes it."""
    return shlex.join(["armwright", *map(str, words)])


def say(text: str) -> None:
    """Print sentences and tables, no wider than the terminal."""
    sys.stdout.write(folded(f"{text}\n", sys.stdout))


def warn(sentences: Iterable[str]) -> None:
    """Tell the operator, beside the results."""
    sys.stderr.writelines(folded(f"armwright: warning: {sentence}\n", sys.stderr) for sentence in sentences)


def answer(args: argparse.Namespace, content: object, text: str, files: Mapping[str, Path] | None = None) -> None:
    """Print a result: with --json `content` (a path is a file that holds it), else `text` and where the files are."""
    if args.json:
        from calib.results import json_text

        sys.stdout.write(content.read_text("utf-8") if isinstance(content, Path) else json_text(content))
        return
    where = aligned([(what, str(file)) for what, file in (files or {}).items()], left=2, indent="  ")
    said = folded(text.rstrip("\n"), sys.stdout)
    sys.stdout.write("\n\n".join(filter(None, (said, where))) + "\n")


class Bar:
    """Shows the progress of a job; a context manager. Where output goes to a file, it writes some lines."""

    def __init__(self, title: str) -> None:
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.table import Column

        self._is_terminal = sys.stderr.isatty()
        self._title = title
        self._last = -1
        self._done = 0.0
        self._began_s = time.monotonic()
        from rich.console import Console

        words = max(10, min(32, shutil.get_terminal_size().columns - 32))  # a share and two times stand beside them
        self._progress = Progress(
            TextColumn("{task.description}", table_column=Column(width=words, no_wrap=True, overflow="ellipsis")),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._task = self._progress.add_task(title, total=1.0)

    def __enter__(self) -> Self:
        if self._is_terminal:
            self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        if kind is None and self._done > 0.0:
            self.advance("done", 1.0)
        if self._is_terminal:  # rich ends with an empty line otherwise
            self._progress.stop()

    def advance(self, what: str, done: float) -> None:
        """Set the share done, 0 to 1, and the present step. The share never falls and never exceeds 1."""
        done = self._done = min(max(done, self._done), 1.0)
        if self._is_terminal:
            self._progress.update(self._task, completed=done, description=what)
            return
        step = int(done * LINES)
        if step != self._last:
            self._last = step
            passed_s = time.monotonic() - self._began_s
            step_name = f": {what}" if what != self._title else ""
            left = f", about {passed_s * (1.0 - done) / done:.0f} s left" if 0.0 < done < 1.0 else ""
            sys.stderr.write(f"{self._title}: {done:4.0%} after {passed_s:.0f} s{left}{step_name}\n")
            sys.stderr.flush()


def has_line() -> bool:
    """Whether a line was typed at the terminal; it is read."""
    is_there = sys.stdin.isatty() and bool(select.select([sys.stdin], [], [], 0.0)[0])
    return is_there and bool(sys.stdin.readline())


QUIET_S = 1.0  # most commands are done by then
QUARTERS = 4  # of a motion, without a terminal


class Progress:
    """Called with every `mode` answer; shows the state of the arm, or the progress of its motion.

    Where somebody else has paused the motion, Enter at this terminal calls `resume`: only the client that began it may.
    """

    def __init__(self, title: str, resume: Callable[[], None] | None = None, stream: TextIO | None = None) -> None:
        self._title, self._stream = title, stream or sys.stderr
        self._resume = resume if sys.stdin.isatty() else None
        self._is_terminal = self._stream.isatty()
        self._begun_s = time.monotonic()
        self._last: object = None
        self._is_drawn = self._is_paused = False

    def __call__(self, answer: Message) -> None:
        self._look_for_enter(answer["mode"] == "PAUSED")
        passed_s = time.monotonic() - self._begun_s
        if passed_s < QUIET_S:
            return
        percent = f"{100.0 * answer['progress']:.0f} %" if answer["mode"] in ("MOVING", "PAUSED") else ""
        if self._is_paused:
            percent = f"paused at {percent}{', Enter resumes' if self._resume else ''}"
        step = answer["step"] or percent or str(answer["mode"]).lower()
        if self._is_terminal:
            width = shutil.get_terminal_size().columns - 1  # a line that wraps is not erased: each redraw would add one
            self._stream.write(f"\r\x1b[K{f'{self._title}: {step}, {passed_s:.0f} s'[:width]}")
            self._is_drawn = True
        elif (mark := (answer["step"], answer["mode"], int(QUARTERS * answer["progress"]))) != self._last:
            self._last = mark
            self._stream.write(f"{self._title}: {step}\n")
        self._stream.flush()

    def _look_for_enter(self, is_paused: bool) -> None:
        was_paused, self._is_paused = self._is_paused, is_paused
        if self._resume is None or not is_paused:
            return
        if was_paused and has_line():
            with contextlib.suppress(RequestRefused):  # stopped meanwhile
                self._resume()
        while not was_paused and has_line():  # typed before: no answer to the pause
            pass

    def close(self) -> None:
        """Erase the line."""
        if self._is_drawn:
            self._stream.write("\r\x1b[K")
            self._stream.flush()
            self._is_drawn = False


@contextlib.contextmanager
def shown(client: ArmClient, args: argparse.Namespace, title: str = "") -> Iterator[None]:
    """Show progress while open, and how it ended; not in a script, whose lines report themselves."""
    if getattr(args, "connect", None) is not None:
        yield
        return
    is_others = args.command == "wait"  # for a motion that another client began, and may resume
    progress = Progress(title or args.command, None if is_others else client.resume)
    client.on_wait = progress
    try:
        yield
    finally:
        client.on_wait = None
        progress.close()
    mode = "the runtime has ended"
    with contextlib.suppress(RuntimeGone):
        mode = str(client.ask("mode")["mode"]).lower()
    sys.stderr.write(f"{title or args.command}: {mode}\n")

"""Shows progress on standard error while a command waits for the arm: one line, redrawn on a terminal."""

import argparse
import contextlib
import sys
import time
from collections.abc import Iterator

from control.server.channel import Message, RuntimeGone
from control.server.client import ArmClient

QUIET_S = 1.0  # most commands are done by then
QUARTERS = 4  # of a motion, without a terminal


class Progress:
    """Called with every `mode` answer; shows the state of the arm, or the progress of its motion."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._is_terminal = sys.stderr.isatty()
        self._begun_s = time.monotonic()
        self._last: object = None
        self._is_drawn = False

    def __call__(self, answer: Message) -> None:
        passed_s = time.monotonic() - self._begun_s
        if passed_s < QUIET_S:
            return
        percent = f"{100.0 * answer['progress']:.0f} %" if answer["mode"] in ("MOVING", "PAUSED") else ""
        step = answer["step"] or percent or str(answer["mode"]).lower()
        if self._is_terminal:
            sys.stderr.write(f"\r\x1b[K{self._title}: {step}, {passed_s:.0f} s")
            self._is_drawn = True
        elif (mark := (answer["step"], answer["mode"], int(QUARTERS * answer["progress"]))) != self._last:
            self._last = mark
            sys.stderr.write(f"{self._title}: {step}\n")
        sys.stderr.flush()

    def close(self) -> None:
        """Erase the line."""
        if self._is_drawn:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()


@contextlib.contextmanager
def shown(client: ArmClient, given: argparse.Namespace, title: str = "") -> Iterator[None]:
    """Show progress while open, and how it ended; not in a script, whose lines report themselves."""
    if getattr(given, "connect", None) is not None:
        yield
        return
    progress = Progress(title or given.command)
    client.on_wait = progress
    try:
        yield
    finally:
        client.on_wait = None
        progress.close()
    mode = "the runtime has ended"
    with contextlib.suppress(RuntimeGone):
        mode = str(client.ask("mode")["mode"]).lower()
    sys.stderr.write(f"{title or given.command}: {mode}\n")

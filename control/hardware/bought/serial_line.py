"""What bought boards on serial lines have in common that speak only when asked: their lines, and the time these need."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from control.hardware.boards import Opened, collect
from control.model.arm import Board
from firmware_iface.errors import LinkError, MisuseError
from firmware_iface.link import ByteLink
from firmware_iface.polled_line import PolledLine
from firmware_iface.serial_link import open_serial

TURN_AROUND_S = 0.0005  # from a request's last byte to the answer's first, and from there to the next request
# A line is looked at every quarter of a millisecond, so a read that may wait for the kernel comes once in 10 ms at most.
LOOKS_BEFORE_A_READ = 40


class AskedBoard(Protocol):
    """A board on a line."""

    problems: list[LinkError]


class PolledBoards:
    """A line, as the loop drains it; meets `control.hardware.boards.Line` and `AskedLine`."""

    def __init__(self, line: PolledLine, boards: Iterable[AskedBoard], post_cycle: Callable[[], None]) -> None:
        """`post_cycle` queues the questions of a cycle."""
        self._line, self._boards, self._post_cycle = line, tuple(boards), post_cycle
        self.attend = line.attend

    def update(self) -> None:
        """Take what has arrived. Raises LinkLost, BoardReset."""
        self._line.update()
        for board in self._boards:
            if board.problems:
                raise board.problems.pop(0)

    def flush(self) -> None:
        """Queue the cycle's questions and send the first; the others follow while the loop waits."""
        self._post_cycle()
        self._line.update()


def require_fit(boards: str, needed_s: float, period_s: float, remedy: str) -> None:
    """Raise MisuseError if the packets of a cycle need longer than the loop has.

    `boards`: whose they are, as `on_line` says it. `remedy`: besides a slower loop.
    """
    if needed_s > period_s:
        raise MisuseError(
            f"{boards} need {needed_s * 1e3:.1f} ms per cycle, the loop has {period_s * 1e3:.1f} ms: serve with --rate"
            f" {math.floor(1.0 / needed_s)} or less, or {remedy}"
        )


def on_line(called: str, boards: Sequence[Board], link: ByteLink) -> str:
    """The boards of a line in messages, `called` so."""
    return f"{called} line {boards[0].port}: {len(boards)} boards at {link.baud} baud"


def open_lines(boards: Sequence[Board], opened: Opened, open_on: Callable[[ByteLink, Sequence[Board]], PolledBoards]) -> None:
    """Open the line of each port with its boards; failures are noted in `opened`."""
    for port in dict.fromkeys(board.port for board in boards):
        on_it = [board for board in boards if board.port == port]
        with collect(opened.failures):
            link = open_serial(port, on_it[0].baud, LOOKS_BEFORE_A_READ)
            opened.closers.append(link.close)
            polled = open_on(link, on_it)
            opened.lines.append(polled)
            opened.polled.append(polled)

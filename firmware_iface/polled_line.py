"""A serial line whose boards speak only when asked: one question at a time, answered or given up before the next is sent.

The line lives from being looked at: `update` in the cycle, and `attend` while the loop waits for the next one. Only `converse`
blocks, which is for use outside of the cycle.
"""

from collections import deque
from collections.abc import Callable
from typing import Final, Protocol

from firmware_iface.clock import Clock
from firmware_iface.errors import BoardSilent, LinkError, Problems
from firmware_iface.link import ByteLink

ATTEMPTS = 3
WRONG: Final = None
_STEP_s = 0.0005
_BITS_PER_BYTE = 10  # 8N1


class Unfinished(Exception):
    """The answer is not complete yet."""


class Question(Protocol):
    """A request and what its answer must be. The packet is made when it is sent, so that what is sent is the newest."""

    @property
    def answer_bytes(self) -> int:
        """The most bytes of an answer; 0: there is none."""
        ...

    def packet(self) -> bytes:
        """The bytes to send."""
        ...

    def answered(self, received: bytes) -> bytes | None:
        """The data in an answer, WRONG if it is not one. Raises Unfinished."""
        ...

    def take(self, data: bytes, sent_at_s: float) -> None:
        """Use the data; `sent_at_s` is when the request was sent, on the host's clock."""
        ...


class PolledLine:
    """One line and its queue of questions. `timeouts` and `wrong_answers` count what did not come or was not right.

    `late_s`: how much later than its quickest answer the newest one was read. Its values are at most by this younger than
    their question, wherever the time went: in the host, the adapter or the board.
    """

    def __init__(self, link: ByteLink, clock: Clock, timeout_s: float) -> None:
        """`timeout_s`: how long a board may take to answer, besides the time of the bytes."""
        self.name = link.name
        self.baud = link.baud
        self.timeouts = 0
        self.wrong_answers = 0
        self.late_s = 0.0
        self.clock = clock
        self._timeout_s = timeout_s
        self._link = link
        self._queue: deque[Question] = deque()
        self._idle: list[Question] = []
        self._starved: list[Question] = []
        self._waiting: Question | None = None
        self._sent_at_s = 0.0
        self._give_up_s = 0.0
        self._received = b""
        self._quickest_s: dict[Question, float] = {}
        self._problems = Problems()  # that `attend` met

    def post(self, question: Question) -> None:
        """Queue a question; one that still waits in the queue is not queued twice."""
        if question not in self._queue:
            self._queue.append(question)

    def withdraw(self, question: Question) -> None:
        """Take it back if it still waits in the queue."""
        if question in self._queue:
            self._queue.remove(question)

    def keep_asking(self, question: Question) -> None:
        """Ask it whenever nothing else is to be asked; see `post_starved`."""
        self._idle.append(question)
        self._starved.append(question)

    def post_starved(self) -> None:
        """Queue what was to be asked in idle time, and had none since the last call: a slow line asks all in turn."""
        for question in self._starved:
            self.post(question)
        self._starved = self._idle[:]

    def update(self) -> None:
        """Take what has arrived, and send the next question if the line is free. Raises LinkLost, and what `attend` met."""
        if self._problems:
            raise self._problems.pop(0)
        self._look()

    def attend(self) -> None:
        """The same while the loop waits: a problem is raised by the next `update`."""
        try:
            self._look()
            if self._waiting is None and self._idle:
                question = self._idle.pop(0)
                self._idle.append(question)
                self._send(question)
        except LinkError as problem:
            self._problems.append(problem)

    def shout(self, packets: bytes) -> None:
        """Send commands at once, whatever is under way; their answers are not awaited. Raises LinkLost."""
        self._queue.clear()
        self._waiting = None
        self._link.write(packets)

    def converse(self, question: Question, is_answered: Callable[[], bool], what: str, remedy: str) -> None:
        """Ask outside of the cycle, and wait for the answer. Raises BoardSilent."""
        for _ in range(ATTEMPTS):
            self._queue.appendleft(question)
            while not is_answered() and (question is self._waiting or question in self._queue):
                self.clock.wait_until_s(self.clock.now_s() + _STEP_s)
                self._look()
            if is_answered():
                return
        raise BoardSilent(
            f"{what} within {self._timeout_s:.3f} s, asked {ATTEMPTS} times ({self.timeouts} time-outs and"
            f" {self.wrong_answers} wrong answers on this line so far); {remedy} and baud rate ({self.baud})"
        )

    def _look(self) -> None:
        received = self._link.read()
        if self._waiting is not None:
            self._received += received
            self._take(self._waiting)
        if self._waiting is None and self._queue:
            self._send(self._queue.popleft())

    def _send(self, question: Question) -> None:
        self._link.read()  # what came unasked answers nothing
        if question in self._starved:
            self._starved.remove(question)
        packet = question.packet()
        self._sent_at_s = self.clock.now_s()
        way_s = (len(packet) + question.answer_bytes) * _BITS_PER_BYTE / self.baud if self.baud else 0.0
        self._give_up_s = self._sent_at_s + self._timeout_s + way_s
        self._waiting, self._received = (question if question.answer_bytes else None), b""
        self._link.write(packet)

    def _miss(self, question: Question) -> None:
        """A question was given up, or its answer was wrong: nothing else is asked for it."""

    def _take(self, question: Question) -> None:
        """Take the answer if it is complete, or give it up."""
        try:
            data = question.answered(self._received)
        except Unfinished:
            if self.clock.now_s() > self._give_up_s:
                self.timeouts += 1
                self._waiting = None
                self._miss(question)
            return
        self._waiting = None
        if data is WRONG:
            self.wrong_answers += 1
            self._miss(question)
        else:
            took_s = self.clock.now_s() - self._sent_at_s
            quickest_s = self._quickest_s.get(question, took_s)
            if took_s <= quickest_s:
                self._quickest_s[question] = quickest_s = took_s
            self.late_s = took_s - quickest_s
            question.take(data, self._sent_at_s)

"""A serial line with RoboClaw boards: one question at a time, answered or given up before the next is sent.

The boards say nothing by themselves, so the line lives from being looked at: `update` in the cycle, and `attend` while the loop
waits for the next one. Nothing here blocks but `ask`, which is for use outside of the cycle.
"""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from firmware_iface.clock import Clock
from firmware_iface.errors import BoardSilent, LinkError
from firmware_iface.link import ByteLink
from firmware_iface.roboclaw import wire

ATTEMPTS = 3
_STEP_s = 0.0005
_BITS_PER_BYTE = 10  # 8N1
# The board answers within 2 ms; the manual's own time-out is also what clears its packet buffer.
ANSWER_TIMEOUT_s = wire.PACKET_GAP_s
VERSION_BYTES = -1  # as `reply_bytes`: text that ends with 0


class Question(NamedTuple):
    """A request whose answer is awaited. `data` is made when it is sent, so that what is sent is the newest.

    `reply_bytes`: of data, without the CRC; None: an acknowledgement; VERSION_BYTES: text. `take` gets the data and when the
    request was sent, on the host's clock.
    """

    address: int
    command: int
    reply_bytes: int | None
    take: Callable[[bytes, float], None]
    data: Callable[[], bytes] | None = None

    def packet(self) -> bytes:
        """The bytes to send."""
        if self.reply_bytes is not None:
            return wire.read_packet(self.address, self.command)
        return wire.command_packet(self.address, self.command, self.data() if self.data else b"")


class PacketLine:
    """One line and its queue of questions. `timeouts` and `crc_errors` count the answers that did not come or were wrong."""

    def __init__(self, link: ByteLink, clock: Clock) -> None:
        self.name = link.name
        self.timeouts = 0
        self.crc_errors = 0
        self._link = link
        self._clock = clock
        self._queue: deque[Question] = deque()
        self._idle: list[Question] = []
        self._waiting: Question | None = None
        self._sent_at_s = 0.0
        self._give_up_s = 0.0
        self._received = b""
        self._problem: LinkError | None = None

    # ---- without blocking

    def post(self, question: Question) -> None:
        """Queue a question; one that still waits in the queue is not queued twice."""
        if question not in self._queue:
            self._queue.append(question)

    def keep_asking(self, question: Question) -> None:
        """Ask it whenever nothing else is to be asked."""
        self._idle.append(question)

    def update(self) -> None:
        """Take what has arrived, and send the next question if the line is free. Raises LinkLost, and what `attend` met."""
        problem, self._problem = self._problem, None
        self._look()
        if problem is not None:
            raise problem

    def attend(self) -> None:
        """The same while the loop waits: a problem is raised by the next `update`."""
        try:
            self._look()
            if self._waiting is None and self._idle:
                question = self._idle.pop(0)
                self._idle.append(question)
                self._send(question)
        except LinkError as problem:
            self._problem = problem

    def shout(self, packets: bytes) -> None:
        """Send commands at once, whatever is under way; their acknowledgements are not awaited. Raises LinkLost."""
        self._queue.clear()
        self._waiting = None
        self._link.write(packets)

    def _look(self) -> None:
        received = self._link.read()
        if self._waiting is not None:
            self._received += received
            self._take(self._waiting)
        if self._waiting is None and self._queue:
            self._send(self._queue.popleft())

    def _send(self, question: Question) -> None:
        self._link.read()  # what came unasked answers nothing
        packet = question.packet()
        self._waiting, self._received = question, b""
        self._sent_at_s = self._clock.now_s()
        self._give_up_s = self._sent_at_s + ANSWER_TIMEOUT_s + self._way_s(len(packet), question)
        self._link.write(packet)

    def _way_s(self, sent_bytes: int, question: Question) -> float:
        """How long the bytes of request and answer are on the line."""
        answer = question.reply_bytes or 0
        answer_bytes = (wire.LONGEST_VERSION if answer == VERSION_BYTES else answer) + 2
        baud = self._link.baud
        return (sent_bytes + answer_bytes) * _BITS_PER_BYTE / baud if baud else 0.0

    def _take(self, question: Question) -> None:
        """Take the answer if it is complete, or give it up."""
        wanted = _length(question, self._received)
        if wanted is None or len(self._received) < wanted:
            if self._clock.now_s() > self._give_up_s:
                self.timeouts += 1
                self._waiting = None
            return
        answer, self._waiting = self._received[:wanted], None
        if question.reply_bytes is None:
            data = b"" if answer[0] == wire.ACKNOWLEDGED else None
        else:
            data = wire.reply_data(question.address, question.command, answer)
        if data is None:
            self.crc_errors += 1
        else:
            question.take(data, self._sent_at_s)

    # ---- outside of the cycle

    def read(self, address: int, command: int, reply_bytes: int, where: str) -> bytes:
        """Read something from a board; waits. Raises BoardSilent."""
        return self._ask(address, command, reply_bytes, None, where)

    def command(self, address: int, command: int, data: bytes, where: str) -> None:
        """Set or command something, and wait for the acknowledgement. Raises BoardSilent."""
        self._ask(address, command, None, lambda: data, where)

    def _ask(
        self,
        address: int,
        command: int,
        reply_bytes: int | None,
        data: Callable[[], bytes] | None,
        where: str,
    ) -> bytes:
        answers: list[bytes] = []
        question = Question(address, command, reply_bytes, lambda got, _: answers.append(got), data)
        for _ in range(ATTEMPTS):
            self._queue.appendleft(question)
            while not answers and (question is self._waiting or question in self._queue):
                self._clock.wait_until_s(self._clock.now_s() + _STEP_s)
                self._look()
            if answers:
                return answers[0]
        raise BoardSilent(
            f"{where}: no answer to command {command} within {ANSWER_TIMEOUT_s:.3f} s, asked {ATTEMPTS} times"
            f" ({self.timeouts} time-outs and {self.crc_errors} wrong answers on this line so far); check its supply, packet"
            f" serial mode, address {address:#04x} and baud rate ({self._link.baud})"
        )


def _length(question: Question, received: bytes) -> int | None:
    """Length of the whole answer; None while it is unknown."""
    if question.reply_bytes is None:
        return 1
    if question.reply_bytes != VERSION_BYTES:
        return question.reply_bytes + 2
    end = received.find(0)
    return None if end < 0 else end + 3

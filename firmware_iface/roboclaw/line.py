"""A serial line with RoboClaw boards."""

from collections.abc import Callable
from dataclasses import dataclass

from firmware_iface.clock import Clock
from firmware_iface.link import ByteLink
from firmware_iface.polled_line import WRONG, PolledLine, Unfinished
from firmware_iface.roboclaw import wire

# The board answers within 2 ms; the manual's own time-out is also what clears its packet buffer.
ANSWER_TIMEOUT_s = wire.PACKET_GAP_s
VERSION_BYTES = -1  # as `reply_bytes`: text that ends with 0


@dataclass(frozen=True, slots=True, eq=False)
class RoboclawQuestion:
    """A command of the manual and its answer; meets `firmware_iface.polled_line.Question`.

    `reply_bytes`: of data, without the CRC; several, ascending, where firmwares differ; None: an acknowledgement; VERSION_BYTES:
    text. `take` gets the data and when the request was sent, on the host's clock.
    """

    address: int
    command: int
    reply_bytes: int | tuple[int, ...] | None
    take: Callable[[bytes, float], None]
    data: Callable[[], bytes] | None = None

    @property
    def answer_bytes(self) -> int:
        """The most bytes of its answer."""
        if self.reply_bytes is None:
            return 1
        if isinstance(self.reply_bytes, tuple):
            return self.reply_bytes[-1] + 2
        return (wire.LONGEST_VERSION if self.reply_bytes == VERSION_BYTES else self.reply_bytes) + 2

    def packet(self) -> bytes:
        """The bytes to send."""
        if self.reply_bytes is not None:
            return wire.read_packet(self.address, self.command)
        return wire.command_packet(self.address, self.command, self.data() if self.data else b"")

    def answered(self, received: bytes) -> bytes | None:
        """The data in an answer. Raises Unfinished."""
        for wanted in self._lengths(received):
            if len(received) < wanted:
                raise Unfinished
            if self.reply_bytes is None:
                return b"" if received[0] == wire.ACKNOWLEDGED else WRONG
            if (data := wire.reply_data(self.address, self.command, received[:wanted])) is not None:
                return data
        return WRONG

    def _lengths(self, received: bytes) -> tuple[int, ...]:
        """Lengths that the whole answer may have. Raises Unfinished while they are unknown."""
        if isinstance(self.reply_bytes, tuple):
            return tuple(count + 2 for count in self.reply_bytes)
        if self.reply_bytes != VERSION_BYTES:
            return (self.answer_bytes,)
        if (end := received.find(0)) < 0:
            raise Unfinished
        return (end + 3,)


class PacketLine(PolledLine):
    """One line with up to eight boards."""

    def __init__(self, link: ByteLink, clock: Clock) -> None:
        super().__init__(link, clock, ANSWER_TIMEOUT_s)

    def read(self, address: int, command: int, reply_bytes: int | tuple[int, ...], where: str) -> bytes:
        """Read something from a board; waits. Raises BoardSilent."""
        return self._ask(address, command, reply_bytes, None, where)

    def command(self, address: int, command: int, data: bytes, where: str) -> None:
        """Set or command something, and wait for the acknowledgement. Raises BoardSilent."""
        self._ask(address, command, None, lambda: data, where)

    def _ask(
        self,
        address: int,
        command: int,
        reply_bytes: int | tuple[int, ...] | None,
        data: Callable[[], bytes] | None,
        where: str,
    ) -> bytes:
        answers: list[bytes] = []
        question = RoboclawQuestion(address, command, reply_bytes, lambda got, _: answers.append(got), data)
        remedy = f"check its supply, packet serial mode, address {address:#04x}"
        self.converse(question, lambda: bool(answers), f"{where}: no answer to command {command}", remedy)
        return answers[0]

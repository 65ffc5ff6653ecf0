"""Errors between the host and the boards, by who is at fault.

The text of each error is the message for the operator: which device, where, what was expected,
what was received, what to do. Noise on a line is counted; it becomes an error only when an
answer or the stream is missing.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

T = TypeVar("T")
MOST_PROBLEMS = 8  # one is raised a cycle: more would be raised long after their cause


class ArmwrightError(Exception):
    """Base of all errors that armwright raises deliberately; `str()` is the message to show."""


class LinkError(ArmwrightError):
    """Base of all errors raised by devices."""


class PortMissing(LinkError):
    """The port or bus does not exist or is in use, or its driver is not installed."""


class PortInUse(PortMissing):
    """Another program of this machine commands the boards on the port or bus."""


class LinkLost(LinkError):
    """An open port or bus was lost (unplugged, bus off, closed by the peer)."""


class BoardSilent(LinkError):
    """A board does not answer, or its stream stopped."""


class BoardReset(LinkError):
    """A board restarted unexpectedly: its counts and parameters are lost. Raised once per restart."""


class BoardFaulted(LinkError):
    """A board is in FAULT, and the request requires its fault to be acknowledged first."""


class WrongIdentity(LinkError):
    """A board answers but is not the expected one: serial number, protocol version or type."""


class BoardRefused(LinkError):
    """A board rejected a valid request; its state is unchanged."""


class ProtocolViolation(LinkError):
    """A board, or another sender on the line, violated the protocol. Carries the received bytes."""

    def __init__(self, message: str, received: bytes = b"") -> None:
        super().__init__(f"{message} (received: {received.hex(' ')})" if received else message)
        self.received = received


class AnotherHost(ProtocolViolation):
    """Another program commands a board of ours."""


class Problems(list[LinkError]):
    """What boards have done wrong and nobody was told yet. One that babbles says nothing new, and fills no memory.

    `raise problems.pop(0)`: a frame that raised an error which it still holds would keep itself alive through its traceback,
    and the loop runs without a garbage collector.
    """

    def append(self, problem: LinkError) -> None:
        """Note a problem, without the frames that it came through. Beyond the most, only restarts: they take the zero away."""
        is_needed = len(self) < MOST_PROBLEMS or isinstance(problem, BoardReset)
        if is_needed and all(str(known) != str(problem) for known in self):
            super().append(problem.with_traceback(None))


class MisuseError(LinkError):
    """An invalid request on the host's side: nothing was sent and nothing changed."""


class ConnectionFailed(LinkError):
    """One error for all devices that failed to connect, with a message for each in `failures`."""

    def __init__(self, failures: Sequence[LinkError]) -> None:
        self.failures = tuple({str(failure): failure for failure in failures}.values())
        lines = "".join(f"\n  - {failure}" for failure in self.failures)
        super().__init__(f"cannot connect:{lines}")


def connect_all(steps: Iterable[Callable[[], T]]) -> list[T]:
    """Run all steps and return their results. One ConnectionFailed names every step that failed."""
    results: list[T] = []
    failures: list[LinkError] = []
    for step in steps:
        try:
            results.append(step())
        except LinkError as failure:
            failures.append(failure)
    if failures:
        raise ConnectionFailed(failures)
    return results

"""What can go wrong between the host and a board, and whose fault it is.

The text of each error is the message for the operator: which device, where, what was expected,
what came, what to do. Noise on a line is no error: it is counted, and becomes one only when an
answer or the stream stays away.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

T = TypeVar("T")


class ArmwrightError(Exception):
    """Base of everything that armwright raises on purpose; `str()` is the message to show."""


class LinkError(ArmwrightError):
    """Base of everything that the devices raise."""


class PortMissing(LinkError):
    """The port or bus is not there, is taken, or its driver is not installed."""


class LinkLost(LinkError):
    """A port or bus that was open has gone (unplugged, bus off, peer closed)."""


class BoardSilent(LinkError):
    """A board does not answer, or its stream stopped."""


class BoardReset(LinkError):
    """A board restarted by itself: its counts and parameters are lost. Raised once for each restart."""


class BoardFaulted(LinkError):
    """A board is in FAULT, and what was asked needs its fault acknowledged first."""


class WrongIdentity(LinkError):
    """A board answers but is not the one asked for: serial number, protocol version, kind."""


class RequestRefused(LinkError):
    """A board understood the request and said no; nothing changed on it."""


class ProtocolViolation(LinkError):
    """A board, or somebody else on the line, sent what its document does not allow. Carries the bytes."""

    def __init__(self, message: str, received: bytes = b"") -> None:
        super().__init__(f"{message} (received: {received.hex(' ')})" if received else message)
        self.received = received


class MisuseError(LinkError):
    """Our own side asked for what cannot be: nothing was sent and nothing changed."""


class ConnectionFailed(LinkError):
    """One error for all devices that failed to connect, each with its own message in `failures`."""

    def __init__(self, failures: Sequence[LinkError], attempted: int) -> None:
        self.failures = tuple(failures)
        lines = "".join(f"\n  - {failure}" for failure in self.failures)
        super().__init__(f"{len(self.failures)} of {attempted} devices failed to connect:{lines}")


def connect_all(steps: Iterable[Callable[[], T]]) -> list[T]:
    """The results of all steps. Each is tried; then one ConnectionFailed names all that failed."""
    results: list[T] = []
    failures: list[LinkError] = []
    for step in steps:
        try:
            results.append(step())
        except LinkError as failure:
            failures.append(failure)
    if failures:
        raise ConnectionFailed(failures, attempted=len(results) + len(failures))
    return results

"""What the openers of all kinds of boards add to while an arm is connected."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from control.hardware.roles import AskedLine, Drives, Encoders, Line
from firmware_iface.errors import LinkError


@dataclass(slots=True)
class Opened:
    """Encoders, drives and lines that were opened, what closes the links, who answered, and what failed."""

    encoders: list[Encoders] = field(default_factory=list)
    drives: list[Drives] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)
    polled: list[AskedLine] = field(
        default_factory=list
    )  # of `lines`: those that live from being attended to
    identities: list[tuple[str, str]] = field(default_factory=list)  # where, what the board says of itself
    closers: list[Callable[[], None]] = field(default_factory=list)
    failures: list[LinkError] = field(default_factory=list)


@contextlib.contextmanager
def collect(failures: list[LinkError]) -> Iterator[None]:
    """Note a failure and go on: one error names all devices that failed."""
    try:
        yield
    except LinkError as error:
        failures.append(error)

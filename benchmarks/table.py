"""One row of the table of measured claims, and how a time is measured."""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter


@dataclass(frozen=True, slots=True)
class BenchRow:
    """A measured claim.

    `ratio` is value / peer_value; `target` describes the requirement, and `passed` whether it holds: None if
    there is no target, or if the required peer could not be run (see `peer`).
    """

    name: str
    value: float
    unit: str
    peer: str = ""
    peer_value: float | None = None
    ratio: float | None = None
    target: str = ""
    passed: bool | None = None


def compared(
    name: str, value: float, unit: str, peer: str, peer_value: float | None, target: str, largest_ratio: float | None
) -> BenchRow:
    """Return a row with a peer; without the peer's value there is no verdict, and for zero there is no ratio."""
    if peer_value is None:
        return BenchRow(name, value, unit, peer, target=target)
    ratio = value / peer_value if peer_value > 0.0 else None
    passed = None if largest_ratio is None else value <= largest_ratio * peer_value
    return BenchRow(name, value, unit, peer, peer_value, ratio, target, passed)


def seconds_a_call(work: Callable[[], object], calls: int) -> float:
    """Return the time of one of the `calls` that one run of `work` makes."""
    start = perf_counter()
    work()
    return (perf_counter() - start) / calls

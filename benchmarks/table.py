"""One row of the table of measured claims, and how a time is measured."""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter


@dataclass(frozen=True, slots=True)
class BenchRow:
    """A measured claim.

    `ratio` is value / peer_value; `target` says in words what must hold, and `passed` whether it does: None where
    there is no target, or where the peer it needs could not be run (then `peer` says so).
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
    name: str,
    value: float,
    unit: str,
    peer: str,
    peer_value: float | None,
    target: str,
    largest_ratio: float | None,
) -> BenchRow:
    """Return a row beside a peer; without the peer's value there is no ratio and no verdict."""
    if peer_value is None:
        return BenchRow(name, value, unit, peer, target=target)
    ratio = value / peer_value
    passed = None if largest_ratio is None else ratio <= largest_ratio
    return BenchRow(name, value, unit, peer, peer_value, ratio, target, passed)


def seconds_a_call(work: Callable[[], object], calls: int) -> float:
    """Return the time of one of the `calls` that one run of `work` makes."""
    start = perf_counter()
    work()
    return (perf_counter() - start) / calls

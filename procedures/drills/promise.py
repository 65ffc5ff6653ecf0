"""What is promised about a fault, and what came of it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from hil_mocks.plant.hand import Point

STANDS_m_s = 0.005
WRONG_rad = (
    0.003  # between an arm that takes itself for homed and its encoders: play and index error included
)
GOES_ON = frozenset[str]()


@dataclass(frozen=True, slots=True)
class Promise:
    """One fault: what is done, when, and what is promised about it."""

    name: str
    says: str
    during: str
    codes: frozenset[str]  # faults of which one is found; none: nothing is reported, and the arm goes on
    within_s: float = 0.3
    most_mm: float = 5.0  # off the asked path

    def run(self) -> "DrillOutcome":
        """Run it on a fresh mock arm."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class DrillOutcome:
    """What the arm did. Lengths in mm, times in s from the fault."""

    drill: Promise
    off_path_mm: float
    ran_on_mm: float
    noticed_s: float | None
    stood_s: float | None
    lost: str
    found: tuple[str, ...]
    message: str
    wrong_mrad: float
    wrong_after: str = ""  # what was wrong once the cause was mended

    @property
    def broken(self) -> tuple[str, ...]:
        """The promises that were not kept, as text."""
        drill, broken = self.drill, []
        if drill.codes and not drill.codes & set(self.found):
            broken.append(f"expected {' or '.join(sorted(drill.codes))}")
        if not drill.codes and self.found:
            broken.append("expected to go on")
        if drill.codes and self.noticed_s is not None and self.noticed_s > drill.within_s:
            broken.append(f"noticed after {drill.within_s * 1e3:.0f} ms")
        if self.off_path_mm > drill.most_mm:
            broken.append(f"more than {drill.most_mm:g} mm off its path")
        if self.wrong_mrad > WRONG_rad * 1e3:
            broken.append(f"{self.wrong_mrad:.0f} mrad wrong, and homed")
        if self.lost.endswith("records"):
            broken.append(f"{self.lost} lost")
        if self.wrong_after:
            broken.append(self.wrong_after)
        return tuple(broken)


def stood_s(way: Sequence[tuple[float, Point]], begun_s: float, looked: int) -> float | None:
    """When the tip had come to rest, by every `looked` place; None if it had not. A gear that settles in its play is at rest."""
    stood_s: float | None = None
    for (before_s, before), (now_s, now) in pairwise(way[::looked]):
        if math.dist(before, now) > STANDS_m_s * (now_s - before_s):
            stood_s = None
        elif stood_s is None:
            stood_s = before_s - begun_s
    return stood_s


def length_m(way: Sequence[tuple[float, Point]]) -> float:
    """The length of a way."""
    return sum(math.dist(a, b) for (_, a), (_, b) in pairwise(way))

"""A drill, and what came of it."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

from hil_mocks.plant.hand import Point
from procedures.drills.stage import MOVE, THINNED, Stage, asked_way, off_way_m, stage

WATCHED_S = 2.0  # after the fault
STANDS_m_s = 0.002
WRONG_rad = (
    0.003  # between an arm that takes itself for homed and its encoders, backlash and index error included
)
GOES_ON = frozenset[str]()


@dataclass(frozen=True, slots=True)
class Drill:
    """One fault: what is done, when, and what is promised about it."""

    name: str
    says: str
    during: str
    inject: Callable[[Stage], None]
    codes: frozenset[str]  # faults of which one is found; none: nothing is reported, and the arm goes on
    within_s: float = 0.3
    most_mm: float = 5.0  # off the asked path


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the arm did. Lengths in mm, times in s from the fault."""

    drill: Drill
    off_path_mm: float
    ran_on_mm: float
    noticed_s: float | None
    stood_s: float | None
    lost: str
    found: tuple[str, ...]
    message: str
    wrong_mrad: float

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
        return tuple(broken)


def run(drill: Drill) -> Outcome:
    """Run a drill on a fresh arm, and let it recover."""
    with stage() as played:
        played.begin(drill.during)
        begun_s = played.now_s
        played.way = played.way[-1:]
        drill.inject(played)
        played.run(max(0.0, begun_s + WATCHED_S - played.now_s))
        way, noticed_s, found = played.way.copy(), played.noticed_s, played.found
        is_done = not found
        message = played.message
        played.recover()
        asked = asked_way(drill.during, WATCHED_S)
        stood_s = _stood_s(way, begun_s)
        return Outcome(
            drill,
            max(off_way_m(tip, asked) for _, tip in (*way[::THINNED], way[-1])) * 1e3,
            _length_m(way) * 1e3,
            None if noticed_s is None else noticed_s - begun_s,
            stood_s,
            _lost(played, drill, is_done),
            found,
            message,
            played.wrong_rad() * 1e3,
        )


def _lost(played: Stage, drill: Drill, is_done: bool) -> str:
    if not played.assembly.runtime.monitor.is_homed:
        return "the zero"
    return "the motion" if drill.during == MOVE and not is_done else "nothing"


def _stood_s(way: list[tuple[float, Point]], begun_s: float) -> float | None:
    """When the tip had come to rest; None if it had not."""
    stood_s: float | None = None
    for (before_s, before), (now_s, now) in pairwise(way):
        if math.dist(before, now) > STANDS_m_s * (now_s - before_s):
            stood_s = None
        elif stood_s is None:
            stood_s = before_s - begun_s
    return stood_s


def _length_m(way: list[tuple[float, Point]]) -> float:
    return sum(math.dist(a, b) for (_, a), (_, b) in pairwise(way))

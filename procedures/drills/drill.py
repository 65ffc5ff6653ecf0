"""A drill on the stepped clock."""

from collections.abc import Callable
from dataclasses import dataclass, field

from control.model.arm import Arm
from control.model.description import load_arm
from procedures.drills.promise import DrillOutcome, Promise, length_m, stood_s
from procedures.drills.stage import (
    MOVE,
    THINNED,
    FROM_rad,
    Stage,
    asked_way,
    gripping_stage,
    off_way_m,
    stage,
)

WATCHED_S = 2.0  # after the fault
KEPT = 0.5  # of the grip's force: less holds no part
LOOKED = 10  # cycles between two looks at the speed of the tip


def _nothing(played: Stage) -> None:
    """No fault."""


def _as_it_is(arm: Arm) -> Arm:
    """No other arm."""
    return arm


@dataclass(frozen=True, slots=True)
class Drill(Promise):
    """A fault that is injected into a stage."""

    inject: Callable[[Stage], None] = field(default=_nothing)
    arm: Callable[[Arm], Arm] = field(default=_as_it_is)  # where the fault is built in
    is_refused: bool = False  # the arm must not be acknowledged into operation
    has_gripper: bool = False  # with an object in it

    def run(self) -> DrillOutcome:
        """Run it on a fresh arm, and let the arm recover."""
        with gripping_stage() if self.has_gripper else stage(self.arm(load_arm("right"))) as played:
            if self.arm is not _as_it_is:
                self._prepare(played)
            played.begin(self.during)
            begun_s, grip_N = played.now_s, played.grip_N()
            played.way = played.way[-1:]
            self.inject(played)
            played.run(max(0.0, begun_s + WATCHED_S - played.now_s))
            has_dropped = played.grip_N() < KEPT * grip_N
            way, noticed_s, found, message = played.way.copy(), played.noticed_s, played.found, played.message
            refusal = played.recover()
            asked = asked_way(self.during, WATCHED_S)
            return DrillOutcome(
                self,
                max(off_way_m(tip, asked) for _, tip in (*way[::THINNED], way[-1])) * 1e3,
                length_m(way) * 1e3,
                None if noticed_s is None else noticed_s - begun_s,
                stood_s(way, begun_s, LOOKED),
                self._lost(played, found, has_dropped),
                found,
                message,
                played.wrong_rad() * 1e3,
                "" if bool(refusal) or not self.is_refused else "the other board was not refused",
            )

    def _prepare(self, played: Stage) -> None:
        """Home, and go to where every drill begins."""
        played.client.enable()
        played.client.home()
        played.client.move_joints(FROM_rad)

    def _lost(self, played: Stage, found: tuple[str, ...], has_dropped: bool) -> str:
        lost = []
        if not played.assembly.runtime.monitor.is_homed:
            lost.append("the zero")
        elif self.during == MOVE and found:
            lost.append("the motion")
        return ", ".join((*lost, *(["the grip"] if has_dropped else []))) or "nothing"

"""Keeps the arms of a cell apart: before a motion begins, at every set-point, in jogs, and where motions lead.

Every cycle gives each arm's capsules now and a little later: on its motion's own time, so that two arms that will meet are
stopped before they do. Jogs and the last guard of set-points (control.motion.guard) hold their poses against those of the others.
Two arms that are too near already may move apart. An arm that is not homed could be anywhere.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from control.errors import ArmError, MotionError
from control.loop.runtime import Runtime
from control.model.arm import Arm
from control.model.cell import Cell, Placed
from control.motion.guard import FarPoses, ROOM_m
from control.motion.joint_limits import reaches_m
from control.motion.setpoint import Motion
from control.safety.collision import FAR, ArmBody, Capsules, Nearest, least_gap, middle, pairs_between
from control.safety.modes import Fault, Mode, Reaction

AHEAD_S = 0.25  # a stop along the path takes 0.4 s at most, at half of the speed on average
LOOKS_MOST = 24  # at a motion before it begins: 1.5 ms of the loop's time
COARSE_S, FINE_S = 0.25, 0.02  # between them, in time of the motion
DEEPER_m = 1e-6  # rounding
FAR_m = 2.0  # beyond it gaps are not measured: some tenths of a second away at any speed
REMEDY = "jog or guide one of the arms away; [[arm]] origin_m and clearance_m of the cell say how near they are"


class GoingOn(NamedTuple):
    """A motion (None: the arm stays), the time of it now, and its pace."""

    motion: Motion | None
    time_s: float
    pace: float


class Presence:
    """Where an arm is, and where it will be: capsules in the frame of the cell, None while its pose is not known."""

    def __init__(self, placed: Placed, runtime: Runtime, tool_length_m: float) -> None:
        self.name, self.runtime = placed.name, runtime
        self._bodies = {
            tool.name: ArmBody(Placed(placed.arm.with_tool(tool.name), placed.origin_m, placed.orientation), tool_length_m)
            for tool in placed.arm.tools
        }
        self._clear_of_itself = {tool.name: FarPoses(reaches_m(placed.arm.with_tool(tool.name))) for tool in placed.arm.tools}
        self._q_rad: Sequence[float] = ()
        self._of_body: ArmBody | None = None
        self._motion: Motion | None = None
        self._ahead: Motion | None = None
        self.now: Capsules | None = None
        self.later: Capsules | None = None

    @property
    def body(self) -> ArmBody:
        """With the tool that is on."""
        return self._bodies[self.runtime.parts.tool.tool.name]

    @property
    def clear_of_itself(self) -> FarPoses:
        """Poses in which its own links are far from each other."""
        return self._clear_of_itself[self.runtime.parts.tool.tool.name]

    def update(self) -> None:
        """Follow the runtime's set-point."""
        runtime = self.runtime
        if not runtime.monitor.is_homed:
            self.now = self.later = None
            return
        q_rad, body = runtime.set_point.q_rad, self.body
        if self.now is None or q_rad != self._q_rad or body is not self._of_body:
            self.now, self._q_rad, self._of_body = body.at(q_rad), q_rad, body
        later_rad = self._later_rad()
        self.later = self.now if later_rad is None else body.at(later_rad)

    def going_on(self, together: Mapping[str, Motion]) -> GoingOn:
        """What the arm will do: the motion that it is about to begin, or goes on with, or none.

        Copies, because motions remember their last pose: nobody else may ask them.
        """
        if self.name in together:
            return GoingOn(copy.copy(together[self.name]), 0.0, 1.0)
        paced = self.runtime.paced
        if self.runtime.monitor.mode is not Mode.MOVING or paced is None:
            return GoingOn(None, 0.0, 0.0)
        return GoingOn(copy.copy(paced.motion), paced.time_s, paced.pace)

    def at(self, going_on: GoingOn, time_s: float) -> Capsules | None:
        """The capsules `time_s` from now."""
        if going_on.motion is None:
            return self.now
        return self.body.at(going_on.motion.at(going_on.time_s + going_on.pace * time_s).q_rad)

    def _later_rad(self) -> Sequence[float] | None:
        runtime, mode = self.runtime, self.runtime.monitor.mode
        if mode is Mode.JOGGING:
            return runtime.parts.tool.guard.resting_pose(runtime.set_point)
        if mode is Mode.GUIDING:
            speeds = runtime.parts.measurement.speed_rad_s
            return [q + AHEAD_S * v for q, v in zip(runtime.set_point.q_rad, speeds, strict=True)]
        paced = runtime.paced
        if mode is not Mode.MOVING or paced is None:
            self._motion = self._ahead = None
            return None
        if self._motion is not paced.motion:
            self._motion, self._ahead = paced.motion, copy.copy(paced.motion)
        return self._ahead.at(paced.time_s + paced.pace * AHEAD_S).q_rad if self._ahead is not None else None


class Neighbours:
    """The other arms of one arm; meets `control.motion.guard.Obstacles`."""

    def __init__(self, own: Presence, others: Sequence[Presence], clearance_m: float) -> None:
        self._own, self._others, self.clearance_m = own, others, clearance_m
        self._pairs: dict[tuple[ArmBody, ArmBody], tuple[tuple[int, int], ...]] = {}

    def objection(self, wanted_rad: Sequence[float], here_rad: Sequence[float], looks_ahead: bool) -> str:
        """Why the arm must not get to `wanted_rad` from `here_rad`: another arm is there, or itself; empty if it may.

        `looks_ahead`: or will be there shortly.
        """
        body, clear = self._own.body, self._own.clear_of_itself
        is_clear = not body.own_pairs or clear.are_near(wanted_rad)
        if is_clear and not self._others:
            return ""
        wanted, here = body.at(wanted_rad), None
        for neighbour in self._others:
            if neighbour.now is None:
                continue
            later = neighbour.later if looks_ahead and neighbour.later is not neighbour.now else None
            for capsules in (neighbour.now,) if later is None else (neighbour.now, later):
                nearest = self.gap(body, wanted, neighbour, capsules, self.clearance_m)
                if nearest.gap_m < self.clearance_m:
                    here = here or body.at(here_rad)
                    if nearest.gap_m < self.gap(body, here, neighbour, capsules, FAR_m).gap_m - DEEPER_m:
                        return f"the arm would come within {nearest.gap_m:.3f} m of arm {neighbour.name!r}"
        if is_clear:
            return ""
        with_itself = least_gap(wanted, wanted, body.own_pairs, ROOM_m)
        if with_itself.gap_m > 0.0:
            clear.note(wanted_rad, min(with_itself.gap_m, ROOM_m))
        elif with_itself.gap_m < 0.0:
            here = here or body.at(here_rad)
            if with_itself.gap_m < least_gap(here, here, body.own_pairs, FAR_m).gap_m - DEEPER_m:
                return f"{body.names[with_itself.one]} of the arm would meet its own {body.names[with_itself.other]}"
        return ""

    def require_clear(self, motion: Motion, together: Mapping[str, Motion] | None = None) -> None:
        """MotionError if a motion that begins now meets another arm, or itself.

        The others go on with their own motions, or begin those of `together` (by name) at the same time.
        """
        for neighbour in self._others:
            if neighbour.now is None:
                raise ArmError(
                    f"arm {neighbour.name!r} is not homed, so its pose is unknown: home it first"
                    f" (`armwright home --arm {neighbour.name}`); jogs are free"
                )
        _Sweep(self, copy.copy(motion), [neighbour.going_on(together or {}) for neighbour in self._others]).run()

    def state(self, time_s: float, motion: Motion, others: Sequence[GoingOn]) -> "_State":
        """The arms `time_s` after the motion's beginning, and how near they are to each other."""
        body = self._own.body
        capsules_here = body.at(motion.at(time_s).q_rad)
        least, what, where = FAR.gap_m, "", (0.0, 0.0, 0.0)
        all_others: list[Capsules] = []
        for neighbour, going_on in zip(self._others, others, strict=True):
            capsules = neighbour.at(going_on, time_s) or ()
            all_others.append(capsules)
            nearest = self.gap(body, capsules_here, neighbour, capsules, FAR_m)
            if nearest.gap_m - self.clearance_m < least:
                least = nearest.gap_m - self.clearance_m
                what = (
                    f"{body.names[nearest.one]} would come within {nearest.gap_m:.3f} m of"
                    f" {neighbour.body.names[nearest.other]} of arm {neighbour.name!r}"
                )
                where = middle(capsules_here[nearest.one], capsules[nearest.other])
        if body.own_pairs and (nearest := least_gap(capsules_here, capsules_here, body.own_pairs, FAR_m)).gap_m < least:
            least = nearest.gap_m
            what = f"{body.names[nearest.one]} would meet its own {body.names[nearest.other]}"
            where = middle(capsules_here[nearest.one], capsules_here[nearest.other])
        return _State(time_s, (capsules_here, *all_others), least, what, where)

    def gap(self, body: ArmBody, capsules_here: Capsules, neighbour: Presence, capsules: Capsules, within_m: float) -> Nearest:
        """How near a pose of this arm is to one of another."""
        key = (body, neighbour.body)
        if key not in self._pairs:
            self._pairs[key] = pairs_between(*key)
        return least_gap(capsules_here, capsules, self._pairs[key], within_m)


def guard_itself(arm: Arm, runtime: Runtime) -> Neighbours | None:
    """Guard an arm that stands alone against itself; None if none of its links can meet another. Not for arms of a cell."""
    presence = Presence(Placed(arm), runtime, 0.0)
    if not presence.body.own_pairs:
        return None
    alone = Neighbours(presence, (), 0.0)
    for tool in runtime.parts.tools.values():
        tool.guard.beside = alone
    return alone


class _State:
    """All arms at one time of a motion: `room_m` is what is left beyond the clearance."""

    __slots__ = ("arms", "room_m", "time_s", "what", "where")

    def __init__(
        self, time_s: float, arms: Sequence[Capsules], room_m: float, what: str, where: tuple[float, float, float]
    ) -> None:
        self.time_s, self.arms, self.room_m, self.what, self.where = time_s, arms, room_m, what, where

    def moved_m(self, later: "_State") -> float:
        """How much nearer two arms can have come between two states: the ways of the fastest ends of their capsules."""
        ways = [
            max((_way_m(a, b) for a, b in zip(before, after, strict=True)), default=0.0)
            for before, after in zip(self.arms, later.arms, strict=True)
        ]
        return ways[0] + max(ways[1:], default=0.0)


def _way_m(before: Sequence[float], after: Sequence[float]) -> float:
    """The longer way of the two ends of a capsule."""
    x, y, z = after[0] - before[0], after[1] - before[1], after[2] - before[2]
    u, v, w = x + after[3] - before[3], y + after[4] - before[4], z + after[5] - before[5]
    return math.sqrt(max(x * x + y * y + z * z, u * u + v * v + w * w))


def _spare_m(ends: tuple[_State, _State]) -> float:
    """What is left between two states in any case, beyond the clearance."""
    before, after = ends
    return min(before.room_m, after.room_m) - before.moved_m(after)


class _Sweep:
    """Looks along a motion before it begins, more closely where arms may come near; a limited number of times.

    What it does not get to see, the look ahead of each cycle does.
    """

    def __init__(self, neighbours: Neighbours, motion: Motion, others: Sequence[GoingOn]) -> None:
        self._neighbours, self._motion, self._others = neighbours, motion, others
        self._looks = 0
        self._start_m = math.inf

    def run(self) -> None:
        """MotionError at the first place that is too near; nearer than where the motion begins."""
        duration_s = self._motion.duration_s
        sections = max(1, min(LOOKS_MOST // 2, math.ceil(duration_s / COARSE_S)))
        states = [self._look(0.0)]
        self._start_m = states[0].room_m
        for k in range(sections):
            states.append(self._look(duration_s * (k + 1) / sections))
            self._refuse(states[-1])
        waiting = list(pairwise(states))
        while waiting and self._looks < LOOKS_MOST:
            # Where the least room may be left is looked at first.
            waiting.sort(key=_spare_m, reverse=True)
            before, after = waiting.pop()
            if _spare_m((before, after)) > 0.0 or after.time_s - before.time_s < FINE_S:
                continue
            between = self._look(0.5 * (before.time_s + after.time_s))
            self._refuse(between)
            waiting += [(before, between), (between, after)]

    def _look(self, time_s: float) -> _State:
        self._looks += 1
        return self._neighbours.state(time_s, self._motion, self._others)

    def _refuse(self, state: _State) -> None:
        if state.room_m < min(0.0, self._start_m - DEEPER_m):
            place = ", ".join(f"{value:.3f}" for value in state.where)
            raise MotionError(
                f"{state.what} after {state.time_s:.2f} s, near ({place}) m in the frame of the cell (clearance_m is"
                f" {self._neighbours.clearance_m:g}); nothing was moved. Take another way, or move the other arm away"
            )


class CollisionWatch:
    """The arms of a cell against each other, once a cycle."""

    def __init__(self, cell: Cell, runtimes: Mapping[str, Runtime]) -> None:
        self._presences = [Presence(placed, runtimes[placed.name], cell.tool_length_m) for placed in cell.arms]
        self._clearance_m = cell.clearance_m
        self.of_arms = {
            presence.name: Neighbours(presence, [one for one in self._presences if one is not presence], cell.clearance_m)
            for presence in self._presences
        }
        for presence in self._presences:
            for tool in presence.runtime.parts.tools.values():
                tool.guard.beside = self.of_arms[presence.name]

    def look(self) -> None:
        """Follow all arms, and stop those whose motions lead too near to another arm."""
        for presence in self._presences:
            try:
                presence.update()
            except Exception as error:  # an arm whose way is not known must not go on
                presence.later = presence.now
                presence.runtime.fail(_lost(error))
        for k, first in enumerate(self._presences):
            for second in self._presences[k + 1 :]:
                self._hold_apart(first, second)

    def _hold_apart(self, first: Presence, second: Presence) -> None:
        moving = [arm for arm in (first, second) if arm.runtime.monitor.mode is Mode.MOVING]
        if not moving or first.later is None or second.later is None or first.now is None or second.now is None:
            return
        neighbours = self.of_arms[first.name]
        later = neighbours.gap(first.body, first.later, second, second.later, self._clearance_m)
        if later.gap_m >= self._clearance_m:
            return
        if later.gap_m >= neighbours.gap(first.body, first.now, second, second.now, FAR_m).gap_m - DEEPER_m:
            return  # they part
        for arm in moving:
            beside = second if arm is first else first
            arm.runtime.fail(
                Fault(
                    "collision",
                    "motion",
                    f"it was stopped: arm {arm.name!r} would come within {later.gap_m:.3f} m of arm {beside.name!r}",
                    REMEDY,
                    Reaction.CONTROLLED,
                )
            )


def _lost(error: Exception) -> Fault:
    text = str(error) if isinstance(error, ArmError) else f"{type(error).__name__}: {error}"
    return Fault(
        "motion",
        "motion",
        f"it was stopped: where it would be {AHEAD_S:g} s later is unknown: {text}",
        "plan it again; if it was planned for this arm, report it with the recording of this run",
        Reaction.CONTROLLED,
    )

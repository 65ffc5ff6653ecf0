"""Requests that cross each other's transitions, at random, on every kind of board and in a cell; the plant's truth judges.

Each sequence sends requests of two clients, and lets another program switch drives, with some cycles or none in between: while
drives go on, while the arm moves, stops, holds, sinks or goes off. The arms stand upright, where friction keeps them, so that
none moves by itself. What must hold in every cycle is in `Judge.look`, what is told at the end in `Judge.judge_answer`.

    python -m tests.crossing --count 100000 --seed 1        # a night; prints each broken promise with its sequence
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from control.loop.runtime import Runtime
from control.model.arm import Arm
from control.safety.modes import CONTROLLED_MODES, TRAVELLING_MODES, Mode
from control.server.in_process import SteppedLoop
from hil_mocks.robot import MockRobot
from hil_mocks.scenario import FaultTable
from tests.cell import FRICTION, RIGHT, open_cell, scenario
from tests.kinds import ON_BOARDS
from tests.pair import APART, PAIR, open_pair
from tests.pair import PERIOD_S as PAIR_PERIOD_S

UPRIGHT = RIGHT.rest.q_rad if RIGHT.rest else APART
SETTLES_S = 0.2
OBEYS_S = 0.15  # until boards that were told to go off are off
LANDS_S = 20.0  # the way off waits until the arm has sunk, at most so long
MOVED_rad = 0.03  # the arm settles on its friction, and in the play of its set-points
SPEED_SHARE = 1.3  # of a joint's limit
BEYOND_rad = 0.06
STEP_rad = 0.06
MOVES = frozenset(("move_joints", "jog", "home"))
LEADS = frozenset(("enable", "hold", "off", "stop", "brake", "guide", "acknowledge"))
KINDS = ("reference", "cia402", "dynamixel", "feetech", "moteus", "odrive", "roboclaw", "vesc", "cell")
WAITS_cycles = (0, 0, 0, 1, 1, 2, 3, 5, 8, 20, 60)
STEPS = 9
MEDDLING = 0.06  # share of steps in which another program switches a drive

Step = Mapping[str, Any]


def steps(pick: random.Random, arms: Sequence[str]) -> Iterator[Step]:
    """A sequence: requests of two clients, disconnections, another program at a drive, and cycles in between."""
    for _ in range(STEPS):
        at = {"arm": pick.choice(arms), "client": pick.randrange(2)}
        draw = pick.random()
        if draw < MEDDLING:
            what = pick.choice(("switched_on", "switched_off"))
            yield {"meddle": what, "joint": pick.randrange(3), "after": pick.random(), **at}
        elif draw < MEDDLING + 0.05:
            yield {"gone": True, **at}
        elif draw < 0.6:
            do = pick.choice(("enable", "off", "enable", "off", "stop", "hold", "brake", "acknowledge"))
            yield {"request": {"do": do}, **at}
        else:
            yield {"request": _other(pick), **at}
        yield {"cycles": pick.choice(WAITS_cycles)}


def _other(pick: random.Random) -> dict[str, Any]:
    q_rad = [q + pick.uniform(-STEP_rad, STEP_rad) for q in UPRIGHT]
    return pick.choice(
        (
            {"do": "move_joints", "q_rad": q_rad, "speed": 0.5},
            {"do": "jog", "joint": 1, "by_rad": q_rad[0] - UPRIGHT[0], "speed_rad_s": 0.2},
            {"do": "jog", "joint_speed_rad_s": [0.1, 0.0, 0.0]},
            {"do": "home"},
            {"do": "guide"},
            {"do": "guide", "weightless": True},
            {"do": "tool", "name": ""},
            {"do": "payload", "mass_kg": 0.01},
            {"do": "override", "fraction": 0.5},
            {"do": "pause"},
            {"do": "resume"},
            {"do": "off", "lets_go": True},
            {"do": "control", "take": pick.random() < 0.5},
            {"do": "control", "revoke": True},
        )
    )


@dataclass
class Judge:
    """One arm, by the plant's truth."""

    runtime: Runtime
    robot: MockRobot
    arm: Arm
    broken: list[str] = field(default_factory=list)
    told: str = ""  # the last accepted request that leads to a mode
    is_meddled_with: bool = False  # by another program, in this sequence
    _may_move: bool = False
    _was_let_be: bool = False
    _off_since_s: float | None = None
    _stood_rad: Sequence[float] = ()
    _before: tuple[float, Sequence[float]] | None = None

    def accepted(self, request: Step) -> None:
        """A request was answered with ok."""
        do = "stop" if request.get("revoke") else request["do"]
        self._may_move |= do in MOVES
        if do in LEADS | MOVES:
            self.told = do
        self._was_let_be = self.runtime.monitor.mode not in CONTROLLED_MODES

    def look(self) -> None:
        """After a cycle: no torque in OFF, no motion that nobody asked for, nothing beyond a limit."""
        now_s, mode, q_rad = self.runtime.now_s, self.runtime.monitor.mode, self.robot.joint_rad()
        driven = [kind in ("voltage", "current") and value != 0.0 for kind, value in self.robot.outputs]
        if mode is not Mode.OFF:
            self._off_since_s = None
        elif self._off_since_s is None or not any(driven):
            self._off_since_s = now_s
        elif now_s - self._off_since_s > OBEYS_S:
            self._say(f"torque in OFF on {sum(driven)} joints")
        for joint, (q, drive) in enumerate(zip(q_rad, self.arm.drives, strict=True)):
            if not drive.joint_lower_rad - BEYOND_rad <= q <= drive.joint_upper_rad + BEYOND_rad:
                self._say(f"joint {joint + 1} is beyond its range in {mode.name}")
            if self._before is not None and now_s > self._before[0]:
                speed = abs(q - self._before[1][joint]) / (now_s - self._before[0])
                if speed > SPEED_SHARE * drive.joint_speed_limit_rad_s:
                    self._say(f"joint {joint + 1} is too fast in {mode.name}")
        self._before = now_s, q_rad
        meddled = (
            self.is_meddled_with and mode is Mode.OFF and any(driven)
        )  # another program's: the runtime ends it within OBEYS_S
        if self._may_move or meddled or not self._stood_rad:
            self._stood_rad = q_rad
            self._may_move &= mode in TRAVELLING_MODES or mode in (Mode.STOPPING, Mode.FAULT)
        elif max(abs(q - p) for q, p in zip(q_rad, self._stood_rad, strict=True)) > MOVED_rad:
            self._say(f"it moved in {mode.name}, and nobody had asked for it")
            self._stood_rad = q_rad

    def judge_answer(self) -> None:
        """When all that was asked has had its time: the arm is where the last answer said, unless there is a fault."""
        monitor = self.runtime.monitor
        wanted = {"enable": Mode.HOLDING, "hold": Mode.HOLDING, "off": Mode.OFF}.get(self.told)
        if self.told in ("stop", "brake") and self._was_let_be and monitor.mode in CONTROLLED_MODES:
            self._say(f"it is {monitor.mode.name} after `{self.told}`")
        if self.told == "enable" and monitor.mode in TRAVELLING_MODES:
            return  # it was on before, and moved
        if wanted is not None and not monitor.faults and monitor.mode is not wanted:
            self._say(f"`{self.told}` was answered with ok, and the arm is {monitor.mode.name}")

    def _say(self, what: str) -> None:
        if what not in self.broken:
            self.broken.append(what)


@dataclass
class Stand:
    """Arms with a runtime, on which sequences are played one after the other."""

    loop: SteppedLoop
    period_s: float
    judges: Mapping[str, Judge]
    clients: tuple[int, int] = (1000, 1001)

    def play(self, sequence: Sequence[Step]) -> list[str]:
        """What was broken in a sequence. Afterwards the arms are off again, or it is said that they are not."""
        for judge in self.judges.values():
            judge.told, judge.is_meddled_with = "", False
            judge.broken.clear()
        for step in sequence:
            self._take(step)
        self._until(lambda: not any(_is_on_its_way(judge.runtime) for judge in self.judges.values()))
        self._cycles(round(SETTLES_S / self.period_s))
        if any(judge.told == "off" for judge in self.judges.values()):
            self._until(lambda: all(j.told != "off" or self._is_off(j) for j in self.judges.values()))
        for judge in self.judges.values():
            judge.judge_answer()
        broken = [f"{name} {what}".strip() for name, judge in self.judges.items() for what in judge.broken]
        return [*broken, *self._landed()]

    def _take(self, step: Step) -> None:
        if "cycles" in step:
            self._cycles(step["cycles"])
            return
        judge = self.judges[step["arm"]]
        if "meddle" in step:
            judge.is_meddled_with = True
            robot = judge.robot
            board = robot.drive_names[step["joint"] % len(robot.drive_names)]
            at_s = judge.runtime.now_s + step["after"] * self.period_s
            robot.inject(FaultTable(step["meddle"], board, at_s=at_s))
        elif "gone" in step:
            self._gone(step["client"])
        elif self._asked(step["request"], step["arm"], self.clients[step["client"]]):
            for name, one in self.judges.items():
                if name == step["arm"] or step["request"]["do"] in ("stop", "brake"):
                    one.accepted(step["request"])

    def _asked(self, request: Step, arm: str, client: int) -> bool:
        return bool(self.loop.request(dict(request), client, arm)["ok"])

    def _gone(self, which: int) -> None:
        self.loop.gone(self.clients[which])
        for judge in self.judges.values():
            if judge.told in ("enable", "hold", "guide"):
                judge.told = ""  # what it began may have ended with it
        first, second = self.clients
        fresh = max(first, second) + 1
        self.clients = (fresh, second) if which == 0 else (first, fresh)

    def _is_off(self, judge: Judge) -> bool:
        return judge.runtime.monitor.mode is Mode.OFF or bool(judge.runtime.monitor.faults)

    def _cycles(self, count: int) -> None:
        for _ in range(count):
            self.loop.run(self.period_s)
            for judge in self.judges.values():
                judge.look()

    def _until(self, is_so: Callable[[], bool]) -> bool:
        for _ in range(round(LANDS_S / self.period_s)):
            if is_so():
                return True
            self._cycles(1)
        return is_so()

    def _landed(self) -> list[str]:
        """From wherever it is, an arm can be brought to OFF without a fault."""
        for which in (0, 1):
            self._gone(which)
        for name, judge in self.judges.items():
            if judge.runtime.monitor.faults:
                self._cycles(round(1.0 / self.period_s))
                self._asked({"do": "acknowledge"}, name, self.clients[0])
            self._asked({"do": "off", "lets_go": True}, name, self.clients[0])
        is_off = self._until(lambda: all(j.runtime.monitor.mode is Mode.OFF for j in self.judges.values()))
        self._cycles(round(0.2 / self.period_s))
        for name, judge in self.judges.items():
            if judge.runtime.monitor.faults:
                self._asked({"do": "acknowledge"}, name, self.clients[0])
            judge.runtime.override = 1.0
        stuck = [f"{n} {j.runtime.monitor.mode.name}" for n, j in self.judges.items()]
        return [] if is_off else [f"it does not get to OFF: {', '.join(stuck)}"]


@contextmanager
def stand(kind: str) -> Iterator[Stand]:
    """An arm on boards of one kind, or a cell of two arms on reference boards."""
    if kind == "cell":
        with open_pair() as pair:
            arms = {placed.name: placed.arm for placed in PAIR.arms}
            judges = {name: Judge(pair.runtime(name), pair.robot(name), arm) for name, arm in arms.items()}
            yield Stand(next(iter(pair.channels.values())).loop, PAIR_PERIOD_S, judges)
        return
    on = ON_BOARDS[kind]
    with open_cell(scenario(UPRIGHT, effect=FRICTION), on.arm, period_s=on.period_s) as cell:
        yield Stand(cell.channel.loop, on.period_s, {"": Judge(cell.runtime, cell.rig.robot, on.arm)})


SEQUENCES_A_STAND = 25  # then another one: a recording of what happened stays short


def _is_on_its_way(runtime: Runtime) -> bool:
    """Whether it comes to rest, or waits for it."""
    return runtime.bound.is_hold or runtime.monitor.mode is Mode.STOPPING


def played(kind: str, seed: int, count: int) -> Iterator[tuple[int, list[Step], list[str]]]:
    """Play `count` sequences: each with its number and what was broken. A sequence depends on kind, seed and number alone,
    but begins where the one before it has left the arm.
    """
    for first in range(0, count, SEQUENCES_A_STAND):
        with stand(kind) as one:
            for number in range(first, min(first + SEQUENCES_A_STAND, count)):
                sequence = list(steps(random.Random(f"{kind} {seed} {number}"), tuple(one.judges)))
                yield number, sequence, one.play(sequence)


def main(arguments: Sequence[str]) -> int:
    """Exit status 1 if a promise was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.crossing", description=__doc__)
    parser.add_argument("--count", type=int, default=1000, help="sequences in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=KINDS)
    args = parser.parse_args(arguments)
    begun_s, broken, done = time.monotonic(), 0, 0
    for kind in args.kinds:
        for number, sequence, what in played(kind, args.seed, args.count // len(args.kinds)):
            done += 1
            if what:
                broken += 1
                print(f"{kind} {number}: {'; '.join(what)}\n    {sequence}", flush=True)
        print(f"{kind}: {done} sequences so far, {broken} broken, {time.monotonic() - begun_s:.0f} s", flush=True)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

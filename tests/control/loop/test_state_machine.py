"""Random sequences of requests, faults and time against a model of the modes: runtime and mock boards on the stepped clock.

The model is written from the promises of docs/safety.md, not from the table in the code. STATE_MACHINE_EXAMPLES=500 in
the environment looks longer than the suite does.
"""

from __future__ import annotations

import os
from contextlib import ExitStack
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from control.safety.modes import Mode
from tests.cell import PERIOD_S, STRETCHED, open_cell, scenario

OFF, BRAKED, HOLDING, MOVING, HOMING = Mode.OFF, Mode.BRAKED, Mode.HOLDING, Mode.MOVING, Mode.HOMING
GUIDING, STOPPING, FAULT, JOGGING, PAUSED = Mode.GUIDING, Mode.STOPPING, Mode.FAULT, Mode.JOGGING, Mode.PAUSED
FOLLOWS = {
    OFF: {BRAKED, FAULT},
    BRAKED: {HOLDING, GUIDING, OFF, FAULT},
    HOLDING: {HOMING, MOVING, JOGGING, GUIDING, BRAKED, FAULT},
    MOVING: {HOLDING, PAUSED, STOPPING, FAULT},
    HOMING: {HOLDING, STOPPING, FAULT},
    GUIDING: {BRAKED, FAULT},
    STOPPING: {HOLDING, FAULT},
    FAULT: {HOLDING, BRAKED, OFF},
    JOGGING: {HOLDING, STOPPING, FAULT},
    PAUSED: {MOVING, HOLDING, STOPPING, FAULT},
}
MAY = {  # in all other modes the request must be refused
    "move_joints": {HOLDING},
    "home": {OFF, BRAKED, HOLDING},
    "jog": {HOLDING, JOGGING},
    "pause": {MOVING, PAUSED},
    "resume": {MOVING, PAUSED},
    "guide": {HOLDING, BRAKED},
    "brake": {BRAKED, HOLDING, GUIDING, FAULT},
}
LEAVES_FAULT = {"acknowledge", "off"}
ZERO_DOUBTED = {"encoder_signal", "encoder_miscount", "zero_lost"}
TRAVELLING = {MOVING, HOMING, JOGGING, PAUSED, STOPPING}
STOPS_WITHIN_S = 1.5
LEAVES_WITHIN_S = 30.0
TARGETS = [STRETCHED, (0.4, -0.5, 0.4), (-0.3, -0.9, 0.6)]
SPEED_LIMIT_rad_s = 2.0  # of arm right
FAULTS = [
    ("silent", "encoder", 0.06),
    ("silent", "motor2", 0.06),
    ("drop_frames", "encoder", 0.2),
    ("drop_frames", "motor1", 0.2),
    ("duplicate_frames", "motor3", 0.2),
    ("quadrature_error", "encoder", 0.05),
    ("over_temperature", "motor3", 0.05),
    ("over_current", "motor1", 0.02),
]


class Arm(RuleBasedStateMachine):
    """Whoever asks, and whatever breaks, modes change only as the document says, and the arm can be brought home."""

    def __init__(self) -> None:
        super().__init__()
        self.stack = ExitStack()
        self.asked: set[str] = set()
        self.was_faulty = False

    @initialize(is_homed=st.booleans())
    def connect(self, is_homed: bool) -> None:
        self.cell = self.stack.enter_context(open_cell(scenario(homed=is_homed)))
        self.seen, self.mode = [self.cell.mode], self.cell.mode
        self.speeds = self.cell.true_speeds()
        self.cell.watchers.append(lambda: self.seen.append(self.cell.mode))

    @rule(cycles=st.integers(1, 80))
    def time_passes(self, cycles: int) -> None:
        self.cell.run(cycles * PERIOD_S)

    @rule(q_rad=st.sampled_from(TARGETS), speed=st.sampled_from([0.2, 1.0]))
    def move(self, q_rad: tuple[float, ...], speed: float) -> None:
        self.ask("move_joints", q_rad=list(q_rad), speed=speed)

    @rule(speed_rad_s=st.sampled_from([0.1, -0.1]))
    def jog(self, speed_rad_s: float) -> None:
        self.ask("jog", joint_speed_rad_s=[speed_rad_s, 0.0, 0.0])

    @rule(do=st.sampled_from(["enable", "home", "pause", "resume", "stop", "hold", "brake", "acknowledge", "off"]))
    def request(self, do: str) -> None:
        self.ask(do)

    @rule()
    def stop(self) -> None:
        """A stop is heard in every mode, and ends every motion in time."""
        assert self.ask("stop")
        begun_s = self.cell.rig.clock.now_s()
        while self.cell.mode in TRAVELLING:
            self.cell.run(PERIOD_S)
            assert self.cell.rig.clock.now_s() - begun_s < STOPS_WITHIN_S

    @rule(weightless=st.booleans())
    def guide(self, weightless: bool) -> None:
        self.ask("guide", weightless=weightless)

    @rule(fault=st.sampled_from(FAULTS))
    def break_something(self, fault: tuple[str, str, float]) -> None:
        kind, board, duration_s = fault
        now_s = self.cell.rig.clock.now_s()
        probability = 0.5 if kind in ("drop_frames", "duplicate_frames") else 1.0
        self.cell.inject(kind, board, at_s=now_s, until_s=now_s + duration_s, probability=probability)
        self.was_faulty = True

    def ask(self, do: str, **arguments: Any) -> bool:
        """Ask, and hold the answer against the model: what is refused changes nothing."""
        before, faults, homed = self.cell.mode, self.cell.faults, self.cell.runtime.monitor.is_homed
        self.cycles_before = len(self.seen)
        answer = self.cell.channel.request({"do": do, **arguments})
        if answer["ok"]:
            assert before in MAY.get(do, set(Mode)), f"{do} was accepted in {before}"
            assert do != "move_joints" or homed
            self.asked.add(do)
        elif len(self.seen) == self.cycles_before:  # no cycle ran in between
            assert (self.cell.mode, self.cell.faults) == (before, faults)
        self.seen.append(self.cell.mode)
        return bool(answer["ok"])

    @invariant()
    def modes_follow_each_other_as_the_document_says(self) -> None:
        for mode in self.seen if hasattr(self, "seen") else ():
            if mode is self.mode:
                continue
            steps = FOLLOWS[self.mode]
            between = {far for near in steps & {BRAKED, HOLDING} for far in FOLLOWS[near]}
            assert mode in steps | between, f"{self.mode} to {mode}"
            assert self.mode is not FAULT or self.asked & LEAVES_FAULT
            if mode is FAULT:
                self.asked -= LEAVES_FAULT
            self.mode = mode
        if hasattr(self, "seen"):
            self.seen.clear()

    @invariant()
    def a_count_that_went_wrong_is_no_zero(self) -> None:
        if hasattr(self, "cell") and {code for code, _ in self.cell.faults} & ZERO_DOUBTED:
            assert not self.cell.runtime.monitor.is_homed

    @invariant()
    def a_fault_is_there_exactly_while_it_is_not_acknowledged(self) -> None:
        if hasattr(self, "cell") and self.cell.mode is FAULT:
            assert self.cell.faults

    @invariant()
    def nothing_is_faster_than_it_may_be(self) -> None:
        if hasattr(self, "cell") and not self.was_faulty and not self.asked & {"guide", "brake", "off"}:
            assert max(self.speeds, default=0.0) <= 1.2 * SPEED_LIMIT_rad_s

    def teardown(self) -> None:
        """From wherever it is, the arm can be brought to OFF: faults end, are acknowledged, and `off` is asked."""
        if hasattr(self, "cell"):
            self.cell.rig.clear_faults()
            self.cell.run(0.3)
            self.cell.channel.request({"do": "stop"})
            self.cell.run(1.0)
            self.cell.channel.request({"do": "acknowledge"})
            assert self.cell.channel.request({"do": "off"})["ok"]
            self.cell.until(lambda: self.cell.mode is OFF, LEAVES_WITHIN_S)
        self.stack.close()


Arm.TestCase.settings = settings(
    max_examples=int(os.environ.get("STATE_MACHINE_EXAMPLES", "6")),
    stateful_step_count=20,
    deadline=None,
    derandomize="STATE_MACHINE_EXAMPLES" not in os.environ,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
TestArm = Arm.TestCase

"""Homing: each joint toward its home switch, on to the next index pulse, stop, shift the counter.

An incremental encoder has no zero at power-up. The switch (a cam that is active on one side of an angle) gives the direction
and the motor turn, and the index pulse in that turn gives the exact position: the counter is shifted by the error of the
latched count once the joint is at rest. The joints home one after the other while the others hold; the first that
fails stops all.

    RELEASE  the switch is active: move back until it is not, and a little further
    SEEK     move forward until the switch becomes active; forward is from `switch_rad` to `index_rad`
    CHECK    as RELEASE, then SEEK again: a glitch, or a wire that came off, is no cam, and would cost whole motor turns. Now
             slowly: without an index, the edge is the zero, and it is seen some cycles late
    INDEX    continue slowly until the index latches
    SETTLE   slow down; at rest, shift the counter
    SHIFTED  the next cycle reads counts from the new zero
    DONE
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from control.hardware.board_stop import Bridge
from control.hardware.interface import HOME_SWITCH, Feedback
from control.motion.setpoint import SetPoint

# By as much a held joint may hunt at rest: without friction by a count, with play or friction by more.
HUNTS_counts, HUNTS_rad = 2, 1e-3
SETTLE_S = 0.1
SETTLE_LIMIT_S = 10.0
SLOW_FRACTION = 0.3  # of the seeking speed, at the edge and the index that give the zero
TURN_TOLERANCE = 0.35  # of the encoder's turn, between the index and its position in arm.toml; half a turn is ambiguous


class Phase(Enum):
    """Phase of a joint's homing."""

    RELEASE = "release"
    SEEK = "seek"
    CHECK = "check"
    INDEX = "index"
    SETTLE = "settle"
    SHIFTED = "shifted"
    DONE = "done"


STEPS = {
    Phase.RELEASE: "backing off its home switch",
    Phase.SEEK: "seeking its home switch",
    Phase.CHECK: "backing off its home switch once more",
    Phase.INDEX: "seeking its index pulse",
    Phase.SETTLE: "coming to rest at its zero",
    Phase.SHIFTED: "zero set",
    Phase.DONE: "zero set",
}


@dataclass(frozen=True, slots=True)
class JointHome:
    """Homing parameters of a joint, in rad: its switch becomes active at `switch_rad`, the next index is at `index_rad`."""

    name: str
    speed_rad_s: float
    acceleration_rad_s2: float
    backoff_rad: float
    travel_rad: float
    switch_rad: float
    index_rad: float
    sense: float  # 1 or -1: the direction in which the switch becomes active
    edge_rad: float  # by which the switch may move
    turn_rad: float  # from one index to the next
    count_rad: float
    index_count: int
    repeat_counts: int = 0  # of an absolute encoder, after which it says the same again: its place within them is known


class Counter(Protocol):
    """The hardware functions that homing needs."""

    def arm_index(self, joint: int) -> None: ...

    def index_count(self, joint: int) -> int | None: ...

    def shift_count(self, joint: int, counts: int) -> None: ...


class HomingFailed(Exception):
    """A joint did not find its zero."""

    def __init__(self, where: str, message: str, remedy: str) -> None:
        super().__init__(f"{where}: {message}; {remedy}")
        self.where = where
        self.message = message
        self.remedy = remedy


class JointHoming:
    """Homes one joint by moving its set-point; call `step` every cycle until `phase` is DONE."""

    def __init__(self, home: JointHome, joint: int, counter: Counter) -> None:
        self.phase = Phase.RELEASE
        self.name = home.name
        self.speed_set_rad_s = 0.0
        self.acceleration_set_rad_s2 = 0.0
        self._home = home
        self._joint = joint
        self._counter = counter
        self._travelled_rad = 0.0  # in this phase
        self._place_rad = 0.0  # since the start
        self._edge_rad: float | None = None  # where the switch became active first
        self._since_active_rad = home.backoff_rad
        self._forth = home.sense
        self._settling_s = self._quiet_s = 0.0
        self._rest_count = 0

    def step(self, feedback: Feedback, elapsed_s: float) -> float:
        """Advance by one cycle and return the step of the set-point in rad. HomingFailed if switch or index is not found."""
        is_active = bool(feedback.channel_flags[self._joint] & HOME_SWITCH)
        if self.phase in (Phase.RELEASE, Phase.CHECK):
            if is_active or self._since_active_rad < self._home.backoff_rad:
                return self._release(is_active, elapsed_s)
            self._enter(Phase.SEEK)  # at once: behind it there may be the limit switch of the other end
        if self.phase is Phase.SEEK:
            return self._seek(is_active, elapsed_s)
        if self.phase is Phase.INDEX:
            return self._find_index(elapsed_s)
        if self.phase is Phase.SETTLE:
            return self._settle(feedback.count[self._joint], elapsed_s)
        self.phase = Phase.DONE  # this cycle's counts are relative to the new zero
        return 0.0

    def take_up(self, bridge: Bridge) -> float:
        """Go on after a pause of the host in which the boards slowed the joint down; return its way meanwhile in rad."""
        step = self.speed_set_rad_s * bridge.motion_s
        self._travelled_rad += step
        self._place_rad += step
        self._since_active_rad += abs(step) if self.phase in (Phase.RELEASE, Phase.CHECK) else 0.0
        self.speed_set_rad_s *= bridge.speed_share
        self.acceleration_set_rad_s2 = 0.0
        return step

    def _release(self, is_active: bool, elapsed_s: float) -> float:
        step = self._go(-self._forth * self._home.speed_rad_s, elapsed_s)
        self._since_active_rad = 0.0 if is_active else self._since_active_rad + abs(step)
        self._check(self._way_rad(), "its home switch stays active", "check for a stuck or inverted switch")
        return step

    def _seek(self, is_active: bool, elapsed_s: float) -> float:
        share = 1.0 if self._edge_rad is None else SLOW_FRACTION
        step = self._go(self._forth * self._home.speed_rad_s * share, elapsed_s)
        self._check(self._way_rad(), "its home switch never became active", "check the switch, its cam and its wire")
        if not is_active:
            return step
        if self._edge_rad is None:
            self._edge_rad = self._place_rad
            self._since_active_rad = 0.0
            self._enter(Phase.CHECK)
        else:
            self._check_edge(abs(self._place_rad - self._edge_rad))
            self._counter.arm_index(self._joint)
            self._enter(Phase.INDEX)
        return step

    def _way_rad(self) -> float:
        """The longest way to release or find the switch: once it was found, it is near."""
        home = self._home
        return home.travel_rad if self._edge_rad is None else home.backoff_rad + self._two_turns_rad

    @property
    def _two_turns_rad(self) -> float:
        """Within which there is an index, as far as the joint turns."""
        return min(2.0 * self._home.turn_rad, self._home.travel_rad)

    def _check_edge(self, off_rad: float) -> None:
        """Check that the switch became active at one place twice."""
        most_rad = self._home.edge_rad
        if off_rad > most_rad:
            raise HomingFailed(
                self._home.name,
                f"its home switch became active at two places, {off_rad:.4f} rad apart (tolerance {most_rad:.4f} rad)",
                "it bounces, or its wire is loose or picks up noise: check switch, plug and shield, then home again",
            )

    def _find_index(self, elapsed_s: float) -> float:
        step = self._go(self._forth * self._home.speed_rad_s * SLOW_FRACTION, elapsed_s)
        if self._counter.index_count(self._joint) is not None:
            self._check_turn()
            self._enter(Phase.SETTLE)
        self._check(self._two_turns_rad, "no index pulse within two turns of the encoder", "check the encoder's Z wire")
        return step

    def _settle(self, count: int, elapsed_s: float) -> float:
        step = self._go(0.0, elapsed_s)
        latched = self._counter.index_count(self._joint)
        most = HUNTS_counts + HUNTS_rad / self._home.count_rad
        is_quiet = self.speed_set_rad_s == 0.0 and abs(count - self._rest_count) <= most
        self._quiet_s = self._quiet_s + elapsed_s if is_quiet else 0.0
        self._settling_s += elapsed_s
        if self._settling_s > SETTLE_LIMIT_S:
            raise HomingFailed(
                self._home.name,
                f"its index was found, but it does not come to rest: it still moved in the last of {SETTLE_LIMIT_S:g} s",
                "it hunts, by gains too high for the play or spring between its motor and its encoder: leave kp, ki and kd out of"
                " its [drive.pid], so that they come from the model, or lower them",
            )
        if not is_quiet:
            self._rest_count = count
        if self._quiet_s >= SETTLE_S and latched is not None:
            self._counter.shift_count(self._joint, self._whole_repeats(self._home.index_count - latched))
            self._enter(Phase.SHIFTED)
        return step

    def _whole_repeats(self, counts: int) -> int:
        """The shift that the switch asks for; of an absolute encoder the nearest one that keeps its place within a turn."""
        repeat = self._home.repeat_counts
        if not repeat:
            return counts
        off = (counts + repeat // 2) % repeat - repeat // 2
        if abs(off) > TURN_TOLERANCE * repeat:
            raise HomingFailed(
                self._home.name,
                f"its home switch and its absolute encoder differ by {abs(off)} of the {repeat} counts after which that repeats"
                f" (tolerance {TURN_TOLERANCE * repeat:.0f}): the turn is ambiguous",
                "the switch has moved: adjust it, or correct switch_rad and zero_count in arm.toml",
            )
        return counts - off

    def _check_turn(self) -> None:
        """Check that the latch is in the encoder's turn of arm.toml, clear of the two adjacent turns."""
        expected_rad = self._home.index_rad - self._home.switch_rad
        off = abs(self._travelled_rad - expected_rad) / self._home.turn_rad
        if off > TURN_TOLERANCE:
            raise HomingFailed(
                self._home.name,
                f"its index was {self._travelled_rad:.4f} rad after its home switch, expected {expected_rad:.4f} rad"
                f" (tolerance {TURN_TOLERANCE * self._home.turn_rad:.4f} rad): the encoder's turn is ambiguous",
                "the switch has moved: adjust it, or correct [drive.home] in arm.toml",
            )

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._travelled_rad = 0.0

    def _check(self, travel_rad: float, message: str, remedy: str) -> None:
        if abs(self._travelled_rad) > travel_rad:
            raise HomingFailed(
                self._home.name, f"{message} (moved {self._travelled_rad:.3f} rad, limit {travel_rad:.3f} rad)", remedy
            )

    def _go(self, speed_rad_s: float, elapsed_s: float) -> float:
        change = self._home.acceleration_rad_s2 * elapsed_s
        speed = min(max(speed_rad_s, self.speed_set_rad_s - change), self.speed_set_rad_s + change)
        step = 0.5 * (self.speed_set_rad_s + speed) * elapsed_s
        self.acceleration_set_rad_s2 = (speed - self.speed_set_rad_s) / elapsed_s
        self.speed_set_rad_s = speed
        self._travelled_rad += step
        self._place_rad += step
        return step


class HomingSequence:
    """Homes joints one after the other: `step` returns the next set-point of all of them."""

    def __init__(self, homes: Sequence[tuple[int, JointHome]], counter: Counter) -> None:
        self._waiting = list(homes)
        self._count = len(self._waiting)
        self._counter = counter
        self._present: tuple[int, JointHoming] | None = None

    @property
    def step_text(self) -> str:
        """The joint being homed and its phase, as text; empty between two joints."""
        if self._present is None:
            return ""
        _, homing = self._present
        return f"{homing.name} ({self._count - len(self._waiting)} of {self._count}): {STEPS[homing.phase]}"

    @property
    def is_done(self) -> bool:
        """Whether every joint is homed."""
        return not self._waiting and self._present is None

    @property
    def phase(self) -> Phase | None:
        """Phase of the joint being homed; None if there is none."""
        return None if self._present is None else self._present[1].phase

    def step(self, set_point: SetPoint, feedback: Feedback, elapsed_s: float) -> SetPoint:
        """Return this cycle's set-point, given the last one. HomingFailed names the joint that did not find its zero."""
        if self._present is None:
            if not self._waiting:
                return set_point
            joint, home = self._waiting.pop(0)
            self._present = (joint, JointHoming(home, joint, self._counter))
        joint, homing = self._present
        step_rad = homing.step(feedback, elapsed_s)
        if homing.phase is Phase.DONE:
            self._present = None
        return _with_joint(set_point, joint, step_rad, homing.speed_set_rad_s, homing.acceleration_set_rad_s2)

    def take_up(self, set_point: SetPoint, bridge: Bridge) -> SetPoint:
        """Go on after a pause of the host in which the boards slowed the joint down."""
        if self._present is None:
            return set_point
        joint, homing = self._present
        step_rad = homing.take_up(bridge)
        return _with_joint(set_point, joint, step_rad, homing.speed_set_rad_s, homing.acceleration_set_rad_s2)


def _with_joint(set_point: SetPoint, joint: int, step_rad: float, speed_rad_s: float, acceleration_rad_s2: float) -> SetPoint:
    q, speed, acceleration = (list(values) for values in set_point)
    q[joint] += step_rad
    speed[joint] = speed_rad_s
    acceleration[joint] = acceleration_rad_s2
    return SetPoint(tuple(q), tuple(speed), tuple(acceleration))

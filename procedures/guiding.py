"""Motions that a hand has shown: another arm follows them, or the arm repeats them.

In: joint angles of a guided arm, now or from a recording. Out: jogs of the follower, or a smoothed path of
the joints within their limits.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.cell import Placed
from control.motion.guard import Guard
from control.motion.joint_limits import JointLimits
from control.motion.joint_path import JointPath
from control.motion.setpoint import SetPoint
from control.recording.reading import Recording
from control.server.channel import Message
from control.server.client import ArmClient, ArmFaulted, MotionStopped, RequestRefused, fault_text

# One arm follows another: jogs of the follower that lead to the leader's joint angles, as they are or
# mirrored.
#
# The follower is jogged, so that all that holds for jogs holds here: reduced speed, the joints' ranges,
# floor, table and the other arms, and it comes to rest when its client falls silent.


PERIOD_S = 0.02  # of the requests; a jog must be renewed at 10 Hz
APPROACH_SPEED = 0.3  # of the joints' limits, to where the leader is
NEAR_rad = 0.02  # of the leader's pose: no approach is needed
MIRRORED_WITHIN_m = 0.02  # between a mirrored tip and the follower's: two calibrated arms differ by some mm
POSES = 12  # at which that is compared
LOST = ("OFF", "FAULT")  # modes of a leader that is not followed


def mirror_signs(leader: Placed, follower: Placed) -> tuple[float, ...]:
    """Signs of the follower's joints for which its tip is the mirror image of the leader's. ArmError if there are none.

    The mirror is the plane halfway between the two bases, perpendicular to the line between them.
    """
    require_alike(leader, follower)
    leader_m, follower_m = np.array(leader.origin_m), np.array(follower.origin_m)
    length_m = float(np.linalg.norm(follower_m - leader_m))
    if length_m < MIRRORED_WITHIN_m:
        raise ArmError(f"follow: arms {leader.name!r} and {follower.name!r} stand at one place: there is no plane between them")
    normal, middle = (follower_m - leader_m) / length_m, 0.5 * (leader_m + follower_m)
    poses = _poses(leader)
    wanted = []
    for q_rad in poses:
        tip = np.array(leader.in_cell(ForwardKinematics(leader.arm).tip(*q_rad)))
        wanted.append(tip - 2.0 * normal * float(normal @ (tip - middle)))
    kinematics = ForwardKinematics(follower.arm)

    def off_m(signs: Sequence[float]) -> float:
        tips = (follower.in_cell(kinematics.tip(*(s * q for s, q in zip(signs, pose, strict=True)))) for pose in poses)
        return max(math.dist(tip, want) for tip, want in zip(tips, wanted, strict=True))

    best = min(itertools.product((1.0, -1.0), repeat=follower.arm.joint_count), key=off_m)
    if off_m(best) > MIRRORED_WITHIN_m:
        raise ArmError(
            f"follow: arms {leader.name!r} and {follower.name!r} are no mirror images of each other in this cell: the tips miss"
            f" by {off_m(best):.3f} m (at most {MIRRORED_WITHIN_m} m); without --mirrored the joints take the same angles"
        )
    return best


def require_alike(leader: Placed, follower: Placed) -> None:
    """ArmError unless both arms have as many joints."""
    counts = leader.arm.joint_count, follower.arm.joint_count
    if counts[0] != counts[1]:
        raise ArmError(
            f"follow: expected arms with as many joints, got {counts[0]} ({leader.name}) and {counts[1]} ({follower.name})"
        )


def _poses(placed: Placed) -> list[tuple[float, ...]]:
    source = random.Random(0)
    limits = [(max(lower, -math.pi), min(upper, math.pi)) for lower, upper in placed.arm.limits_rad]
    return [tuple(source.uniform(*ends) for ends in limits) for _ in range(POSES)]


class Following:
    """A follower on its leader's heels. `signs`: of the follower's joint angles over the leader's."""

    def __init__(self, leader: ArmClient, follower: ArmClient, placed: Placed, signs: Sequence[float]) -> None:
        """`placed`: the follower."""
        self._leader, self._follower, self._signs = leader, follower, tuple(signs)
        self._range_rad = placed.arm.limits_rad
        self._is_jogging = False
        self.limited = ""

    def approach(self) -> None:
        """Move the follower to where the leader's pose puts it, by a planned motion. RequestRefused, MotionStopped."""
        target = self._target_rad(self._read(self._leader))
        away_rad = max(abs(a - b) for a, b in zip(target, self._read(self._follower)["joint_set_rad"], strict=True))
        if away_rad > NEAR_rad:
            self._follower.move_joints(target, APPROACH_SPEED)

    def step(self) -> None:
        """One request: the leader's speed, and what brings the follower nearer. ArmFaulted or MotionStopped end it."""
        leader = self._read(self._leader)
        speeds = [sign * speed for sign, speed in zip(self._signs, leader["speed_rad_s"], strict=True)]
        try:
            self.limited = self._follower.follow(self._target_rad(leader), speeds)
        except RequestRefused as refusal:
            if not self._is_jogging:
                raise
            raise MotionStopped(f"following has ended: {refusal}") from None
        self._is_jogging = True

    def run(self, on_step: Callable[[], bool]) -> None:
        """Follow until `on_step`, called after each request, is false."""
        self.approach()
        self.step()
        while on_step():
            self._follower.wait(PERIOD_S)
            self.step()

    def _read(self, client: ArmClient) -> Message:
        status = client.status()
        if status["mode"] == "FAULT":
            raise ArmFaulted(fault_text(status))
        if status["mode"] in LOST or not status["is_homed"]:
            homed = "homed" if status["is_homed"] else "not homed"
            raise ArmError(f"follow: arm {status['arm']!r} is {status['mode']} and {homed}: enable and home both arms first")
        return status

    def _target_rad(self, leader: Message) -> tuple[float, ...]:
        """The follower's joint angles, within its range."""
        return tuple(
            min(max(sign * q, lower), upper)
            for sign, q, (lower, upper) in zip(self._signs, leader["joint_rad"], self._range_rad, strict=True)
        )


# A motion that a hand has guided, from a recording, as a path of the joints: smoothed, eased, and within
# limits.
#
# The angles are resampled and smoothed twice with a raised cosine, held at both ends before, so that the
# path begins and ends at rest. Where a joint would exceed its speed, acceleration or jerk, or the tip its
# speed, the whole path takes longer.


Array = NDArray[np.float64]
STEP_S = 0.01  # of the resampled angles
SMOOTH_S = 0.12  # half width of each smoothing: a hand's tremor is faster
KNOT_S = 0.04  # between the path's knots, of the guided time
KNOTS_MOST = 4000  # a request stays below the longest line
STILL_rad = 0.003  # from the first and the last pose: the hand has not begun, or has ended
SHORTEST_S = 0.2
MARGIN = 1.02  # of the limits: between the knots


@dataclass(frozen=True, slots=True)
class Guided:
    """Joint angles (m, n) at times (m,) [s] from 0, of run `run` of a recording."""

    run: int
    times_s: Array
    q_rad: Array


@dataclass(frozen=True, slots=True)
class Replay:
    """The path, how much longer it takes than the hand took, and which limit made it longer; empty if none did."""

    path: JointPath
    slowdown: float
    limit: str


def guided_motion(file: Path, arm: Arm, run: int | None = None) -> Guided:
    """The last hand-guided motion of a recording, or that of a run. ArmError says what there is instead."""
    recording = Recording.open(file)
    names = recording.layout.names
    count = recording.layout.joint_count
    if count != arm.joint_count:
        raise ArmError(f"{file}: expected a recording of {arm.joint_count} joints, as arm {arm.name!r} has, got {count}")
    angle = "joint{}_rad" if "joint1_rad" in names else "q{}_rad"
    wanted = [names.index(name) for name in ("t_s", "run", "mode", *(angle.format(j + 1) for j in range(count)))]
    guiding = recording.modes.index("GUIDING")
    rows = [[row[k] for k in wanted] for row in recording.rows() if row[wanted[2]] == guiding]
    table = np.array(rows, dtype=np.float64).reshape(-1, len(wanted))
    runs = sorted({int(number) for number in table[:, 1]})
    if not runs or (run is not None and run not in runs):
        have = f"it has hand-guided runs {', '.join(map(str, runs))}" if runs else "nothing in it was guided by hand"
        raise ArmError(f"{file}: no hand-guided run{'' if run is None else f' {run}'}: {have}")
    chosen = runs[-1] if run is None else run
    part = table[table[:, 1] == chosen]
    return Guided(chosen, part[:, 0] - part[0, 0], part[:, 3:])


def replayed(guided: Guided, arm: Arm, speed: float = 1.0) -> Replay:
    """The path of a guided motion for an arm, at a fraction of its limits. ArmError, MotionError."""
    q_rad = _smoothed(_moving_part(guided))
    limits = JointLimits.of(arm)
    _require_range(q_rad, limits, guided.run)
    knots = _knots(q_rad)
    slowdown, limit = _slowdown(q_rad, arm, limits.scaled(speed), speed)
    times = (knots * STEP_S * slowdown).tolist()
    v, a = _rates(q_rad)
    v, a = v[knots] / slowdown, a[knots] / slowdown**2
    v[[0, -1]] = a[[0, -1]] = 0.0
    rows = zip(q_rad[knots].tolist(), v.tolist(), a.tolist(), strict=True)
    path = JointPath((t - times[0] for t in times), [SetPoint(*map(tuple, row)) for row in rows])
    path.require_within(limits)
    Guard(arm, limits).require_joint_path(path)  # before the arm moves to the beginning
    return Replay(path, slowdown, limit)


def _moving_part(guided: Guided) -> Array:
    """The angles at even times, without the standing before and after the motion."""
    q, t = guided.q_rad, guided.times_s
    is_begun = np.abs(q - q[0]).max(axis=1) > STILL_rad
    is_going_on = np.abs(q - q[-1]).max(axis=1) > STILL_rad
    if not is_begun.any() or t[-1] < SHORTEST_S:
        raise ArmError(f"replay: run {guided.run}: the arm was hardly moved by hand: guide it, then replay that run")
    first, last = int(np.argmax(is_begun)), len(q) - int(np.argmax(is_going_on[::-1]))
    first, last = max(first - 1, 0), min(max(last, first + 2), len(q))
    even = np.arange(t[first], t[last - 1], STEP_S)
    return np.column_stack([np.interp(even, t[first:last], column) for column in q[first:last].T])


def _smoothed(q_rad: Array) -> Array:
    """Held at both ends, then smoothed twice: at rest at both ends, with a continuous acceleration."""
    half = round(SMOOTH_S / STEP_S)
    weights = np.hanning(2 * half + 3)[1:-1]
    weights /= weights.sum()
    held = np.pad(q_rad, ((4 * half, 4 * half), (0, 0)), mode="edge")
    for _ in range(2):
        held = np.column_stack([np.convolve(column, weights, mode="valid") for column in held.T])
    return held


def _rates(q_rad: Array) -> tuple[Array, Array]:
    """Speeds and accelerations in the guided time, by central differences."""
    v = np.gradient(q_rad, STEP_S, axis=0)
    return v, np.gradient(v, STEP_S, axis=0)


def _knots(q_rad: Array) -> NDArray[np.int64]:
    """Which of the even times are knots of the path; both ends are."""
    count = min(KNOTS_MOST, max(2, round(len(q_rad) * STEP_S / KNOT_S)))
    return np.unique(np.round(np.linspace(0, len(q_rad) - 1, count)).astype(np.int64))


def _slowdown(q_rad: Array, arm: Arm, limits: JointLimits, speed: float) -> tuple[float, str]:
    """How much longer the path must take, at least 1, and why: speed, acceleration or jerk of a joint, or the tip's speed."""
    v, a = _rates(q_rad)
    j = np.gradient(a, STEP_S, axis=0)
    needs = [(1.0, "")]
    for what, values, most, power in (
        ("speed", v, limits.speed_rad_s, 1.0),
        ("acceleration", a, limits.acceleration_rad_s2, 2.0),
        ("jerk", j, limits.jerk_rad_s3, 3.0),
    ):
        over = (np.abs(values).max(axis=0) / np.array(most)) ** (1.0 / power)
        joint = int(np.argmax(over))
        needs.append((float(over[joint]), f"the {what} of joint {joint + 1}"))
    ways_m = np.linalg.norm(np.diff(ForwardKinematics(arm).tips(q_rad), axis=0), axis=1)
    needs.append((float(ways_m.max()) / STEP_S / (speed * arm.limits.tip_speed_m_s), "the tip's speed"))
    slowdown, limit = max(needs)
    return (MARGIN * slowdown, limit) if limit else (1.0, "")


def _require_range(q_rad: Array, limits: JointLimits, run: int) -> None:
    lower, upper = np.array(limits.lower_rad), np.array(limits.upper_rad)
    beyond = np.maximum(lower - q_rad, q_rad - upper)
    joint = int(np.argmax(beyond.max(axis=0)))
    if beyond[:, joint].max() > 0.0:
        at = int(np.argmax(beyond[:, joint]))
        raise ArmError(
            f"replay: run {run}: joint {joint + 1} was guided to {q_rad[at, joint]:.4f} rad, outside of its range"
            f" {lower[joint]:.4f} to {upper[joint]:.4f} rad: guide it again within"
        )

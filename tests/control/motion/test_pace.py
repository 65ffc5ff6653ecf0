"""Pause, resume and override: the arm stays on its path, and inside the limits of its joints."""

import math
import random
from itertools import pairwise

import pytest

from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.pace import Paced
from control.motion.plan import plan_path
from control.safety.limits import SetPointLimits, limit_set_point

ARM = load_arm("right")
LIMITS = JointLimits.of(ARM)
PERIOD_S = 0.002
CIRCLE = [(0.5 + 0.09 * math.cos(a), 0.09 * math.sin(a), 0.1) for a in (2.0 * math.pi * i / 12 for i in range(13))]
GUARDS = [
    SetPointLimits(low, high, 1.05 * speed, 1.05 * acceleration)
    for low, high, speed, acceleration in zip(
        LIMITS.lower_rad, LIMITS.upper_rad, LIMITS.speed_rad_s, LIMITS.acceleration_rad_s2, strict=True
    )
]


def fastest_circle():
    """A circle so fast that some joint is at a limit of its own."""
    path = plan_path(ARM, CIRCLE, 0.9)
    return path.joints


def followed(paced, wanted_of, most_s=60.0):
    """Set-points until the motion is over; each has passed the loop's last guard, and no joint accelerates more than it may."""
    last = paced.motion.at(0.0)
    points = [last]
    for cycle in range(int(most_s / PERIOD_S)):
        now = paced.advance(PERIOD_S, wanted_of(cycle * PERIOD_S))
        allowed = limit_set_point(now.q_rad, last.q_rad, last.speed_rad_s, GUARDS, PERIOD_S)
        assert not allowed.reasons, (cycle, allowed.reasons)
        for v, before, guard in zip(now.speed_rad_s, last.speed_rad_s, GUARDS, strict=True):
            assert abs(v - before) / PERIOD_S <= guard.acceleration_rad_s2 + 1e-6, cycle
        points.append(now)
        last = now
        if paced.is_over:
            return points
    return points


def test_at_full_pace_the_motion_is_the_one_that_was_planned():
    move = JointMove((0.0, 0.0, 0.0), (0.5, -0.3, 0.2), LIMITS)
    paced = Paced(move, LIMITS.acceleration_rad_s2, 1.0)
    for cycle in range(1, 200):
        for got, planned in zip(paced.advance(PERIOD_S, 1.0), move.at(cycle * PERIOD_S), strict=True):
            assert got == pytest.approx(planned, abs=1e-9)


@pytest.mark.parametrize("pause_s", [0.02, 0.2, 0.4, 0.6])
def test_a_pause_comes_to_rest_on_the_path_and_goes_on_to_its_end(pause_s):
    paced = Paced(fastest_circle(), LIMITS.acceleration_rad_s2, 1.0)
    points = followed(paced, lambda t: 0.0 if pause_s <= t < pause_s + 1.5 else 1.0)
    assert paced.is_over
    at_rest = points[int((pause_s + 1.4) / PERIOD_S)]
    assert at_rest.speed_rad_s == at_rest.acceleration_rad_s2 == (0.0, 0.0, 0.0)
    tip = ForwardKinematics(ARM).tip
    # A spline through 12 points of a circle of 90 mm is within 0.4 mm of it; so is a tip that never leaves the spline.
    off = [abs(math.hypot(x - 0.5, y) - 0.09) for x, y, _ in (tip(*p.q_rad) for p in points)]
    assert max(off) < 4e-4
    assert tip(*points[-1].q_rad) == pytest.approx(CIRCLE[-1], abs=1e-6)


def test_a_pause_takes_less_than_half_a_second_on_a_path_that_is_not_at_its_limits():
    path = plan_path(ARM, CIRCLE, 0.3)
    paced = Paced(path.joints, LIMITS.acceleration_rad_s2, 1.0)
    points = followed(paced, lambda t: 1.0 if t < 0.5 else 0.0, most_s=1.0)
    speeds = [max(map(abs, p.speed_rad_s)) for p in points]
    assert speeds[int(0.5 / PERIOD_S)] > 0.1
    assert speeds[-1] == 0.0
    assert paced.time_s - 0.5 < 0.25


@pytest.mark.parametrize("override", [0.01, 0.3, 0.999])
def test_an_override_stretches_the_time_and_nothing_else(override):
    move = JointMove((0.0, 0.0, 0.0), (0.05, -0.03, 0.02), LIMITS)
    points = followed(Paced(move, LIMITS.acceleration_rad_s2, override), lambda _: override)
    assert len(points) * PERIOD_S == pytest.approx(move.duration_s / override, abs=3 * PERIOD_S / override)
    assert max(max(map(abs, p.speed_rad_s)) for p in points) <= override * max(LIMITS.speed_rad_s)


@pytest.mark.parametrize("seed", range(6))
def test_whatever_paces_are_wanted_no_limit_of_a_joint_is_passed(seed):
    """Two kinds of motion at their limits: a joint move is at its jerk limit everywhere, the circle at its acceleration."""
    draw = random.Random(seed)
    paces = [draw.choice([0.0, 1.0, draw.random()]) for _ in range(300)]
    q_to = tuple(draw.uniform(low, high) for low, high in zip(LIMITS.lower_rad, LIMITS.upper_rad, strict=True))
    for motion in (fastest_circle(), JointMove((0.0, 0.0, 0.0), q_to, LIMITS)):
        paced = Paced(motion, LIMITS.acceleration_rad_s2, 1.0)
        followed(paced, lambda t: paces[int(t / 0.13) % 300], most_s=6.0)


def test_a_pause_at_any_moment_of_a_move_at_its_limits_asks_for_no_more_than_they_are():
    """Where the move brakes by itself at full acceleration, there is nothing left for the pause."""
    move = JointMove((-1.0, -1.0, -1.0), (1.0, 0.5, 1.0), LIMITS)
    for tick in range(round(move.duration_s / 0.02)):
        paced = Paced(move, LIMITS.acceleration_rad_s2, 1.0)
        followed(paced, lambda t, begin=0.02 * tick: 0.0 if t >= begin else 1.0, most_s=0.02 * tick + 0.4)


def test_the_speed_that_a_set_point_says_is_the_one_that_it_moves_at():
    paced = Paced(fastest_circle(), LIMITS.acceleration_rad_s2, 1.0)
    points = followed(paced, lambda t: 0.2 if t > 0.3 else 1.0, most_s=2.0)
    for before, after in pairwise(points):
        for joint in range(3):
            moved = (after.q_rad[joint] - before.q_rad[joint]) / PERIOD_S
            said = 0.5 * (after.speed_rad_s[joint] + before.speed_rad_s[joint])
            # half a cycle of the largest acceleration
            assert moved == pytest.approx(said, abs=0.5 * PERIOD_S * 10.5 + 1e-6)


def test_a_motion_tells_whether_it_can_rest_on_its_path_in_time() -> None:
    from control.motion.setpoint import SetPoint

    class Even:
        duration_s = 10.0

        def at(self, time_s: float) -> SetPoint:
            return SetPoint((time_s,), (1.0,), (0.0,))

    class Broken(Even):
        def at(self, time_s: float) -> SetPoint:
            raise ValueError("no way")

    paced = Paced(Even(), [10.0], 1.0)
    paced.advance(0.5, 1.0)
    assert paced.can_rest(0.4)
    assert not paced.can_rest(0.2)
    assert (paced.time_s, paced.pace) == (0.5, 1.0)
    assert not Paced(Even(), [1e-3], 1.0).can_rest(0.4)
    assert not Paced(Broken(), [10.0], 1.0).can_rest(0.4)

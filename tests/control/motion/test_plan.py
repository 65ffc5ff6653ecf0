"""Paths planned for the reference arm: what runs, what is slowed and by whom, what is refused and why."""

import json
import math

import numpy as np
import pytest

from benchmarks.loop.jobs import circle, line
from control.errors import ArmError, PathError
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm
from control.motion import checks
from control.motion.following import BOUND_M, FEWEST
from control.motion.joint_limits import JointLimits
from control.motion.joint_path import JointPath
from control.motion.plan import Slowdown, plan_path
from control.motion.waypoints import Waypoints

ARM = load_arm("right")
KINEMATICS, INVERSE = ForwardKinematics(ARM), InverseKinematics(ARM)
LIMITS = JointLimits.of(ARM)
TABLE = ARM.table


def _calibrated():
    deviations = np.random.default_rng(5).uniform(-0.004, 0.004, ARM.dh.shape)
    return ARM.with_dh(ARM.dh + deviations)


def _samples(motion, count=1500):
    points = [motion.at(motion.duration_s * i / count) for i in range(count + 1)]
    return [np.array(column) for column in zip(*points, strict=True)]


@pytest.mark.parametrize("setup", ["normal", "roll", "pitch"])
@pytest.mark.parametrize("shape", [circle, line])
def test_circle_and_line_of_the_table_run_at_150_mm_s_on_every_tilt_without_slowing(shape, setup):
    planned = plan_path(ARM, shape(TABLE, setup), 0.15, setup=setup)
    assert planned.slowdowns == ()
    q, _, _ = _samples(planned.joints, 300)
    tips = KINEMATICS.tips(q)
    wanted = [planned.spline.at(planned.duration_s * i / 300)[0] for i in range(301)]
    np.testing.assert_allclose(tips, wanted, atol=BOUND_M)


@pytest.mark.parametrize("arm", [ARM, _calibrated()], ids=["nominal", "calibrated"])
def test_joint_speed_and_acceleration_are_the_derivatives_of_the_angles(arm):
    motion = plan_path(arm, circle(TABLE), 0.15).joints
    step = 1e-4
    for time in (0.1, 0.75, 1.0, 2.02, 3.3):
        before, here, after = (motion.at(time + k * step) for k in (-1, 0, 1))
        for joint in range(3):
            speed = (after.q_rad[joint] - before.q_rad[joint]) / (2 * step)
            acceleration = (after.speed_rad_s[joint] - before.speed_rad_s[joint]) / (2 * step)
            assert here.speed_rad_s[joint] == pytest.approx(speed, abs=1e-6)
            assert here.acceleration_rad_s2[joint] == pytest.approx(acceleration, abs=1e-5)


def test_the_path_of_a_calibrated_arm_puts_its_own_tip_on_the_circle():
    arm = _calibrated()
    q, _, _ = _samples(plan_path(arm, circle(TABLE), 0.15).joints, 200)
    tips = ForwardKinematics(arm).tips(q)
    radius = np.hypot(tips[:, 0] - 0.5, tips[:, 1])
    assert np.abs(radius[20:-20] - 0.09).max() < 2e-6
    assert np.abs(tips[:, 2]).max() < 1e-8


def test_a_path_starts_and_ends_at_rest():
    motion = plan_path(ARM, circle(TABLE), 0.15).joints
    for time in (0.0, motion.duration_s, motion.duration_s + 5.0):
        assert motion.at(time).speed_rad_s == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)


def test_a_motion_sampled_forward_backward_or_at_random_gives_the_same_set_points():
    planned = plan_path(ARM, circle(TABLE), 0.15)
    forward, jumping = planned.joints, planned.joints
    times = [planned.duration_s * i / 100 for i in range(101)]
    expected = {time: forward.at(time) for time in times}
    for time in np.random.default_rng(1).permutation(times).tolist():
        for got, wanted in zip(jumping.at(time), expected[time], strict=True):
            assert got == pytest.approx(wanted, abs=1e-8)


@pytest.mark.parametrize("speed", [0.3, 0.6, 1.0])
def test_a_path_too_fast_for_the_arm_is_slowed_until_every_limit_holds(speed):
    planned = plan_path(ARM, circle(TABLE), speed)
    _, speeds, accelerations = _samples(planned.joints)
    assert np.abs(speeds).max() <= 2.0 * 1.001
    assert np.abs(accelerations).max() <= 10.0 * 1.002
    asked = plan_path(ARM, circle(TABLE), 0.1).duration_s * 0.1 / speed
    assert planned.duration_s >= asked * (1.0 - 1e-9)


def test_slowing_uses_the_limit_up_and_is_faster_than_slowing_the_whole_path():
    planned = plan_path(ARM, circle(TABLE), 1.0)
    assert planned.slowdowns
    _, speeds, accelerations = _samples(planned.joints)
    use = max(np.abs(speeds).max() / 2.0, math.sqrt(np.abs(accelerations).max() / 10.0))
    assert use > 0.95
    assert planned.duration_s < 1.8  # the whole circle slowed by its worst section: 1.84 s


def test_a_slowed_path_is_continuous_in_velocity():
    spline = plan_path(ARM, circle(TABLE), 1.0).spline
    for knot in spline.times_s[1:-1]:
        assert spline.at(knot - 1e-12)[1] == pytest.approx(spline.at(knot + 1e-12)[1], abs=1e-6)


def test_a_slowdown_says_how_much_where_and_which_limit():
    planned = plan_path(ARM, [(0.4, -0.25, 0.1), (0.42, 0.0, 0.1), (0.4, 0.25, 0.1)], 0.9)
    assert planned.slowdowns
    assert all(slow.factor > 1.0 and 1 <= slow.waypoint <= 3 for slow in planned.slowdowns)
    assert str(Slowdown(1.4, 7, "joint 2 speed")) == "1.40 times as long as asked at way-point 7: joint 2 speed"


def test_the_tip_speed_limit_is_kept_and_named():
    planned = plan_path(ARM, [(0.35, -0.2, 0.2), (0.45, 0.0, 0.2), (0.35, 0.2, 0.2)], 1.6)
    _, _, _ = _samples(planned.joints, 10)
    fastest = max(math.hypot(*planned.spline.at(planned.duration_s * i / 999)[1]) for i in range(1000))
    assert fastest <= ARM.limits.tip_speed_m_s * 1.001


def test_without_speeds_the_acceleration_stays_continuous_when_slowed():
    spline = plan_path(ARM, circle(TABLE), pace_m_s=0.9).spline
    for knot in spline.times_s[1:-1]:
        assert spline.at(knot - 1e-12)[2] == pytest.approx(spline.at(knot + 1e-12)[2], abs=1e-5)


def test_speeds_of_a_file_are_used_unless_others_are_given():
    points = circle(TABLE).points
    named = Waypoints(points, (0.05,) * 25)
    assert plan_path(ARM, named).duration_s == pytest.approx(plan_path(ARM, points, 0.05).duration_s)
    assert plan_path(ARM, named, 0.1).duration_s == pytest.approx(plan_path(ARM, points, 0.1).duration_s)


def test_the_branch_nearest_to_the_arm_is_held_along_the_path():
    for near in ((0.0, -1.1, 0.2), (0.0, 0.3, 2.5)):
        try:
            planned = plan_path(ARM, circle(TABLE), 0.15, q_near_rad=near)
        except ArmError:
            continue
        q, _, _ = _samples(planned.joints, 200)
        assert {str(INVERSE.branch(pose)) for pose in q.tolist()} == {planned.branch}


@pytest.mark.parametrize("bad", [0, 1, 2])
def test_a_way_point_out_of_reach_is_named_with_the_distance(bad):
    points = [(0.45, -0.05, 0.1), (0.5, 0.0, 0.1), (0.55, 0.05, 0.1)]
    points[bad] = (1.2, 0.0, 0.1)
    with pytest.raises(PathError, match=rf"^way-point {bad + 1}: .* out of reach by 0\.4\d+ m.*nothing was moved") as caught:
        plan_path(ARM, points, 0.1)
    assert caught.value.waypoint == bad + 1


def test_a_way_point_from_a_file_is_named_by_file_and_line():
    points = ((0.45, -0.05, 0.1), (1.2, 0.0, 0.1))
    with pytest.raises(PathError, match=r"way-point 2 \(p\.csv:3\): "):
        plan_path(ARM, Waypoints(points, None, ("p.csv:2", "p.csv:3")), 0.1)


def test_a_way_point_beyond_a_joint_limit_names_joint_and_excess():
    with pytest.raises(PathError, match=r"way-point 2: .*joint \d .*rad beyond its limits"):
        plan_path(ARM, [(0.3, 0.3, 0.2), (-0.45, 0.02, 0.2)], 0.1)


def test_a_path_through_a_singular_region_is_refused_although_both_ends_are_good():
    with pytest.raises(PathError, match=r"(before|after) way-point [12]: .*(singular|reach|range|limit)"):
        plan_path(ARM, [(0.02, -0.3, 0.4), (0.02, 0.3, 0.4)], 0.1)


def test_a_path_into_the_table_is_refused_and_says_how_deep():
    with pytest.raises(PathError, match=r"way-point 2: the tip would go 0\.0200 m below the table") as caught:
        plan_path(ARM, [(0.45, 0.0, 0.05), (0.5, 0.0, -0.02), (0.55, 0.0, 0.05)], 0.1)
    assert caught.value.waypoint == 2


def test_touching_the_table_is_in_order_and_a_millimetre_into_it_is_not():
    good = [(0.45, 0.0, 0.0), (0.55, 0.0, -0.9 * checks.TOUCH_TOLERANCE_M)]
    assert plan_path(ARM, good, 0.1).duration_s > 0.0
    with pytest.raises(PathError, match="below the table"):
        plan_path(ARM, [(0.45, 0.0, 0.0), (0.55, 0.0, -0.001)], 0.1)


def test_the_tilted_board_is_the_one_that_counts():
    rolled = circle(TABLE, "roll")
    with pytest.raises(PathError, match="below the table"):
        plan_path(ARM, rolled, 0.1, setup="normal")
    assert plan_path(ARM, rolled, 0.1, setup="roll").duration_s > 0.0


def test_away_from_the_board_the_floor_counts():
    with pytest.raises(PathError, match=r"below the floor"):
        plan_path(ARM, [(0.3, 0.4, 0.1), (0.3, 0.42, -0.05)], 0.1)


def test_way_points_above_the_board_follow_its_tilt():
    raised = line(TABLE, "pitch", height_m=0.03)
    a = TABLE.pitch_tilt_rad
    middle = raised.points[4]
    assert middle == pytest.approx((0.5 + 0.03 * math.sin(a), 0.0, 0.03 * math.cos(a)))


def test_a_planned_path_survives_json_and_runs_the_same():
    planned = plan_path(ARM, circle(TABLE), 1.0)
    back = JointPath.from_message(json.loads(json.dumps(planned.to_message())))
    assert back.duration_s == pytest.approx(planned.duration_s, abs=1e-9)
    np.testing.assert_allclose(back.at(1.0), planned.joints.at(1.0), atol=1e-6)


def test_a_path_of_minutes_needs_no_more_sections_than_a_request_has_room_for():
    planned = plan_path(ARM, line(TABLE), 5e-4)
    assert planned.duration_s > 300.0
    assert len(planned.joints.times_s) < 2 * FEWEST  # halved until they are short enough; 6,000 of at most 0.1 s
    assert planned.joints.at(150.0).q_rad == pytest.approx(
        INVERSE.nearest(planned.spline.at(150.0)[0], planned.q_start_rad), abs=1e-5
    )

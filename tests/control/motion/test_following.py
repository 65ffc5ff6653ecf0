"""Paths of arms of two to seven joints: tip and orientation as asked for, rates that fit, limits, what is refused and where."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from benchmarks.arms import ARMS, FIVE, FOUR, SEVEN, SIX, TWO, arm_of, circle_in_place, tip_of, turned_in_place
from control.errors import ArmError, PathError
from control.kinematics import rotation
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics, PoseKinematics
from control.model.arm import Arm
from control.motion.following import BOUND_M, BOUND_RAD, LONGEST_S, OrientationSpline, turns_rad
from control.motion.joint_limits import JointLimits
from control.motion.joint_path import JointPath
from control.motion.plan import plan_path
from control.motion.waypoints import Waypoints


def sampled(path: JointPath, count: int = 1500) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    times_s = np.linspace(0.0, path.duration_s, count)
    points = [path.at(float(t)) for t in times_s]
    q, speed, acceleration = (np.array(column) for column in zip(*points, strict=True))
    return times_s, q, speed, acceleration


@pytest.mark.parametrize(("arm", "speed"), [(FOUR, None), (FIVE, 0.15), (SIX, 0.15), (SEVEN, None)])
def test_the_tip_stays_within_a_micrometre_of_the_cubic_and_the_joints_within_their_limits(arm: Arm, speed: float | None) -> None:
    planned = plan_path(arm, circle_in_place(arm), speed, q_near_rad=arm.rest.q_rad if arm.rest else None)
    path, limits = planned.joints, JointLimits.of(arm)
    times_s, q, _, _ = sampled(path)
    wanted = np.array([planned.spline.at(float(t))[0] for t in times_s])
    assert np.linalg.norm(ForwardKinematics(arm).tips(q) - wanted, axis=1).max() < BOUND_M
    path.require_within(limits)
    assert planned.duration_s == path.duration_s
    assert planned.q_start_rad == pytest.approx(path.knots[0].q_rad, abs=1e-12)


def test_a_path_that_its_joints_slow_down_is_still_few_sections_with_the_slowed_speeds() -> None:
    slow = tuple(replace(drive, joint_speed_limit_rad_s=0.15) for drive in FOUR.drives)
    arm = replace(FOUR, drives=slow)
    planned = plan_path(arm, circle_in_place(arm), None)
    path = planned.joints
    times_s, q, speed, _ = sampled(path)
    assert abs(speed).max() == pytest.approx(0.15, rel=0.02)
    assert np.gradient(q, times_s, axis=0)[1:-1] == pytest.approx(speed[1:-1], abs=2e-3)
    assert len(path.knots) < 2 * planned.duration_s / LONGEST_S


@pytest.mark.parametrize("arm", [SIX, SEVEN], ids=lambda arm: arm.name)
def test_position_and_orientation_are_held_together(arm: Arm) -> None:
    waypoints = circle_in_place(arm, tilt_rad=0.2)
    planned = plan_path(arm, waypoints, 0.1)
    times_s, q, _, _ = sampled(planned.joints)
    wanted = np.array([planned.spline.at(float(t))[0] for t in times_s])
    tip = PoseKinematics(ForwardKinematics(arm)).batch(q)
    assert np.linalg.norm(tip.position_m - wanted, axis=1).max() < BOUND_M
    assert waypoints.orientations is not None
    at = np.searchsorted(times_s, planned.spline.times_s[:-1])
    turned = rotation.matrices(np.array(waypoints.orientations[:-1]))
    off = rotation.logarithms(turned @ np.swapaxes(tip.rotation[at], 1, 2))
    assert np.linalg.norm(off, axis=1).max() < 2e-3 + BOUND_RAD  # a sample's time from the way-point's


@pytest.mark.parametrize("arm", [FOUR, SEVEN], ids=lambda arm: arm.name)
def test_speed_and_acceleration_are_the_derivatives_of_the_angles(arm: Arm) -> None:
    times_s, q, speed, acceleration = sampled(plan_path(arm, circle_in_place(arm)).joints, 4001)
    np.testing.assert_allclose(np.gradient(q, times_s, axis=0)[2:-2], speed[2:-2], atol=2e-3)
    np.testing.assert_allclose(np.gradient(speed, times_s, axis=0)[2:-2], acceleration[2:-2], atol=0.25)


def test_free_joints_stay_near_and_the_same_path_gives_the_same_postures() -> None:
    waypoints = circle_in_place(SEVEN)
    first, again = (plan_path(SEVEN, waypoints, 0.1).joints for _ in range(2))
    assert first.knots == again.knots
    _, q, _, _ = sampled(first)
    assert np.abs(q[-1] - q[0]).max() < 0.05  # a closed circle: hardly any drift of the posture
    assert np.abs(q - q[0]).max() < 0.5


def test_free_joints_leave_the_outer_fifth_of_their_range() -> None:
    near_limit = replace(SEVEN, drives=tuple(replace(d, joint_upper_rad=0.65 if d.joint == 2 else 2.6) for d in SEVEN.drives))
    assert SEVEN.rest is not None
    _, q, _, _ = sampled(plan_path(near_limit, circle_in_place(SEVEN), 0.1, q_near_rad=SEVEN.rest.q_rad).joints)
    assert q[:, 1].max() <= 0.65
    assert q[-1, 1] < q[0, 1]


def test_a_turn_in_place_and_a_turn_faster_than_the_way_are_slow_enough() -> None:
    here, waypoints = tip_of(SIX), turned_in_place(SIX, -0.5)
    planned = plan_path(SIX, waypoints, 0.2)
    times_s, q, _, _ = sampled(planned.joints)
    tip = PoseKinematics(ForwardKinematics(SIX)).batch(q)
    is_first = times_s < planned.spline.times_s[1]
    assert np.linalg.norm(tip.position_m[is_first] - here.position_m, axis=1).max() < BOUND_M
    relative = rotation.logarithms(tip.rotation[1:] @ np.swapaxes(tip.rotation[:-1], 1, 2))
    turning = np.linalg.norm(relative, axis=1) / np.diff(times_s)
    assert turning.max() <= 1.01 * SIX.limits.tip_turn_speed_rad_s


def test_turning_faster_than_allowed_is_slowed_and_said() -> None:
    calm = replace(SIX, limits=replace(SIX.limits, tip_turn_speed_rad_s=0.1))
    planned = plan_path(calm, circle_in_place(SIX, tilt_rad=0.2), 0.1)
    assert any("turning speed of the tip" in str(slowdown) for slowdown in planned.slowdowns)


def test_a_singular_passage_is_refused_with_its_place() -> None:
    with pytest.raises(PathError, match=r"way-point 2: the arm is near-singular: 0\.01") as caught:
        plan_path(SIX, turned_in_place(SIX, 0.5), 0.1)  # its axes 4 and 6 become parallel
    assert caught.value.waypoint == 2


def test_near_a_singular_pose_the_path_is_slowed() -> None:
    assert FOUR.rest is not None
    stretched = ForwardKinematics(FOUR).tip(0.0, 0.5, -0.35, -0.2)
    x, y, z = stretched
    planned = plan_path(FOUR, [(x - 0.2, y, z), (x, y, z)], 0.9)
    assert planned.slowdowns


def test_two_joints_follow_the_surface_that_they_reach_and_refuse_to_leave_it() -> None:
    assert TWO.rest is not None
    start = np.array(TWO.rest.q_rad)
    taught = [ForwardKinematics(TWO).tip(*(start + share * np.array([0.5, 0.3]))) for share in np.linspace(0, 1, 6)]
    planned = plan_path(TWO, taught, 0.1)
    times_s, q, _, _ = sampled(planned.joints)
    wanted = np.array([planned.spline.at(float(t))[0] for t in times_s])
    assert np.linalg.norm(ForwardKinematics(TWO).tips(q) - wanted, axis=1).max() < 1e-3
    x, y, z = taught[0]
    with pytest.raises(ArmError, match=r"way-point 2|out of reach"):
        plan_path(TWO, [taught[0], (1.1 * x, y, z)], 0.1)


@pytest.mark.parametrize("arm", [FOUR, FIVE], ids=lambda arm: arm.name)
def test_an_orientation_that_the_joints_cannot_give_is_refused_at_its_way_point(arm: Arm) -> None:
    with pytest.raises(PathError, match=r"rad"):
        plan_path(arm, circle_in_place(arm, tilt_rad=0.3), 0.1)


@pytest.mark.parametrize("arm", [FOUR, FIVE, SIX, SEVEN], ids=lambda arm: arm.name)
def test_what_was_taught_with_its_orientation_can_be_run(arm: Arm) -> None:
    """Poses of the arm itself, to the six decimals of a file."""
    assert arm.rest is not None
    kinematics, rng = PoseKinematics(ForwardKinematics(arm)), np.random.default_rng(4)
    poses = np.array(arm.rest.q_rad) + rng.uniform(-0.12, 0.12, (4, arm.joint_count))
    tip = kinematics.batch(poses)
    waypoints = Waypoints(
        tuple((float(x), float(y), float(z)) for x, y, z in np.round(tip.position_m, 6)),
        None,
        (),
        tuple(rotation.checked_quaternion(q) for q in np.round(rotation.quaternions(tip.rotation), 6)),
    )
    planned = plan_path(arm, waypoints, 0.1)
    found = kinematics.batch(np.array(planned.q_waypoints_rad))
    np.testing.assert_allclose(found.position_m, waypoints.points, atol=1e-8)


def test_the_message_is_the_joints_path_and_comes_back() -> None:
    planned = plan_path(SIX, circle_in_place(SIX), 0.1)
    again = JointPath.from_message(planned.to_message())
    np.testing.assert_allclose(again.knots, planned.joints.knots, atol=1e-9)


@pytest.mark.parametrize("name", list(ARMS))
def test_every_arm_says_what_is_out_of_its_reach(name: str) -> None:
    with pytest.raises(PathError, match="out of reach"):
        plan_path(ARMS[name], [(3.0, 0.0, 0.3), (3.0, 0.1, 0.3)], 0.1)


@pytest.mark.parametrize("arm", [FOUR, FIVE, SIX, SEVEN], ids=lambda arm: arm.name)
def test_a_way_point_out_of_reach_is_named_itself_and_not_where_the_path_leaves_the_reach(arm: Arm) -> None:
    first = circle_in_place(arm).points[0]
    with pytest.raises(PathError, match=r"^way-point 2: .*\(3\.0000, 0\.0000, 0\.3000\) m is out of reach") as caught:
        plan_path(arm, [first, (3.0, 0.0, 0.3), first], 0.1)
    assert caught.value.waypoint == 2


# ---- orientations


def test_between_two_way_points_the_orientation_is_slerp_from_rest_to_rest() -> None:
    first, last = (1.0, 0.0, 0.0, 0.0), (np.cos(0.4), np.sin(0.4), 0.0, 0.0)
    spline = OrientationSpline((0.0, 2.0), (first, last), (True, True))
    found = spline.sample(np.zeros(5, dtype=np.int64), np.linspace(0.0, 2.0, 5))
    shares = 0.8 * np.array([0.0, 0.15625, 0.5, 0.84375, 1.0])  # 3 s^2 - 2 s^3
    np.testing.assert_allclose(rotation.logarithms(found.rotation), np.outer(shares, [1, 0, 0]), atol=1e-12)
    np.testing.assert_allclose(found.velocity_rad_s[[0, -1]], 0.0, atol=1e-12)
    assert turns_rad((first, last)) == pytest.approx((0.8,))


def test_angular_velocity_is_continuous_and_with_its_acceleration_fits_the_rotation() -> None:
    rng = np.random.default_rng(0)
    turned = rotation.quaternions(rotation.exponentials(rng.uniform(-1, 1, (4, 3))))
    spline = OrientationSpline((0.0, 1.0, 2.5, 3.0), [tuple(q) for q in turned.tolist()], (True, False, False, True))
    section, into, h = np.array([0, 1, 2]), np.array([0.4, 0.7, 0.2]), 1e-5
    here, after, before = (spline.sample(section, into + k * h) for k in (0, 1, -1))
    omega = rotation.logarithms(after.rotation @ np.swapaxes(before.rotation, 1, 2)) / (2 * h)
    np.testing.assert_allclose(here.velocity_rad_s, omega, atol=1e-7)
    rate = (after.velocity_rad_s - before.velocity_rad_s) / (2 * h)
    np.testing.assert_allclose(here.acceleration_rad_s2, rate, atol=1e-4)
    ends = spline.sample(np.array([0, 1]), np.array([1.0, 1.5])).velocity_rad_s
    starts = spline.sample(np.array([1, 2]), np.array([0.0, 0.0])).velocity_rad_s
    np.testing.assert_allclose(ends, starts, atol=1e-9)


def test_a_third_joint_that_does_not_move_the_tip_leaves_it_its_surface() -> None:
    rest = (0.24, 1.14, -0.03)
    rows = [(0.0, 0.0, 0.121, 0.0), (0.0, pi / 2, 0.0, -pi / 2), (0.258, 0.0, 0.159, -pi / 2)]
    arm = arm_of("on its last axis", rows, "modified", rest, tool_m=(0.0, 0.0, 0.039))
    kinematics = ForwardKinematics(arm)
    taught = [np.round(kinematics.tip(*(np.array(rest) + 0.1 * k)), 6).tolist() for k in range(3)]
    planned = plan_path(arm, taught, 0.1)
    assert np.abs(kinematics.tips(np.array(planned.q_waypoints_rad)) - taught).max() < 1e-4
    assert np.abs(kinematics.tip(*InverseKinematics(arm).nearest(taught[1], rest)) - np.array(taught[1])).max() < 1e-4

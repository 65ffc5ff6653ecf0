"""The last guard: floor, table and own base, for whole motions, each set-point, and the rest of a jog."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.arms import SEVEN, SIX
from control.errors import ArmError, MotionError
from control.kinematics.kinematics import Corners, ForwardKinematics
from control.model.arm import Arm
from control.motion.guard import Guard, stopping_distance
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove, StopMotion
from control.motion.joint_path import JointPath
from control.motion.setpoint import SetPoint, at_rest
from control.safety.workspace import LinkThickness, Workspace
from tests.cell import RIGHT

LIMITS = JointLimits.of(RIGHT)
THIN = LinkThickness((0.0, 0.0))  # of two corners
LOW = (0.0, -1.0, -0.35)  # the tip over the board, 0.1 m above it


def with_limits(**changes: Any) -> Any:
    return replace(RIGHT, limits=replace(RIGHT.limits, **changes))


def poses(count: int) -> np.ndarray[Any, Any]:
    lower, upper = np.array(RIGHT.limits_rad).T
    return np.random.default_rng(3).uniform(lower, upper, (count, 3))


def walk(arm: Arm, start: Sequence[float], step_rad: float, seed: int, count: int = 200) -> Any:
    """Poses on straight ways from one random pose to the next, `step_rad` apart in the joint that has furthest to go."""
    rng = np.random.default_rng(seed)
    lower, upper = np.array(arm.limits_rad).T
    q, towards = np.array(start), rng.uniform(lower, upper)
    for _ in range(count):
        if np.abs(towards - q).max() < step_rad:
            towards = rng.uniform(lower, upper)
        q = q + (towards - q) * min(1.0, step_rad / np.abs(towards - q).max())
        yield q


def test_corners_are_the_frames_origins_and_the_tip_scalar_and_in_batches() -> None:
    corners, kinematics = Corners(RIGHT), ForwardKinematics(RIGHT)
    for q, *batch in zip(poses(20), *(c.T for c in corners.batch(poses(20))), strict=True):
        places = corners.at(*q)
        frames = kinematics.link_transforms([q])[0, :, :3, 3]
        assert places[0] == pytest.approx(frames[2], abs=1e-12)  # the elbow; the shoulder never moves
        assert places[-1] == pytest.approx(kinematics.tip(*q), abs=1e-12)
        assert np.allclose(places, batch, atol=1e-12)


@pytest.mark.parametrize("arm", [with_limits(base_radius_m=0.06), SIX, SEVEN], ids=lambda arm: arm.name)
def test_a_set_point_is_refused_as_if_the_guard_remembered_no_pose_that_was_far_from_everything(arm: Arm) -> None:
    guard, start = Guard(arm, JointLimits.of(arm)), (0.0,) * arm.joint_count
    here = next(tuple(q) for q in walk(arm, start, 0.3, seed=2) if guard.clearance(tuple(q)).distance_m > 0.0)
    refused, count = 0, 4000
    for q in map(tuple, walk(arm, here, 0.02, seed=3, count=count)):
        is_met = guard.clearance(q).distance_m < 0.0
        assert bool(guard.fixed_objection(q, here)) == is_met, q
        refused += is_met
    assert 0 < refused < count


def test_a_set_point_that_is_no_number_is_not_near_to_any_pose() -> None:
    guard = Guard(RIGHT, LIMITS)
    assert not guard.fixed_objection((0.0, 0.3, 0.3), (0.0, 0.3, 0.3))
    with pytest.raises(ArmError, match="finite"):
        guard.fixed_objection((0.0, math.nan, 0.3), (0.0, 0.3, 0.3))


def test_a_calibrated_arm_does_not_meet_its_base_with_the_link_that_hangs_on_it() -> None:
    """No length of a calibrated arm is exactly zero, so its shoulder moves a little about axis 1."""
    arm = with_limits(base_radius_m=0.06).with_dh(RIGHT.dh + 1e-3)
    guard, nominal = Guard(arm, LIMITS), Guard(with_limits(base_radius_m=0.06), LIMITS)
    corners = guard._corners
    assert len(corners.at(0.1, 0.2, 0.3)) == len(nominal._corners.at(0.1, 0.2, 0.3)) + 1
    elbow = corners.at(0.1, 0.2, 0.3)[corners.first_free]
    assert elbow == pytest.approx(nominal._corners.at(0.1, 0.2, 0.3)[nominal._corners.first_free], abs=5e-3)
    for q in poses(300):
        found, expected = guard.clearance(tuple(q)), nominal.clearance(tuple(q))
        if abs(expected.distance_m) > 5e-3:
            assert (found.distance_m < 0.0) == (expected.distance_m < 0.0), q
    moved(guard, (0.0, 0.15, 0.75), (0.4, -0.6, 0.2))


def test_a_tool_is_a_corner_of_its_own() -> None:
    arm = replace(RIGHT, tool=replace(RIGHT.tool, position_m=(0.0, 0.0, 0.2)))
    assert len(Corners(arm).at(0.1, 0.2, 0.3)) == len(Corners(RIGHT).at(0.1, 0.2, 0.3)) + 1
    assert Corners(arm).at(0.1, 0.2, 0.3)[-1] == pytest.approx(ForwardKinematics(arm).tip(0.1, 0.2, 0.3))


# ---- the workspace


def workspace(**changes: Any) -> Workspace:
    return replace(Workspace.of(RIGHT), **changes)


def height_m(x: float, y: float, z: float, where: Workspace) -> float:
    return where.clearance([(x, y, 0.9), (x, y, z)], THIN).distance_m


def test_the_floor_counts_beside_the_board_and_the_tilted_board_over_it() -> None:
    where = workspace(tolerance_m=0.0, base_radius_m=0.0)
    assert height_m(0.3, 0.4, -0.05, where) == pytest.approx(-0.05)
    assert where.clearance([(0.3, 0.4, 0.9), (0.3, 0.4, -0.05)], THIN).what == "the tip would be below the floor or table"
    slope = math.tan(RIGHT.table.roll_tilt_rad)
    assert height_m(0.5, -0.09, -0.05, where) == pytest.approx(-0.05 + 0.09 * slope)  # tilted away from the arm's tip
    assert height_m(0.5, 0.0, -0.05, where) == pytest.approx(-0.05)
    assert height_m(0.5, -0.13, -0.05, where) == pytest.approx(-0.05)  # beyond the board


def test_the_tolerance_is_for_what_the_model_does_not_know() -> None:
    where = workspace(tolerance_m=0.01, base_radius_m=0.0)
    assert where.clearance([(0.3, 0.4, 0.9), (0.3, 0.4, -0.0099)], THIN).distance_m >= 0.0
    assert where.clearance([(0.3, 0.4, 0.9), (0.3, 0.4, -0.0101)], THIN).distance_m < 0.0


def test_a_forearm_is_held_above_the_floor_between_its_ends() -> None:
    where = workspace(tolerance_m=0.0, base_radius_m=0.0, floor_z_m=0.0)
    low_elbow = where.clearance([(0.3, 0.4, -0.02), (0.3, 0.4, 0.3)], THIN)
    assert low_elbow.distance_m == pytest.approx(-0.02)
    assert low_elbow.what == "the arm would be below the floor or table"


def test_the_distance_from_the_base_is_that_of_two_segments() -> None:
    """Against a search along both."""
    where, source = workspace(base_top_m=0.1, base_radius_m=10.0, floor_z_m=-9.0), random.Random(5)
    for _ in range(200):
        ends = [tuple(source.uniform(-0.4, 0.4) for _ in range(3)) for _ in range(2)]
        along = np.linspace(0.0, 1.0, 2001)[:, None]
        points = np.array(ends[0]) + along * (np.array(ends[1]) - np.array(ends[0]))
        heights = np.clip(points[:, 2], 0.0, 0.1)
        true = float(np.hypot(np.hypot(points[:, 0], points[:, 1]), points[:, 2] - heights).min())
        clearance = where.clearance(ends, THIN)
        assert clearance.distance_m + 10.0 == pytest.approx(true, abs=3e-4)
        assert clearance.what == "the arm would meet its own base"


@pytest.mark.parametrize("radius_m", [0.0, 0.03])
def test_arrays_and_floats_say_the_same(radius_m: float) -> None:
    guard = Guard(thick(radius_m, with_limits(base_radius_m=0.1)), LIMITS)
    batch = guard._corners.batch(poses(300))
    body = LinkThickness(guard._corners.radii_m, guard._corners.first_free)
    least = np.min([distances for distances, _ in guard._workspace.clearances(batch, body)], axis=0)
    near = 0
    for q, expected in zip(poses(300), least, strict=True):
        if (distance_m := guard.clearance(tuple(q)).distance_m) < math.inf:
            near += 1
            assert distance_m == pytest.approx(expected, abs=1e-12) or distance_m > 0.0
            assert (distance_m < 0.0) == (expected < 0.0)
    assert near > 50


def test_a_position_that_is_not_a_number_is_an_error() -> None:
    with pytest.raises(Exception, match="finite positions"):
        workspace().clearance([(0.3, math.nan, 0.9), (0.3, 0.4, 0.1)], THIN)


def thick(radius_m: float, arm: Any = RIGHT) -> Any:
    return replace(arm, links=tuple(replace(link, radius_m=radius_m) for link in arm.links))


def test_a_link_is_as_thick_as_its_radius_says_and_the_tip_is_a_point() -> None:
    where, body = workspace(tolerance_m=0.0, base_radius_m=0.06, board=None), LinkThickness((0.0, 0.02, 0.04))
    upright = [(0.4, 0.0, 0.9), (0.4, 0.0, 0.5), (0.4, 0.0, -0.01)]
    assert where.clearance(upright, body).distance_m == pytest.approx(-0.01)  # the tip may touch, so it has no radius
    elbow_low = [(0.4, 0.0, 0.9), (0.4, 0.0, 0.03), (0.4, 0.0, 0.9)]
    assert where.clearance(elbow_low, body).distance_m == pytest.approx(0.03 - 0.04)  # the thicker of both links
    forearm = where.clearance([(0.4, 0.0, 0.9), (0.4, 0.0, 0.05), (0.5, 0.0, -0.001)], body)
    assert forearm.distance_m == pytest.approx(0.05 - 0.75 * 0.051 - 0.04)  # a quarter before the tip
    beside = [(0.0, 0.115, 0.4), (0.0, 0.115, 0.07), (0.5, 0.115, 0.3)]
    assert where.clearance(beside, body).distance_m == pytest.approx(0.115 - 0.06 - 0.04, abs=5e-3)


def test_the_radius_of_a_link_comes_from_its_arm_toml_and_stops_what_a_line_would_pass() -> None:
    low = (0.6, -0.85, -0.2)
    assert Guard(RIGHT, LIMITS).clearance(low).distance_m >= 0.0
    assert Guard(thick(0.2), LIMITS).clearance(low).distance_m < 0.0
    assert Corners(thick(0.2)).radii_m == (0.2,) * len(Corners(RIGHT).at(0.0, 0.0, 0.0))


# ---- motions


def there_and_back(*poses_rad: tuple[float, ...]) -> JointPath:
    still = (0.0,) * len(poses_rad[0])
    return JointPath([2.0 * k for k in range(len(poses_rad))], [SetPoint(q, still, still) for q in poses_rad])


def moved(guard: Guard, start: tuple[float, ...], end: tuple[float, ...]) -> None:
    guard.require_move(JointMove(start, end, LIMITS), at_rest(start), end)


def test_a_joint_move_is_refused_by_what_lies_on_its_way_and_not_only_at_its_end() -> None:
    guard = Guard(RIGHT, LIMITS)
    moved(guard, (0.0, 0.15, 0.75), (1.0, -0.9, -0.25))
    with pytest.raises(MotionError, match=r"the tip would be below the floor or table, [1-9][\d.]* mm deeper than allowed"):
        moved(guard, (0.0, 0.15, 0.75), (0.0, -1.9, -0.6))
    with pytest.raises(MotionError, match=r"after .* s; nothing was moved"):
        moved(guard, (0.0, -0.9, -0.3), (0.0, -1.1, -1.2))


def test_an_arm_that_is_too_low_may_come_up_but_goes_no_deeper() -> None:
    guard = Guard(replace(with_limits(floor_z_m=0.5), table=None), LIMITS)  # a floor that was raised by mistake
    low, lower, high = (0.0, -0.6, 0.2), (0.0, -0.7, 0.2), (0.0, -0.2, 0.2)
    assert guard.clearance(low).distance_m < 0.0
    moved(guard, low, high)
    with pytest.raises(MotionError, match="below the floor"):
        moved(guard, low, lower)
    for start, over, end in ((low, high, low), (lower, low, lower)):  # up, and down again to where it was
        with pytest.raises(MotionError, match="below the floor"):
            guard.require_joint_path(there_and_back(start, over, end))
    assert guard.objection(high, low) == ""
    assert "below the floor" in guard.objection(lower, low)


def test_a_motion_that_begins_inside_is_refused_for_a_dip_between_the_poses_that_others_are_checked_at() -> None:
    """A joint move whose tip first sinks by half a millimetre, and comes out later."""
    guard = Guard(replace(with_limits(floor_z_m=0.5), table=None), LIMITS)
    start, end = (0.0, -0.6, 0.2), (0.0, -0.2, -0.4)
    move = JointMove(start, end, LIMITS)
    heights = [guard.clearance(move.at(t).q_rad).distance_m for t in np.linspace(0.0, move.duration_s, 400)]
    assert heights[0] < 0.0
    assert -2e-3 < min(heights) - heights[0] < -1e-4
    with pytest.raises(MotionError, match="The arm begins inside: jog it out first"):
        guard.require_rising(move)
    guard.require_rising(JointMove(start, (0.0, -0.2, 0.2), LIMITS))
    Guard(RIGHT, LIMITS).require_rising(JointMove((0.0, 0.15, 0.75), (0.0, -1.9, -0.6), LIMITS))  # begins outside


def test_a_stop_takes_as_far_as_its_closed_form_says() -> None:
    source, endless = random.Random(1), JointLimits((-1e3,), (1e3,), (100.0,), (10.0,), (200.0,))
    compared = 0
    for _ in range(300):
        speed, acceleration = source.uniform(-2.0, 2.0), source.uniform(-10.0, 10.0)
        if speed * acceleration < 0.0 and abs(speed) < acceleration**2 / 400.0:
            continue  # it would turn back: the closed form says where it stands still first
        stop = StopMotion(SetPoint((0.0,), (speed,), (acceleration,)), endless)
        assert stopping_distance(speed, acceleration, 10.0, 200.0) == pytest.approx(stop.at(9.0).q_rad[0], abs=1e-9)
        compared += 1
    assert compared > 200
    assert stopping_distance(0.0, 0.0, 10.0, 200.0) == 0.0


# ---- stops


def lowest_m(guard: Guard, motion: Any) -> float:
    times_s = (motion.duration_s * k / 40 for k in range(41))
    return min(corner[2] for time_s in times_s for corner in guard._corners.at(*motion.at(time_s).q_rad))


def with_floor_at(guard: Guard, z_m: float) -> Guard:
    guard._workspace = workspace(floor_z_m=z_m, tolerance_m=0.0, base_radius_m=0.0, board=None)
    return guard


def dipping_states(seed: int) -> Any:
    """States in joint moves, the height of the move's lowest place, and how deep below it each joint's own stop gets."""
    source, guard = random.Random(seed), Guard(RIGHT, LIMITS)
    while True:
        start, end = (tuple(source.uniform(*limits) * 0.9 for limits in RIGHT.limits_rad) for _ in "ab")
        move = JointMove(start, end, LIMITS)
        state = move.at(move.duration_s * source.uniform(0.2, 0.8))
        floor_m = lowest_m(guard, move) - 1e-5
        if (depth_m := floor_m - lowest_m(guard, StopMotion(state, LIMITS))) > 1e-3:
            yield guard, state, floor_m, depth_m


def test_a_stop_that_would_pass_the_floor_brakes_on_the_line_on_which_the_joints_move() -> None:
    for _, (guard, state, floor_m, _) in zip(range(6), dipping_states(2), strict=False):
        stop = with_floor_at(guard, floor_m).stop_from(state)
        assert lowest_m(guard, stop) >= floor_m
        assert stop.at(0.0).q_rad == pytest.approx(state.q_rad, abs=1e-12)
        assert stop.at(0.0).speed_rad_s == pytest.approx(state.speed_rad_s, abs=1e-12)


def test_where_no_stop_is_free_the_least_deep_one_is_taken() -> None:
    guard, state, floor_m, depth_m = next(dipping_states(3))
    deep = with_floor_at(guard, floor_m + 0.3)
    stop = deep.stop_from(state._replace(speed_rad_s=(0.0, -1.0, -1.0), acceleration_rad_s2=(0.0, 0.0, 0.0)))
    plain = StopMotion(state._replace(speed_rad_s=(0.0, -1.0, -1.0), acceleration_rad_s2=(0.0, 0.0, 0.0)), LIMITS)
    assert depth_m > 0.0
    assert lowest_m(guard, stop) > lowest_m(guard, plain)


def test_a_stop_with_room_below_is_each_joints_own_and_so_is_one_at_rest() -> None:
    guard, state, floor_m, depth_m = next(dipping_states(4))
    assert isinstance(with_floor_at(guard, floor_m - depth_m - 1e-4).stop_from(state), StopMotion)
    assert isinstance(with_floor_at(guard, floor_m + 0.5).stop_from(at_rest(state.q_rad)), StopMotion)


def test_a_jog_is_refused_for_what_its_stop_meets_on_the_way_though_its_end_is_free() -> None:
    """A slow joint that lowers the tip stops before a fast one that lifts it."""
    found, source, guard = 0, random.Random(5), Guard(RIGHT, LIMITS)
    for _ in range(60):
        q = (0.0, source.uniform(-1.0, 0.0), source.uniform(-0.5, 0.5))
        state = SetPoint(q, (0.0, source.uniform(-0.5, -0.2), source.uniform(0.2, 2.0)), (0.0, 0.0, 0.0))
        stop = StopMotion(state, LIMITS)
        ends_m = min(lowest_m(guard, JointMove(q, q, LIMITS)) for q in (state.q_rad, stop.at(9.0).q_rad))
        if ends_m - (way_m := lowest_m(guard, stop)) > 2e-4:
            found += 1
            with_floor_at(guard, 0.5 * (ends_m + way_m))
            assert guard.objection(guard.resting_pose(state), state.q_rad) == ""
            assert "below the floor" in guard.jog_objection(state, state)
            assert with_floor_at(guard, way_m - 1e-4).jog_objection(state, state) == ""
    assert found > 1

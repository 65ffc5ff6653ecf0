"""Inverse kinematics: all branches, limits, calibrated arms, other structures, and honest errors."""

import dataclasses
import math

import numpy as np
import pytest

from control.errors import ArmError, BadTarget, JointLimitViolated, MissingModel, NearSingular, OutOfReach
from control.kinematics import reach
from control.kinematics.inverse import BRANCHES, Branch, InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.numeric_inverse import descend
from control.kinematics.pose_inverse import PoseInverse, TipPose
from control.kinematics.reach import JointRange, travel_rad, turned_toward
from control.model.arm import Arm
from control.model.description import load_arm
from tests.cell import with_drive
from tests.control.kinematics.tables import arm_of
from tests.places import ARMS

BOUNDS = np.array([5e-3, np.radians(2.0), 5e-3, np.radians(2.0)])  # of a calibration (docs/calibrate.md)
FRONT_UP = Branch("front", "up")
RIGHT = load_arm("right")
FREE = dataclasses.replace(RIGHT, drives=(), rest=None)  # the same arm without joint limits


def _calibrated(seed: int, arm: Arm = FREE) -> Arm:
    source = np.random.default_rng(seed)
    return arm.with_dh(arm.dh + source.uniform(-1.0, 1.0, arm.dh.shape) * BOUNDS)


def _relative(seed: int) -> Arm:
    """Another arm of the same structure: any lengths, offsets, angle offsets, tool, and either convention's sign."""
    source = np.random.default_rng(seed)
    dh = FREE.dh.copy()
    dh[:, [0, 2]] += source.uniform(-0.1, 0.1, (4, 2))
    dh[:, 1] = source.uniform(-3, 3, 4)
    dh[2:, 3] = source.uniform(-3, 3, 2)
    dh[0, 3] *= source.choice([-1, 1])
    dh[1, 3] = source.choice([0.0, math.pi])
    x, y, z = source.uniform(-0.05, 0.05, 3)
    return dataclasses.replace(FREE.with_dh(dh), tool=dataclasses.replace(FREE.tool, position_m=(x, y, z)))


def _modified() -> Arm:
    """The reference arm written in modified DH: each row takes L and alpha from the row before."""
    dh = RIGHT.dh
    moved = np.zeros_like(dh)
    moved[:, :2] = dh[:, :2]
    moved[1:, 2:] = dh[:-1, 2:]
    return dataclasses.replace(RIGHT.with_dh(moved), dh_convention="modified")


def _wrapped(angles: np.ndarray) -> np.ndarray:
    return np.remainder(angles + math.pi, 2 * math.pi) - math.pi


EXACT = [pytest.param(_relative(seed), id=f"relative {seed}") for seed in range(12)]
EXACT += [pytest.param(FREE, id="right"), pytest.param(_modified(), id="modified")]
CALIBRATED = [pytest.param(_calibrated(seed), id=f"calibrated {seed}") for seed in range(8)]


@pytest.mark.parametrize("arm", EXACT + CALIBRATED)
def test_every_branch_reaches_the_point_and_one_of_them_is_the_pose_it_came_from(arm: Arm) -> None:
    inverse = InverseKinematics(dataclasses.replace(arm, drives=()))
    found = 0
    for q in np.random.default_rng(4).uniform(-3, 3, (60, 3)):
        point = inverse.kinematics.tip(*q.tolist())
        try:
            solutions = inverse.branches(point)
        except (NearSingular, OutOfReach):
            continue
        for solution in solutions:
            assert math.dist(inverse.kinematics.tip(*solution.q), point) < 1e-9
            assert inverse.branch(solution.q) == solution.branch
        nearest = min(np.abs(_wrapped(np.array(s.q) - q)).max() for s in solutions)
        found += bool(nearest < 1e-6)
    assert found >= 45  # the others lie within the margins of a singular pose


def test_the_reference_arm_reaches_its_table_in_four_ways_of_which_limits_leave_one() -> None:
    solutions = InverseKinematics(RIGHT).branches((0.5, 0.0, 0.0))
    assert [s.branch for s in solutions] == list(BRANCHES)
    assert [s.branch for s in solutions if s.within_limits] == [FRONT_UP]


def test_branch_names_mean_what_they_say() -> None:
    inverse = InverseKinematics(FREE)
    by_branch = {s.branch: s.q for s in inverse.branches((0.45, 0.1, 0.2))}
    frames = inverse.kinematics.link_transforms(np.array(list(by_branch.values())))
    for branch, elbow, x_axis in zip(by_branch, frames[:, 2, :3, 3], frames[:, 1, :3, 0], strict=True):
        toward = np.array([0.45, 0.1])
        assert (x_axis[:2] @ toward > 0.0) == (branch.shoulder == "front")
        along = elbow[:2] @ toward / (toward @ toward)
        line_height = 0.076 + along * (0.2 - 0.076)
        assert (elbow[2] > line_height) == (branch.elbow == "up")


def test_an_elbow_up_over_the_shoulder_is_still_above_the_line() -> None:
    by_branch = {s.branch: s.q for s in InverseKinematics(FREE).branches((0.45, 0.1, 0.2))}
    frames = InverseKinematics(FREE).kinematics.link_transforms(np.array(list(by_branch.values())))
    heights = dict(zip(by_branch, frames[:, 2, 2, 3].tolist(), strict=True))
    for shoulder in ("front", "back"):
        assert heights[Branch(shoulder, "up")] > heights[Branch(shoulder, "down")]


def test_a_point_in_millimetres_is_told_its_metres() -> None:
    with pytest.raises(OutOfReach, match=r"\(this looks like millimetres: write \[0\.3, 0, 0\.2\]\)"):
        InverseKinematics(FREE).branches((300.0, 0.0, 200.0))


@pytest.mark.parametrize(
    ("point", "distance_m"),
    [
        ((2.0, 0.012, 0.076), 2.0 - 0.7543),
        ((0.5, 0.012, 1.5), math.hypot(0.5, 1.424) - 0.7543),
        ((0.03, 0.012, 0.076), 0.4 - 0.3543 - 0.03),
        ((0.005, 0.0, 0.5), 0.012 - 0.005),
    ],
)
def test_out_of_reach_says_by_how_much(point: tuple[float, float, float], distance_m: float) -> None:
    inverse = InverseKinematics(FREE)
    with pytest.raises(OutOfReach, match="out of reach by") as caught:
        inverse.branches(point)
    assert caught.value.distance_m == pytest.approx(distance_m, abs=1e-4)  # the offset of 0.012 m, too
    with pytest.raises(OutOfReach):
        inverse.follow(point, (0.0, -1.0, 0.3))


def test_a_calibrated_arm_says_by_how_much_a_point_is_out_of_its_own_reach() -> None:
    inverse = InverseKinematics(_calibrated(3))
    q = np.random.default_rng(0).uniform(-math.pi, math.pi, (100_000, 3))
    point = np.array([0.6, 0.3, 0.8])
    nearest = np.linalg.norm(inverse.kinematics.tips(q) - point, axis=1).min()
    with pytest.raises(OutOfReach) as caught:
        inverse.branches(point.tolist())
    assert caught.value.distance_m == pytest.approx(nearest, abs=2e-3)  # the scatter's mesh


def test_near_singular_targets_say_which_and_how_near() -> None:
    inverse = InverseKinematics(FREE)
    reach = 0.7543 * math.cos(0.5 * 0.02)  # the elbow bent by about 0.02 rad
    with pytest.raises(NearSingular, match=r"the elbow would be 0\.0[12].* rad from stretched") as elbow:
        inverse.branches((reach, 0.012, 0.076))
    assert elbow.value.which == "elbow"
    assert elbow.value.margin == pytest.approx(0.02, abs=2e-3)
    with pytest.raises(NearSingular, match=r"the shoulder would be 0\.005") as shoulder:
        inverse.branches((0.005, 0.012, 0.6))
    assert shoulder.value.which == "shoulder"
    assert shoulder.value.margin == pytest.approx(0.005, abs=1e-9)
    with pytest.raises(NearSingular, match="from folded"):
        inverse.branches((0.0459, 0.012, 0.076))


def test_a_joint_limit_says_which_joint_and_by_how_much() -> None:
    inverse = InverseKinematics(RIGHT)
    behind = inverse.kinematics.tip(2.9, -1.0, 0.3)
    with pytest.raises(JointLimitViolated, match=r"joint 1 would have to be at 2\.9") as caught:
        inverse.solve(behind, FRONT_UP)
    assert caught.value.joint == 1
    assert caught.value.excess_rad == pytest.approx(0.3)
    with pytest.raises(JointLimitViolated, match="in any way"):
        inverse.nearest(behind, (0.0, -1.0, 0.3))


def test_a_pose_on_its_limit_is_allowed_and_one_beyond_is_not() -> None:
    inverse = InverseKinematics(RIGHT)
    on_limit = (2.6, -1.0, 0.3)
    assert inverse.solve(inverse.kinematics.tip(*on_limit), FRONT_UP) == pytest.approx(on_limit)
    with pytest.raises(JointLimitViolated):
        inverse.solve(inverse.kinematics.tip(2.6 + 1e-6, -1.0, 0.3), FRONT_UP)


def test_whole_turns_bring_an_angle_into_shifted_limits() -> None:
    drives = tuple(
        dataclasses.replace(d, joint_lower_rad=d.joint_lower_rad + 2 * math.pi, joint_upper_rad=9.0) if d.joint == 1 else d
        for d in RIGHT.drives
    )
    inverse = InverseKinematics(dataclasses.replace(RIGHT, drives=drives, rest=None))
    q = inverse.solve((0.5, 0.0, 0.0), FRONT_UP)
    assert q[0] == pytest.approx(2 * math.pi, abs=0.1)


@pytest.mark.parametrize("bad", [(0.5, 0.0, math.nan), (math.inf, 0.0, 0.0), (0.5, 0.0), (0.5, 0.0, 0.0, 0.0)])
def test_a_target_that_is_none_is_rejected(bad: tuple[float, ...]) -> None:
    inverse = InverseKinematics(RIGHT)
    for function in (lambda: inverse.branches(bad), lambda: inverse.solve(bad, FRONT_UP)):
        with pytest.raises(BadTarget, match="three finite coordinates"):
            function()
    with pytest.raises(BadTarget, match="three finite coordinates"):
        inverse.nearest(bad, (0.0, -1.0, 0.3))


@pytest.mark.parametrize("arm", [RIGHT, _calibrated(2, RIGHT), load_arm(ARMS / "panda.toml")])
def test_the_cycle_never_gets_a_number_that_is_none(arm: Arm) -> None:
    inverse = InverseKinematics(arm)
    near = (0.0, -1.0, 0.3) if arm.joint_count == 3 else (0.1,) * 7
    with pytest.raises(ArmError):
        inverse.follow((0.5, math.nan, 0.0), near)
    with pytest.raises(ArmError):
        inverse.follow((0.5, 0.0, 0.0), (math.nan,) * arm.joint_count)


def test_an_unknown_branch_lists_the_four() -> None:
    with pytest.raises(ArmError, match="shoulder front, elbow up; shoulder front, elbow down"):
        InverseKinematics(RIGHT).solve((0.5, 0.0, 0.0), Branch("left", "up"))  # type: ignore[arg-type]


@pytest.mark.parametrize("arm", [FREE, *(_calibrated(seed) for seed in range(3))])
@pytest.mark.parametrize("branch", BRANCHES)
def test_a_followed_path_stays_on_its_branch_through_the_turn_of_joint_1(arm: Arm, branch: Branch) -> None:
    inverse = InverseKinematics(arm)
    angles = np.linspace(0.0, 4 * math.pi, 2000)
    path = np.stack([0.5 * np.cos(angles), 0.5 * np.sin(angles), 0.1 + 0.05 * np.sin(3 * angles)], axis=1)
    q = inverse.solve(path[0].tolist(), branch)
    start = q[0]
    for point in path.tolist():
        following = inverse.follow(point, q)
        assert travel_rad(following, q) < 0.05
        assert inverse.branch(following) == branch
        assert math.dist(inverse.kinematics.tip(*following), point) < 1e-9
        q = following
    assert q[0] - start == pytest.approx(4 * math.pi, abs=0.05)  # no jump at +-pi


@pytest.mark.parametrize("arm", [FREE, _calibrated(1)])
def test_a_path_through_a_singular_pose_ends_in_an_error_not_on_another_branch(arm: Arm) -> None:
    inverse = InverseKinematics(arm)
    q = inverse.solve((0.6, 0.05, 0.2), FRONT_UP)
    visited = [q]

    def walk() -> None:
        for x in np.linspace(0.6, 0.8, 400).tolist():
            visited.append(inverse.follow((x, 0.05, 0.2), visited[-1]))

    with pytest.raises((NearSingular, OutOfReach)):
        walk()
    assert inverse.branch(visited[-1]) == FRONT_UP


def test_a_jump_of_the_target_is_an_error() -> None:
    inverse = InverseKinematics(FREE)
    with pytest.raises(NearSingular, match="would jump"):
        inverse.follow((-0.4, 0.3, 0.2), inverse.solve((0.5, 0.0, 0.1), FRONT_UP))


def test_following_beyond_a_limit_is_an_error() -> None:
    inverse = InverseKinematics(RIGHT)
    with pytest.raises(JointLimitViolated, match="to follow the path"):
        inverse.follow(inverse.kinematics.tip(2.61, -1.0, 0.3), (2.59, -1.0, 0.3))


def test_nearest_takes_the_branch_with_the_least_travel() -> None:
    inverse = InverseKinematics(FREE)
    for solution in inverse.branches((0.4, 0.2, 0.3)):
        near = tuple(angle + 0.05 for angle in solution.q)
        assert inverse.nearest((0.4, 0.2, 0.3), near) == pytest.approx(solution.q)
    far = tuple(angle + 2 * math.pi for angle in inverse.solve((0.4, 0.2, 0.3), FRONT_UP))
    assert inverse.nearest((0.4, 0.2, 0.3), far) == pytest.approx(far)


def test_seven_joints_reach_any_point_that_they_have_a_pose_for() -> None:
    inverse = InverseKinematics(load_arm(ARMS / "panda.toml"))
    assert not inverse.has_branches
    for q in np.random.default_rng(9).uniform(-1.5, 1.5, (10, 7)).tolist():
        point = inverse.kinematics.tip(*q)
        found = inverse.nearest(point, [0.3] * 7)
        assert math.dist(inverse.kinematics.tip(*found), point) < 1e-9
        followed = inverse.follow(point, [angle + 0.01 for angle in q])
        assert math.dist(inverse.kinematics.tip(*followed), point) < 1e-9
        assert travel_rad(followed, q) < 0.1
    with pytest.raises(OutOfReach):
        inverse.nearest((2.0, 0.0, 0.0), [0.3] * 7)
    with pytest.raises(MissingModel, match=r"use nearest\(\)"):
        inverse.branches((0.4, 0.0, 0.4))


def test_a_descent_slides_along_the_limits_instead_of_stopping_at_them() -> None:
    """From a corner of narrow ranges that hold a solution; steps that are only cut off stop in one case of ten."""
    k = InverseKinematics(load_arm(ARMS / "panda.toml")).kinematics
    source, arrived = np.random.default_rng(0), 0
    for q in source.uniform(-1, 1, (100, 7)):
        limits = q[:, None] + 0.3 * source.uniform(0.02, 1, (7, 2)) * [-1.0, 1.0]
        corner = np.where(source.random(7) < 0.5, limits[:, 0], limits[:, 1])
        end = descend(k, k.tip(*q.tolist()), corner.tolist(), limits)
        assert (limits[:, 0] <= end.q).all()
        assert (limits[:, 1] >= end.q).all()
        arrived += end.distance_m < 1e-9
    assert arrived >= 98


def _serial(*alphas: float) -> Arm:
    return arm_of([(0.1, 0.0, 0.3, alpha) for alpha in alphas])


def test_arms_of_one_and_two_joints_reach_what_they_can_and_say_what_they_cannot() -> None:
    pendulum = InverseKinematics(load_arm(ARMS / "pendulum.toml"))
    assert pendulum.nearest((0.06, 0.08, 0.0), [0.0]) == pytest.approx([math.atan2(0.08, 0.06)])
    with pytest.raises(OutOfReach) as caught:
        pendulum.nearest((0.06, 0.08, 0.03), [0.0])
    assert caught.value.distance_m == pytest.approx(0.03)
    two = InverseKinematics(_serial(math.pi / 2, 0.0))
    point = two.kinematics.tip(0.7, -0.4)
    assert two.nearest(point, [0.0, 0.0]) == pytest.approx([0.7, -0.4], abs=1e-6)


def test_three_joints_of_another_structure_go_the_numeric_way() -> None:
    inverse = InverseKinematics(_serial(1.0, 1.2, 0.3))
    assert not inverse.has_branches
    q = [0.3, -0.8, 0.9]
    point = inverse.kinematics.tip(*q)
    assert math.dist(inverse.kinematics.tip(*inverse.nearest(point, [0.0] * 3)), point) < 1e-9
    assert inverse.follow(point, [0.31, -0.79, 0.9]) == pytest.approx(q, abs=1e-6)


def test_a_singular_target_of_any_arm_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reach, "LOSES_A_DIRECTION", dataclasses.replace(reach.LOSES_A_DIRECTION, least=0.5))
    inverse = InverseKinematics(_serial(math.pi / 2, 0.0, 0.0))
    straight = InverseKinematics(_serial(1.0, 1.2, 0.0))
    assert inverse.has_branches
    with pytest.raises(NearSingular, match=r"the arm would be .* m/rad from losing a direction"):
        straight.nearest(straight.kinematics.tip(0.3, -0.8, 0.9), [0.3, -0.8, 0.9])


def test_an_arm_with_a_link_of_no_length_has_no_named_branches_and_no_crash() -> None:
    dh = RIGHT.dh.copy()
    dh[1, 2] = 0.0
    assert not InverseKinematics(RIGHT.with_dh(dh)).has_branches
    parallel = RIGHT.dh.copy()
    parallel[0, 3] = 0.0
    assert not InverseKinematics(RIGHT.with_dh(parallel)).has_branches


def test_turns_are_whole_and_toward_the_wanted_side() -> None:
    assert turned_toward((3.0, -3.0), (-3.0, 3.0)) == pytest.approx((3.0 - 2 * math.pi, -3.0 + 2 * math.pi))
    joints = JointRange(RIGHT)
    assert joints.farthest_rad((0.0, 0.9, 0.0)) == (pytest.approx(0.1), 2)
    assert not joints.is_inside((0.0, math.nan, 0.0))
    assert joints.toward((2.5, 0.0, 0.0), (2.5 - 2 * math.pi, 0.0, 0.0)) == (2.5, 0.0, 0.0)


@pytest.mark.parametrize("name", ["so101", "widowx250"])  # 5 and 6 joints; a position leaves 2 and 3 of them free
def test_with_joints_to_spare_the_pose_is_near_the_one_before(name: str) -> None:
    arm, source = load_arm(name), np.random.default_rng(1)
    inverse, (lower, upper) = InverseKinematics(arm), np.array(arm.limits_rad).T
    longer = []
    for _ in range(30):
        near = source.uniform(0.7 * lower, 0.7 * upper)
        known = np.clip(near + source.uniform(-0.6, 0.6, len(near)), 0.9 * lower, 0.9 * upper)
        tip_m = inverse.kinematics.tip(*known)
        q_rad = inverse.nearest(tip_m, tuple(near))
        assert math.dist(inverse.kinematics.tip(*q_rad), tip_m) < 1e-8
        longer.append(travel_rad(q_rad, near) / travel_rad(known, near))
    assert max(longer) < 1.5  # the least sum of squares, whose largest part may be somewhat larger


def test_a_point_that_joints_to_spare_cannot_reach_is_missed_by_a_finite_distance() -> None:
    arm = load_arm("koch")
    inverse, near = InverseKinematics(arm), (0.0, 0.0, -0.5, 0.5, 0.0)
    for point, missed_m in [((0.15, 0.0, 0.15), 0.05), ((3.0, 0.0, 0.1), 3.0)]:
        with pytest.raises(OutOfReach) as caught:
            inverse.nearest(point, near)
        assert 0.0 < caught.value.distance_m < missed_m


def test_a_pose_beyond_a_range_names_the_joint() -> None:
    narrow = with_drive(RIGHT, 1, joint_lower_rad=-0.1, joint_upper_rad=0.1)
    q = (0.6, *(0.5 * (lower + upper) + 0.2 for lower, upper in RIGHT.limits_rad[1:]))
    with pytest.raises(OutOfReach, match=r"needs joint 1 0\.\d+ rad beyond its range"):
        PoseInverse(narrow).nearest(TipPose.of(ForwardKinematics(RIGHT).tip(*q)), q)

"""Position and orientation of random arms: against plain 4x4 chains and MuJoCo, and back to joint angles."""

import dataclasses

import mujoco
import numpy as np
import pytest

from control.errors import BadTarget, NearSingular, OutOfReach
from control.kinematics import rotation
from control.kinematics.kinematics import ForwardKinematics, PoseKinematics
from control.kinematics.pose_inverse import ACCURACY, PoseInverse, Targets, TipPose, errors, joint_rates, margins, solve, task_of
from control.model.arm import Arm, Convention, Link
from tests.control.dynamics.mujoco_arm import model_of
from tests.control.kinematics.tables import arm_of

PI = np.pi
CONVENTIONS: tuple[Convention, ...] = ("standard", "modified")
JOINTS = range(2, 8)


def random_dh(joints: int, seed: int) -> np.ndarray:
    """Lengths up to 0.3 m, any angles."""
    rng = np.random.default_rng(100 * joints + seed)
    return np.asarray(rng.uniform([-0.2, -3, -0.3, -3], [0.3, 3, 0.3, 3], (joints, 4)))


def random_arm(joints: int, convention: Convention, seed: int = 0) -> PoseKinematics:
    return PoseKinematics(ForwardKinematics(arm_of(random_dh(joints, seed), convention, tool_m=(0.02, -0.01, 0.1))))


def poses(joints: int, count: int = 60) -> np.ndarray:
    return np.asarray(np.random.default_rng(joints).uniform(-3, 3, (count, joints)))


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("joints", JOINTS)
def test_the_pose_is_that_of_the_chain_and_its_jacobian_that_of_small_differences(joints: int, convention: Convention) -> None:
    arm, q = random_arm(joints, convention), poses(joints)
    found, h = arm.batch(q), 1e-6
    frames = arm.kinematics.link_transforms(q)[:, -1]
    np.testing.assert_allclose(found.rotation, frames[:, :3, :3], atol=1e-13)
    np.testing.assert_allclose(found.position_m, arm.kinematics.tips(q), atol=1e-13)
    for joint, unit in enumerate(np.eye(joints)):
        after, before = arm.batch(q + h * unit), arm.batch(q - h * unit)
        moved = errors(Targets(after.position_m, after.rotation), before) / (2 * h)
        np.testing.assert_allclose(found.jacobian[:, :, joint], moved, atol=1e-8)
    one = arm.at(*q[3].tolist())
    for scalar, batch in zip(one, found, strict=True):
        np.testing.assert_allclose(np.array(scalar), batch[3], atol=1e-14)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("joints", JOINTS)
def test_mujoco_sees_the_tip_at_the_same_place_and_turned_the_same_way(joints: int, convention: Convention) -> None:
    dh = random_dh(joints, 1)
    links = tuple(
        Link("revolute", *row, mass_kg=1.0, com_m=(0.0, 0.0, 0.0), inertia_kg_m2=(0.1, 0.1, 0.1)) for row in dh.tolist()
    )
    arm = Arm("random", links, dh_convention=convention)
    ours = PoseKinematics(ForwardKinematics(arm))
    model, data = model_of(arm)
    for q in poses(joints, 5):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        position, turned, jacobian = ours.at(*q.tolist())
        np.testing.assert_allclose(data.xpos[-1], position, atol=1e-12)
        np.testing.assert_allclose(data.xmat[-1].reshape(3, 3), np.array(turned), atol=1e-12)
        linear, angular = np.zeros((3, joints)), np.zeros((3, joints))
        mujoco.mj_jacBody(model, data, linear, angular, model.nbody - 1)
        np.testing.assert_allclose(np.vstack((linear, angular)), np.array(jacobian), atol=1e-12)


def test_rotations_come_back_from_vectors_and_quaternions_up_to_half_a_turn() -> None:
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(500, 3))
    vectors *= (rng.uniform(0, PI, 500) / np.linalg.norm(vectors, axis=1))[:, None]
    for row, angle in enumerate((0.0, 1e-9, 1e-5, PI - 1e-7, PI - 0.05)):
        vectors[row] *= angle / np.linalg.norm(vectors[row])
    turned = rotation.exponentials(vectors)
    np.testing.assert_allclose(rotation.logarithms(turned), vectors, atol=1e-9)
    np.testing.assert_allclose(rotation.matrices(rotation.quaternions(turned)), turned, atol=1e-14)
    by_element = [rotation.quaternion_of(rows) for rows in turned.tolist()]
    np.testing.assert_allclose(by_element, rotation.quaternions(turned), atol=1e-9)
    h, rates = 1e-6, rng.normal(size=(500, 3))
    after, before = rotation.exponentials(vectors + h * rates), rotation.exponentials(vectors - h * rates)
    omega = rotation.logarithms(after @ np.swapaxes(before, 1, 2)) / (2 * h)
    np.testing.assert_allclose((rotation.left_jacobians(vectors) @ rates[:, :, None])[:, :, 0], omega, atol=1e-7)


@pytest.mark.parametrize("values", [(1, 0, 0), (0, 0, 0, 0), (1, 1, 0, 0), (float("nan"), 0, 0, 1)])
def test_only_a_unit_quaternion_is_an_orientation(values: tuple[float, ...]) -> None:
    with pytest.raises(BadTarget, match="unit quaternion"):
        rotation.checked_quaternion(values)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("joints", JOINTS)
@pytest.mark.parametrize("has_orientation", [False, True])
def test_poses_are_found_again_from_nearby_seeds(joints: int, convention: Convention, has_orientation: bool) -> None:
    arm = random_arm(joints, convention)
    task, q = task_of(arm, has_orientation), poses(joints, 300)
    there = arm.batch(q)
    is_regular = margins(task, there.jacobian) > 0.02
    q, there = q[is_regular], arm.batch(q[is_regular])
    targets = Targets(there.position_m, there.rotation if has_orientation else None)
    near = q + np.random.default_rng(1).uniform(-0.01, 0.01, q.shape)
    solution = solve(arm, task, targets, near)
    assert solution.is_solved.all()
    exact = solution.error[:, task.exact]
    assert not exact.size or np.abs(exact).max() < ACCURACY
    if not task.freedom(joints) and not task.nearest:
        np.testing.assert_allclose(solution.q_rad, q, atol=1e-7)


def test_of_all_poses_that_hold_the_tip_the_nearest_to_the_posture_is_taken() -> None:
    arm, rng = random_arm(7, "modified"), np.random.default_rng(5)
    task, q = task_of(arm, True), np.array([[0.3, -0.8, 0.4, 1.1, -0.5, 0.9, 0.2]])
    tip = arm.batch(q)
    targets = Targets(tip.position_m, tip.rotation)
    posture = q + rng.uniform(-0.02, 0.02, q.shape)
    solution = solve(arm, task, targets, posture)
    here = np.linalg.norm(solution.q_rad - posture)
    for _ in range(20):  # any other pose with the same tip is further from the posture
        other = solve(arm, task, targets, solution.q_rad + rng.uniform(-0.05, 0.05, q.shape))
        assert np.linalg.norm(other.q_rad - posture) >= here - 1e-9


def test_rates_move_the_tip_as_wanted_and_the_rest_as_the_posture_does() -> None:
    arm, rng = random_arm(7, "standard"), np.random.default_rng(2)
    task, jacobians = task_of(arm, True), arm.batch(poses(7, 20)).jacobian
    tip, posture = rng.normal(size=(20, 6)), rng.normal(size=(20, 7))
    rates = joint_rates(task, jacobians, tip, posture)
    np.testing.assert_allclose((jacobians @ rates[:, :, None])[:, :, 0], tip, atol=1e-6)
    left = (rates - posture)[:, :, None]
    null = np.linalg.svd(jacobians)[2][:, -1:]
    np.testing.assert_allclose(null @ left, 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("joints", "has_orientation", "exact", "nearest"),
    [(2, False, 0, 3), (3, False, 3, 0), (4, False, 3, 0), (5, True, 3, 3), (6, True, 6, 0), (7, True, 6, 0)],
)
def test_an_arm_holds_exactly_what_its_joints_can(joints: int, has_orientation: bool, exact: int, nearest: int) -> None:
    task = task_of(random_arm(joints, "standard"), has_orientation)
    assert (len(task.exact), len(task.nearest)) == (exact, nearest)


def test_a_flat_arm_of_three_joints_holds_its_position_only_as_nearly_as_its_plane_allows() -> None:
    flat = PoseKinematics(ForwardKinematics(arm_of([(0.0, 0.0, 0.3, 0.0)] * 3)))
    assert task_of(flat, False).nearest == (0, 1, 2)


# ---- from anywhere


def six(seed: int = 0) -> Arm:
    """A six-joint arm with a wrist, every parameter a little off."""
    dh = np.array(
        [[0.15, 0, 0, PI / 2], [0, 0, 0.35, 0], [0, 0, 0.05, PI / 2], [0.3, 0, 0, -PI / 2], [0, 0, 0, PI / 2], [0.08, 0, 0, 0]]
    )
    dh = dh + np.random.default_rng(seed).uniform(-1, 1, dh.shape) * [2e-3, 0.02, 2e-3, 0.02]
    return arm_of(dh)


def test_a_pose_is_reached_in_several_ways_and_the_first_is_near_where_the_arm_is() -> None:
    arm, q = six(), np.array([0.3, 0.8, -1.2, 0.2, 0.9, 0.1])
    inverse = PoseInverse(arm)
    tip = inverse.kinematics.batch(q[None])
    target = TipPose.of(tip.position_m[0], rotation.quaternions(tip.rotation)[0])
    ways = list(inverse.solutions(target, (q + 0.1).tolist()))
    assert len(ways) >= 4
    np.testing.assert_allclose(ways[0], q, atol=1e-6)
    for way in ways:
        error = errors(target.targets(), inverse.kinematics.batch(np.array([way])))
        assert np.abs(error).max() < ACCURACY


def test_what_is_out_of_reach_or_singular_or_cannot_be_turned_is_said() -> None:
    inverse = PoseInverse(six())
    with pytest.raises(OutOfReach, match="out of reach by"):
        inverse.nearest(TipPose.of((2.0, 0.0, 0.5), (1, 0, 0, 0)), (0.1,) * 6)
    straight = inverse.kinematics.batch(np.array([[0.2, 0.5, -1.0, 0.0, 0.0, 0.0]]))
    wrist = TipPose.of(straight.position_m[0], rotation.quaternions(straight.rotation)[0])
    narrow = dataclasses.replace(six(), links=six().links[:5])
    with pytest.raises((NearSingular, OutOfReach)):
        PoseInverse(narrow).nearest(dataclasses.replace(wrist, position_m=(0.2, 0.2, 0.3)), (0.2, 0.5, -1.0, 0.0, 0.0))

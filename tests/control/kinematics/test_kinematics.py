"""Forward kinematics and its derivatives, against 4x4 chains and differences, for any arm."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from control.errors import ArmError, BadTarget
from control.kinematics import chain
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Convention
from control.model.description import load_arm
from tests.control.kinematics.tables import arm_of
from tests.places import ARMS

Array = NDArray[np.float64]
ROUNDING_M = 1e-14  # some ten operations on lengths of a metre


def _rot(axis: int, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    matrix = np.eye(4)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def _trans(axis: int, length: float) -> Array:
    matrix = np.eye(4)
    matrix[axis, 3] = length
    return matrix


def _textbook_frames(k: ForwardKinematics, q: Array) -> list[Array]:
    """The four elementary transforms of every link, as the paper's appendix multiplies them."""
    frames, angles = [np.eye(4)], iter(q)
    for (d, theta, length, alpha), turns in zip(k.dh, k.joints, strict=True):
        theta = theta + next(angles) if turns else theta
        along_z, along_x = (_trans(2, d) @ _rot(2, theta)), (_trans(0, length) @ _rot(0, alpha))
        frames.append(frames[-1] @ (along_z @ along_x if k.convention == "standard" else along_x @ along_z))
    return frames


def _random_arm(seed: int) -> ForwardKinematics:
    """Any number of links, fixed ones anywhere, exact right angles and arbitrary ones mixed."""
    source = np.random.default_rng(seed)
    links = int(source.integers(1, 8))
    dh = source.uniform(-1.0, 1.0, (links, 4))
    exact = source.random((links, 4)) < 0.4
    dh[exact] = source.choice([0.0, math.pi / 2, -math.pi / 2, math.pi], exact.sum())
    joints = source.random(links) < 0.7
    joints[source.integers(links)] = True
    convention: Convention = "modified" if seed % 2 else "standard"
    return ForwardKinematics(arm_of(dh, convention, joints.tolist(), tuple(source.uniform(-0.1, 0.1, 3).tolist())))


def _planar_arm(convention: Convention) -> ForwardKinematics:
    """Five parallel axes between two skew ones, a fixed link among them: turns whose angles add up."""
    dh = np.random.default_rng(11).uniform(-1.0, 1.0, (7, 4))
    dh[1:6, 3] = 0.0
    return ForwardKinematics(arm_of(dh, convention, [True, True, True, False, True, True, True], (0.1, -0.2, 0.3)))


ALL = [
    pytest.param(_planar_arm("standard"), id="planar standard"),
    pytest.param(_planar_arm("modified"), id="planar modified"),
    *(pytest.param(_random_arm(seed), id=f"random {seed}") for seed in range(30)),
    pytest.param(ForwardKinematics(load_arm("right")), id="right"),
    pytest.param(ForwardKinematics(load_arm("left")), id="left"),
    pytest.param(ForwardKinematics(load_arm(ARMS / "panda.toml")), id="panda"),
    pytest.param(ForwardKinematics(load_arm(ARMS / "pendulum.toml")), id="pendulum"),
]


def _poses(k: ForwardKinematics, count: int = 7) -> Array:
    return np.random.default_rng(5).uniform(-3.0, 3.0, (count, k.joint_count))


def test_the_reference_arm_matches_the_closed_form() -> None:
    tip = ForwardKinematics(load_arm("right")).tip
    for q1, q2, q3 in np.random.default_rng(1).uniform(-3, 3, (50, 3)).tolist():
        reach = 0.3543 * math.cos(q2 + q3) - 0.4 * math.sin(q2)
        height = 0.076 + 0.4 * math.cos(q2) + 0.3543 * math.sin(q2 + q3)
        c, s = math.cos(q1), math.sin(q1)
        assert tip(q1, q2, q3) == pytest.approx((c * reach - 0.012 * s, s * reach + 0.012 * c, height), abs=ROUNDING_M)


@pytest.mark.parametrize("k", ALL)
def test_every_way_to_the_tip_agrees_with_the_4x4_chain(k: ForwardKinematics) -> None:
    q = _poses(k)
    expected_frames = np.array([_textbook_frames(k, pose) for pose in q])
    expected = expected_frames[:, -1] @ np.array([*k.tool_m, 1.0])
    assert k.link_transforms(q) == pytest.approx(expected_frames, abs=ROUNDING_M)
    assert k.tips(q) == pytest.approx(expected[:, :3], abs=ROUNDING_M)
    assert chain.tips(k.dh, q, k.joints, k.convention, k.tool_m) == pytest.approx(expected[:, :3], abs=ROUNDING_M)
    assert k.tips_and_dh_jacobian(q)[0] == pytest.approx(expected[:, :3], abs=ROUNDING_M)
    assert np.array([k.tip(*pose) for pose in q.tolist()]) == pytest.approx(expected[:, :3], abs=ROUNDING_M)


@pytest.mark.parametrize("k", ALL)
def test_the_jacobian_is_the_slope_of_the_tip(k: ForwardKinematics) -> None:
    q, h = _poses(k), 1e-6
    jacobians = k.jacobians(q)
    for joint in range(k.joint_count):
        step = np.zeros(k.joint_count)
        step[joint] = h
        slope = (k.tips(q + step) - k.tips(q - step)) / (2 * h)
        assert jacobians[:, :, joint] == pytest.approx(slope, abs=1e-8)  # rounding 1e-15 over 1e-6
    for pose, jacobian in zip(q.tolist(), jacobians, strict=True):
        tip, rows = k.tip_jacobian(*pose)
        assert tip == pytest.approx(k.tip(*pose), abs=ROUNDING_M)
        assert np.array(rows) == pytest.approx(jacobian, abs=ROUNDING_M)


@pytest.mark.parametrize("k", ALL)
def test_the_identification_jacobian_is_the_slope_by_every_dh_parameter(k: ForwardKinematics) -> None:
    q, h = _poses(k), 1e-6
    jacobian = k.identification_jacobian(q)
    assert jacobian.shape == (len(q), 3, k.dh.size)
    for parameter in range(k.dh.size):
        step = np.zeros(k.dh.size)
        step[parameter] = h
        step = step.reshape(k.dh.shape)
        ahead, behind = (chain.tips(k.dh + sign * step, q, k.joints, k.convention, k.tool_m) for sign in (1, -1))
        assert jacobian[:, :, parameter] == pytest.approx((ahead - behind) / (2 * h), abs=1e-8)


def test_parameters_of_the_reference_arm_that_no_data_separate_have_equal_or_no_columns() -> None:
    """theta4 and alpha4 move nothing, d2 and d3 move the same, and L3 as L4."""
    q = np.random.default_rng(2).uniform(-1, 1, (30, 3))
    by = ForwardKinematics(load_arm("right")).identification_jacobian(q).reshape(90, 4, 4)
    assert not by[:, 3, [1, 3]].any()
    assert by[:, 1, 0] == pytest.approx(by[:, 2, 0], abs=ROUNDING_M)
    assert by[:, 2, 2] == pytest.approx(by[:, 3, 2], abs=ROUNDING_M)
    assert np.linalg.matrix_rank(by.reshape(90, 16), tol=1e-9) == 10


def test_numbers_of_a_calibrated_arm_reach_the_compiled_function_unchanged() -> None:
    arm = load_arm("right")
    dh = arm.dh + np.random.default_rng(8).normal(0, 1e-12, (4, 4))
    q = _poses(ForwardKinematics(arm))
    k = ForwardKinematics(arm.with_dh(dh))
    expected = np.array([_textbook_frames(k, pose)[-1][:3, 3] for pose in q])
    assert k.tips(q) == pytest.approx(expected, abs=3e-16, rel=3e-15)


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((2, 2)), [[0.0, math.nan, 0.0]], [[0.0, 0.0, math.inf]]])
def test_poses_that_are_none_are_rejected(bad: object) -> None:
    k = ForwardKinematics(load_arm("right"))
    for function in (k.tips, k.jacobians, k.identification_jacobian, k.link_transforms):
        with pytest.raises(BadTarget, match="joint angles"):
            function(np.asarray(bad, dtype=np.float64))


def test_no_poses_give_no_tips() -> None:
    k, none = ForwardKinematics(load_arm("right")), np.zeros((0, 3))
    assert k.tips(none).shape == (0, 3)
    assert k.jacobians(none).shape == (0, 3, 3)
    assert k.link_transforms(none).shape == (0, 5, 4, 4)
    assert k.identification_jacobian(none).shape == (0, 3, 16)


def test_a_dh_table_that_is_none_is_rejected() -> None:
    with pytest.raises(ArmError, match="finite DH table"):
        load_arm("right").with_dh(np.zeros((4, 3)))
    with pytest.raises(ArmError, match="finite DH table"):
        load_arm("right").with_dh([[0.0, math.nan, 0.0, 0.0]] * 4)


def test_equal_arms_share_what_is_compiled_and_others_do_not() -> None:
    dh, tool_m = load_arm("right").dh, (0.1, 0.0, 0.0)
    first = ForwardKinematics(arm_of(dh, tool_m=tool_m))
    assert ForwardKinematics(arm_of(dh, tool_m=tool_m)).tip is first.tip
    longer = dh + np.eye(*dh.shape)
    others = map(
        ForwardKinematics,
        (
            arm_of(dh),
            arm_of(longer, tool_m=tool_m),
            arm_of(dh, "modified", tool_m=tool_m),
            arm_of(dh, joints=(*first.joints[:-1], not first.joints[-1]), tool_m=tool_m),
        ),
    )
    assert all(other != first and other.tip is not first.tip for other in others)

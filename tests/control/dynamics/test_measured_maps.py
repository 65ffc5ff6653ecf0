"""Measured maps in the controller: encoders and back, loads and directions, torques; and what a file may not hold."""

from __future__ import annotations

from dataclasses import replace
from math import pi, tau
from pathlib import Path

import numpy as np
import pytest

from calib.arm_problem.joint_effects import known_corrections
from calib.points.points import make_points
from control.dynamics.feedforward import torque_model
from control.dynamics.joint_side import EncoderChain, JointSide, has_joint_side, usable_range_rad
from control.errors import ArmFileError
from control.model.arm import Arm
from control.model.description import arm_text, load_arm, parse_arm
from control.model.maps import CorrectionMap

RIGHT = load_arm("right")
STILL = (0.0, 0.0, 0.0)
ANGLES = CorrectionMap(2, "angle_rad", "angle_rad", (0.0, 0.003, -0.002, 0.001, 0.002), -1.5, 1.5, (0.0005,) * 5)
LOADS = CorrectionMap(3, "angle_rad", "load_Nm", (0.002, 0.0015, 0.0, -0.001, -0.004), -8.0, 8.0)
TURN = CorrectionMap(1, "torque_Nm", "motor_turn_rad", (0.1, 0.4, -0.2, -0.3))
SPEED = CorrectionMap(1, "torque_Nm", "speed_rad_s", (-0.8, -0.2, 0.0, 0.2, 0.8), -1.0, 1.0)
DIRECTED = CorrectionMap(2, "torque_Nm", "angle_rad", (0.0,) * 4, -1.0, 1.0, (0.5,) * 4)


def having(*maps: CorrectionMap) -> Arm:
    return replace(RIGHT, maps=maps)


def test_encoders_and_back_are_the_same_joints_with_speeds_and_accelerations() -> None:
    chain, h = EncoderChain(having(ANGLES)), 1e-4
    rng = np.random.default_rng(0)
    for q, speed, acceleration in rng.uniform(-1.2, 1.2, (20, 3, 3)).tolist():
        e, turned, bent = chain.encoders(q, speed, acceleration)
        assert chain.joints(e, STILL) == pytest.approx(q, abs=1e-12)
        ahead, behind = (
            chain.encoders([a + t * b + 0.5 * t * t * c for a, b, c in zip(q, speed, acceleration, strict=True)], STILL, STILL)[0]
            for t in (h, -h)
        )
        assert turned == pytest.approx(np.subtract(ahead, behind) / (2 * h), abs=1e-6)
        assert bent == pytest.approx((np.array(ahead) - 2 * np.array(e) + behind) / h**2, abs=1e-5)


def test_a_standing_arm_is_where_the_identification_says() -> None:
    arm = having(ANGLES, LOADS)
    encoders = np.random.default_rng(1).uniform(-1.0, 1.0, (6, 3))
    points = make_points(["free"] * 6, list("abcdef"), [1] * 6, encoders, np.full((6, 3), np.nan))
    for row, shift in zip(encoders, known_corrections(arm, points), strict=True):
        assert JointSide(arm).stand(row.tolist()) == pytest.approx((row + shift).tolist(), abs=3e-6)


def test_the_map_of_a_direction_is_followed_without_a_jump() -> None:
    side = JointSide(having(ANGLES))
    side.stand((0.0, 0.2, 0.0))
    before = side.aim(((0.0, 0.2, 0.0), STILL, STILL), 0.002)[0][1]
    steps = []
    for _ in range(400):
        moving = ((0.0, 0.2, 0.0), (0.0, 1e-5, 0.0), STILL)
        after = side.aim(moving, 0.002)[0][1]
        steps.append(after - before)
        before = after
    assert sum(steps) == pytest.approx(-0.0005, abs=2e-6)  # the encoder stays behind a joint that is ahead
    assert max(map(abs, steps)) < 5e-5


def test_ranges_hold_for_every_state_of_a_map() -> None:
    (_, _), (lower, upper), _ = usable_range_rad(having(ANGLES))
    assert lower > RIGHT.limits_rad[1][0]
    assert upper <= RIGHT.limits_rad[1][1]


def test_torques_are_added_at_the_set_point() -> None:
    plain, mapped = torque_model(RIGHT), torque_model(having(TURN, SPEED, DIRECTED))
    turn = 1.0 / RIGHT.drive(1).gear_ratio
    at, speed = (0.25 * tau * turn, 0.3, 0.0), (0.5, 0.4, 0.0)
    added = np.subtract(mapped(at, speed, STILL), plain(at, speed, STILL))
    assert added == pytest.approx([0.4 + 0.2, 0.5, 0.0], abs=1e-9)
    backwards = tuple(-one for one in speed)
    added = np.subtract(mapped(at, backwards, STILL), plain(at, backwards, STILL))
    assert added == pytest.approx([0.4 - 0.2, -0.5, 0.0], abs=1e-9)


def test_a_map_of_torques_leaves_joints_where_their_encoders_are() -> None:
    assert not has_joint_side(having(TURN, SPEED))
    assert has_joint_side(having(LOADS))


def test_a_file_keeps_its_maps_exactly(tmp_path: Path) -> None:
    arm = having(ANGLES, LOADS, TURN, SPEED)
    assert parse_arm(arm_text(arm), tmp_path / "arm.toml").maps == arm.maps


@pytest.mark.parametrize(
    ("one", "says"),
    [
        (replace(ANGLES, joint=4), "a joint from 1 to 3"),
        (replace(ANGLES, over="speed_rad_s"), 'expected "angle_rad" or "load_Nm", got "speed_rad_s"'),
        (replace(ANGLES, values=(0.0, 0.1)), "at least 4 values"),
        (replace(ANGLES, by_direction=(0.1,) * 4), "5 values, as many as in values"),
        (replace(ANGLES, upper=-2.0), "more than lower"),
        (replace(ANGLES, values=(0.0, 0.09, 0.0, 0.0, 0.0), lower=-0.2, upper=0.2), "change by at most 0.2 rad per rad"),
        (replace(LOADS, values=(0.0, 0.0, 0.0, pi, 0.0)), "up to 0.1 rad"),
        (replace(TURN, upper=3.0), "one turn of the motor"),
    ],
)
def test_what_no_controller_can_follow_is_refused_with_line_and_key(one, says, tmp_path: Path) -> None:
    with pytest.raises(ArmFileError, match=r"\[\[map\]\] 1|map 1") as error:
        parse_arm(arm_text(having(one)), tmp_path / "arm.toml")
    assert says in str(error.value)


def test_the_same_map_twice_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArmFileError, match="each map once per joint"):
        parse_arm(arm_text(having(ANGLES, ANGLES)), tmp_path / "arm.toml")

"""Axes that are nearly parallel: the fixed row that holds the tilt which no parameter of their own rows does."""

import dataclasses

import numpy as np
import pytest

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_frames import link_frames
from calib.arm_problem.parallel_axes import frame_behind, parallel_joints, tilt_row, with_tilt_behind
from control.errors import ArmError
from control.model.arm import Arm
from control.model.description import load_arm

RIGHT = load_arm("right")
MODIFIED = dataclasses.replace(RIGHT, dh_convention="modified")


def poses(arm: Arm) -> np.ndarray:
    return np.random.default_rng(1).uniform(-1.5, 1.5, (20, arm.joint_count))


@pytest.mark.parametrize("arm", [RIGHT, MODIFIED], ids=["standard", "modified"])
def test_a_row_without_a_twist_moves_nothing_and_its_twist_turns_all_beyond_about_y(arm: Arm) -> None:
    (joint, *_), q, tilt = parallel_joints(arm), poses(arm), 0.003
    more = with_tilt_behind(arm, joint)
    before = link_frames(ArmModel(arm), arm.dh, q)
    assert ArmModel(more).tips(more.dh, q) == pytest.approx(before.tip_m, abs=1e-12)
    dh = np.array(more.dh)
    dh[tilt_row(more, joint), 3] += tilt
    frame = frame_behind(arm, joint)
    turned = np.cross(before.axes[:, frame, :, 1], before.tip_m - before.origin_m[:, frame])
    moved = ArmModel(more).tips(dh, q) - before.tip_m
    assert np.abs(moved - tilt * turned).max() < 0.6 * tilt**2


def test_a_pair_with_a_row_between_is_left_alone_and_crossing_axes_are() -> None:
    more = with_tilt_behind(RIGHT, 2)
    assert parallel_joints(RIGHT) == (2,)
    assert parallel_joints(more) == ()
    with pytest.raises(ArmError, match="joints 1 and 2 are not parallel"):
        with_tilt_behind(RIGHT, 1)
    twisted = dataclasses.replace(RIGHT.links[1], alpha_rad=0.1)
    assert parallel_joints(dataclasses.replace(RIGHT, links=(RIGHT.links[0], twisted, RIGHT.links[2]))) == ()

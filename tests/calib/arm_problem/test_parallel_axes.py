"""Axes that are nearly parallel: the fixed row that holds the tilt which no parameter of their own rows does."""

import dataclasses

import numpy as np
import pytest

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_bending import link_frames
from calib.arm_problem.parallel_axes import (
    frame_behind,
    in_the_same_rows,
    numbers_before,
    parallel_joints,
    tilt_row,
    with_tilt_behind,
)
from control.errors import ArmError
from control.model.arm import Arm, Effect
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


@pytest.mark.parametrize("arm", [RIGHT, MODIFIED], ids=["standard", "modified"])
def test_an_arm_is_put_in_the_rows_of_one_that_gap_gave_a_tilt(arm: Arm) -> None:
    (joint, *_) = parallel_joints(arm)
    more = with_tilt_behind(arm, joint)
    row = tilt_row(more, joint)
    tilted = dataclasses.replace(more.links[row], alpha_rad=0.003)
    rows = (*more.links[:row], tilted, *more.links[row + 1 :])
    tilted_arm = dataclasses.replace(more, links=rows)
    assert in_the_same_rows(arm, tilted_arm) == (more, tilted_arm)
    assert in_the_same_rows(tilted_arm, arm) == (tilted_arm, more)
    assert in_the_same_rows(arm, arm) == (arm, arm)
    with pytest.raises(ArmError, match="no row of one stands for one of the other"):
        in_the_same_rows(arm, load_arm("so101"))


@pytest.mark.parametrize(("arm", "added"), [(RIGHT, 1), (MODIFIED, 2)], ids=["standard", "modified"])
def test_effects_of_links_stay_with_their_links_when_a_row_comes_between(arm: Arm, added: int) -> None:
    (joint, *_) = parallel_joints(arm)
    effects = tuple(Effect("link_flexure", link, {"EI_Nm2": 100.0 * link}) for link in (joint, joint + 1))
    more = with_tilt_behind(dataclasses.replace(arm, effects=(*effects, Effect("backlash", joint + 1))), joint)
    assert [effect.joint for effect in more.effects] == [joint, joint + 1 + added, joint + 1]
    assert more.links[joint + added].L_m == arm.links[joint].L_m
    before = numbers_before(arm, more)
    assert before == {link + added: link for link in range(joint + 1, len(arm.links) + 1)}
    assert [before.get(e.joint, e.joint) for e in more.effects[:2]] == [joint, joint + 1]
    assert numbers_before(more, more) == {}

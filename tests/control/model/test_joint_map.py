"""Counts and radians: ratio, direction, zero, and the wrap of the counter."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from control.errors import BadTarget
from control.model.arm import Drive
from control.model.description import load_arm
from control.model.drive import JointMap, Unwrapper

DRIVE = Drive(1, 100.0, 2048, 0.03, 0.3, 24.0)


def test_one_joint_turn_is_ratio_times_counts_per_turn() -> None:
    assert JointMap(DRIVE).count(2.0 * math.pi) == 204_800
    assert JointMap(DRIVE).radians(204_800) == pytest.approx(2.0 * math.pi, abs=1e-15)


def test_direction_and_zero_apply_to_counts() -> None:
    map_ = JointMap(dataclasses.replace(DRIVE, encoder_direction=-1, zero_count=500))
    assert map_.radians(500) == 0.0
    assert map_.count(math.pi) == 500 - 102_400
    assert map_.radians(500 - 102_400) == pytest.approx(math.pi)


@given(st.integers(-(2**31), 2**31 - 1), st.sampled_from([1, -1]), st.floats(0.1, 1000.0))
def test_a_count_survives_the_way_to_radians_and_back(count: int, direction: int, ratio: float) -> None:
    drive = dataclasses.replace(DRIVE, gear_ratio=ratio, encoder_direction=direction, zero_count=17)
    map_ = JointMap(drive)
    assert map_.count(map_.radians(count)) == count


@pytest.mark.parametrize("joint", [1, 2, 3])
def test_the_reference_arm_resolves_its_joints_to_thirty_microradians(joint: int) -> None:
    assert abs(JointMap(load_arm("right").drive(joint)).radians(1)) < 31e-6


@pytest.mark.parametrize("angle", [math.nan, math.inf])
def test_an_angle_that_is_none_has_no_count(angle: float) -> None:
    with pytest.raises(BadTarget, match="finite"):
        JointMap(DRIVE).count(angle)


@pytest.mark.parametrize("bits", [8, 12, 16, 32])
@pytest.mark.parametrize("is_signed", [True, False])
def test_a_counter_is_followed_through_many_wraps_both_ways(bits: int, is_signed: bool) -> None:
    def raw(count: int) -> int:
        low = count % (1 << bits)
        return low - (1 << bits) if is_signed and low >= 1 << (bits - 1) else low

    step = (1 << (bits - 1)) - 1  # the longest that is unambiguous
    track = [i * step for i in range(10)]
    track += [track[-1] - i * step for i in range(25)]
    unwrapper = Unwrapper(bits, raw(track[0]))
    assert [unwrapper.update(raw(count)) for count in track] == track


def test_the_first_count_is_the_reference_whatever_it_is() -> None:
    unwrapper = Unwrapper(16, -5)
    assert unwrapper.update(-5) == -5
    assert unwrapper.update(65_530) == -6

"""Answers follow from what was measured: not from the order of the rows, nor from limits that nobody came near."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from benchmarks.gap.static.cases import Design, Hidden, designed
from calib.gap.finding import EffectName
from calib.gap.poses.find import find
from calib.gap.poses.floor import noise_floor
from calib.gap.poses.measured import Left
from calib.gap.poses.outcome import StaticGap
from calib.gap.poses.recordings import parts, split
from calib.points.points import Points
from control.model.arm import Arm

HIDDEN = (Hidden("encoder_scale", 1, 0.006), Hidden("backlash", 2, 0.004))
DESIGNS = (
    Design(rig="planar", free=36, visits=4),
    Design(rig="planar", free=36, visits=4, has_time=False),
    Design(rig="planar", free=36, visits=1),  # too few recordings: single poses report
    Design(step=8, free=12, has_time=False),
)


def shuffled(points: Points) -> tuple[Points, np.ndarray]:
    order = np.random.default_rng(5).permutation(len(points))
    return points.chosen(order), order


@pytest.mark.parametrize("design", DESIGNS)
def test_what_reports_what_is_left_out_in_turn_and_the_noise_are_the_same_poses_in_any_order(
    design: Design,
) -> None:
    arm, points = designed(71, (), design)
    other, order = shuffled(points)
    first, second = split(points), split(other)
    np.testing.assert_array_equal(second.report, first.report[order])
    np.testing.assert_array_equal(second.known, first.known[order])
    unplaced = dataclasses.replace(points, tip_m=np.full(points.tip_m.shape, np.nan))
    np.testing.assert_array_equal(parts(shuffled(unplaced)[0], 5), parts(unplaced, 5)[order])
    left = Left(np.array(points.tip_m), np.full(points.tip_m.shape, np.nan))
    same = Left(left.tip_m[order], left.turn_rad)
    assert noise_floor(arm, other, same).tip_m == pytest.approx(
        noise_floor(arm, points, left).tip_m, rel=1e-9
    )


@cache
def recorded(has_time: bool) -> tuple[Arm, Points, StaticGap]:
    arm, points = designed(72, HIDDEN, dataclasses.replace(DESIGNS[0], has_time=has_time))
    return arm, points, find(arm, points)


def require_same(one: StaticGap, other: StaticGap) -> None:
    told, again = (
        {e.name: {key: value for key, (value, _) in e.parameters.items()} for e in found.finding.effects}
        for found in (one, other)
    )
    assert told.keys() == again.keys() >= {EffectName(hidden.effect, hidden.joint) for hidden in HIDDEN}
    for name, parameters in told.items():
        assert again[name] == pytest.approx(parameters, rel=1e-5, abs=1e-8)
    assert other.finding.gap_after == pytest.approx(one.finding.gap_after, rel=1e-5)


@pytest.mark.parametrize("has_time", [True, False], ids=["with times", "without times"])
def test_rows_in_another_order_have_the_same_answer(has_time: bool) -> None:
    arm, points, found = recorded(has_time)
    require_same(found, find(arm, shuffled(points)[0]))


def test_current_limits_that_are_five_times_as_wide_have_the_same_answer() -> None:
    arm, points, found = recorded(True)
    drives = tuple(dataclasses.replace(one, current_limit_A=5.0 * one.current_limit_A) for one in arm.drives)
    require_same(found, find(dataclasses.replace(arm, drives=drives), points))

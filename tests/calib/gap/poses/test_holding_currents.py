"""Holding currents and tips see one geometry: what an arm carries follows its lengths and angles."""

import dataclasses

import numpy as np
import pytest

from benchmarks.gap.static.cases import Design, Hidden, designed
from benchmarks.gap.static.rough_cases import case
from calib.arm_problem.assembly import Choice, problem_of
from calib.gap.poses.currents import holding_currents
from calib.gap.poses.find import find
from calib.gap.poses.linear import Fit
from control.dynamics.static_pose import gravity_Nm, torque_per_A
from tests.thirds import third_of


@pytest.mark.parametrize("rig", ["six", "planar"])
def test_what_motors_hold_follows_the_geometry_that_the_fit_has(rig: str) -> None:
    arm, points = designed(62, (), Design(rig=rig, free=30, visits=7))
    problem = problem_of(arm, points, Choice().for_points(arm, points))
    bounded = np.array([one.has_bound for one in problem.parameters])
    x = 0.2 * np.random.default_rng(62).standard_normal(len(bounded)) * bounded
    there = dataclasses.replace(Fit.nominal(problem), x=x)
    load_Nm = gravity_Nm(there.shaped(arm), points.q_rad, points.payload_kg)
    points = dataclasses.replace(points, current_A=load_Nm / torque_per_A(arm))
    still = np.zeros(points.q_rad.shape)
    for fit in (Fit.nominal(problem), there):
        held = holding_currents(fit, arm, points, still, ())
        assert held is not None
        *by_geometry, torque_Nm = held.columns_Nm
        left = torque_Nm - np.einsum("kmn,k->mn", by_geometry[: len(x)], x)
        assert np.abs(left).max() < 0.05 * np.abs(torque_Nm).max()


@pytest.mark.parametrize(("rig", "joint"), [("planar", 1), pytest.param("six", 2, marks=pytest.mark.nightly)])
def test_a_motor_whose_current_has_the_other_sign_is_said_and_never_written(rig: str, joint: int) -> None:
    arm, points = designed(63, (), Design(rig=rig, free=40, visits=7))
    current_A = np.array(points.current_A)
    current_A[:, joint - 1] *= -0.7
    found = find(arm, dataclasses.replace(points, current_A=current_A))
    assert {effect.name.effect for effect in found.finding.effects} <= {"link_geometry"}
    assert "torque_constant" not in {effect.effect for effect in found.file.effects}
    assert found.finding.unknown is not None
    assert f"torque_constant on joint {joint}" in found.finding.unknown.where


@pytest.mark.parametrize("seed", third_of([93_015, 93_023]))
def test_an_arm_off_its_drawing_carries_what_its_geometry_says_and_nothing_is_named_or_left(seed: int) -> None:
    one = case("null", seed)
    found = find(one.arm, one.points).finding
    assert {effect.name.effect for effect in found.effects} <= {"link_geometry"}
    assert found.unknown is None


@pytest.mark.nightly  # tests/calib/gap/test_one_file.py has the same gear beside an encoder's scale at each change
def test_a_gear_so_soft_that_its_loads_move_with_it_is_named_beside_an_encoders_error() -> None:
    hidden = (Hidden("encoder_eccentricity", 4, 0.006, 0.4), Hidden("joint_compliance", 2, 600.0))
    found = find(*designed(64, hidden, Design(rig="six", free=40, visits=5))).finding
    assert [(one.name.effect, one.name.joint) for one in found.effects[1:]] == [("joint_compliance", 2)]
    assert [{name.joint for name in names} for names in found.ambiguous] == [{4}]
    assert found.unknown is None
    assert found.gap_after < 1.35

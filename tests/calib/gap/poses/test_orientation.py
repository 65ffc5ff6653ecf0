"""Measured orientations name effects: each row counts by its own noise, and shows what moves no tip."""

import dataclasses

import numpy as np
import pytest

from benchmarks.gap.static.cases import RIGS, Design, Hidden, NOISE_m, designed
from benchmarks.gap.static.physics import Poses, bent, frames_of
from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.assembly import problem_of
from calib.arm_problem.link_bending import bending, link_frames
from calib.gap.finding import EffectName
from calib.gap.poses.cautions import UNKNOWN_TURNS, about_orientations
from calib.gap.poses.find import find
from calib.gap.poses.floor import Floor, noise_floor
from calib.gap.poses.linear import Fit, Residuals, by_joints
from calib.gap.posterior.term import Block, Term, on_joint
from calib.gap.words import in_words
from calib.validation.verdict import REPEATS_FREEDOM
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Camera
from tests.calib.simulated import with_rows

TURN_NOISE_rad = 3e-4
LITTLE = Design(
    rig="six",
    tilts=("normal",),
    free=16,
    visits=4,
    has_currents=False,
    has_time=False,
    has_payload=False,
    turn_noise_rad=TURN_NOISE_rad,
)
SIX = dataclasses.replace(RIGS["six"].arm, camera=Camera(NOISE_m, TURN_NOISE_rad))


def test_an_effect_of_a_joint_whose_axis_holds_the_tip_is_named_by_the_orientation() -> None:
    _, points = designed(3100, (Hidden("encoder_scale", 6, 0.008),), LITTLE)
    tips, turns = by_joints(Fit.nominal(problem_of(SIX, points)))
    assert np.abs(tips[:, :, 5]).max() < 1e-12
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1.0)
    found = find(SIX, points)
    named = {one.name: one.parameters for one in found.finding.effects}
    assert named[EffectName("encoder_scale", 6)]["scale"][0] == pytest.approx(0.008, rel=0.15)
    assert len(named) == 2  # it and the geometry
    expected = {"tip_m": NOISE_m, "turn_rad": TURN_NOISE_rad}
    assert found.finding.noise_floor == pytest.approx(expected, rel=1e-3)  # and what fine encoders add
    assert any("orientations count beside the tip" in sentence for sentence in in_words(found.finding))
    assert found.finding.after_si["turn_rad"] < 1.3 * TURN_NOISE_rad < 0.5 * found.finding.before_si["turn_rad"]


def test_rows_follow_joints_and_turns_of_the_last_link_as_the_problem_does() -> None:
    _, points = designed(3101, (), LITTLE)
    fit, lever = Fit.nominal(problem_of(SIX, points)), 0.3
    m, step = len(points), 1e-6
    one = Term(
        Block(5, "any"),
        "",
        2,
        0,
        1.0,
        slope_rad=np.concatenate((on_joint(np.ones(m), 4, 6), np.zeros((1, m, 6)))),
        turn_rad=np.stack((np.zeros((m, 3)), np.tile((0.0, 1.0, 0.0), (m, 1)))),
    )
    measured = fit.measured(lever)
    moved = dataclasses.replace(points, q_rad=points.q_rad + step * one.slope_rad[0])
    near = dataclasses.replace(fit, problem=problem_of(SIX, moved))
    turned = dataclasses.replace(fit, problem=problem_of(SIX, points))
    turned.problem.observed = dataclasses.replace(turned.problem.observed, known_turn_rad=step * one.turn_rad[1])
    for column, other in zip(measured.moved_by(one), (near, turned), strict=True):
        slope = (measured.residual - other.measured(lever).residual) / step
        np.testing.assert_allclose(slope, column, atol=0.02)  # an error of 10 mrad turns axes by as much


def test_a_bent_link_turns_what_it_carries_as_a_row_of_hinges_does() -> None:
    rig, still = RIGS["six"], np.zeros(4)
    q = np.random.default_rng(5).uniform(rig.lower, rig.upper, (4, 6))
    at = Poses(q, still, still + 0.4, still, still, still, ("free",) * 4, np.random.default_rng(0))
    frames = frames_of(rig, rig.arm.dh, q)
    tip, down = frames[-1][:, :3, 3], np.asarray(rig.arm.gravity_m_s2)
    shift, turn = bent(Hidden("link_flexure", 5, 100.0), at, rig, frames, tip, down)
    found = bending(rig.arm, link_frames(ArmModel(rig.arm), rig.arm.dh, q), at.payload, 5)
    np.testing.assert_allclose(found.shift / 100.0, shift, atol=0.02 * np.abs(shift).max())
    np.testing.assert_allclose(found.turn / 100.0, turn, atol=0.02 * np.abs(turn).max())


def _floor(arm: Arm, is_repeated: bool, pairs_count: int = 32) -> Floor:
    _, points = designed(3102, (), LITTLE)
    if is_repeated:
        same = np.repeat(np.arange(pairs_count), 2)
        points = points.chosen(same)
    noise = np.random.default_rng(1).normal(0.0, 1.0, (2, len(points), 3))
    return noise_floor(arm, points, Residuals(NOISE_m * noise[0], TURN_NOISE_rad * noise[1]))


def test_the_noise_of_orientations_is_that_of_repeats_else_of_the_data_sheet_else_they_are_not_used() -> None:
    blind = dataclasses.replace(SIX, camera=None)
    assert _floor(blind, is_repeated=True).turn_rad == pytest.approx(TURN_NOISE_rad, rel=0.2)
    of_steps = 1e-3  # and what fine encoders add
    assert _floor(SIX, is_repeated=False).turn_rad == pytest.approx(TURN_NOISE_rad, rel=of_steps)
    unknown = _floor(blind, is_repeated=False)
    assert unknown.lever_m == 0.0
    _, points = designed(3102, (), LITTLE)
    assert list(about_orientations(points, unknown)) == [UNKNOWN_TURNS]
    assert not list(about_orientations(points, _floor(SIX, is_repeated=False)))


def test_steps_of_encoders_are_in_the_floor_where_angles_were_read_in_whole_counts() -> None:
    _, fine = designed(3102, (), LITTLE)
    fine = fine.chosen(np.repeat(np.arange(len(fine)), 2))
    counts, kinematics = 4096, ForwardKinematics(SIX)
    drives = tuple(dataclasses.replace(one, gear_ratio=1.0, encoder_counts_per_rev=counts) for one in SIX.drives)
    servos, step_rad = dataclasses.replace(SIX, camera=None, drives=drives), 2.0 * np.pi / counts
    counted = with_rows(fine, q_rad=np.round(fine.q_rad / step_rad) * step_rad)
    noise = NOISE_m * np.random.default_rng(1).normal(size=(len(fine), 3))
    moved_m = kinematics.tips(counted.q_rad) - kinematics.tips(fine.q_rad)
    of_fine, of_counted = (
        noise_floor(servos, points, Residuals(noise, np.full_like(noise, np.nan))).tip_m for points in (fine, counted)
    )
    assert of_fine == pytest.approx(NOISE_m, rel=0.2)
    assert of_counted == pytest.approx(np.hypot(of_fine, np.sqrt(np.mean(moved_m**2))), rel=0.15)
    assert of_counted > 1.5 * of_fine


def test_a_noise_needs_three_pairs_of_repeats_as_in_calibrate_and_says_how_well_it_is_known() -> None:
    blind = dataclasses.replace(SIX, camera=None)
    assert np.isnan(_floor(blind, is_repeated=True, pairs_count=2).tip_m)
    known = _floor(blind, is_repeated=True, pairs_count=3)
    assert known.tip_m == pytest.approx(NOISE_m, rel=3.0 * known.doubt)
    assert known.doubt == pytest.approx(1.0 / np.sqrt(2.0 * REPEATS_FREEDOM))

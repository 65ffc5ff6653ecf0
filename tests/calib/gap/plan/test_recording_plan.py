"""What is planned to be recorded: clear of everything, within every limit, from both sides, and the same every time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.errors import CalibrationError
from calib.gap.plan.foresight import as_recorded, foreseen, in_words
from calib.gap.plan.motions import CLEARANCE_m, MotionLimits, clear, collision_free_box, demand, multisine, poses_of, ramps, shake
from calib.gap.plan.plan import REFERENCE, APPROACH_rad, PlanRequest, recording_plan
from calib.gap.poses.recordings import split
from control.dynamics.static_pose import gravity_Nm
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.description import load_arm

RIGHT = load_arm("right")
QUICK = PlanRequest(payload_kg=0.5, is_quick=True)


@pytest.fixture(scope="module")
def quick():
    return recording_plan(RIGHT, QUICK)


@pytest.fixture(scope="module")
def room():
    return collision_free_box(RIGHT)


def test_every_pose_of_the_room_keeps_the_arm_clear_of_the_floor(room) -> None:
    corners = np.array(np.meshgrid(*[(0.0, 0.5, 1.0)] * 3)).reshape(3, -1).T
    drawn = np.random.default_rng(5).uniform(0.0, 1.0, (2000, 3))
    poses = room.at(np.concatenate((corners, drawn)))
    # a box is looked at on 3000 poses: between them a corner may dip a little, never by half the clearance
    assert clear(RIGHT, poses, 0.5 * CLEARANCE_m).all()
    assert (room.width_rad > 1.0).all()


def test_gravity_pulls_joints_two_and_three_both_ways_in_the_room(room) -> None:
    pull = gravity_Nm(RIGHT, room.at(np.random.default_rng(6).uniform(0.0, 1.0, (500, 3))))
    assert (pull[:, 1:] > 0.1).any(axis=0).all()
    assert (pull[:, 1:] < -0.1).any(axis=0).all()


def test_an_arm_without_room_is_told_so() -> None:
    high = dataclasses.replace(RIGHT, limits=dataclasses.replace(RIGHT.limits, floor_z_m=0.7))
    with pytest.raises(CalibrationError, match="no collision-free box"):
        collision_free_box(high)


def test_motions_stay_in_the_room_below_every_limit_and_are_what_their_derivatives_say(room) -> None:
    inner, limits = room.inset(0.02), MotionLimits.of(RIGHT)
    for path in (
        ramps(inner, limits, (0.06, 0.12, 0.25, 0.5), 0.6),
        ramps(inner, limits, (0.015, 0.03), 1.2),
        multisine(inner, limits, (0.3, 1.6), 0.95, 4.0, 1),
        multisine(inner, limits, (0.12, 0.3), 1.0, 8.0, 2),
        shake(inner, limits, (2.0, 9.0), 4.0, 1),
    ):
        times = np.arange(0.0, path.duration_s, 0.002)
        sampled = [path.at(float(t)) for t in times]
        q, v, a = (np.array([point[k] for point in sampled]) for k in range(3))
        assert room.holds(q)
        assert demand(path, limits) <= 0.9 + 1e-9
        assert (np.abs(v) <= limits.joints.speed_rad_s).all()
        assert (np.abs(a) <= limits.joints.acceleration_rad_s2).all()
        tip = np.linalg.norm(np.einsum("mij,mj->mi", ForwardKinematics(RIGHT).jacobians(q), v), axis=1)
        assert tip.max() <= RIGHT.limits.tip_speed_m_s
        # central differences over 4 ms: an error of the jerk's change, far below a per cent of the limits
        assert np.abs(np.gradient(q, times, axis=0) - v)[2:-2].max() < 1e-3
        assert np.abs(np.gradient(v, times, axis=0) - a)[2:-2].max() < 0.05


def test_ramps_hold_each_speed_both_ways(room) -> None:
    shares = (0.06, 0.12, 0.25, 0.5)
    path = ramps(room, MotionLimits.of(RIGHT), shares, 0.6)
    speeds = np.array([knot.speed_rad_s for knot in path.knots])
    fastest = np.abs(speeds).max()
    for j in range(3):
        held, counts = np.unique(np.round(speeds[:, j] / fastest, 3), return_counts=True)
        steady = held[(counts > 5) & (held != 0.0)]
        assert (steady > 0).sum() >= 4
        assert (steady < 0).sum() >= 4


def test_a_plan_approaches_every_pose_from_two_opposite_sides_inside_the_limits(quick) -> None:
    lower, upper = np.array(RIGHT.limits_rad).T
    sides: dict[tuple[str, float], set[tuple[int, ...]]] = {}
    for visit in quick.visits:
        start, end = np.array(visit.start_rad), np.array(visit.q_rad)
        assert ((start >= lower) & (start <= upper)).all()
        assert np.sign(end - start).tolist() == list(visit.direction)
        assert np.abs(end - start) == pytest.approx(APPROACH_rad)
        if visit.point != REFERENCE:
            sides.setdefault((visit.point, visit.payload_kg), set()).add(visit.direction)
    for directions in sides.values():
        one, other = directions
        assert one == tuple(-d for d in other)
    assert len({frozenset(d) for d in sides.values()}) == 2  # both pairs of sides occur


def test_poses_come_shuffled_with_the_reference_in_between_and_the_load_last(quick) -> None:
    names = [visit.point for visit in quick.visits if not visit.payload_kg]
    seen = [k for k, name in enumerate(names) if name == REFERENCE]
    assert len(seen) >= 12  # pairs of repeats enough for a noise floor
    assert max(np.diff(seen)) <= 12
    alone = [name for name in names if name.startswith("a")]
    assert alone != sorted(alone)
    loads = [step.payload_kg for step in quick.steps]
    assert loads == sorted(loads)
    assert set(loads) == {0.0, 0.5}


@pytest.mark.parametrize("asked", [QUICK, PlanRequest(has_motions=False), PlanRequest(has_motions=False, minutes=1.6)])
def test_each_side_of_each_block_is_a_recording_and_a_fifth_of_all_is_kept_apart_with_every_side(asked) -> None:
    plan = recording_plan(RIGHT, asked)
    points = as_recorded(RIGHT, plan.visits, plan.duration_s)
    parts = split(points)
    assert parts.recordings_count == 4 * len(set(points.setup))
    assert 0.2 * len(points) < parts.report.sum() < 0.3 * len(points)
    if len(set(points.setup)) < 4:
        return
    assert len(np.unique(points.direction[parts.report], axis=0)) == 4
    # each block goes over much of the room, and what is held out over most of it
    for setup in set(points.setup):
        own = points.q_rad[np.array(points.setup) == setup]
        assert (np.ptp(own, axis=0) > 0.4 * plan.room.width_rad).all()
    assert (np.ptp(points.q_rad[parts.report], axis=0) > 0.7 * plan.room.width_rad).all()


def test_joint_two_moves_while_motor_three_stands(quick) -> None:
    poses = np.array([visit.q_rad for visit in quick.visits if visit.point.startswith("a")])
    middle = quick.room.middle_rad
    still = np.abs(poses[:, 2] - middle[2]) < 1e-3
    assert np.ptp(poses[still, 1]) > 0.8 * quick.room.width_rad[1]


def test_runs_repeat_differ_in_speed_and_some_carry_the_load(quick) -> None:
    motions = [tuple(map(tuple, poses_of(run.path).tolist())) for run in quick.runs]
    assert len(set(motions)) <= len(motions) - 3  # ramps, a swing and a wide one are there twice
    assert len({run.kind for run in quick.runs}) >= 6
    assert {run.payload_kg for run in quick.runs} == {0.0, 0.5}
    assert len({run.name for run in quick.runs}) == len(quick.runs)


def test_records_have_keys_of_their_own_and_the_plan_is_the_same_every_time(quick) -> None:
    keys = [(visit.setup, visit.point, visit.repeat) for visit in quick.visits]
    assert len(set(keys)) == len(keys)
    again = recording_plan(RIGHT, QUICK)
    assert again.visits == quick.visits
    assert again.duration_s == quick.duration_s


def test_only_poses_or_only_motions() -> None:
    assert not recording_plan(RIGHT, PlanRequest(has_motions=False, is_quick=True)).runs
    assert not recording_plan(RIGHT, PlanRequest(has_poses=False, is_quick=True)).visits


def test_the_time_that_is_given_is_used_and_not_passed() -> None:
    short = recording_plan(RIGHT, PlanRequest(has_motions=False, minutes=1.6))
    longer = recording_plan(RIGHT, PlanRequest(has_motions=False, minutes=3.0))
    assert short.duration_s <= 96.0
    assert 144.0 < longer.duration_s <= 180.0
    assert len(longer.visits) > len(short.visits)
    with pytest.raises(CalibrationError, match="the shortest useful recording takes"):
        recording_plan(RIGHT, PlanRequest(minutes=0.2))


def test_what_a_plan_would_make_nameable_is_said_before_anything_moves(quick) -> None:
    poses_only = dataclasses.replace(quick, steps=quick.visits)
    said = " ".join(in_words(RIGHT, poses_only, 0.5))
    for name in ("backlash on joint 2", "joint_compliance on joint 2", "encoder_scale on joint 1", "belt_coupling"):
        assert name in said
    few = dataclasses.replace(quick, steps=tuple(v for v in quick.visits if v.point == REFERENCE or v.point < "a3"))
    unnamed = [sentence for sentence in in_words(RIGHT, few, 0.0) if sentence.startswith("They could not name")]
    assert 0 < len(unnamed) <= 2
    named = [str(one.name) for one in foreseen(RIGHT, few) if not one.is_nameable]
    assert all(name in " ".join(unnamed) for name in named)


def test_an_arm_without_masses_is_planned_for_all_the_same() -> None:
    bare: Arm = dataclasses.replace(
        RIGHT, links=tuple(dataclasses.replace(link, mass_kg=None, com_m=None, inertia_kg_m2=None) for link in RIGHT.links)
    )
    plan = recording_plan(bare, PlanRequest(has_motions=False, is_quick=True))
    assert not [visit for visit in plan.visits if visit.point.startswith("g")]
    assert np.isnan(as_recorded(bare, plan.visits, plan.duration_s).current_A).all()

"""The loop on a mock arm that hides play, springs, a belt's and encoders' errors, with them in its arm.toml and without."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Effect, Limits
from control.motion.plan import PlannedPath, plan_path
from control.safety.modes import Mode
from control.server.client import ArmFaulted
from hil_mocks.scenario import EffectTable
from tests.cell import RIGHT, Cell, holding_cell, scenario
from tests.thirds import third_of

FRICTION = tuple(Effect("coulomb_friction", j, {"torque_Nm": t}) for j, t in ((1, 1.0), (2, 1.2), (3, 0.7)))
GEARS = tuple(Effect("backlash", j, {"width_rad": 0.005}) for j in (1, 2, 3))
SPRINGS = tuple(Effect("joint_compliance", j, {"stiffness_Nm_rad": k}) for j, k in ((2, 2500.0), (3, 1500.0)))
RIGID = (
    Effect("belt_coupling", None, {"ratio": 0.01}),
    Effect("encoder_eccentricity", 1, {"amplitude_rad": 0.004, "phase_rad": 0.7}),
    Effect("encoder_scale", 2, {"scale": 0.004}),
)
NEAR = (0.1, -0.6, 0.2)
STOPS_m = ((0.45, 0.1, 0.25), (0.3, -0.2, 0.35), (0.15, 0.0, 0.6))
INVERSE, KINEMATICS = InverseKinematics(RIGHT), ForwardKinematics(RIGHT)


@contextmanager
def an_arm(hidden: Sequence[Effect], known: Sequence[Effect], limits: Limits = RIGHT.limits, **keys: object) -> Iterator[Cell]:
    """A mock arm that hides friction and more, and a loop that knows friction and so much of it."""
    tables = tuple(EffectTable(e.effect, e.joint or 0, dict(e.parameters)) for e in (*FRICTION, *hidden))
    arm = replace(RIGHT, effects=(*FRICTION, *known), limits=limits)
    with holding_cell(scenario(effect=tables), believed=arm, **keys) as cell:
        cell.client.home()
        yield cell


def resting_errors_m(cell: Cell) -> float:
    """Largest tip error at three stops, approached gently."""
    q, errors = NEAR, []
    for stop in STOPS_m:
        q = INVERSE.nearest(stop, q)
        cell.client.move_joints(q, 0.4)
        cell.run(0.3)
        errors.append(math.dist(cell.rig.tip_m(), stop))
    return max(errors)


# Level of the arm without the effect: 0.13 mm at most at these stops (benchmarks.calibration.corrections: 0.05 mm RMS).
LEVEL_m = 0.00025


def test_an_arm_that_knows_what_it_hides_rests_where_one_without_it_does() -> None:
    hidden = (*GEARS, *SPRINGS, *RIGID)
    with an_arm(hidden, ()) as cell:
        assert resting_errors_m(cell) > 2e-3
    with an_arm(hidden, hidden) as cell:
        assert resting_errors_m(cell) < LEVEL_m


def circle(arm: Arm = RIGHT) -> PlannedPath:
    turns = np.linspace(0.0, 2.0 * np.pi, 13)
    points = [(0.4 + 0.05 * np.cos(a), 0.05 * np.sin(a), 0.3 + 0.025 * np.sin(a + 1.0)) for a in turns]
    return plan_path(arm, [tuple(map(float, p)) for p in points], 0.15)


def path_errors_m(cell: Cell) -> list[float]:
    """Tip errors on the circle, cycle by cycle."""
    path, runtime = circle(), cell.runtime
    cell.client.move_joints(path.q_start_rad, 0.4)
    cell.run(0.2)
    errors: list[float] = []

    def watch() -> None:
        if cell.mode is Mode.MOVING:
            errors.append(math.dist(cell.rig.tip_m(), KINEMATICS.tip(*runtime.set_point.q_rad)))

    cell.watchers.append(watch)
    cell.client.run_path(path.to_message())
    return errors


def rms(errors: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def test_on_a_path_too_the_tip_goes_where_it_is_sent() -> None:
    hidden = (*GEARS[:2], *RIGID)
    with an_arm(hidden, ()) as cell:
        assert rms(path_errors_m(cell)) > 1e-3
    with an_arm(hidden, hidden) as cell:
        # 0.16 mm on the arm without them; a gear that crosses its play takes 0.1 s, during which the tip is off.
        assert rms(path_errors_m(cell)) < 3.5e-4


def test_status_tells_joints_from_encoders_and_the_tip_by_the_joints() -> None:
    hidden = (*GEARS, *RIGID)
    with an_arm(hidden, hidden) as cell:
        cell.client.move_joints(INVERSE.nearest(STOPS_m[0], NEAR), 0.4)
        cell.run(0.3)
        status = cell.client.status()
        assert status["joint_rad"] == pytest.approx(cell.rig.joint_rad(), abs=4e-4)
        assert math.dist(status["tip_m"], cell.rig.tip_m()) < LEVEL_m
        assert status["tip_set_m"] == pytest.approx(STOPS_m[0], abs=1e-9)
        assert max(abs(j - q) for j, q in zip(status["joint_rad"], status["q_rad"], strict=True)) > 2e-3
        assert max(map(abs, status["following_error_rad"])) < 2e-4


def test_encoder_angles_are_taken_as_they_are_when_asked_so_and_held() -> None:
    hidden = (*GEARS, *RIGID)
    target = (0.3, -0.8, 0.4)
    with an_arm(hidden, hidden) as cell:
        cell.client.move_joints(target, 0.5, as_encoders=True)
        cell.run(0.5)
        assert cell.client.status()["q_set_rad"] == pytest.approx(target, abs=1e-6)
        # The next motion is of the joints again and begins without a step.
        speeds = cell.true_speeds()
        cell.client.move_joints(target, 0.5)
        assert cell.rig.joint_rad() == pytest.approx(target, abs=5e-4)
        assert max(speeds) < 0.3


def test_a_target_at_which_an_encoder_would_leave_its_range_is_refused_and_nothing_moves() -> None:
    with an_arm((), (Effect("encoder_scale", 2, {"scale": -0.01}),)) as cell:
        assert "outside of its range" in cell.refusal(do="move_joints", q_rad=[0.1, 0.795, 0.2])
        assert cell.mode is Mode.HOLDING
        cell.client.move_joints((0.1, 0.785, 0.2))  # the encoder's end is at 0.792


def test_set_points_of_the_encoders_keep_their_limits_all_the_way() -> None:
    hidden = (*GEARS, *SPRINGS, *RIGID)
    with an_arm((), hidden) as cell:
        aims: list[tuple[float, ...]] = []
        cell.watchers.append(lambda: aims.append(cell.runtime.aim.q_rad))
        cell.client.move_joints((-0.5, -1.2, 0.9))
        cell.client.move_joints((0.5, -0.3, 0.1))
        cell.start_move((-0.5, -1.2, 0.9))
        cell.run(0.4)
        cell.client.stop()
        cell.run(0.3)
        cell.client.jog(joint=2, by_rad=-0.1)
        assert not cell.faults
    speed = np.diff(aims, axis=0) / 0.002
    acceleration = np.diff(speed, axis=0) / 0.002
    assert np.abs(speed).max() <= 2.0 * (1.155 + 0.25)
    assert np.abs(acceleration).max() <= 10.0 * (1.155 + 0.5)


def test_a_payload_that_is_told_changes_what_springs_give_without_a_step() -> None:
    with an_arm(SPRINGS, SPRINGS) as cell:
        cell.client.move_joints(NEAR, 0.5)
        cell.run(0.2)
        aims: list[tuple[float, ...]] = []
        cell.watchers.append(lambda: aims.append(cell.runtime.aim.q_rad))
        cell.rig.set_payload(0.5)
        cell.client.ask("payload", mass_kg=0.5)
        cell.run(0.6)
        assert aims[-1][1] != pytest.approx(aims[0][1], abs=3e-4)
        assert np.abs(np.diff(aims, n=2, axis=0)).max() <= 5.0 * 0.002**2 * 1.001  # half the acceleration limit
        assert math.dist(cell.rig.tip_m(), KINEMATICS.tip(*NEAR)) < 3.5e-4


def test_homing_again_and_a_stop_by_hand_leave_the_arm_where_it_is() -> None:
    hidden = (*GEARS, *RIGID)
    with an_arm(hidden, hidden) as cell:
        cell.client.ask("home", again=True)
        cell.client.until(["HOLDING"], 120.0)
        before = cell.runtime.aim.q_rad
        cell.run(0.3)
        assert cell.runtime.aim.q_rad == pytest.approx(before, abs=2e-5)
        assert cell.client.status()["joint_rad"] == pytest.approx(cell.rig.joint_rad(), abs=3e-3)
        cell.client.guide()
        cell.run(0.05)
        cell.client.hold()
        held = cell.runtime.aim.q_rad
        cell.run(0.3)
        assert cell.runtime.aim.q_rad == pytest.approx(held, abs=5e-5)
        assert not cell.faults


def test_an_arm_that_is_held_back_stops_from_where_its_encoders_are() -> None:
    hidden = (*GEARS, *RIGID)
    limits = replace(RIGHT.limits, unexplained_torque=1.0)  # else the torque that weight does not explain stops it first
    with an_arm(hidden, hidden, limits) as cell:
        cell.rig.robot.plant.push(0, -30.0)  # N m, more than its motor has
        with pytest.raises(ArmFaulted, match=r"following error|do not explain"):
            cell.client.move_joints((0.6, -0.6, 0.2))
        assert cell.runtime.aim.q_rad[0] == pytest.approx(cell.runtime.parts.measurement.q_rad[0], abs=0.01)


# ---- feed-forward

AT_1_2_3 = (
    (
        Effect("viscous_friction", 1, {"coefficient_Nm_s_rad": 6.0}),
        Effect("coulomb_friction", 2, {"torque_Nm": 2.0}),
        Effect("cogging", 3, {"amplitude_Nm": 0.6, "order": 2.0, "phase_rad": 0.4}),
    ),
    (
        Effect("stribeck_friction", 1, {"torque_Nm": 1.0, "speed_rad_s": 0.3}),
        Effect("load_friction", 2, {"fraction": 0.25}),
        Effect("torque_constant", 3, {"scale": 0.7}),
    ),
    (Effect("payload", None, {"mass_kg": 0.5}), Effect("link_inertia", 2, {"mass_kg": 1.0})),
)


@cache
def tracking_without_rad() -> tuple[float, ...]:
    return tracking_rad((), ())


def tracking_rad(hidden: tuple[Effect, ...], known: tuple[Effect, ...]) -> tuple[float, ...]:
    """RMS of each joint's following error on slow moves there and back."""
    arm = replace(RIGHT, effects=known)
    tables = tuple(EffectTable(e.effect, e.joint or 0, dict(e.parameters)) for e in hidden)
    with holding_cell(scenario(effect=tables), believed=arm) as cell:
        cell.client.home()
        errors: list[list[float]] = []

        def watch() -> None:
            measured = cell.runtime.parts.measurement.q_rad
            errors.append([q - s for q, s in zip(measured, cell.runtime.aim.q_rad, strict=True)])

        cell.watchers.append(watch)
        for target in ((0.3, -0.8, 0.5), NEAR):
            cell.client.move_joints(target, 0.35)
        return tuple(np.sqrt(np.mean(np.square(errors), axis=0)).tolist())


@pytest.mark.parametrize("effects", third_of(AT_1_2_3, 1), ids=lambda effects: "+".join(e.effect for e in effects))
def test_what_is_known_is_fed_forward(effects: tuple[Effect, ...]) -> None:
    base = tracking_without_rad()
    unknown, known = tracking_rad(effects, ()), tracking_rad(effects, effects)
    for effect in effects:
        joint = (effect.joint or 2) - 1
        shows = unknown[joint] - base[joint]
        assert shows > 0.1 * base[joint], effect
        assert known[joint] - base[joint] < 0.5 * shows, effect


def test_friction_is_not_fed_forward_at_standstill() -> None:
    places = []
    for known in ((), FRICTION):
        with holding_cell(scenario(), believed=replace(RIGHT, effects=known)) as cell:
            cell.client.home()
            cell.run(0.5)
            places.append(cell.rig.joint_rad())
    assert places[0] == places[1]


def last_row(cell: Cell) -> dict[str, float]:
    """The newest row that was recorded."""
    recorder = cell.runtime.parts.recorder
    values = recorder.layout.packing.unpack(recorder.last_rows()[-1])
    return dict(zip(recorder.layout.names, values, strict=True))


def angles(row: dict[str, float], form: str) -> list[float]:
    return [row[form.format(joint)] for joint in (1, 2, 3)]


def test_what_is_recorded_of_the_joints_is_where_they_are_and_are_to_be() -> None:
    hidden, target = (*GEARS, *SPRINGS, *RIGID), INVERSE.nearest(STOPS_m[0], NEAR)
    with an_arm(hidden, hidden) as cell:
        cell.client.move_joints(target, 0.4)
        cell.run(0.3)
        row = last_row(cell)
        assert angles(row, "joint{}_set_rad") == pytest.approx(target, abs=1e-9)
        assert angles(row, "q{}_set_rad") == list(cell.runtime.aim.q_rad)
        assert math.dist(KINEMATICS.tip(*angles(row, "joint{}_rad")), cell.rig.tip_m()) < LEVEL_m
        # what the encoders say is another tip, both wanted and measured
        assert math.dist(KINEMATICS.tip(*angles(row, "q{}_set_rad")), STOPS_m[0]) > 1e-3
        assert math.dist(KINEMATICS.tip(*angles(row, "q{}_rad")), cell.rig.tip_m()) > 1e-3


def test_a_motion_of_the_encoders_is_recorded_as_the_joints_that_it_makes() -> None:
    with an_arm(RIGID, RIGID) as cell:
        cell.client.move_joints(NEAR, 0.4, as_encoders=True)
        row = last_row(cell)
        side = cell.runtime.parts.joint_side
        assert side is not None
        assert angles(row, "q{}_set_rad") == pytest.approx(NEAR, abs=1e-9)
        assert angles(row, "joint{}_set_rad") == pytest.approx(side.joint_rad(NEAR), abs=1e-9)
        assert math.dist(angles(row, "joint{}_set_rad"), NEAR) > 1e-3


def test_an_arm_without_such_effects_records_no_column_twice() -> None:
    with an_arm((), ()) as cell:
        assert not [name for name in last_row(cell) if name.startswith("joint")]
        status = cell.client.status()
        assert (status["joint_rad"], status["joint_set_rad"]) == (status["q_rad"], status["q_set_rad"])

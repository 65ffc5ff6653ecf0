"""The records of the effects: complete, and the same as those of the model."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.arrays import Array
from calib.gap.effects.catalogue import RECORDS, known_laws, parameters
from calib.gap.effects.motor import SAMPLING
from calib.gap.residuals.rows import ResidualRows
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import prepare
from calib.gap.signals.terms import Form, Law, angle_error, friction_Nm
from control.dynamics.feedforward import torque_model
from control.model.arm import Arm, Effect
from control.model.description import load_arm
from control.model.effects import EFFECTS
from tests.calib.gap.series.prescribed import log_of

RIGHT = load_arm("right")
IN_THE_FILE = (
    Effect("encoder_scale", 2, {"scale": 0.004}),
    Effect("encoder_eccentricity", 1, {"amplitude_rad": 0.003, "phase_rad": -2.0}),
    Effect("backlash", 1, {"width_rad": 0.005}),
    Effect("joint_compliance", 2, {"stiffness_Nm_rad": 400.0, "damping_Nm_s_rad": 0.7}),
    Effect("link_flexure", 2, {"EI_Nm2": 200.0}),
    Effect("belt_coupling", None, {"ratio": 0.01}),
    Effect("thermal_drift", 3, {"final_rad": 0.004, "time_constant_s": 60.0}),
    Effect("payload", None, {"mass_kg": 0.2}),
    Effect("coulomb_friction", 1, {"torque_Nm": 0.8}),
    Effect("viscous_friction", 2, {"coefficient_Nm_s_rad": 0.5}),
    Effect("stribeck_friction", 3, {"torque_Nm": 0.6, "speed_rad_s": 0.05}),
    Effect("load_friction", 2, {"fraction": 0.1}),
    Effect("asymmetric_friction", 1, {"torque_Nm": -0.2}),
    Effect("cogging", 2, {"amplitude_Nm": 0.4, "order": 7.0, "phase_rad": 2.5}),
    Effect("torque_constant", 3, {"scale": 0.94}),
    Effect("command_delay", None, {"delay_s": 0.002}),
    Effect("supply_sag", None, {"resistance_ohm": 0.08}),
    Effect("link_inertia", 2, {"mass_kg": 0.3}),
    Effect("link_inertia", 3, {"inertia_kg_m2": 0.004}),
)
FRAMES = {"base_frame", "link_geometry"}  # what the file has of them is in its kinematics
TORQUES = [one for one in IN_THE_FILE if EFFECTS[one.effect].torque is not None]
ANGLES = [form for record in RECORDS.values() if record.series for form in record.series.forms if form.angle]


@dataclasses.dataclass(frozen=True)
class Sampled:
    """One sample of a run."""

    q: Array
    speed: Array
    acceleration: Array
    t_s: Array


def _moving(*state: tuple[float, ...]) -> Sampled:
    q, speed = (np.array([values]) for values in state)
    return Sampled(q, speed, 0.0 * q, np.zeros(1))


def law_of(effect: Effect) -> Law:
    (law,) = known_laws(dataclasses.replace(RIGHT, effects=(effect,)))
    return law


def test_every_effect_has_a_record_and_every_record_an_effect() -> None:
    assert RECORDS.keys() - {SAMPLING} == EFFECTS.keys()
    assert {one.effect for one in IN_THE_FILE} | FRAMES == EFFECTS.keys()
    assert all(name == one.effect and (one.poses or one.series) for name, one in RECORDS.items())


@pytest.mark.parametrize("effect", IN_THE_FILE, ids=lambda one: f"{one.effect}-{one.joint}")
def test_what_the_file_has_becomes_a_law_and_the_same_parameters_again(effect: Effect) -> None:
    law = law_of(effect)
    assert law.bounded() == law
    assert law.is_worth_a_name(np.full(3, 30.0))
    count = len(law.values)
    found = parameters(RIGHT, law, np.diag(np.full(count, 1e-12)))
    assert {name: value for name, (value, _) in found.items()} == pytest.approx(dict(effect.parameters))
    assert all(sd >= 0.0 for _, sd in found.values())


@pytest.mark.parametrize("effect", TORQUES, ids=lambda one: one.effect)
def test_identification_and_feed_forward_have_one_law(effect: Effect) -> None:
    arm: Arm = dataclasses.replace(RIGHT, effects=(effect,))
    q, speed, still = (0.2, -0.9, 0.4), (0.01, -0.02, 0.3), (0.0, 0.0, 0.0)
    rigid, whole = (torque_model(one)(q, speed, still) for one in (RIGHT, arm))
    j = (effect.joint or 0) - 1
    run = _moving(q, speed)
    own = friction_Nm(law_of(effect), run, np.array([rigid[j]]), RIGHT.drive(j + 1).gear_ratio)
    assert own == pytest.approx([whole[j] - rigid[j]], abs=1e-12)
    assert own[0] != 0.0


@pytest.mark.parametrize("form", ANGLES, ids=str)
def test_an_angles_error_has_the_derivatives_that_it_says(form: Form) -> None:
    assert form.angle is not None
    values, step = (0.003, 40.0 if form.is_by_time else 0.002)[: form.count], 1e-4
    at, time = np.array([0.3, -1.2]), np.array([5.0, 30.0])
    moved = (lambda h: (values, at, time + h)) if form.is_by_time else (lambda h: (values, at + h, time))
    before, here, after = (form.angle(*moved(h)) for h in (-step, 0.0, step))
    assert here[1] == pytest.approx((after[0] - before[0]) / (2.0 * step), rel=1e-5, abs=1e-9)
    assert here[2] == pytest.approx((after[1] - before[1]) / (2.0 * step), rel=1e-5, abs=1e-9)


def test_the_belt_moves_the_joint_that_the_models_record_names() -> None:
    belt = law_of(Effect("belt_coupling", None, {"ratio": 0.01}))
    run = _moving((0.1, 0.5, 0.2), (0.0, 0.3, 0.0))
    motor, (q, _, _) = angle_error([belt], run)
    assert q - run.q == pytest.approx(np.array([[0.0, 0.0, 0.005]]))
    assert motor.speed_rad_s == pytest.approx(np.array([[0.0, 0.0, 0.003]]))
    assert EFFECTS["belt_coupling"].moves == 3


def test_a_gear_is_soft_or_loose_or_both() -> None:
    gears = {one.effect: one.traits for one in RECORDS.values() if one.series and one.series.form.is_gear}
    assert gears.keys() == {"joint_compliance", "backlash"}
    assert not any(one.alternative for one in gears.values())
    assert all(one.is_on_every_joint for one in gears.values())


def test_cogging_comes_round_with_the_motor_and_not_with_an_encoder_that_misreads_it() -> None:
    """5 mrad at a joint are half a radian at its motor: what cogging adds to the rows follows the found scale."""
    recording = prepare(RIGHT, log_of(RIGHT))
    cogging = law_of(Effect("cogging", 2, {"amplitude_Nm": 0.4, "order": 4.0, "phase_rad": 0.5}))
    scale = law_of(Effect("encoder_scale", 2, {"scale": 0.01}))
    rows = ResidualRows(Physics(RIGHT, recording), ())
    (current,) = (cell.rows for cell in rows.table.cells if str(cell) == "current of joint 2")
    added = (rows.residual((scale, cogging)) - rows.residual((scale,)))[current]
    np.testing.assert_allclose(rows.friction_slope(cogging, (scale,))[current], added, atol=1e-6 * np.abs(added).max())
    misread = rows.friction_slope(cogging)[current]
    assert np.linalg.norm(misread - added) > 0.2 * np.linalg.norm(added)

"""The table of effects is that of docs/formats.md; laws and feed-forward have the signs it gives them."""

import dataclasses
import math

import numpy as np
import pytest

from control.dynamics import effect_laws as laws
from control.dynamics.dynamics import Dynamics
from control.dynamics.feedforward import torque_model
from control.model.arm import Effect
from control.model.description import load_arm
from control.model.effects import EFFECTS, parameter_names

RIGHT = load_arm("right")
STILL, MOVING = (0.0, 0.0, 0.0), (0.5, -0.5, 0.5)
POSE = (0.1, -1.0, 0.3)


def test_the_twenty_effects_are_there_with_their_parameters() -> None:
    assert len(EFFECTS) == 20
    assert parameter_names(EFFECTS["stribeck_friction"]) == ("torque_Nm", "speed_rad_s")
    assert parameter_names(EFFECTS["link_geometry"])[0] == "link<i>_d_m"
    assert {kind.place for kind in EFFECTS.values()} == {"joint", "link", "none", "joint or none"}


def test_friction_opposes_motion_and_vanishes_at_rest() -> None:
    for law in (
        lambda v: laws.coulomb_Nm(v, 1.2),
        lambda v: laws.viscous_Nm(v, 1.2),
        lambda v: laws.stribeck_Nm(v, 1.2, 0.1),
        lambda v: laws.load_friction_Nm(v, -4.0, 0.3),
    ):
        assert law(0.0) == 0.0
        assert law(0.05) > 0.0
        assert law(-0.05) == pytest.approx(-law(0.05))
    assert laws.coulomb_Nm(1.0, 1.2) == pytest.approx(1.2)
    assert laws.stribeck_Nm(1.0, 1.2, 0.1) == pytest.approx(0.0, abs=1e-12)
    assert laws.asymmetric_Nm(-1.0, 0.2) == laws.asymmetric_Nm(1.0, 0.2) == pytest.approx(0.2)


def test_the_joint_is_where_formats_md_says_behind_its_encoder() -> None:
    assert laws.encoder_scale_rad(2.0, 0.01) == pytest.approx(0.02)
    assert laws.encoder_eccentricity_rad(0.5, 0.01, 0.2) == pytest.approx(0.01 * math.sin(0.7))
    assert laws.backlash_rad(1.0, 0.02) == -0.01  # the motor is ahead of the joint that it pushes
    assert laws.compliance_rad(3.0, 300.0) == pytest.approx(-0.01)
    assert laws.belt_coupling_rad(0.4, 0.5) == pytest.approx(0.2)
    assert laws.cogging_Nm(0.0, 100.0, 0.1, 7, math.pi / 2) == pytest.approx(0.1)


def test_laws_take_arrays() -> None:
    speeds = np.linspace(-1, 1, 5)
    assert laws.stribeck_Nm(speeds, 1.0, 0.1).shape == (5,)


EFFECTS_OF_JOINT_2 = [
    (Effect("coulomb_friction", 2, {"torque_Nm": 1.5}), lambda q, v, load: laws.coulomb_Nm(v, 1.5)),
    (
        Effect("viscous_friction", 2, {"coefficient_Nm_s_rad": 0.8}),
        lambda q, v, load: laws.viscous_Nm(v, 0.8),
    ),
    (
        Effect("stribeck_friction", 2, {"torque_Nm": 0.4, "speed_rad_s": 0.6}),
        lambda q, v, load: laws.stribeck_Nm(v, 0.4, 0.6),
    ),
    (Effect("load_friction", 2, {"fraction": 0.2}), lambda q, v, load: laws.load_friction_Nm(v, load, 0.2)),
    (Effect("asymmetric_friction", 2, {"torque_Nm": 0.3}), lambda q, v, load: laws.asymmetric_Nm(v, 0.3)),
    (
        Effect("cogging", 2, {"amplitude_Nm": 0.3, "order": 7.0, "phase_rad": 0.5}),
        lambda q, v, load: laws.cogging_Nm(q, 120.0, 0.3, 7.0, 0.5),
    ),
]


@pytest.mark.parametrize(("effect", "law"), EFFECTS_OF_JOINT_2, ids=lambda item: getattr(item, "effect", ""))
def test_the_feed_forward_adds_a_known_effect_to_its_joint_alone(effect: Effect, law) -> None:  # type: ignore[no-untyped-def]
    rigid = Dynamics(RIGHT).inverse(POSE, MOVING, STILL)
    with_effect = torque_model(dataclasses.replace(RIGHT, effects=(effect,)))(POSE, MOVING, STILL)
    added = np.array(with_effect) - np.array(rigid)
    assert added == pytest.approx([0.0, law(POSE[1], MOVING[1], rigid[1]), 0.0])


def test_effects_that_are_no_torque_leave_the_feed_forward_alone() -> None:
    other = (Effect("backlash", 1, {"width_rad": 0.01}), Effect("belt_coupling", None, {"ratio": 0.1}))
    arm = dataclasses.replace(RIGHT, effects=other)
    assert torque_model(arm)(POSE, MOVING, STILL) == torque_model(RIGHT)(POSE, MOVING, STILL)


def test_a_payload_is_carried() -> None:
    empty, loaded = torque_model(RIGHT)(POSE, STILL, STILL), torque_model(RIGHT, 0.5)(POSE, STILL, STILL)
    assert abs(loaded[1]) > abs(empty[1]) + 1.0

"""The table of effects is that of docs/formats.md; laws and feed-forward have the signs it gives them."""

import dataclasses
import math

import numpy as np
import pytest

from control.dynamics.dynamics import Dynamics
from control.dynamics.feedforward import torque_model
from control.model import effects as laws
from control.model.arm import Effect
from control.model.description import load_arm
from control.model.effects import EFFECTS, linear_values, moved_joint, parameter_names, total

RIGHT = load_arm("right")
STILL, MOVING = (0.0, 0.0, 0.0), (0.5, -0.5, 0.5)
POSE = (0.1, -1.0, 0.3)
STRIBECK = {"torque_Nm": 1.2, "speed_rad_s": 0.1}
FRICTIONS = {
    "coulomb_friction": {"torque_Nm": 1.2},
    "viscous_friction": {"coefficient_Nm_s_rad": 1.2},
    "stribeck_friction": STRIBECK,
    "load_friction": {"fraction": 0.3},
}


def test_the_twenty_effects_are_there_with_their_parameters() -> None:
    assert len(EFFECTS) == 20
    assert parameter_names(EFFECTS["stribeck_friction"]) == ("torque_Nm", "speed_rad_s")
    assert parameter_names(EFFECTS["link_geometry"])[0] == "link<i>_d_m"
    assert {kind.place for kind in EFFECTS.values()} == {"joint", "link", "none", "joint or none"}


def test_friction_opposes_motion_and_vanishes_at_rest() -> None:
    for effect, parameters in FRICTIONS.items():
        law = EFFECTS[effect].torque
        assert law is not None
        torque = law(parameters, math)
        assert torque(0.0, 0.0, -4.0) == 0.0
        assert torque(0.0, 0.05, -4.0) > 0.0
        assert torque(0.0, -0.05, -4.0) == pytest.approx(-torque(0.0, 0.05, -4.0))
    assert laws.coulomb_friction({"torque_Nm": 1.2})(0.0, 1.0, 0.0) == pytest.approx(1.2)
    assert laws.stribeck_friction(STRIBECK)(0.0, 1.0, 0.0) == pytest.approx(0.0, abs=1e-12)
    uneven = laws.asymmetric_friction({"torque_Nm": 0.2})
    assert uneven(0.0, -1.0, 0.0) == uneven(0.0, 1.0, 0.0) == pytest.approx(0.2)


def test_a_law_is_the_same_of_floats_and_of_arrays() -> None:
    speeds = np.linspace(-0.5, 0.5, 7)
    for effect, parameters in {**FRICTIONS, "cogging": {"amplitude_Nm": 0.1, "order": 7.0, "phase_rad": 0.4}}.items():
        law = EFFECTS[effect].torque
        assert law is not None
        each = [law(parameters, math)(0.3, v, -4.0) for v in speeds.tolist()]
        assert law(parameters, np)(0.3 * np.ones(7), speeds, -4.0 * np.ones(7)) == pytest.approx(np.array(each))


def test_slow_motion_has_all_its_friction() -> None:
    torque = laws.coulomb_friction({"torque_Nm": 1.0})
    assert torque(0.0, 0.010, 0.0) > 0.99
    assert torque(0.0, 0.001, 0.0) < 0.35


def test_the_joint_is_where_formats_md_says_behind_its_encoder() -> None:
    assert laws.backlash_rad(1.0, 0.02) == -0.01  # the motor is ahead of the joint that it pushes
    assert laws.compliance_rad(3.0, 300.0) == pytest.approx(-0.01)
    assert laws.cogging({"amplitude_Nm": 0.1, "order": 7.0, "phase_rad": math.pi / 2})(0.0, 0.0, 0.0) == 0.1
    a, b = linear_values("encoder_eccentricity", {"amplitude_rad": 0.01, "phase_rad": 0.2})
    assert a * math.sin(0.5) + b * math.cos(0.5) == pytest.approx(0.01 * math.sin(0.7))
    assert moved_joint("belt_coupling", None) == 3
    assert moved_joint("backlash", 2) == 2


@pytest.mark.parametrize(
    ("effect", "one", "other", "both"),
    [
        ("backlash", {"width_rad": 0.003}, {"width_rad": 0.002}, {"width_rad": 0.005}),
        ("joint_compliance", {"stiffness_Nm_rad": 600.0}, {"stiffness_Nm_rad": 300.0}, {"stiffness_Nm_rad": 200.0}),
        ("torque_constant", {"scale": 0.96}, {"scale": 0.95}, {"scale": 0.91}),
        ("link_flexure", {"EI_Nm2": 200.0}, {"EI_Nm2": 200.0}, {"EI_Nm2": 100.0}),
        (
            "cogging",
            {"amplitude_Nm": 0.3, "order": 7.0, "phase_rad": 0.0},
            {"amplitude_Nm": 0.4, "order": 7.0, "phase_rad": math.pi / 2},
            {"amplitude_Nm": 0.5, "order": 7.0, "phase_rad": math.atan2(4.0, 3.0)},
        ),
        ("link_inertia", {"mass_kg": 0.1}, {"mass_kg": 0.2}, {"mass_kg": 0.3}),
        ("stribeck_friction", STRIBECK, {"torque_Nm": 2.0, "speed_rad_s": 0.2}, {"torque_Nm": 2.0, "speed_rad_s": 0.2}),
    ],
)
def test_two_effects_of_a_kind_are_one(
    effect: str, one: dict[str, float], other: dict[str, float], both: dict[str, float]
) -> None:
    assert total(effect, one, other) == pytest.approx(both)


def test_waves_of_other_orders_do_not_add_up() -> None:
    other = {"amplitude_Nm": 0.4, "order": 8.0, "phase_rad": 0.1}
    assert total("cogging", {"amplitude_Nm": 0.3, "order": 7.0, "phase_rad": 0.0}, other) == other


@pytest.mark.parametrize("effect", [name for name, kind in EFFECTS.items() if kind.linear is not None])
def test_linear_unknowns_and_parameters_are_each_others_inverse(effect: str) -> None:
    linear = EFFECTS[effect].linear
    assert linear is not None
    count = 2 if "phase_rad" in EFFECTS[effect].required else 1
    values = (0.03, 0.04)[:count]
    assert linear.values(linear.parameters(values)) == pytest.approx(values)
    for place in range(count):
        moved = [v + 1e-7 * (k == place) for k, v in enumerate(values)]
        before, after = linear.parameters(values), linear.parameters(moved)
        steps = [(after[name] - before[name]) / 1e-7 for name in before]
        assert [row[place] for row in linear.slopes(values)] == pytest.approx(steps, rel=1e-4)


EFFECTS_OF_JOINT_2 = [
    Effect("coulomb_friction", 2, {"torque_Nm": 1.5}),
    Effect("viscous_friction", 2, {"coefficient_Nm_s_rad": 0.8}),
    Effect("stribeck_friction", 2, {"torque_Nm": 0.4, "speed_rad_s": 0.6}),
    Effect("load_friction", 2, {"fraction": 0.2}),
    Effect("asymmetric_friction", 2, {"torque_Nm": 0.3}),
    Effect("cogging", 2, {"amplitude_Nm": 0.3, "order": 7.0, "phase_rad": 0.5}),
]


def _by_hand(effect: Effect, q: float, speed: float, load: float) -> float:
    """Torque of an effect as docs/formats.md has it."""
    p, sign = effect.parameters, math.tanh(speed / 0.003)
    match effect.effect:
        case "coulomb_friction":
            return p["torque_Nm"] * sign
        case "viscous_friction":
            return p["coefficient_Nm_s_rad"] * speed
        case "stribeck_friction":
            return p["torque_Nm"] * math.exp(-((speed / p["speed_rad_s"]) ** 2)) * sign
        case "load_friction":
            return p["fraction"] * abs(load) * sign
        case "asymmetric_friction":
            return p["torque_Nm"] * abs(sign)
        case _:
            return p["amplitude_Nm"] * math.sin(p["order"] * RIGHT.drive(2).gear_ratio * q + p["phase_rad"])


@pytest.mark.parametrize("effect", EFFECTS_OF_JOINT_2, ids=lambda item: item.effect)
def test_the_feed_forward_adds_a_known_effect_to_its_joint_alone(effect: Effect) -> None:
    rigid = Dynamics(RIGHT).inverse(POSE, MOVING, STILL)
    with_effect = torque_model(dataclasses.replace(RIGHT, effects=(effect,)))(POSE, MOVING, STILL)
    added = np.array(with_effect) - np.array(rigid)
    assert added == pytest.approx([0.0, _by_hand(effect, POSE[1], MOVING[1], rigid[1]), 0.0])


def test_effects_that_are_no_torque_leave_the_feed_forward_alone() -> None:
    other = (Effect("backlash", 1, {"width_rad": 0.01}), Effect("belt_coupling", None, {"ratio": 0.1}))
    arm = dataclasses.replace(RIGHT, effects=other)
    assert torque_model(arm)(POSE, MOVING, STILL) == torque_model(RIGHT)(POSE, MOVING, STILL)


def test_a_payload_is_carried() -> None:
    empty, loaded = torque_model(RIGHT)(POSE, STILL, STILL), torque_model(RIGHT, 0.5)(POSE, STILL, STILL)
    assert abs(loaded[1]) > abs(empty[1]) + 1.0

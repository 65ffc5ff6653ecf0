"""Static effects between encoder and joint: linear as said, found where hidden, and left alone where nothing tells them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.joint_effects import corrections, effects_of, known_corrections, unclear_flanks, unphysical, with_effects
from calib.errors import CalibrationError
from calib.identify.identification import identify
from calib.identify.objective import LeastSquares
from calib.points.points import Points, make_points
from control.dynamics.dynamics import Dynamics
from control.dynamics.static_pose import resting
from control.model.arm import Arm, Effect
from control.model.description import load_arm

ARM = load_arm("right")
FRICTION_Nm = np.array([1.3, 1.5, 0.9])
K_Nm_A = np.array([d.gear_ratio * d.torque_constant_Nm_A for d in ARM.drives])
SHARE = 3 / 8  # of friction on the links: between two of the parts in which unclear flanks are taken together
NAMES = (
    "encoder_scale:1",
    "encoder_eccentricity:2",
    "backlash:1",
    "backlash:2",
    "backlash:3",
    "joint_compliance:2",
    "joint_compliance:3",
    "belt_coupling",
)
# What is hidden, as docs/formats.md has it, and the largest error of each parameter [its unit] that the camera's noise leaves
# (four standard deviations or more).
HIDDEN = {
    "encoder_scale:1": ({"scale": 0.01}, 4e-4),
    "encoder_eccentricity:3": ({"amplitude_rad": 0.008, "phase_rad": 0.7}, 3e-2),
    "backlash:1": ({"width_rad": 0.006}, 2e-4),
    "backlash:2": ({"width_rad": 0.004}, 6e-4),  # one pose in six has the other flank
    "backlash:3": ({"width_rad": 0.008}, 6e-4),
    "joint_compliance:2": ({"stiffness_Nm_rad": 800.0}, 30.0),
    "belt_coupling": ({"ratio": -0.015}, 4e-4),
}


def poses(seed: int, m: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Poses (m, 3) all over the workspace, and the signs of the last motions (m, 3)."""
    rng = np.random.default_rng(seed)
    q = rng.uniform([-1.2, -1.5, -1.0], [1.2, 0.6, 1.3], (m, 3))
    return q, rng.choice([-1.0, 1.0], (m, 3))


def measured(name: str, parameters: dict[str, float], seed: int, share: float = SHARE) -> Points:
    """Camera points of an arm that hides one effect: written here from the physics, with `share` of friction on the links."""
    joint_rad, last = poses(seed)
    rng = np.random.default_rng(seed + 1)
    gravity = Dynamics(ARM).torques(joint_rad, 0.0 * joint_rad, 0.0 * joint_rad)
    passed = gravity + share * FRICTION_Nm * last
    effect, _, number = name.partition(":")
    j = int(number or 3) - 1
    motor_rad = joint_rad.copy()
    if effect == "backlash":
        motor_rad[:, j] += 0.5 * parameters["width_rad"] * np.sign(passed[:, j])
    elif effect == "joint_compliance":
        motor_rad[:, j] += passed[:, j] / parameters["stiffness_Nm_rad"]
    elif effect == "belt_coupling":
        motor_rad[:, 2] -= parameters["ratio"] * joint_rad[:, 1]
    encoder_rad = motor_rad.copy()
    if effect == "encoder_scale":
        encoder_rad[:, j] /= 1.0 + parameters["scale"]
    elif effect == "encoder_eccentricity":
        for _ in range(5):
            encoder_rad[:, j] = motor_rad[:, j] - parameters["amplitude_rad"] * np.sin(
                encoder_rad[:, j] + parameters["phase_rad"]
            )
    dh = ARM.dh + rng.uniform(-1.0, 1.0, (4, 4)) * [0.002, 0.01, 0.002, 0.01]
    tips = ArmModel(ARM).tips(dh, joint_rad) + rng.normal(0.0, 1.4e-4, (len(joint_rad), 3))
    held_A = (gravity + FRICTION_Nm * last + rng.normal(0.0, 0.02, gravity.shape)) / K_Nm_A
    m = len(joint_rad)
    return make_points(["free"] * m, [str(k) for k in range(m)], [1] * m, encoder_rad, tips, last, held_A, payload_kg=np.zeros(m))


@pytest.mark.parametrize("name", HIDDEN)
def test_a_hidden_effect_comes_back_with_its_parameters(name: str) -> None:
    parameters, tolerance = HIDDEN[name]
    points = measured(name, parameters, seed=3)
    wanted = corrections(ARM, points, [name])
    before = identify(problem_of(ARM, points), objective=LeastSquares(), starts_count=1)
    identification = identify(problem_of(ARM, points, Choice(corrections=wanted)), objective=LeastSquares(), starts_count=1)
    (effect,) = effects_of(identification.solution.corrections)
    assert effect.effect == name.partition(":")[0]
    for key, value in parameters.items():
        assert effect.parameters[key] == pytest.approx(value, abs=tolerance)
    assert before.noise_m > 1.3 * identification.noise_m
    assert identification.noise_m < 1.15 * 1.4e-4  # nothing but the camera's noise is left


@pytest.mark.parametrize("name", NAMES)
def test_slopes_are_the_derivative_of_the_residuals(name: str) -> None:
    points = measured("backlash:1", {"width_rad": 0.004}, seed=5)
    problem = problem_of(ARM, points, Choice(corrections=corrections(ARM, points, [name])))
    x = np.random.default_rng(0).uniform(-0.3, 0.3, len(problem.parameters))
    _, jacobian = problem.residuals_and_jacobian(x)
    step = 1e-6
    for k in range(16, len(x)):  # after the DH parameters
        ahead, behind = (problem.residuals(x + sign * step * np.eye(len(x))[k]) for sign in (1.0, -1.0))
        assert np.allclose((ahead - behind) / (2.0 * step), jacobian[:, :, k], atol=1e-9)


def test_what_the_arm_knows_is_added_to_the_encoders_and_not_twice() -> None:
    points = measured("backlash:1", {"width_rad": 0.006}, seed=7)
    play, scale = Effect("backlash", 1, {"width_rad": 0.006}), Effect("encoder_scale", 2, {"scale": 0.02})
    arm = dataclasses.replace(ARM, effects=(play, scale))
    flank = resting(arm, points.q_rad, points.direction, points.current_A).flank
    shift = known_corrections(arm, points)
    assert np.allclose(shift[:, 0], -0.003 * flank[:, 0], atol=1e-15)
    assert np.allclose(shift[:, 1], 0.02 * points.q_rad[:, 1], atol=1e-15)
    assert not known_corrections(arm, points, ["backlash:1"])[:, 0].any()
    (again,) = [c for c in corrections(arm, points, ["backlash:1"]) if c.name == "backlash1"]
    assert again.nominal == 0.006


def test_eccentricity_goes_to_sine_and_cosine_and_back() -> None:
    off_centre = Effect("encoder_eccentricity", 2, {"amplitude_rad": 0.004, "phase_rad": -2.1})
    arm = dataclasses.replace(ARM, effects=(off_centre,))
    points = measured("encoder_scale:1", {"scale": 0.0}, seed=1)
    values = {c.name: c.nominal for c in corrections(arm, points, ["encoder_eccentricity:2"])}
    (back,) = effects_of(values)
    assert back.parameters == pytest.approx(off_centre.parameters, abs=1e-15)
    assert np.allclose(known_corrections(arm, points)[:, 1], 0.004 * np.sin(points.q_rad[:, 1] - 2.1), atol=1e-15)


def test_found_effects_replace_those_of_the_same_joint_and_keep_the_others() -> None:
    old = (Effect("backlash", 1, {"width_rad": 0.001}), Effect("coulomb_friction", 1, {"torque_Nm": 1.0}))
    arm = with_effects(dataclasses.replace(ARM, effects=old), {"backlash1": 0.004, "belt_coupling": 0.01})
    assert {(e.effect, e.joint): dict(e.parameters) for e in arm.effects} == {
        ("coulomb_friction", 1): {"torque_Nm": 1.0},
        ("backlash", 1): {"width_rad": 0.004},
        ("belt_coupling", None): {"ratio": 0.01},
    }


def test_a_play_below_zero_is_left_out_and_said() -> None:
    assert effects_of({"backlash2": -1e-4, "backlash2_unclear1": 2e-4}) == ()
    (said,) = unphysical({"backlash2": -1e-4})
    assert "joint 2" in said
    assert unphysical({"backlash2": 1e-4}) == ()
    assert unphysical({"backlash2": 1e-4, "backlash2_unclear4": -1e-4, "backlash2_led": 0.0}) == ()


def test_a_gear_that_never_leaves_one_flank_is_said() -> None:
    points = measured("backlash:2", {"width_rad": 0.004}, seed=3)
    gravity = Dynamics(ARM).torques(points.q_rad, 0.0 * points.q_rad, 0.0 * points.q_rad)[:, 1]
    hanging = points.chosen(np.flatnonzero(gravity > 3.0))
    (said,) = unclear_flanks(ARM, hanging, ["backlash:2"])
    assert "cannot be distinguished from the joint's zero" in said


def test_friction_against_gravity_leaves_the_flank_open_unless_gravity_is_far_stronger() -> None:
    q = np.array([[0.0, -1.4, 0.0], [0.0, -1.4, 0.0], [0.0, 0.0, 0.2], [0.0, 0.0, 0.2]])
    last = np.array([[1, 1, 1], [-1, -1, -1], [1, 1, 1], [-1, -1, -1]], dtype=float)
    gravity = Dynamics(ARM).torques(q, 0.0 * q, 0.0 * q)
    current = (gravity + FRICTION_Nm * last) / K_Nm_A
    flank = resting(ARM, q, last, current).flank
    assert gravity[0, 1] > 4.0
    assert 0.0 < gravity[2, 2] < FRICTION_Nm[2]
    assert flank.tolist() == [[1, 1, 1], [-1, 1, 0], [1, 1, 1], [-1, 0, 0]]


def test_a_joint_that_a_hand_led_lies_where_the_link_pushed_it_unless_its_motor_pushes_harder() -> None:
    q = np.tile([0.1, -1.2, -0.2], (40, 1))
    last = np.tile([1.0, -1.0, -1.0], (40, 1))
    gravity = Dynamics(ARM).torques(q, 0.0 * q, 0.0 * q)
    held = np.zeros((40, 3))
    held[:4] = FRICTION_Nm * last[:4]  # the motors took the arm there; a hand did the others
    state = resting(ARM, q, last, (gravity + held) / K_Nm_A)
    assert not state.is_led[:4].any()
    assert state.is_led[4:].all()
    assert (state.flank[4:, 1] == 1.0).all()  # 4 Nm of gravity
    assert (state.flank[4:, [0, 2]] == 0.0).all()
    assert (state.leaning[4:, [0, 2]] == [-1.0, 1.0]).all()


def test_without_currents_directions_and_gravity_tell_what_they_can() -> None:
    q = np.tile([0.1, -1.2, -0.2], (2, 1))
    last = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0]])
    assert resting(ARM, q, last).flank.tolist() == [[1, 1, 1], [-1, 1, 0]]


@pytest.mark.parametrize("text", ["backlash", "backlash:4", "backlash:x", "play:1", "belt_coupling:3", ""])
def test_an_effect_that_there_is_not_is_refused(text: str) -> None:
    points = measured("backlash:1", {"width_rad": 0.006}, seed=7)
    with pytest.raises(CalibrationError, match="effect: expected"):
        corrections(ARM, points, [text])


def test_an_encoder_effect_needs_neither_masses_nor_drives(tmp_path: Path) -> None:
    bare: Arm = dataclasses.replace(
        ARM, drives=(), links=tuple(dataclasses.replace(link, mass_kg=None, com_m=None, inertia_kg_m2=None) for link in ARM.links)
    )
    points = measured("encoder_scale:1", {"scale": 0.01}, seed=7)
    assert len(corrections(bare, points, ["encoder_scale:1", "belt_coupling"])) == 2

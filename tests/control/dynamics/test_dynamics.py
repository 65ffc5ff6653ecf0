"""Joint torques against MuJoCo and against energy, for any arm; what is missing is named."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest

from control.dynamics.dynamics import Dynamics
from control.errors import ArmError, BadTarget, MissingModel
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Drive, Link
from control.model.description import load_arm
from tests.control.dynamics.mujoco_arm import model_of
from tests.places import ARMS

RIGHT = load_arm("right")
PENDULUM = load_arm(ARMS / "pendulum.toml")
SMALL = 1e-8  # MuJoCo's least masses and inertias, and rounding over torques of some 100 N m


def _random_arm(seed: int) -> Arm:
    source = np.random.default_rng(seed)
    count = int(source.integers(1, 7))
    links = []
    for number in range(count):
        d, theta, length, alpha = source.uniform(-1, 1, 4)
        moments = source.uniform(0.1, 0.15, 3)
        kind = "fixed" if number and source.random() < 0.3 else "revolute"
        links.append(
            Link(kind, d, theta, length, alpha, source.uniform(0.1, 2), _three(source.uniform(-0.2, 0.2, 3)), _three(moments))  # type: ignore[arg-type]
        )
    drives = (Drive(1, 50.0, 2048, 0.03, 0.3, 24.0, rotor_inertia_kg_m2=1e-5),)
    gravity = _three(source.uniform(-10, 10, 3))
    convention = "modified" if seed % 2 else "standard"
    return Arm("any", tuple(links), gravity, dh_convention=convention, drives=drives)


def _three(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


ALL = [pytest.param(_random_arm(seed), id=f"random {seed}") for seed in range(12)]
ALL += [pytest.param(RIGHT, id="right"), pytest.param(PENDULUM, id="pendulum")]


@pytest.mark.parametrize("payload_kg", [0.0, 0.7])
@pytest.mark.parametrize("arm", ALL)
def test_torques_and_mass_matrix_are_those_of_mujoco(arm: Arm, payload_kg: float) -> None:
    dynamics = Dynamics(arm, payload_kg)
    model, data = model_of(arm, payload_kg)
    source = np.random.default_rng(1)
    q, speed, push = source.uniform(-2, 2, (3, 10, arm.joint_count))
    batch = dynamics.torques(q, speed, push)
    still = dynamics.gravities(q)
    matrices = dynamics.mass_matrices(q)
    for i in range(len(q)):
        data.qpos, data.qvel, data.qacc = q[i], speed[i], push[i]
        mujoco.mj_inverse(model, data)
        expected = data.qfrc_inverse.copy()
        assert dynamics.inverse(q[i].tolist(), speed[i].tolist(), push[i].tolist()) == pytest.approx(expected, abs=1e-6)
        assert batch[i] == pytest.approx(expected, abs=1e-6)
        full = np.zeros((arm.joint_count, arm.joint_count))
        mujoco.mj_fullM(model, data, full)
        assert matrices[i] == pytest.approx(full, abs=SMALL)
        assert np.array(dynamics.mass_matrix(q[i].tolist())) == pytest.approx(full, abs=SMALL)
        data.qvel, data.qacc = 0.0, 0.0
        mujoco.mj_inverse(model, data)
        assert dynamics.gravity(q[i].tolist()) == pytest.approx(data.qfrc_inverse, abs=SMALL)
        assert still[i] == pytest.approx(data.qfrc_inverse, abs=SMALL)


def _potential_J(arm: Arm, q: np.ndarray) -> float:
    frames = ForwardKinematics(arm).link_transforms(q[None])[0, 1:]
    heights = (
        (link.mass_kg or 0.0) * np.dot(arm.gravity_m_s2, (frame @ [*(link.com_m or (0, 0, 0)), 1.0])[:3])
        for link, frame in zip(arm.links, frames, strict=True)
    )
    return -float(sum(heights))


@pytest.mark.parametrize("arm", ALL)
def test_gravity_torque_is_the_slope_of_the_potential_energy(arm: Arm) -> None:
    q, h = np.random.default_rng(2).uniform(-2, 2, arm.joint_count), 1e-6
    steps = np.eye(arm.joint_count) * h
    slopes = [(_potential_J(arm, q + s) - _potential_J(arm, q - s)) / (2 * h) for s in steps]
    assert Dynamics(arm).gravity(q.tolist()) == pytest.approx(slopes, abs=1e-6)


@pytest.mark.parametrize("arm", ALL)
def test_the_power_of_the_torques_is_the_rate_of_the_energy(arm: Arm) -> None:
    dynamics, h = Dynamics(arm), 1e-5
    q, speed, push = np.random.default_rng(3).uniform(-1, 1, (3, arm.joint_count))

    def energy_J(t: float) -> float:
        at, rate = q + speed * t + 0.5 * push * t * t, speed + push * t
        return 0.5 * float(rate @ dynamics.mass_matrices(at[None])[0] @ rate) + _potential_J(arm, at)

    torque = np.array(dynamics.inverse(q.tolist(), speed.tolist(), push.tolist()))
    assert torque @ speed == pytest.approx((energy_J(h) - energy_J(-h)) / (2 * h), abs=1e-5)


def test_a_mass_matrix_is_symmetric_and_positive() -> None:
    for matrix in Dynamics(RIGHT).mass_matrices(np.random.default_rng(4).uniform(-2, 2, (20, 3))):
        assert np.array_equal(matrix, matrix.T)
        assert np.linalg.eigvalsh(matrix).min() > 0.1  # at least a reflected rotor, 0.142 kg m^2


def test_the_pendulum_hangs_with_its_known_torque() -> None:
    dynamics = Dynamics(PENDULUM)
    for angle in (0.0, 0.3, math.pi / 2):
        assert dynamics.gravity([angle]) == pytest.approx([0.49 * 9.81 * 0.1 * math.sin(angle)], abs=1e-12)
    assert dynamics.mass_matrix([1.0])[0][0] == pytest.approx(0.49 * 0.01 + 0.001814)


def test_a_payload_can_differ_from_row_to_row() -> None:
    dynamics = Dynamics(RIGHT)
    q = np.random.default_rng(5).uniform(-1, 1, (3, 3))
    rows = dynamics.torques(q, q, q, [0.0, 0.5, 1.0])
    still = dynamics.gravities(q, [0.0, 0.5, 1.0])
    for row, held, pose, payload in zip(rows, still, q.tolist(), (0.0, 0.5, 1.0), strict=True):
        assert row == pytest.approx(Dynamics(RIGHT, payload).inverse(pose, pose, pose))
        assert held == pytest.approx(Dynamics(RIGHT, payload).gravity(pose), abs=1e-12)


def test_missing_masses_are_named_and_only_when_dynamics_is_asked_for() -> None:
    panda = load_arm(ARMS / "panda.toml")
    with pytest.raises(MissingModel, match=r"mass_kg, com_m, inertia_kg_m2 of \[\[link\]\] 1 in .*panda\.toml"):
        Dynamics(panda)
    links = (RIGHT.links[0], dataclasses.replace(RIGHT.links[1], com_m=None), *RIGHT.links[2:])
    with pytest.raises(MissingModel, match=r"dynamics needs com_m of \[\[link\]\] 2"):
        Dynamics(dataclasses.replace(RIGHT, links=links))


def test_a_fixed_link_may_carry_the_mass_of_the_joint_before_it() -> None:
    bare, forearm = RIGHT.links[2], RIGHT.links[3]
    moved = dataclasses.replace(forearm, mass_kg=0.6, com_m=(0.0, 0.0, -0.2), inertia_kg_m2=(0.01, 0.01, 0.01))
    empty = dataclasses.replace(bare, mass_kg=None, com_m=None, inertia_kg_m2=None)
    Dynamics(dataclasses.replace(RIGHT, links=(*RIGHT.links[:2], empty, moved)))


def test_states_that_are_none_are_rejected() -> None:
    dynamics = Dynamics(RIGHT)
    with pytest.raises(BadTarget, match=r"\(m, 3\)"):
        dynamics.torques(np.zeros((2, 2)), np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(ArmError, match="equal shapes"):
        dynamics.torques(np.zeros((2, 3)), np.zeros((1, 3)), np.zeros((2, 3)))
    with pytest.raises(ArmError, match="payload_kg"):
        Dynamics(RIGHT, math.nan)


def test_equal_arms_share_what_is_compiled_and_others_do_not() -> None:
    arm, first = Dynamics(RIGHT), RIGHT.links[0]
    heavier = dataclasses.replace(RIGHT, links=(dataclasses.replace(first, mass_kg=99.0), *RIGHT.links[1:]))
    on_a_wall = dataclasses.replace(RIGHT, gravity_m_s2=(0.0, 9.81, 0.0))
    assert Dynamics(dataclasses.replace(RIGHT)).gravity is arm.gravity
    for other in (Dynamics(RIGHT, 0.5), Dynamics(heavier), Dynamics(on_a_wall)):
        assert other != arm
        assert other.gravity is not arm.gravity

"""Frames of the plant against a plain chain of 4x4 matrices, true DH deviations, gravity torque of the reference arm."""

from __future__ import annotations

import dataclasses
import math
import random

import numpy as np
import pytest
from numpy.typing import NDArray

from control.model.description import load_arm
from hil_mocks.errors import MockError
from hil_mocks.plant.effects import gather
from hil_mocks.plant.parts import ArmParts, Convention, LinkParts, PlantTool, parts_of
from hil_mocks.plant.plant import Plant

Matrix = NDArray[np.float64]


def transform(axis: str, shift_m: float = 0.0, turn_rad: float = 0.0) -> Matrix:
    """Shift along and turn about x or z."""
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    if axis == "x":
        return np.array([[1, 0, 0, shift_m], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, shift_m], [0, 0, 0, 1.0]])


def chain_tip(arm: ArmParts, q_rad: list[float]) -> Matrix:
    """Tip by multiplying link transforms one by one."""
    pose, angles = np.eye(4), iter(q_rad)
    for link in arm.links:
        theta = link.theta_rad + (next(angles) if link.is_revolute else 0.0)
        about_z = transform("z", link.d_m) @ transform("z", 0.0, theta)
        about_x = transform("x", link.L_m) @ transform("x", 0.0, link.alpha_rad)
        pose = pose @ (about_z @ about_x if arm.convention == "standard" else about_x @ about_z)
    tip: Matrix = (pose @ np.array([*arm.tool.tip_m, 1.0]))[:3]
    return tip


def random_arm(seed: int, convention: Convention) -> ArmParts:
    """The reference arm's drives on links of any shape, with a tool."""
    source = random.Random(seed)
    nominal = parts_of(load_arm("right"))
    links = tuple(
        LinkParts(*(source.uniform(-0.4, 0.4) for _ in range(4)), link.is_revolute, 1.0, (0.0, 0.0, 0.1), (0.01, 0.01, 0.01))
        for link in nominal.links
    )
    return dataclasses.replace(nominal, links=links, convention=convention, tool=PlantTool((0.02, -0.03, 0.05)))


@pytest.mark.parametrize("convention", ["standard", "modified"])
@pytest.mark.parametrize("seed", range(5))
def test_the_tip_is_where_a_chain_of_matrices_puts_it(convention: Convention, seed: int) -> None:
    arm, source = random_arm(seed, convention), random.Random(seed)
    q = [source.uniform(-0.7, 0.7) for _ in range(3)]
    subject = Plant(arm, gather([], 3, 4, "test"), q)
    assert subject.tip_m() == pytest.approx(chain_tip(arm, q), abs=1e-12)


def test_deviations_move_the_tip_as_changed_dh_parameters_do() -> None:
    from hil_mocks.plant.effects import EffectEntry

    arm = parts_of(load_arm("right"))
    off = {"link1_d_m": 0.003, "link2_theta_rad": -0.02, "link2_L_m": 0.002, "link3_alpha_rad": 0.015, "link4_d_m": -0.004}
    links = list(arm.links)
    for name, value in off.items():
        i, key = int(name[4]) - 1, name[6:]
        links[i] = dataclasses.replace(links[i], **{key: getattr(links[i], key) + value})
    q = [0.4, -0.6, 0.5]
    subject = Plant(arm, gather([EffectEntry("link_geometry", 0, off)], 3, 4, "test"), q)
    assert subject.tip_m() == pytest.approx(chain_tip(dataclasses.replace(arm, links=tuple(links)), q), abs=1e-12)


@pytest.mark.parametrize("q", [(0.0, -0.9, 0.0), (0.3, -0.2, 0.6), (-1.0, -1.5, -0.7)])
def test_gravity_torque_of_the_reference_arm_is_that_of_the_formula(q: tuple[float, float, float]) -> None:
    """Masses at their centres: link 2 along the upper arm, link 3 along the forearm, link 1 on the axis of yaw.

    With a = pi/2 + q2 the upper arm's elevation, the forearm (z3) points at elevation a + q3 - pi/2.
    """
    arm = parts_of(load_arm("right"))
    upper_rad = math.pi / 2 + q[1]
    fore_rad = upper_rad + q[2] - math.pi / 2
    reach_2 = (0.4 - 0.21) * math.cos(upper_rad)
    reach_3 = 0.4 * math.cos(upper_rad) + 0.15 * math.cos(fore_rad)
    about_2_Nm = 9.81 * (1.1 * reach_2 + 0.6 * reach_3)
    about_3_Nm = 9.81 * 0.6 * 0.15 * math.cos(fore_rad)
    subject = Plant(arm, gather([], 3, 4, "test"), q)
    for j, torque_Nm in enumerate((0.0, about_2_Nm, about_3_Nm)):
        subject.push(j, torque_Nm)
        subject.drive_open(j)
    subject.step(20)
    assert max(map(abs, subject.joint_speed_rad_s())) < 1e-6


def test_the_hard_stop_is_a_margin_behind_the_joint_limit() -> None:
    arm = parts_of(load_arm("right"))
    subject = Plant(arm, gather([], 3, 4, "test"), (0.0, -0.5, 0.0))
    for j, current in enumerate((0.0, 0.0, 4.0)):
        subject.drive_current(j, current)
    for _ in range(1500):
        subject.step(2)
    assert subject.joint_rad()[2] == pytest.approx(1.5 + 0.05, abs=1e-4)


def test_a_start_outside_the_joint_limits_is_refused() -> None:
    arm = parts_of(load_arm("right"))
    with pytest.raises(MockError, match=r"joint 2 at 1 rad is outside its limits -1\.9 to 0\.8"):
        Plant(arm, gather([], 3, 4, "test"), (0.0, 1.0, 0.0))


def test_steps_twice_as_long_give_the_same_motion() -> None:
    from hil_mocks.plant.build import PlantOptions

    def end(timestep_s: float) -> tuple[float, ...]:
        options = PlantOptions(timestep_s=timestep_s)
        subject = Plant(parts_of(load_arm("right")), gather([], 3, 4, "test"), (0.1, -1.0, 0.2), options)
        for k in range(400):
            for j, sign in enumerate((1.0, -1.0, 1.0)):
                subject.drive_voltage(j, sign * 1.5 * math.sin(0.02 * k))
            subject.step(round(2e-3 / timestep_s))
        return subject.joint_rad()

    assert end(5e-4) == pytest.approx(end(1.25e-4), abs=2e-4)
    assert end(1e-3) == pytest.approx(end(1.25e-4), abs=5e-4)

"""Links that bend as a textbook's beams do, and an arm that stands elsewhere than nominal."""

from __future__ import annotations

import math
from typing import Literal

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from control.model.description import load_arm
from hil_mocks.errors import MockError
from hil_mocks.plant.build import ArmToBuild, PlantOptions, build
from hil_mocks.plant.effects import EffectEntry, gather
from hil_mocks.plant.parts import ArmParts, LinkParts, PlantTool, parts_of
from hil_mocks.plant.plant import BasePose, Plant
from tests.hil_mocks.pendulum import drive

G, EI, L = 9.81, 150.0, 0.5
COM = 0.2  # of the bar's own mass from its root
KG, INERTIA = 0.8, (0.001, 0.02, 0.02)


def bar(convention: Literal["standard", "modified"] = "standard", mass_kg: float = KG) -> ArmParts:
    """One horizontal bar on a hinge with a vertical axis: gravity bends it, the hinge feels nothing."""
    if convention == "standard":
        link = LinkParts(0.0, 0.0, L, 0.0, True, mass_kg, (COM - L, 0.0, 0.0), INERTIA)
        return ArmParts("bar", (0.0, 0.0, -G), convention, (link,), (drive(),), PlantTool((0.0, 0.0, 0.0)))
    link = LinkParts(0.0, 0.0, 0.0, 0.0, True, mass_kg, (COM, 0.0, 0.0), INERTIA)
    return ArmParts("bar", (0.0, 0.0, -G), convention, (link,), (drive(),), PlantTool((L, 0.0, 0.0)))


def tip_z_m(arm: ArmParts, payload_kg: float, *entries: EffectEntry) -> float:
    """Height of the tip when the link has come to rest."""
    found = gather([*entries, EffectEntry("payload", 0, {"mass_kg": payload_kg})], 1, len(arm.links), "test")
    subject = Plant(arm, found, (0.0,))
    subject.step(2000)
    return subject.tip_m()[2]


FLEX = EffectEntry("link_flexure", 1, {"EI_Nm2": EI})


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_a_payload_and_its_own_weight_bend_a_bar_as_a_cantilever(convention: Literal["standard", "modified"]) -> None:
    own = KG * G * COM**2 * (3.0 * L - COM) / (6.0 * EI)
    load = 1.5 * G * L**3 / (3.0 * EI)
    # 2e-3: second order in a slope of 0.02 rad, and the vibration that is left after a second.
    assert tip_z_m(bar(convention), 0.0, FLEX) == pytest.approx(-own, rel=2e-3)
    assert tip_z_m(bar(convention), 1.5, FLEX) == pytest.approx(-(own + load), rel=2e-3)
    assert tip_z_m(bar(convention), 1.5) == pytest.approx(0.0, abs=1e-9)


def test_a_load_on_an_arm_beyond_the_bar_bends_it_by_its_moment_too() -> None:
    """A second, rigid bar goes on straight: force F and moment F L2 at the end of the first, whose slope tilts the second."""
    second = LinkParts(0.0, 0.0, 0.3, 0.0, False, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    first = bar(mass_kg=1e-9).links[0]
    hinged = LinkParts(0.0, 0.0, 0.3, 0.0, True, 1e-6, (-0.3, 0.0, 0.0), (1e-6, 1e-6, 1e-6))
    for links, joints in (((first, second), 1), ((first, hinged), 2)):
        arm = ArmParts("bars", (0.0, 0.0, -G), "standard", links, (drive(),) * joints, PlantTool((0.0, 0.0, 0.0)))
        found = gather([FLEX, EffectEntry("payload", 0, {"mass_kg": 1.0})], joints, 2, "test")
        subject = Plant(arm, found, (0.0,) * joints)
        subject.step(2000)
        F, M = G, 0.3 * G
        deflection, slope = F * L**3 / (3 * EI) + M * L**2 / (2 * EI), F * L**2 / (2 * EI) + M * L / EI
        whole = F * 0.8**3 / (3 * EI)  # over a fixed link the beam is one of 0.8 m
        expected = whole if joints == 1 else deflection + 0.3 * slope
        assert subject.tip_m()[2] == pytest.approx(-expected, rel=3e-3)


def test_a_payload_hangs_at_the_tool_and_nowhere_else() -> None:
    """A tool away from the last frame: what the payload's weight does as the hinge turns is that of its own distance."""
    arm = bar("modified", mass_kg=1e-6)
    level = ArmParts("level", (0.0, -G, 0.0), "modified", arm.links, arm.drives, arm.tool)
    effects = gather([EffectEntry("payload", 0, {"mass_kg": 2.0})], 1, 1, "test")
    high_J, low_J = (Plant(level, effects, (angle,)).energy_J()[0] for angle in (0.3, 0.0))
    assert high_J - low_J == pytest.approx(2.0 * G * L * math.sin(0.3), rel=1e-5)


def test_a_bending_arm_starts_at_rest() -> None:
    parts = parts_of(load_arm("right"))
    entries = [EffectEntry("link_flexure", 2, {"EI_Nm2": 300.0}), EffectEntry("payload", 0, {"mass_kg": 0.5})]
    subject = Plant(parts, gather(entries, 3, 4, "test"), (0.1, -0.6, 0.2))
    for joint in range(3):
        subject.drive_voltage(joint, 0.0)
    before = subject.tip_m()
    subject.step(2)
    assert math.dist(before, subject.tip_m()) < 2e-6  # 1 ms of free fall alone is 5e-6 m


def test_a_bending_links_mass_and_inertia_are_those_of_the_rigid_one() -> None:
    parts = parts_of(load_arm("right"))
    energies = []
    for EI_Nm2 in (None, 1e7):
        entries = [EffectEntry("link_flexure", 2, {"EI_Nm2": EI_Nm2})] if EI_Nm2 else []
        (built,) = build([ArmToBuild(parts, gather(entries, 3, 4, "test"), 5e-4, 0.5, 0.05)])
        state = mujoco.MjData(built.model)
        state.qpos[list(built.link_hinge)] = (0.1, -0.6, 0.2)
        state.qvel[list(built.link_hinge)] = (0.5, -0.4, 0.8)
        mujoco.mj_forward(built.model, state)
        mujoco.mj_energyPos(built.model, state)
        mujoco.mj_energyVel(built.model, state)
        energies.append(list(state.energy))
    assert energies[0] == pytest.approx(energies[1], rel=1e-6)


def test_a_link_of_no_length_cannot_bend() -> None:
    arm = bar()
    short = ArmParts(
        "short",
        arm.gravity_m_s2,
        "standard",
        (LinkParts(0, 0, 0, 0, True, 1, (0, 0, 0), INERTIA),),
        arm.drives,
        PlantTool((0.0, 0.0, 0.0)),
    )
    with pytest.raises(MockError, match=r"bends 0\.0000 m of link"):
        Plant(short, gather([FLEX], 1, 1, "test"), (0.0,))


BASE = {"x_m": 0.01, "y_m": -0.02, "z_m": 0.005, "rx_rad": 0.02, "ry_rad": -0.03, "rz_rad": 0.1}


def test_camera_and_hand_see_the_arm_where_it_really_stands() -> None:
    parts = parts_of(load_arm("right"))
    pose = (0.1, -0.6, 0.2)
    nominal = Plant(parts, gather([], 3, 4, "test"), pose)
    moved = Plant(parts, gather([EffectEntry("base_frame", 0, BASE)], 3, 4, "test"), pose)
    turn = Rotation.from_rotvec([BASE["rx_rad"], BASE["ry_rad"], BASE["rz_rad"]])
    # The effect is the pose of the world in the base frame: base_p = origin + R world_p.
    expected = turn.inv().apply(np.array(nominal.tip_m()) - [BASE["x_m"], BASE["y_m"], BASE["z_m"]])
    assert moved.tip_m() == pytest.approx(expected.tolist(), abs=1e-12)
    for joint in range(3):
        moved.drive_open(joint)
    seat = np.add(expected, (0.01, 0.02, 0.03)).tolist()
    moved.step(round(1.2 * moved.hand.seat(seat) / moved.timestep_s))
    for _ in range(600):
        moved.step(1)
    assert moved.tip_m() == pytest.approx(seat, abs=2e-4)


def test_a_turned_world_and_back_is_the_same_point() -> None:
    base_pose = BasePose((0.1, 0.2, -0.3), (0.4, -1.1, 2.0))
    assert base_pose.in_base(base_pose.in_world((1.0, 2.0, 3.0))) == pytest.approx((1.0, 2.0, 3.0))


def test_a_hand_at_the_tip_steadies_the_links_that_its_grip_leaves_free() -> None:
    link = LinkParts(0.0, 0.0, 0.3, 0.0, True, 0.5, (-0.15, 0.0, 0.0), (0.0005, 0.004, 0.004))
    chain = ArmParts("chain", (0.0, -G, 0.0), "standard", (link,) * 3, (drive(),) * 3, PlantTool((0.0, 0.0, 0.0)))
    subject = Plant(chain, gather([], 3, 3, "test"), (0.3, 0.9, -0.7))  # no friction, and one motion more than the grip takes
    for joint in range(3):
        subject.drive_open(joint)

    def fastest_rad_s(steps: int) -> float:
        places_rad = []
        for _ in range(steps):
            subject.step(1)
            places_rad.append([subject.motor_rad(j) for j in range(3)])
        return float(np.abs(np.diff(places_rad, axis=0)).max()) / PlantOptions().timestep_s

    subject.hand.seat(subject.tip_m())
    held_rad_s = fastest_rad_s(4000)
    assert 0.05 < held_rad_s < 0.5
    subject.hand.let_go()
    assert fastest_rad_s(4000) > 1.0

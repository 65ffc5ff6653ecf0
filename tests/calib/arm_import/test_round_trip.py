"""Our own URDF and MJCF come back as the same arm; random arms of MuJoCo's are read as MuJoCo moves them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from calib.arm_import import arm_links, read_arm
from calib.export import export_text
from control.dynamics.dynamics import Dynamics
from control.kinematics.kinematics import ForwardKinematics, PoseKinematics
from control.model.arm import Arm, Convention, Tool
from control.model.description import load_arm
from tests.places import ARMS

SAME_m = 1e-9
RIGHT = load_arm("right")
PANDA = load_arm(ARMS / "panda.toml")


def perturbed(arm: Arm) -> Arm:
    rows = np.random.default_rng(7).uniform(-1.0, 1.0, (len(arm.links), 4))
    return arm.with_dh(arm.dh + rows * np.array([0.005, 0.035, 0.005, 0.035]))


OWN = {
    "reference": RIGHT,
    "calibrated": perturbed(RIGHT),
    "seven joints, modified": PANDA,
    "seven joints, calibrated, with a tool": dataclasses.replace(perturbed(PANDA), tool=Tool((0.03, -0.02, 0.05))),
}


@pytest.mark.parametrize("convention", ["standard", "modified"])
@pytest.mark.parametrize("form", ["urdf", "mjcf"])
@pytest.mark.parametrize("name", OWN)
def test_an_exported_arm_comes_back(name: str, form: str, convention: Convention, tmp_path: Path) -> None:
    arm, file = OWN[name], tmp_path / f"arm.{form}"
    file.write_text(export_text(arm, form), encoding="utf-8")
    links, _ = arm_links(read_arm(file, form), convention)
    q = np.random.default_rng(1).uniform(-2.0, 2.0, (40, arm.joint_count))
    back = PoseKinematics(ForwardKinematics(Arm("again", links, dh_convention=convention))).batch(q)
    own = PoseKinematics(ForwardKinematics(arm)).batch(q)
    assert np.abs(back.position_m - own.position_m).max() < SAME_m
    assert np.abs(back.rotation - own.rotation).max() < SAME_m


def test_masses_come_back_with_their_torques(tmp_path: Path) -> None:
    bare = dataclasses.replace(RIGHT, drives=())
    file = tmp_path / "arm.urdf"
    file.write_text(export_text(bare, "urdf"), encoding="utf-8")
    links, notes = arm_links(read_arm(file, "urdf"), "standard")
    assert [note for note in notes if "products" in note] == []
    q = np.random.default_rng(2).uniform(-1.0, 1.0, (20, 3))
    mine, theirs = Dynamics(Arm("again", links)), Dynamics(bare)
    assert np.abs(mine.torques(q, q, q) - theirs.torques(q, q, q)).max() < 1e-9


def random_mjcf(rng: np.random.Generator, joints: int) -> str:
    """A chain with axes, anchors, turned bodies, reference angles and full inertia at random."""
    text, closing = "", ""
    for number in range(1, joints + 1):
        place, quat = rng.uniform(-0.3, 0.3, 3), rng.normal(size=4)
        axis, anchor, com = rng.normal(size=3), rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.1, 0.1, 3)
        text += (
            f'<body name="b{number}" pos="{_of(place)}" quat="{_of(quat)}">'
            f'<inertial pos="{_of(com)}" quat="{_of(rng.normal(size=4))}" mass="{rng.uniform(0.2, 3.0)}"'
            ' diaginertia="0.01 0.012 0.015"/>'
            f'<joint name="j{number}" type="hinge" axis="{_of(axis)}" pos="{_of(anchor)}"'
            f' range="-2 2" ref="{rng.uniform(-1.0, 1.0)}"/>'
        )
        closing += "</body>"
    head = '<mujoco model="random"><compiler angle="radian"/><worldbody>'
    return f"{head}{text}{closing}</worldbody></mujoco>"


def _of(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


@pytest.mark.parametrize("convention", ["standard", "modified"])
@pytest.mark.parametrize("joints", [2, 4, 6, 7])
def test_a_random_arm_moves_and_weighs_as_in_mujoco(joints: int, convention: Convention, tmp_path: Path) -> None:
    rng = np.random.default_rng(joints)
    file = tmp_path / "random.xml"
    file.write_text(random_mjcf(rng, joints), encoding="utf-8")
    serial = read_arm(file, "mjcf")
    links, _ = arm_links(serial, convention)
    arm = Arm("random", links, gravity_m_s2=serial.gravity_m_s2, dh_convention=convention)
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    body = model.body(f"b{joints}").id
    for q in rng.uniform(-2.0, 2.0, (5, joints)):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        frame = ForwardKinematics(arm).link_transforms(q[None])[0][-1]
        assert np.abs(frame[:3, 3] - data.xpos[body]).max() < SAME_m
        assert np.abs(frame[:3, :3] - data.xmat[body].reshape(3, 3)).max() < SAME_m
        gravity = Dynamics(arm).torques(q[None], 0 * q[None], 0 * q[None])[0]
        assert np.abs(gravity - data.qfrc_bias).max() < 1e-8

"""Exported arms, loaded where they are meant to be loaded: MuJoCo reads URDF and MJCF, pytransform3d reads URDF."""

from __future__ import annotations

import dataclasses
import json
import math
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pytransform3d.urdf import UrdfTransformManager

from calib.arm_import import arm_links, read_arm
from calib.errors import CalibrationError
from calib.export import FORMS, export, export_text
from calib.export.rigid import losses
from console.main import main
from control.dynamics.dynamics import Dynamics
from control.files import NotWritten
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Calibration, Drive, Effect, Link, Tool
from control.model.description import load_arm
from tests.places import ARMS

SAME_m = 1e-9
SAME_Nm = 1e-9
RIGHT = load_arm("right")
PANDA = load_arm(ARMS / "panda.toml")
ROWS = np.random.default_rng(5).uniform(-1.0, 1.0, (4, 4))


def perturbed(arm: Arm) -> Arm:
    """As calibration leaves it: no angle is a right one any more."""
    rows = np.random.default_rng(7).uniform(-1.0, 1.0, (len(arm.links), 4))
    return arm.with_dh(arm.dh + rows * np.array([0.005, 0.035, 0.005, 0.035]))


def with_tool(arm: Arm) -> Arm:
    return dataclasses.replace(arm, tool=Tool((0.03, -0.02, 0.05)))


ARMS = {
    "reference": RIGHT,
    "calibrated": perturbed(RIGHT),
    "left": load_arm("left"),
    "seven joints, modified, tool": with_tool(PANDA),
    "seven joints, modified, tool, calibrated": perturbed(with_tool(PANDA)),
    "standard with tool": with_tool(perturbed(RIGHT)),
    "modified with masses": dataclasses.replace(perturbed(RIGHT), dh_convention="modified"),
}


def poses(arm: Arm, count: int = 40) -> np.ndarray:
    """Random joint angles within the limits: pytransform3d clips what is outside of them."""
    low, high = np.array([(max(a, -3.0), min(b, 3.0)) for a, b in arm.limits_rad]).T
    return np.random.default_rng(1).uniform(low, high, (count, arm.joint_count))


def mujoco_tips(text: str, q: np.ndarray) -> np.ndarray:
    model = mujoco.MjModel.from_xml_string(text)
    state = mujoco.MjData(model)
    places = [model.joint(f"joint{j}").qposadr[0] for j in range(1, q.shape[1] + 1)]
    tips = []
    for pose in q:
        state.qpos[places] = pose
        mujoco.mj_kinematics(model, state)
        tips.append(state.body("tip").xpos.copy())
    return np.array(tips)


def urdf_reader_tips(text: str, q: np.ndarray) -> np.ndarray:
    reader = UrdfTransformManager()
    reader.load_urdf(text)
    tips = []
    for pose in q:
        for joint, angle in enumerate(pose, start=1):
            reader.set_joint(f"joint{joint}", float(angle))
        tips.append(reader.get_transform("tip", "base")[:3, 3])
    return np.array(tips)


def json_tips(text: str, q: np.ndarray) -> np.ndarray:
    """As somebody reads it who has nothing but the file: `chain` says how the rows multiply."""
    content = json.loads(text)
    tips = []
    for pose in q:
        frame = np.eye(4)
        for row in content["dh"]:
            turn = row["theta_rad"] + (pose[row["joint"] - 1] if row["joint"] else 0.0)
            z, x = screw(2, row["d_m"], turn), screw(0, row["L_m"], row["alpha_rad"])
            frame = frame @ (z @ x if content["dh_convention"] == "standard" else x @ z)
        tips.append((frame @ [*content["tool_m"], 1.0])[:3])
    return np.array(tips)


def screw(axis: int, along: float, about: float) -> np.ndarray:
    matrix = np.eye(4)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    c, s = math.cos(about), math.sin(about)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    matrix[axis, 3] = along
    return matrix


@pytest.mark.parametrize("name", ARMS)
def test_every_reader_puts_the_tip_where_the_model_does(name: str) -> None:
    arm = ARMS[name]
    q = poses(arm)
    wanted = ForwardKinematics(arm).tips(q)
    np.testing.assert_allclose(mujoco_tips(export_text(arm, "mjcf"), q), wanted, atol=SAME_m, rtol=0.0)
    np.testing.assert_allclose(mujoco_tips(export_text(arm, "urdf"), q), wanted, atol=SAME_m, rtol=0.0)
    np.testing.assert_allclose(urdf_reader_tips(export_text(arm, "urdf"), q), wanted, atol=SAME_m, rtol=0.0)
    np.testing.assert_allclose(json_tips(export_text(arm, "json"), q), wanted, atol=SAME_m, rtol=0.0)


lengths = st.floats(-0.5, 0.5)
angles = st.floats(-math.pi, math.pi) | st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi])
links = st.builds(
    Link,
    st.sampled_from(["revolute", "fixed"]),
    lengths,
    angles,
    lengths,
    angles,
    st.none() | st.floats(0.1, 5.0),
    st.tuples(lengths, lengths, lengths),
    st.tuples(*(st.floats(0.01, 0.0199),) * 3),
)
arms = st.builds(
    Arm,
    st.text(max_size=12),
    st.lists(links, min_size=1, max_size=12).filter(lambda rows: any(row.joint == "revolute" for row in rows)).map(tuple),
    dh_convention=st.sampled_from(["standard", "modified"]),
    tool=st.builds(Tool, st.tuples(lengths, lengths, lengths)),
)
twelve_joints = Arm("twelve", tuple(Link("revolute", 0.1, 0.3 * k, 0.05, 0.7 - 0.1 * k) for k in range(12)))
one_joint = Arm("one", (Link("revolute", 0.1, 0.2, 0.3, 0.4),))


@settings(max_examples=30, deadline=None)
@given(arms)
def test_any_arm_of_any_name_reads_back_as_itself(arm: Arm) -> None:
    q = poses(arm, 3)
    wanted = ForwardKinematics(arm).tips(q)
    for form in ("mjcf", "urdf"):
        np.testing.assert_allclose(mujoco_tips(export_text(arm, form), q), wanted, atol=SAME_m, rtol=0.0)
    np.testing.assert_allclose(urdf_reader_tips(export_text(arm, "urdf"), q), wanted, atol=SAME_m, rtol=0.0)
    assert json.loads(export_text(arm, "json"))["name"] == arm.name


@pytest.mark.parametrize("arm", [one_joint, twelve_joints], ids=lambda arm: arm.name)
def test_one_joint_and_twelve(arm: Arm) -> None:
    q = poses(arm)
    wanted = ForwardKinematics(arm).tips(q)
    for read, form in ((mujoco_tips, "mjcf"), (mujoco_tips, "urdf"), (urdf_reader_tips, "urdf")):
        np.testing.assert_allclose(read(export_text(arm, form), q), wanted, atol=SAME_m, rtol=0.0)


def loaded_with_gravity(arm: Arm, form: str) -> mujoco.MjModel:
    """URDF has no gravity: whoever reads it sets it, as the warning says."""
    model = mujoco.MjModel.from_xml_string(export_text(arm, form))
    if form == "urdf":
        model.opt.gravity[:] = arm.gravity_m_s2
    return model


def weighing(arm: Arm) -> Arm:
    """Masses at every link, off all axes, and gravity from somewhere else."""
    rng = np.random.default_rng(3)
    heavy = [
        dataclasses.replace(
            link,
            mass_kg=float(rng.uniform(0.2, 3.0)),
            com_m=tuple(rng.uniform(-0.2, 0.2, 3).tolist()),
            inertia_kg_m2=tuple(rng.uniform(0.01, 0.019, 3).tolist()),
        )
        for link in arm.links
    ]
    return dataclasses.replace(arm, links=tuple(heavy), gravity_m_s2=(1.0, -2.0, -9.5))


@pytest.mark.parametrize("form", ["mjcf", "urdf"])
@pytest.mark.parametrize("arm", [RIGHT, weighing(perturbed(RIGHT)), weighing(with_tool(PANDA))])
def test_torques_in_mujoco_are_those_of_our_dynamics(arm: Arm, form: str) -> None:
    """At rest and in motion: gravity, Coriolis and inertia. URDF holds no rotors, which only acceleration would feel."""
    model = loaded_with_gravity(arm, form)
    state = mujoco.MjData(model)
    dynamics = Dynamics(arm)
    speeds = np.random.default_rng(2).uniform(-2.0, 2.0, (20, arm.joint_count))
    for q, speed in zip(poses(arm, 20), speeds, strict=True):
        for v in (np.zeros(arm.joint_count), speed):
            state.qpos[:], state.qvel[:] = q, v
            mujoco.mj_forward(model, state)
            wanted = dynamics.torques([q], [v], [np.zeros(arm.joint_count)])[0]
            np.testing.assert_allclose(state.qfrc_bias, wanted, atol=SAME_Nm, rtol=0.0)


def test_mjcf_holds_the_whole_mass_matrix_with_rotors() -> None:
    model = mujoco.MjModel.from_xml_string(export_text(weighing(RIGHT), "mjcf"))
    state = mujoco.MjData(model)
    state.qpos[:] = 0.3, -0.4, 0.5
    mujoco.mj_forward(model, state)
    full = np.zeros((3, 3))
    mujoco.mj_fullM(model, state, full)
    np.testing.assert_allclose(full, Dynamics(weighing(RIGHT)).mass_matrix([0.3, -0.4, 0.5]), atol=1e-9)


def test_limits_torques_and_friction_come_through() -> None:
    friction = (Effect("viscous_friction", 2, {"coefficient_Nm_s_rad": 1.5}), Effect("coulomb_friction", 2, {"torque_Nm": 0.7}))
    arm = dataclasses.replace(RIGHT, effects=friction)
    for form in ("mjcf", "urdf"):
        model = mujoco.MjModel.from_xml_string(export_text(arm, form))
        joint = model.joint("joint2")
        assert joint.range == pytest.approx([-1.9, 0.8])
        assert joint.damping[0] == 1.5
        assert joint.frictionloss[0] == 0.7
        assert model.joint("joint1").damping[0] == 0.0
    root = ET.fromstring(export_text(arm, "urdf"))
    limit = root.find("joint[@name='joint1']/limit")
    assert limit is not None
    assert float(limit.get("effort", "")) == pytest.approx(8.0 * 0.0302 * 100.0)  # current limit x k_t x ratio
    assert float(limit.get("velocity", "")) == 2.0


def test_without_a_current_limit_the_torque_is_that_of_the_stalled_motor() -> None:
    drive = dataclasses.replace(RIGHT.drives[0], current_limit_A=math.inf, joint_speed_limit_rad_s=math.inf)
    arm = dataclasses.replace(RIGHT, drives=(drive, *RIGHT.drives[1:]))
    limit = ET.fromstring(export_text(arm, "urdf")).find("joint[@name='joint1']/limit")
    assert limit is not None
    assert float(limit.get("effort", "")) == pytest.approx(24.0 / 0.299 * 0.0302 * 100.0)
    assert float(limit.get("velocity", "")) == pytest.approx(24.0 / (0.0302 * 100.0))


def test_a_joint_without_limits_turns_freely() -> None:
    for form in ("mjcf", "urdf"):
        model = mujoco.MjModel.from_xml_string(export_text(PANDA, form))
        assert not model.jnt_limited.any()
    drive = Drive(1, 100.0, 2048, 0.03, 0.3, 24.0, joint_lower_rad=-1.0)
    arm = dataclasses.replace(RIGHT, drives=(drive,), rest=None)
    assert any("joint 1, -1 to inf rad" in said for said in export_losses(arm, "urdf"))


def export_losses(arm: Arm, form: str) -> tuple[str, ...]:
    from calib.export.rigid import losses

    return losses(arm, form)


def test_what_is_lost_is_said() -> None:
    hidden = (
        Effect("backlash", 1, {"width_rad": 0.005}),
        Effect("encoder_scale", 2, {"scale": 0.01}),
        Effect("viscous_friction", 2, {"coefficient_Nm_s_rad": 1.5}),
        Effect("base_frame", None, dict.fromkeys(("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"), 0.0)),
    )
    arm = dataclasses.replace(RIGHT, effects=hidden, gravity_m_s2=(0.0, 0.0, -1.62))
    text = " ".join(export_losses(arm, "urdf"))
    assert "backlash of 1 (width_rad 0.005)" in text
    assert "encoder_scale of 2 (scale 0.01)" in text
    assert "viscous" not in text
    assert "base_frame" not in text
    assert "-1.62" in text
    assert "rotor inertia: joint 3" in text
    assert "table, camera" in text
    text = " ".join(export_losses(arm, "mjcf"))
    assert "backlash" in text
    assert "no gravity" not in text
    assert "no rotor inertia" not in text
    assert export_losses(arm, "json") == ()
    assert any("1, 2, 3, 4, 5, 6, 7 are unknown" in line for line in export_losses(PANDA, "mjcf"))


def test_json_holds_everything_and_says_how_to_check_a_reader(tmp_path: Path) -> None:
    arm = dataclasses.replace(perturbed(RIGHT), calibration=Calibration("right.toml", {"p.csv": "ab"}, "2026-01-01", "E2", "0.1"))
    assert export(arm, "json", tmp_path / "new" / "arm.json") == ()
    content = json.loads((tmp_path / "new" / "arm.json").read_text("utf-8"))
    assert content["format"] == "armwright-arm/1"
    assert content["arm"]["drive"][1]["gear_ratio"] == 120.0
    assert content["arm"]["calibration"]["from"] == "right.toml"
    assert content["arm"]["table"]["circle_points"] == 24
    assert content["at_zero"]["tip_m"] == pytest.approx(ForwardKinematics(arm).tip(0.0, 0.0, 0.0), abs=1e-12)
    assert np.shape(content["at_zero"]["base_T_link"]) == (4, 4, 4)
    free = json.loads(export_text(dataclasses.replace(RIGHT, drives=(Drive(1, 1.0, 1, 1.0, 1.0, 1.0),)), "json"))
    assert free["arm"]["drive"][0]["current_limit_A"] is None


def test_a_comment_names_the_origin_and_no_name_breaks_the_xml() -> None:
    made = Calibration("a--b->.toml", {"<p>&.csv": "ab" * 32}, "2026-01-01", "E2", "0.1.0")
    arm = dataclasses.replace(RIGHT, name='"<&\x00\n-->\ud800\N{GREEK SMALL LETTER ALPHA}', calibration=made)
    for form in ("urdf", "mjcf"):
        text = export_text(arm, form)
        root = ET.fromstring(text)
        name = root.get("name") or root.get("model")
        assert name == '"<&_ -->_\N{GREEK SMALL LETTER ALPHA}'
        assert "2026-01-01" in text
        assert "ab" * 32 in text


def test_nothing_is_overwritten_and_a_wrong_form_is_named(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text("mine")
    with pytest.raises(CalibrationError, match="already exists"):
        export(RIGHT, "urdf", tmp_path / "arm.urdf")
    assert (tmp_path / "arm.urdf").read_text() == "mine"
    with pytest.raises(CalibrationError, match='one of urdf, mjcf, json, got "sdf"'):
        export(RIGHT, "sdf", tmp_path / "arm.sdf")
    with pytest.raises(NotWritten, match="not written: Not a directory: choose another place"):
        export(RIGHT, "urdf", tmp_path / "arm.urdf" / "below.urdf")
    assert list(tmp_path.iterdir()) == [tmp_path / "arm.urdf"]


@pytest.mark.parametrize("form", FORMS)
def test_the_command_writes_the_file_and_says_what_it_lacks(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"arm.{form}"
    assert main(["export-arm", "--arm", "left", "--export", form, "--out", str(path)]) == 0
    said = capsys.readouterr().out
    assert str(path) in said
    assert ("cannot express: table" in said) == (form != "json")
    assert path.read_text("utf-8") == export_text(load_arm("left"), form)
    assert main(["export-arm", "--arm", "left", "--export", form, "--out", str(path)]) == 2
    assert "is not overwritten" in capsys.readouterr().err


def test_gripper_and_bought_boards_are_among_what_a_form_lacks() -> None:
    assert "urdf cannot express: gripper, boards, rest pose; omitted" in losses(load_arm("viperx300s"), "urdf")


@pytest.mark.parametrize("form", ["urdf", "mjcf"])
def test_names_of_joints_and_links_go_through_an_export_and_an_import(form: str, tmp_path: Path) -> None:
    rows = [
        dataclasses.replace(link, joint_name=f"pan {number}", link_name=f"arm {number}")
        for number, link in enumerate(RIGHT.links[:3])
    ]
    first = Link("fixed", 0.02, 0.3, 0.01, 0.4)  # a model's own world is no name for it
    last = dataclasses.replace(first, link_name="gripper_frame")
    export(dataclasses.replace(RIGHT, links=(first, *rows, last), table=None), form, tmp_path / "arm.xml")
    back, _ = arm_links(read_arm(tmp_path / "arm.xml", form), "standard")
    assert [link.joint_name for link in back if link.joint == "revolute"] == ["pan 0", "pan 1", "pan 2"]
    names = [link.link_name for link in back if link.link_name]
    assert names == ["arm 0", "arm 1", "arm 2", "gripper_frame"]

"""URDF and MJCF as they are found: a right import, or one sentence that names the file and what to do."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from calib.arm_import import arm_links, read_arm
from calib.errors import ImportedModelError
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm

INERTIA = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
LINK = f'<link name="{{}}"><inertial><mass value="1"/>{INERTIA}</inertial></link>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", more: str = "", xyz: str = "0 0 0.2") -> str:
    limit = '<limit lower="-1" upper="2" effort="10" velocity="3"/>' if kind == "revolute" else ""
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="0 0 0"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 1 0"/>{limit}{more}</joint>'
    )


def robot(*joints: str, links: str = "abcd", head: str = "") -> str:
    lines = "\n".join("".join(map(LINK.format, line)) for line in links.splitlines())
    return f'<?xml version="1.0"?>{head}<robot name="r">{lines}{"".join(joints)}</robot>'


PLAIN = (joint("j1", "a", "b"), joint("j2", "b", "c"), joint("f", "c", "d", "fixed", xyz="0 0 0.3"))


def read(text: str, tmp_path: Path, form: str = "urdf", **where: str):  # type: ignore[no-untyped-def]
    file = tmp_path / "robot.xml"
    file.write_text(text, encoding="utf-8")
    return read_arm(file, form, **where)


def test_a_plain_arm_is_read_with_limits_masses_and_its_fixed_end(tmp_path: Path) -> None:
    serial = read(robot(*PLAIN), tmp_path)
    assert [(j.lower_rad, j.upper_rad, j.torque_Nm, j.speed_rad_s) for j in serial.joints] == [(-1, 2, 10, 3)] * 2
    assert [mass.mass_kg for mass in serial.masses if mass] == [1.0, 2.0]  # the fixed end moves with joint 2
    links, _ = arm_links(serial, "standard")
    tip = ForwardKinematics(Arm("r", links)).tips(np.array([[0.5 * math.pi, 0.0]]))[0]
    assert np.allclose(tip, [0.5, 0.0, 0.2], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (robot(joint("lift", "a", "b", "prismatic"), *PLAIN[1:]), "joint lift is prismatic"),
        (robot(joint("j1", "a", "b", "floating"), *PLAIN[1:]), "joint j1 is floating"),
        (robot(joint("j1", "a", "b"), joint("j2", "b", "c", more='<mimic joint="j1"/>'), PLAIN[2]), "joint j2 follows joint j1"),
        (robot(joint("j1", "a", "b"), joint("j2", "b", "c"), joint("j3", "b", "d")), "has 2 ends: c (2 joints), d (2 joints)"),
        (robot(joint("f", "a", "b", "fixed"), joint("g", "b", "c", "fixed"), joint("h", "c", "d", "fixed")), "no joint turns"),
        (robot(joint("j1", "a", "b"), joint("j2", "c", "d")), "one link without a parent, got a, c"),
        (robot(joint("j1", "a", "b"), joint("j2", "d", "c"), joint("j3", "c", "d")), "hang on each other"),
        (robot(joint("j1", "b", "a"), joint("j2", "c", "b"), joint("j3", "d", "c"), joint("j4", "a", "d")), "form a loop"),
        (robot(joint("j1", "a", "b"), joint("j2", "c", "b"), links="abc"), "link b has a second parent"),
        (robot(joint("j1", "a", "nowhere")), "names a link, got 'nowhere'"),
        (robot(PLAIN[0].replace("0 0 0.2", "0 0"), *PLAIN[1:]), "expected 3 numbers, got 2"),
        (robot(PLAIN[0].replace("0 0 0.2", "0 nan 0.2"), *PLAIN[1:]), "expected a finite number, got 'nan'"),
        (robot(PLAIN[0].replace("0 1 0", "0 0 0"), *PLAIN[1:]), "expected an axis, got 0 0 0"),
        (robot(PLAIN[0].replace('lower="-1"', 'lower="3"'), *PLAIN[1:]), "lower limit 3 is above"),
        (robot(PLAIN[0].replace('type="revolute"', 'type="hinge"'), *PLAIN[1:]), "got 'hinge'"),
        (robot(PLAIN[0].replace("0 0 0.2", "0 0 ${length}"), *PLAIN[1:]), "this is xacro, not URDF: run `xacro"),
        ('<robot xmlns:xacro="x"><xacro:macro name="m"/></robot>', "this is xacro"),
        ("<mujoco/>", "expected <robot>, got <mujoco>; use --from-mjcf"),
        ("<robot><link name='a'></robot>", "which is XML"),
        ("", "which is XML"),
        ("name = 'x'", "which is XML"),
        ("<robot name='r'/>", "at least one <link>"),
    ],
)
def test_what_no_serial_arm_has_is_said_in_one_sentence(text: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(ImportedModelError) as caught:
        read(text, tmp_path)
    assert says in str(caught.value)
    assert str(tmp_path / "robot.xml") in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("form", "root"), [("urdf", "robot"), ("mjcf", "mujoco")])
def test_hostile_xml_is_refused_before_anything_grows(form: str, root: str, tmp_path: Path) -> None:
    laughs = '<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]>'
    outside = '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/hostname">]>'
    for head in (laughs, outside):
        with pytest.raises(ImportedModelError, match="DOCTYPE"):
            read(f"{head}<{root}>&a;</{root}>", tmp_path, form)
    with pytest.raises(ImportedModelError, match="nested more than"):
        read(f"<{root}>" + "<body>" * 300 + "</body>" * 300 + f"</{root}>", tmp_path, form)
    with pytest.raises(ImportedModelError, match="more than 200000 elements"):
        read(f"<{root}>" + "<a/>" * 200_001 + f"</{root}>", tmp_path, form)
    with pytest.raises(ImportedModelError, match="expected at most 16 MB"):
        read(f"<{root}>" + " " * 16_000_001 + f"</{root}>", tmp_path, form)


def test_a_gripper_beside_the_chosen_tip_is_weight_and_said(tmp_path: Path) -> None:
    joints = (joint("j1", "a", "b"), joint("j2", "b", "c"), joint("finger", "c", "d", "prismatic"))
    serial = read(robot(*joints), tmp_path, tip="c")
    assert serial.masses[1] is not None
    assert serial.masses[1].mass_kg == 2.0
    assert any("finger" in note for note in serial.notes)


def test_limits_and_masses_that_are_missing_are_said(tmp_path: Path) -> None:
    text = robot(*PLAIN).replace('<limit lower="-1" upper="2" effort="10" velocity="3"/>', "")
    _, notes = arm_links(read(text, tmp_path), "standard")
    assert any("joints without limits in the file: j1, j2" in note for note in notes)
    bare = robot(*PLAIN).replace('<mass value="1"/>', "")
    links, notes = arm_links(read(bare, tmp_path), "standard")
    assert any("no masses" in note for note in notes)
    assert all(link.mass_kg is None for link in links)


@pytest.mark.parametrize("rounded", ["1.57", "1.571", "1.5708", "1.57080", "1.5707963"])
def test_a_rounded_right_angle_is_read_as_one(rounded: str, tmp_path: Path) -> None:
    text = robot(PLAIN[0], PLAIN[1].replace('rpy="0 0 0"', f'rpy="{rounded} 0 0"'), PLAIN[2])
    serial = read(text, tmp_path)
    assert abs(serial.axes[0].direction @ serial.axes[1].direction) < 1e-15
    links, _ = arm_links(serial, "standard")
    assert all(link.alpha_rad % (0.5 * math.pi) == 0.0 for link in links)


def test_an_angle_that_is_no_rounding_stays(tmp_path: Path) -> None:
    text = robot(PLAIN[0], PLAIN[1].replace('rpy="0 0 0"', 'rpy="1.5721 0 0"'), PLAIN[2])
    serial = read(text, tmp_path)
    assert serial.axes[0].direction @ serial.axes[1].direction == pytest.approx(math.cos(1.5721), abs=1e-15)


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ('<joint name="s" type="slide" axis="0 0 1"/>', "joint s is slide"),
        ('<freejoint name="free"/>', "joint free is free"),
        ('<joint name="ball" type="ball"/>', "joint ball is ball"),
        ('<replicate count="1000000000"><body/></replicate>', "<replicate> is not read"),
        ('<joint name="j" type="hinge" axis="0 0 1" nonsense="1"/>', "MuJoCo cannot read it"),
    ],
)
def test_mjcf_that_is_no_arm_is_said_in_one_sentence(body: str, says: str, tmp_path: Path) -> None:
    text = f'<mujoco><worldbody><body name="b">{body}<geom size="0.1"/></body></worldbody></mujoco>'
    with pytest.raises(ImportedModelError) as caught:
        read(text, tmp_path, "mjcf")
    assert says in str(caught.value)


def test_mjcf_without_its_meshes_is_read_and_said(tmp_path: Path) -> None:
    text = (
        '<mujoco><asset><mesh name="m" file="gone.stl"/></asset><worldbody><body name="b">'
        '<inertial pos="0 0 0.1" mass="2" diaginertia="0.01 0.01 0.01"/><joint name="j" axis="0 1 0"/>'
        '<geom type="mesh" mesh="m"/><body name="c" pos="0 0 0.3"/></body></worldbody></mujoco>'
    )
    serial = read(text, tmp_path, "mjcf")
    assert serial.masses[0] is not None
    assert serial.masses[0].mass_kg == pytest.approx(2.0)
    assert any("without its shapes" in note for note in serial.notes)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('rpy="0 0 0"', 'rpy="0 90 0"', r"<origin> rpy: .* got 90 \(this looks like degrees: write 1.5708"),
        ('xyz="0 0 0.2"', 'xyz="0 0 200"', r"<origin> xyz: .* looks like millimetres: write 0.2"),
        ('lower="-1"', 'lower="-60"', r"<limit> lower: .* looks like degrees: write -1.0472"),
        ('xyz="0 0 0.2"', 'xyz="0 0 0,2"', "decimals have a point"),
        ('xyz="0 0 0.2"', 'xyz="$(arg lift)"', "this is xacro"),
    ],
)
def test_a_value_in_another_unit_is_named_by_its_element_and_line(old: str, new: str, says: str, tmp_path: Path) -> None:
    text = robot(*PLAIN).replace("<joint", "\n<joint")
    with pytest.raises(ImportedModelError, match=rf"robot\.xml, line 2: {says}|robot\.xml, line 2: .*{says}"):
        read(text.replace(old, new, 1), tmp_path)


@pytest.mark.parametrize("encoding", ["gb2312", "shift_jis", "no-such", "utf-16"])
def test_an_encoding_that_is_not_read_gets_a_remedy(encoding: str, tmp_path: Path) -> None:
    file = tmp_path / "robot.xml"
    head = f'<?xml version="1.0" encoding="{encoding}"?>'
    file.write_bytes(robot(*PLAIN).replace('<?xml version="1.0"?>', head).encode("ascii"))
    with pytest.raises(ImportedModelError, match="save the file as UTF-8"):
        read_arm(file, "urdf")
    file.write_bytes(robot(*PLAIN, head="<!-- \u673a -->").encode("gb2312"))  # and the file does not say so
    with pytest.raises(ImportedModelError, match="save the file as UTF-8"):
        read_arm(file, "urdf")


def test_moments_that_no_body_has_become_the_nearest_possible_ones_and_are_said(tmp_path: Path) -> None:
    narrow = INERTIA.replace('iyy="0.01"', 'iyy="0.05"')
    serial = read(robot(*PLAIN, links="a\nbcd").replace(INERTIA, narrow, 2), tmp_path)
    said = [note for note in serial.notes if "no body has the moments 0.01, 0.01, 0.05" in note]
    assert [re.findall(r"line \d, link \w", note) for note in said] == [["line 1, link a"], ["line 2, link b"]]
    mass = serial.masses[0]
    assert mass is not None
    assert np.linalg.eigvalsh(mass.inertia_kg_m2) == pytest.approx([0.025, 0.025, 0.05])

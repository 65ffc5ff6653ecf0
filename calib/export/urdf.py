"""URDF: one link and one joint per DH row, the tip as a fixed frame (wiki.ros.org/urdf/XML)."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

from calib.export.frames import (
    ExportedLink,
    about,
    bodies_of,
    document,
    end_names,
    ends_m,
    massless_joints,
    numbers,
    safe,
    tip_in_last,
)
from calib.export.losses import DriveFigures, joint_figures
from control.model.arm import Arm, Vector3

LEAST_LENGTH_m = 1e-3  # shorter links get no shape
THICKNESS = 0.12  # a shape's radius over its length, within:
THICKEST_m = 0.02
_ORIGIN: Vector3 = (0.0, 0.0, 0.0)


def urdf_text(arm: Arm) -> str:
    """The arm as URDF."""
    bodies = bodies_of(arm)
    root = ET.Element("robot", name=safe(arm.name))
    _for_mujoco(root, bodies)
    base, tip = end_names(arm)
    ET.SubElement(root, "link", name=base)
    for body, end in zip(bodies, ends_m(arm, bodies), strict=True):
        _add_link(root, body, end)
    ET.SubElement(root, "link", name=tip)
    parent = base
    for body in bodies:
        _add_joint(root, arm, body, parent)
        parent = body.name
    turned = bodies[-1].body_T_dh.rpy_rad
    _joint(root, f"{tip}_fixed", "fixed", parent, tip, tip_in_last(arm, bodies), turned)
    return document(root, about(arm))


def _for_mujoco(root: ET.Element, bodies: tuple[ExportedLink, ...]) -> None:
    """MuJoCo's own element, which other readers ignore: keep the fixed frames and the shapes."""
    compiler = ET.SubElement(
        ET.SubElement(root, "mujoco"), "compiler", fusestatic="false", discardvisual="false"
    )
    for key, value in mass_bounds(bodies).items():
        compiler.set(key, value)


def mass_bounds(bodies: tuple[ExportedLink, ...]) -> dict[str, str]:
    """MuJoCo refuses moving bodies without mass; these get the smallest possible one."""
    if massless_joints(bodies):
        return {"boundmass": "1e-6", "boundinertia": "1e-9"}
    if any(body.has_inertia and min(body.link.inertia_kg_m2 or _ORIGIN) < 1e-12 for body in bodies):
        return {"boundinertia": "1e-12"}
    return {}


def _add_link(root: ET.Element, body: ExportedLink, end_m: Vector3) -> None:
    link = ET.SubElement(root, "link", name=body.name)
    if body.has_inertia:
        inertial = ET.SubElement(link, "inertial")
        _origin(inertial, body.com_m, body.body_T_dh.rpy_rad)
        ET.SubElement(inertial, "mass", value=repr(body.link.mass_kg))
        ixx, iyy, izz = (repr(moment) for moment in body.link.inertia_kg_m2 or _ORIGIN)
        ET.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")
    length = math.hypot(*end_m)
    if length > LEAST_LENGTH_m:
        visual = ET.SubElement(link, "visual")
        middle = (0.5 * end_m[0], 0.5 * end_m[1], 0.5 * end_m[2])
        _origin(visual, middle, _toward(end_m))
        cylinder = ET.SubElement(ET.SubElement(visual, "geometry"), "cylinder")
        cylinder.set("radius", repr(shape_radius_m(length)))
        cylinder.set("length", repr(length))


def _toward(end_m: Vector3) -> Vector3:
    """The rpy that rotates z, a cylinder's axis, towards a point."""
    return 0.0, math.atan2(math.hypot(end_m[0], end_m[1]), end_m[2]), math.atan2(end_m[1], end_m[0])


def shape_radius_m(length_m: float) -> float:
    """Radius of a link's shape."""
    return min(THICKEST_m, THICKNESS * length_m)


def _add_joint(root: ET.Element, arm: Arm, body: ExportedLink, parent: str) -> None:
    at = body.parent_T_body
    if body.joint is None:
        _joint(root, body.joint_name, "fixed", parent, body.name, at.position_m, at.rpy_rad)
        return
    figures = joint_figures(arm, body.joint)
    kind = "revolute" if figures.is_limited else "continuous"
    joint = _joint(root, body.joint_name, kind, parent, body.name, at.position_m, at.rpy_rad)
    ET.SubElement(joint, "axis", xyz="0 0 1")
    _limit(joint, figures)
    if figures.viscous_Nm_s_rad or figures.coulomb_Nm:
        damping, friction = repr(figures.viscous_Nm_s_rad), repr(figures.coulomb_Nm)
        ET.SubElement(joint, "dynamics", damping=damping, friction=friction)


def _joint(
    root: ET.Element, name: str, kind: str, parent: str, child: str, xyz_m: Vector3, rpy_rad: Vector3
) -> ET.Element:
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    _origin(joint, xyz_m, rpy_rad)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def _origin(of: ET.Element, xyz_m: Vector3, rpy_rad: Vector3) -> None:
    ET.SubElement(of, "origin", xyz=numbers(xyz_m), rpy=numbers(rpy_rad))


def _limit(joint: ET.Element, figures: DriveFigures) -> None:
    """URDF wants effort and velocity wherever there is a limit; a drive always gives both."""
    if not math.isfinite(figures.torque_Nm):
        return
    limit = ET.SubElement(joint, "limit")
    if figures.is_limited:
        limit.set("lower", repr(figures.lower_rad))
        limit.set("upper", repr(figures.upper_rad))
    limit.set("effort", repr(figures.torque_Nm))
    limit.set("velocity", repr(figures.speed_rad_s))

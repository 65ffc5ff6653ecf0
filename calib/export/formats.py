"""The forms of `armwright export-arm`: URDF, MJCF, plain JSON, and Python code that compensates without armwright."""

from __future__ import annotations

import dataclasses
import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from calib.errors import CalibrationError
from calib.export.rigid import (
    DriveFigures,
    ExportedLink,
    about,
    bodies_of,
    document,
    end_names,
    ends_m,
    joint_figures,
    massless_joints,
    numbers,
    safe,
    tip_in_last,
)
from control.kinematics.chain import link_transforms, tips
from control.model.arm import Arm, Vector3

FORMAT = "armwright-arm/1"
CONVENTIONS = {
    "standard": "parent_T_link = Tz(d) Rz(theta + q) Tx(L) Rx(alpha)",
    "modified": "parent_T_link = Rx(alpha) Tx(L) Rz(theta + q) Tz(d)",
}


def plain_text(rigid: Arm, arm: Arm) -> str:
    """JSON: `rigid` as rows and transforms, `arm` with all that its file has. SI, radians; null: infinite limit, unknown mass."""
    content = {
        "format": FORMAT,
        "name": arm.name,
        "units": "SI, radians; a key ends in its unit",
        "dh_convention": arm.dh_convention,
        "chain": f"{CONVENTIONS[arm.dh_convention]}; base_T_tip = product of all, then the tool's position",
        "joints": arm.joint_count,
        "dh": _rows(rigid),
        "tool_m": list(arm.tool.position_m),
        "at_zero": _at_zero(rigid),
        "arm": _plain_values(arm),
    }
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _rows(arm: Arm) -> list[dict[str, object]]:
    """The DH table, one object per link; `joint` (1-based) adds its angle to theta, null if the link is fixed."""
    rows: list[dict[str, object]] = []
    joint = 0
    for link in arm.links:
        joint += link.joint == "revolute"
        rows.append(
            {
                "joint": joint if link.joint == "revolute" else None,
                "d_m": link.d_m,
                "theta_rad": link.theta_rad,
                "L_m": link.L_m,
                "alpha_rad": link.alpha_rad,
            }
        )
    return rows


def _at_zero(arm: Arm) -> dict[str, object]:
    """Transforms at joint angles 0, for checking a reader."""
    q = np.zeros((1, arm.joint_count))
    frames = link_transforms(arm.dh, q, arm.joints, arm.dh_convention)[0]
    tip = tips(arm.dh, q, arm.joints, arm.dh_convention, arm.tool.position_m)[0]
    return {"base_T_link": [frame.tolist() for frame in frames[1:]], "tip_m": tip.tolist()}


def _plain_values(value: object) -> Any:
    """Dataclasses as objects with the keys of arm.toml; numbers that JSON cannot represent are null."""
    if dataclasses.is_dataclass(value):
        fields = [f for f in dataclasses.fields(value) if f.metadata.get("key") != ""]
        return {f.metadata.get("key", f.name): _plain_values(getattr(value, f.name)) for f in fields}
    if isinstance(value, Mapping):
        return {str(key): _plain_values(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain_values(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


# Compensated motion without armwright: one Python file that turns wanted joint angles into those to command.
#
# A program that knows the published model only asks for joint angles q. At the angles that `commanded(q)` returns, the tip of
# this arm is where the published model has its tip at q: the least change of the joints that does it, by Newton's method with
# damping, dq = J^T (J J^T + damping)^-1 (wanted - tip). Near singular poses it would take wide turns; there no joint leaves
# what was wanted by more than 0.2 rad, and the tip stays short. Encoder scale and eccentricity are taken out last. Orientation
# follows as it comes.


CORRECTED = ("encoder_scale", "encoder_eccentricity")
CODE = '''
from math import cos, sin

DAMPING_m2, STEPS = 1e-6, 6
FURTHEST_rad = 0.2  # that a joint is moved: beyond it the pose is singular


def commanded(wanted_rad):
    """Joint angles [rad] to command, so that the tip goes where the published model has it at `wanted_rad`."""
    target, _ = _tip(PUBLISHED, PUBLISHED_TOOL_m, PUBLISHED_IS_MODIFIED, wanted_rad)
    joints = list(wanted_rad)
    for _ in range(STEPS):
        tip, columns = _tip(ARM, TOOL_m, IS_MODIFIED, joints)
        gram = [[sum(c[i] * c[k] for c in columns) + DAMPING_m2 * (i == k) for k in range(3)] for i in range(3)]
        pull = _solved(gram, [a - b for a, b in zip(target, tip)])
        moved = [q + sum(a * b for a, b in zip(c, pull)) for q, c in zip(joints, columns)]
        joints = [min(max(q, w - FURTHEST_rad), w + FURTHEST_rad) for q, w in zip(moved, wanted_rad)]
    return [_encoder_rad(q, *error) for q, error in zip(joints, ENCODERS)]


def _encoder_rad(joint_rad, scale, amplitude_rad, phase_rad):
    """What the encoder says there: joint = (1 + scale) encoder + amplitude sin(encoder + phase)."""
    encoder_rad = joint_rad
    for _ in range(STEPS):
        encoder_rad = (joint_rad - amplitude_rad * sin(encoder_rad + phase_rad)) / (1.0 + scale)
    return encoder_rad


def _tip(rows, tool_m, is_modified, joints):
    """The tip [m] in the base frame, and how it moves with each joint [m/rad]."""
    x, y, z, origin = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
    angles, axes = iter(joints), []
    for turns, d, theta, length, alpha in rows:
        angle = theta + next(angles) if turns else theta
        if is_modified:
            y, z = _turned(y, z, alpha)
            origin = _moved(_moved(origin, x, length), z, d)
        if turns:
            axes.append((z, origin))
        x, y = _turned(x, y, angle)
        if not is_modified:
            origin = _moved(_moved(origin, z, d), x, length)
            y, z = _turned(y, z, alpha)
    for axis, by in zip((x, y, z), tool_m):
        origin = _moved(origin, axis, by)
    return origin, [_cross(axis, [a - b for a, b in zip(origin, place)]) for axis, place in axes]


def _turned(a, b, angle):
    """Two axes of a frame after a turn about the third."""
    c, s = cos(angle), sin(angle)
    return [c * p + s * q for p, q in zip(a, b)], [c * q - s * p for p, q in zip(a, b)]


def _moved(place, axis, by):
    return [p + by * a for p, a in zip(place, axis)]


def _cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _solved(m, right):
    """x of m x = right, for three unknowns."""
    adjugate = [_cross(m[1], m[2]), _cross(m[2], m[0]), _cross(m[0], m[1])]
    scale = 1.0 / sum(a * b for a, b in zip(m[0], adjugate[0]))
    return [scale * sum(adjugate[k][i] * right[k] for k in range(3)) for i in range(3)]
'''


def python_text(arm: Arm, published: Arm) -> str:
    """The file. CalibrationError if the two have other joints."""
    if arm.joint_count != published.joint_count:
        raise CalibrationError(
            f"arm {published.name} is another arm than {arm.name}: {published.joint_count} joints instead of {arm.joint_count}"
        )
    names = ", ".join(map(_plain, arm.joint_names))
    head = (
        f'"""Arm {_plain(arm.name)}: joint angles to command for those that a program plans with {_plain(published.name)}.\n\n'
        f'Written by armwright; needs Python alone. Lengths in m, angles in rad; joints from the base on: {names}.\n"""\n'
    )
    return head + CODE + "\n\n" + "\n".join(_values(arm, published)) + "\n"


def omitted(arm: Arm, published: Arm) -> tuple[str, ...]:
    """A sentence for what the file leaves out, and one where the two tips are two places on the last link."""
    others = [effect for effect in arm.effects if effect.effect not in CORRECTED]
    names = sorted({effect.effect for effect in others})
    sentences = [f"python corrects geometry, scale and eccentricity; not {', '.join(names)}"] if names else []
    if arm.maps:
        sentences.append("python has no maps: omitted")
    if arm.tool.position_m != published.tool.position_m:
        own, theirs = (", ".join(f"{1e3 * x:.1f}" for x in shown.tool.position_m) for shown in (arm, published))
        sentences.append(
            f"the tip is ({own}) mm from the last link's frame, and that of {published.name} ({theirs}) mm: the first is sent to"
            " where the second was planned; if the first is a board's place, write your tool back into [tool] before"
        )
    return tuple(sentences)


def _values(arm: Arm, published: Arm) -> Iterator[str]:
    for called, shown in (("PUBLISHED", published), ("ARM", arm)):
        yield f"{called} = [  # turns, d, theta, L, alpha"
        for link in shown.links:
            row = (link.joint == "revolute", link.d_m, link.theta_rad, link.L_m, link.alpha_rad)
            yield f"    {row!r},"
        yield "]"
    yield f"PUBLISHED_TOOL_m, TOOL_m = {published.tool.position_m!r}, {arm.tool.position_m!r}"
    yield f"PUBLISHED_IS_MODIFIED, IS_MODIFIED = {published.dh_convention == 'modified'}, {arm.dh_convention == 'modified'}"
    errors = {
        (effect.joint, key): value
        for effect in arm.effects
        if effect.effect in CORRECTED
        for key, value in effect.parameters.items()
    }
    yield "ENCODERS = [  # scale, amplitude, phase"
    for joint in range(1, arm.joint_count + 1):
        keys = ("scale", "amplitude_rad", "phase_rad")
        yield f"    {tuple(errors.get((joint, key), 0.0) for key in keys)!r},"
    yield "]"


def _plain(text: str) -> str:
    """A name within a docstring."""
    return "".join(c if c.isprintable() and c not in '"\\' else "_" for c in text)


# URDF: one link and one joint per DH row, the tip as a fixed frame (wiki.ros.org/urdf/XML).


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
    compiler = ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", fusestatic="false", discardvisual="false")
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


def _joint(root: ET.Element, name: str, kind: str, parent: str, child: str, xyz_m: Vector3, rpy_rad: Vector3) -> ET.Element:
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


# MJCF, MuJoCo's own format (mujoco.readthedocs.io, XML reference), with masses, friction, rotors and torque motors.


def mjcf_text(arm: Arm) -> str:
    """The arm as MJCF: a body per DH row, the tip as a body and a site."""
    bodies = bodies_of(arm)
    root = ET.Element("mujoco", model=safe(arm.name))
    bounds = mass_bounds(bodies)
    ET.SubElement(root, "compiler", {"angle": "radian", "autolimits": "true", "inertiafromgeom": "false"} | bounds)
    ET.SubElement(root, "option", gravity=numbers(arm.gravity_m_s2), integrator="implicitfast")
    base, tip = end_names(arm)
    place = ET.SubElement(ET.SubElement(root, "worldbody"), "body", name=base)
    for body, end in zip(bodies, ends_m(arm, bodies), strict=True):
        place = _add_body(place, arm, body, end)
    at, turned = numbers(tip_in_last(arm, bodies)), numbers(bodies[-1].body_T_dh.quaternion)
    end_of_it = ET.SubElement(place, "body", name=tip, pos=at, quat=turned)
    ET.SubElement(end_of_it, "site", name=tip, size="0.005")
    _add_motors(root, arm, {body.joint: body.joint_name for body in bodies})
    return document(root, about(arm))


def _add_body(parent: ET.Element, arm: Arm, body: ExportedLink, end_m: Vector3) -> ET.Element:
    at = body.parent_T_body
    here = ET.SubElement(parent, "body", name=body.name, pos=numbers(at.position_m), quat=numbers(at.quaternion))
    if body.has_inertia:
        ET.SubElement(
            here,
            "inertial",
            pos=numbers(body.com_m),
            quat=numbers(body.body_T_dh.quaternion),
            mass=repr(body.link.mass_kg),
            diaginertia=numbers(body.link.inertia_kg_m2 or ()),
        )
    if body.joint is not None:
        ET.SubElement(here, "joint", {"name": body.joint_name, "axis": "0 0 1"} | _mjcf_joint(joint_figures(arm, body.joint)))
    length = math.hypot(*end_m)
    if length > LEAST_LENGTH_m:
        shape = {"type": "capsule", "fromto": numbers((0.0, 0.0, 0.0, *end_m)), "contype": "0"}
        ET.SubElement(here, "geom", shape | {"conaffinity": "0", "size": repr(shape_radius_m(length))})
    return here


def _mjcf_joint(figures: DriveFigures) -> dict[str, str]:
    """MJCF joint attributes of a drive; values of 0 or infinity are omitted."""
    held = {"armature": figures.rotor_kg_m2, "damping": figures.viscous_Nm_s_rad, "frictionloss": figures.coulomb_Nm}
    attributes = {key: repr(value) for key, value in held.items() if value}
    if figures.is_limited:
        attributes["range"] = numbers((figures.lower_rad, figures.upper_rad))
    return attributes


def _add_motors(root: ET.Element, arm: Arm, joint_names: Mapping[int | None, str]) -> None:
    """Add a motor per drive; its control is the torque at the joint in N m."""
    if not arm.drives:
        return
    actuators = ET.SubElement(root, "actuator")
    for drive in arm.drives:
        torque = joint_figures(arm, drive.joint).torque_Nm
        ET.SubElement(
            actuators, "motor", name=f"motor{drive.joint}", joint=joint_names[drive.joint], ctrlrange=numbers((-torque, torque))
        )

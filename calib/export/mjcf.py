"""MJCF, MuJoCo's own format (mujoco.readthedocs.io, XML reference), with masses, friction, rotors and torque motors."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping

from calib.export.frames import (
    ExportedLink,
    about,
    bodies_of,
    document,
    end_names,
    ends_m,
    numbers,
    safe,
    tip_in_last,
)
from calib.export.losses import DriveFigures, joint_figures
from calib.export.urdf import LEAST_LENGTH_m, mass_bounds, shape_radius_m
from control.model.arm import Arm, Vector3


def mjcf_text(arm: Arm) -> str:
    """The arm as MJCF: a body per DH row, the tip as a body and a site."""
    bodies = bodies_of(arm)
    root = ET.Element("mujoco", model=safe(arm.name))
    bounds = mass_bounds(bodies)
    ET.SubElement(
        root, "compiler", {"angle": "radian", "autolimits": "true", "inertiafromgeom": "false"} | bounds
    )
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
    here = ET.SubElement(
        parent, "body", name=body.name, pos=numbers(at.position_m), quat=numbers(at.quaternion)
    )
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
        ET.SubElement(
            here,
            "joint",
            {"name": body.joint_name, "axis": "0 0 1"} | _joint(joint_figures(arm, body.joint)),
        )
    length = math.hypot(*end_m)
    if length > LEAST_LENGTH_m:
        shape = {"type": "capsule", "fromto": numbers((0.0, 0.0, 0.0, *end_m)), "contype": "0"}
        ET.SubElement(here, "geom", shape | {"conaffinity": "0", "size": repr(shape_radius_m(length))})
    return here


def _joint(figures: DriveFigures) -> dict[str, str]:
    """MJCF joint attributes of a drive; values of 0 or infinity are omitted."""
    held = {
        "armature": figures.rotor_kg_m2,
        "damping": figures.viscous_Nm_s_rad,
        "frictionloss": figures.coulomb_Nm,
    }
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
            actuators,
            "motor",
            name=f"motor{drive.joint}",
            joint=joint_names[drive.joint],
            ctrlrange=numbers((-torque, torque)),
        )

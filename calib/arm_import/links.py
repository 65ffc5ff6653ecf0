"""DH links, with masses, of a serial arm from another format; and a sentence for everything that a link cannot hold."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import numpy as np

from calib.arm_import.dh_rows import Row, dh_rows, frames_at_zero
from calib.arm_import.tree import Mass, SerialArm
from calib.arrays import Array
from control.model.arm import Convention, Effect, Link, Vector3
from control.model.rules import PART_NAME

WORTH_SAYING = 1e-3  # products of inertia over the largest moment


def arm_links(serial: SerialArm, convention: Convention) -> tuple[tuple[Link, ...], tuple[str, ...]]:
    """The links from base to tip, whose last frame is the tip's, and what is lost."""
    rows = dh_rows(serial.axes, serial.base_T_tip, convention)
    frames = frames_at_zero(rows, convention)
    is_known = any(mass is not None for mass in serial.masses)
    links: list[Link] = []
    notes = [] if is_known else ["the file has no masses: add them for everything with torques"]
    for row, frame in zip(rows, frames, strict=True):
        link = Link(_kind(row), _even(row.d_m), row.theta_rad, _even(row.L_m), row.alpha_rad)
        if row.joint is not None and is_known:
            mass = serial.masses[row.joint - 1]
            link = with_mass(link, mass, frame)
            notes += _lost(serial.joints[row.joint - 1].name, mass, frame)
        links.append(_named(link, row, serial))
    for end, name in ((0, serial.base), (-1, serial.tip)):
        if links[end].joint == "fixed" and name not in serial.links:
            links[end] = dataclasses.replace(links[end], link_name=_own(name))
    between = sum(row.joint is None for row in rows[1:-1])
    if between:
        notes.append(f"{between} fixed rows stand between joints whose axes are almost parallel")
    return tuple(links), (*notes, *_other_losses(serial))


def friction_effects(serial: SerialArm) -> tuple[Effect, ...]:
    """Damping and dry friction of the joints as effects of the model."""
    effects = []
    for number, joint in enumerate(serial.joints, start=1):
        if joint.coulomb_Nm > 0.0:
            effects.append(Effect("coulomb_friction", number, {"torque_Nm": joint.coulomb_Nm}))
        if joint.viscous_Nm_s_rad > 0.0:
            parameters = {"coefficient_Nm_s_rad": joint.viscous_Nm_s_rad}
            effects.append(Effect("viscous_friction", number, parameters))
    return tuple(effects)


def with_mass(link: Link, mass: Mass | None, frame: Array) -> Link:
    """A link with a body that is given in the base frame at zero; without one it weighs nothing."""
    if mass is None:
        nothing = (0.0, 0.0, 0.0)
        com, moments, kg = nothing, nothing, 0.0
    else:
        local = mass.seen_from(_inverse(frame))
        com, kg = _vector(local.com_m), _even(mass.mass_kg)
        moments = _vector(np.maximum(np.diag(local.inertia_kg_m2), 0.0))
    return dataclasses.replace(link, mass_kg=kg, com_m=com, inertia_kg_m2=moments)


def _named(link: Link, row: Row, serial: SerialArm) -> Link:
    """With the names of its joint and body, unless they are those that an export invents."""
    if row.joint is None:
        return link
    joint = serial.joints[row.joint - 1]
    return dataclasses.replace(link, joint_name=_own(joint.name), link_name=_own(serial.links[row.joint - 1]))


def _own(name: str) -> str:
    return name if PART_NAME.holds(name) else ""


def _kind(row: Row) -> Literal["revolute", "fixed"]:
    return "fixed" if row.joint is None else "revolute"


def _inverse(frame: Array) -> Array:
    return np.asarray(np.linalg.inv(frame), dtype=np.float64)


def _vector(values: Array) -> Vector3:
    x, y, z = (_even(float(v)) for v in values)
    return x, y, z


def _even(value: float) -> float:
    """Without the last bits of a sum: 0.3 for 0.30000000000000004."""
    return round(value, 14) + 0.0


def _lost(joint: str, mass: Mass | None, frame: Array) -> list[str]:
    if mass is None:
        return [f"{joint} carries no mass in the file: it weighs 0"]
    inertia = mass.seen_from(_inverse(frame)).inertia_kg_m2
    moments = np.diag(inertia)
    if moments.max() <= 0.0:
        return [f"{joint} carries a mass without inertia: its moments are 0"]
    products = np.abs(inertia - np.diag(moments)).max()
    if products <= WORTH_SAYING * moments.max():
        return []
    return [
        f"{joint}: products of inertia up to {products:.2g} kg m^2 ({100 * products / moments.max():.1f} % of the largest"
        " moment) are left out: a link has moments about its frame's axes only"
    ]


def _other_losses(serial: SerialArm) -> list[str]:
    bare = [joint.name for joint in serial.joints if joint.lacks_limits]
    notes = [f"joints without limits in the file: {', '.join(bare)}"] if bare else []
    free = [j.name for j in serial.joints if not j.lacks_limits and not math.isfinite(j.upper_rad)]
    if free:
        notes.append(f"joints that turn without end: {', '.join(free)}")
    return notes

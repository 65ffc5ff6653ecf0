"""A robot as other formats have it, a tree of links at joint angles zero; the serial arm in it, as DH links with masses, and a
sentence for everything that a link cannot hold.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from calib.arm_import.dh_rows import Axis, Row, dh_rows, frames_at_zero
from calib.arrays import Array
from calib.errors import ImportedModelError
from control.model.arm import Convention, Effect, Link, Vector3
from control.model.rules import PART_NAME

Kind = Literal["revolute", "prismatic", "fixed", "other"]
MOVING: Final = ("revolute", "prismatic", "other")


@dataclass(frozen=True, slots=True)
class TreeJoint:
    """What moves a link: axis and a point on it in the link's own frame at zero; limits are infinite where none are given.

    `kind` "other" has more than one degree of freedom; `word` is the file's own for it. `follows` names the joint that it mimics.
    """

    name: str
    kind: Kind
    word: str
    axis: Array
    anchor_m: Array
    lower_rad: float = -math.inf
    upper_rad: float = math.inf
    torque_Nm: float = math.inf
    speed_rad_s: float = math.inf
    viscous_Nm_s_rad: float = 0.0
    coulomb_Nm: float = 0.0
    rotor_kg_m2: float = 0.0
    follows: str = ""
    lacks_limits: bool = False  # the format wants limits here, and the file has none
    where: str = ""  # in the file, for messages


@dataclass(frozen=True, slots=True)
class Mass:
    """A rigid body: mass, centre, and inertia (3, 3) about the centre, in some frame; `where` in its file, for messages."""

    mass_kg: float
    com_m: Array
    inertia_kg_m2: Array
    where: str = ""

    def seen_from(self, frame: Array) -> Mass:
        """The same body in a frame in which its own is `frame` (4, 4)."""
        turn = frame[:3, :3]
        com = turn @ self.com_m + frame[:3, 3]
        return replace(self, com_m=com, inertia_kg_m2=turn @ self.inertia_kg_m2 @ turn.T)


@dataclass(frozen=True, slots=True)
class TreeLink:
    """A body: its parent's name ("" for the root), its pose in the parent's frame, what moves it, its mass."""

    name: str
    parent: str
    parent_T_link: Array
    joint: TreeJoint | None
    mass: Mass | None


@dataclass(frozen=True, slots=True)
class Tree:
    """A robot: its links by name, parents before children; gravity in the root's frame; sentences about what was read."""

    name: str
    file: str
    links: dict[str, TreeLink]
    gravity_m_s2: tuple[float, float, float]
    notes: tuple[str, ...] = ()

    def base_T_links(self) -> dict[str, Array]:
        """Pose of every link in the root's frame at joint angles zero."""
        poses: dict[str, Array] = {}
        for link in self.links.values():
            above = poses[link.parent] if link.parent else np.eye(4)
            poses[link.name] = above @ link.parent_T_link
        return poses

    def path_to(self, name: str) -> list[TreeLink]:
        """The links from the root to one, both included."""
        path = [self.links[name]]
        while path[-1].parent:
            path.append(self.links[path[-1].parent])
        return path[::-1]


def possible_inertia(inertia_kg_m2: Array) -> Array:
    """The nearest inertia (3, 3) that a body can have: one whose mass nowhere lies at an imaginary distance.

    J = tr(S) 1 - S with the second moments S = sum m r r', which have no negative eigenvalue; negative ones are made zero.
    """
    second = 0.5 * np.trace(inertia_kg_m2) * np.eye(3) - inertia_kg_m2
    values, vectors = np.linalg.eigh(second)
    second = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(np.trace(second) * np.eye(3) - second)


def together(masses: list[Mass]) -> Mass | None:
    """Several bodies of one frame as one; None if none weighs anything."""
    total = sum(mass.mass_kg for mass in masses)
    if total <= 0.0:
        return None
    com = sum((m.mass_kg * m.com_m for m in masses), np.zeros(3)) / total
    inertia = np.zeros((3, 3))
    for body in masses:
        r = body.com_m - com
        inertia += body.inertia_kg_m2 + body.mass_kg * (float(r @ r) * np.eye(3) - np.outer(r, r))
    return Mass(total, com, inertia, max(masses, key=lambda body: body.mass_kg).where)


@dataclass(frozen=True, slots=True)
class SerialArm:
    """Joints from base to tip in the base link's frame at zero: axes, what they are, what each carries up to the next."""

    joints: tuple[TreeJoint, ...]
    links: tuple[str, ...]  # which each joint moves
    axes: tuple[Axis, ...]
    masses: tuple[Mass | None, ...]
    base_T_tip: Array
    base: str
    tip: str
    gravity_m_s2: tuple[float, float, float]
    notes: tuple[str, ...]


def serial_arm(tree: Tree, base: str | None = None, tip: str | None = None) -> SerialArm:
    """The arm from link `base` (the root if None) to link `tip` (the only end if None).

    Raises:
        ImportedModelError: several ends, a joint that does not turn, no joint.
    """
    base = _named(tree, base, "--base") if base else next(iter(tree.links))
    tip = _named(tree, tip, "--tip") if tip else _only_end(tree, base)
    path = tree.path_to(tip)
    names = [link.name for link in path]
    if base not in names:
        raise ImportedModelError(f"{tree.file}: link {tip} is not behind link {base}")
    path = path[names.index(base) + 1 :]
    turning = [link for link in path if link.joint is not None and link.joint.kind != "fixed"]
    _require_serial(tree, turning, base, tip)
    poses = tree.base_T_links()
    from_base = np.linalg.inv(poses[base])
    seen = {name: from_base @ pose for name, pose in poses.items()}
    masses, notes = _carried(tree, seen, base, turning)
    gravity = from_base[:3, :3] @ np.array(tree.gravity_m_s2)
    joints = tuple(link.joint for link in turning if link.joint is not None)
    return SerialArm(
        joints=joints,
        links=tuple(link.name for link in turning),
        axes=tuple(_axis(seen[link.name], joint) for link, joint in zip(turning, joints, strict=True)),
        masses=masses,
        base_T_tip=seen[tip],
        base=base,
        tip=tip,
        gravity_m_s2=(float(gravity[0]), float(gravity[1]), float(gravity[2])),
        notes=(*tree.notes, *notes),
    )


def _named(tree: Tree, name: str, option: str) -> str:
    if name in tree.links:
        return name
    raise ImportedModelError(f"{tree.file}: {option}: expected one of {', '.join(tree.links)}, got {name}")


def _only_end(tree: Tree, base: str) -> str:
    """The end of the arm; of several, an error that lists them with the joints that move them."""
    parents = {link.parent for link in tree.links.values()}
    ends = [name for name in tree.links if name not in parents and base in (link.name for link in tree.path_to(name))]
    if len(ends) == 1:
        return ends[0]
    moved = {end: sum(_moves(link) for link in tree.path_to(end)) for end in ends}
    listed = ", ".join(f"{end} ({count} joints)" for end, count in moved.items())
    raise ImportedModelError(f"{tree.file}: the tree has {len(ends)} ends: {listed}; name the arm's with --tip LINK")


def _moves(link: TreeLink) -> bool:
    return link.joint is not None and link.joint.kind in MOVING


def _require_serial(tree: Tree, turning: Sequence[TreeLink], base: str, tip: str) -> None:
    for link in turning:
        joint = link.joint
        if joint is None:
            continue
        if joint.follows:
            raise ImportedModelError(
                f"{tree.file}: joint {joint.name} follows joint {joint.follows} (mimic): an arm of armwright has a motor at"
                " every joint; end the arm before it with --tip LINK"
            )
        if joint.kind != "revolute":
            raise ImportedModelError(
                f"{tree.file}: joint {joint.name} is {joint.word}: an arm of armwright has revolute joints only; begin"
                " behind it with --base LINK, end before it with --tip LINK, or make it fixed"
            )
    if not turning:
        raise ImportedModelError(f"{tree.file}: no joint turns between link {base} and link {tip}")


def _axis(pose: Array, joint: TreeJoint) -> Axis:
    return Axis(pose[:3, :3] @ joint.anchor_m + pose[:3, 3], pose[:3, :3] @ joint.axis)


def _carried(
    tree: Tree, seen: dict[str, Array], base: str, turning: Sequence[TreeLink]
) -> tuple[tuple[Mass | None, ...], list[str]]:
    """The mass that moves with each joint: its link and all that hangs on it, side branches at their zero."""
    order = {link.name: number for number, link in enumerate(turning)}
    owner: dict[str, int] = {}
    side: list[str] = []
    for link in tree.links.values():
        owner[link.name] = order.get(link.name, owner.get(link.parent, -1))
        if link.name not in order and _moves(link) and owner[link.name] >= 0 and link.joint is not None:
            side.append(link.joint.name)
    masses: list[list[Mass]] = [[] for _ in turning]
    for name, number in owner.items():
        mass = tree.links[name].mass
        if number >= 0 and mass is not None:
            masses[number].append(mass.seen_from(seen[name]))
    notes = []
    if side:
        notes.append(f"joints beside the arm ({', '.join(side)}) were taken as fixed at their zero; their masses count")
    return tuple(together(group) for group in masses), notes


WORTH_SAYING = 1e-3  # products of inertia over the largest moment


def arm_links(serial: SerialArm, convention: Convention) -> tuple[tuple[Link, ...], tuple[str, ...]]:
    """The links from base to tip, whose last frame is the tip's, and what is lost."""
    rows = dh_rows(serial.axes, serial.base_T_tip, convention)
    frames = frames_at_zero(rows, convention)
    is_known = any(mass is not None for mass in serial.masses)
    links: list[Link] = []
    notes = [] if is_known else ["the file has no masses: add them for everything with torques"]
    for row, frame in zip(rows, frames, strict=True):
        link = Link("fixed" if row.joint is None else "revolute", _even(row.d_m), row.theta_rad, _even(row.L_m), row.alpha_rad)
        if row.joint is not None and is_known:
            mass = serial.masses[row.joint - 1]
            link = with_mass(link, mass, frame)
            notes += _lost(serial.joints[row.joint - 1].name, mass, frame)
        links.append(_with_names(link, row, serial))
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


def _with_names(link: Link, row: Row, serial: SerialArm) -> Link:
    """With the names of its joint and body, unless they are those that an export invents."""
    if row.joint is None:
        return link
    joint = serial.joints[row.joint - 1]
    return dataclasses.replace(link, joint_name=_own(joint.name), link_name=_own(serial.links[row.joint - 1]))


def _own(name: str) -> str:
    return name if PART_NAME.holds(name) else ""


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

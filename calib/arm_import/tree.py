"""A robot as other formats have it: links in a tree, joints between them, all at joint angles zero."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from calib.arrays import Array

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

    def children(self, name: str) -> list[TreeLink]:
        """The links directly behind one."""
        return [link for link in self.links.values() if link.parent == name]

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
    for one in masses:
        r = one.com_m - com
        inertia += one.inertia_kg_m2 + one.mass_kg * (float(r @ r) * np.eye(3) - np.outer(r, r))
    return Mass(total, com, inertia, max(masses, key=lambda one: one.mass_kg).where)

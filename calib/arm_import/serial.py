"""The serial arm in a tree: which links lie between base and tip, its axes, and what each joint carries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_import.dh_rows import Axis
from calib.arm_import.tree import MOVING, Mass, Tree, TreeJoint, TreeLink, together
from calib.arrays import Array
from calib.errors import ImportedModelError


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
    ends = [
        name
        for name in tree.links
        if name not in parents and base in (link.name for link in tree.path_to(name))
    ]
    if len(ends) == 1:
        return ends[0]
    moved = {end: sum(_moves(link) for link in tree.path_to(end)) for end in ends}
    listed = ", ".join(f"{end} ({count} joints)" for end, count in moved.items())
    raise ImportedModelError(
        f"{tree.file}: the tree has {len(ends)} ends: {listed}; name the arm's with --tip LINK"
    )


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
        notes.append(
            f"joints beside the arm ({', '.join(side)}) were taken as fixed at their zero; their masses count"
        )
    return tuple(together(group) for group in masses), notes

"""Static poses that tell effects apart: long travel of every joint, one joint alone, gravity both ways, and spread in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.design.candidates import joint_box, spread_poses
from calib.gap.plan.collision_free_box import CollisionFreeBox, clear
from control.dynamics.static_pose import gravity_Nm
from control.errors import MissingModel
from control.model.arm import Arm

APPROACH_rad = 0.03  # of every joint before it stops: several times the play and the windup of a sound gear
SPREAD_FROM = 400  # poses that the rarer pull of gravity is looked for among
OUTSIDE_FROM = 3000
WAY_STEPS = 25


@dataclass(frozen=True, slots=True)
class PoseCounts:
    """How many poses of each kind: levels of each joint alone, spread over the room, outside of it, with the rarer pull."""

    levels: int = 4
    spread: int = 16
    outside: int = 8
    pulled: int = 2


@dataclass(frozen=True, slots=True)
class NamedPose:
    """A pose by name; `via_rad`: where to come from and go back to where the straight way is not clear."""

    name: str
    q_rad: tuple[float, ...]
    via_rad: tuple[float, ...] | None = None


def static_poses(arm: Arm, room: CollisionFreeBox, extent: PoseCounts) -> tuple[NamedPose, ...]:
    """All poses; the approach to each stays inside the joints' ranges and clear."""
    inner = room.inset(APPROACH_rad)
    found = _alone(inner, extent.levels)
    found += [
        ("s", q) for q in spread_poses((inner.lower_rad, inner.upper_rad), extent.spread, edge_share=0.3)
    ]
    found += [("g", q) for q in _pulled(arm, inner, extent.pulled)]
    numbered = [NamedPose(f"{kind}{k + 1}", _plain(q)) for k, (kind, q) in enumerate(found)]
    via = _plain(room.middle_rad)
    outside = _outside(arm, room, extent.outside)
    return (*numbered, *(NamedPose(f"o{k + 1}", _plain(q), via) for k, q in enumerate(outside)))


def _alone(inner: CollisionFreeBox, levels: int) -> list[tuple[str, Array]]:
    """Each joint through its travel while the others stand in the middle: also joint 2 while motor 3 stands."""
    found = []
    for j in range(len(inner.lower_rad)):
        for share in np.linspace(0.0, 1.0, levels):
            q = inner.middle_rad.copy()
            q[j] = inner.lower_rad[j] + share * inner.width_rad[j]
            found.append(("a", q))
    return found


def _pulled(arm: Arm, inner: CollisionFreeBox, count: int) -> list[Array]:
    """For every joint that gravity pulls both ways, poses with the strongest of the rarer pull."""
    poses = spread_poses((inner.lower_rad, inner.upper_rad), SPREAD_FROM, edge_share=0.3)
    try:
        pull = gravity_Nm(arm, poses)
    except MissingModel:
        return []
    found = []
    for j in range(poses.shape[1]):
        rarer = -1.0 if (pull[:, j] > 0.0).mean() > 0.5 else 1.0
        strongest = np.argsort(-rarer * pull[:, j])
        found += [poses[k] for k in strongest[:count] if rarer * pull[k, j] > 0.02]
    return found


def _outside(arm: Arm, room: CollisionFreeBox, count: int) -> list[Array]:
    """Poses beyond the room, far from each other, with a clear straight way from its middle, and room to approach."""
    lower, upper = joint_box(arm)
    poses = spread_poses((lower + APPROACH_rad, upper - APPROACH_rad), OUTSIDE_FROM)
    beyond = ~((poses >= room.lower_rad) & (poses <= room.upper_rad)).all(axis=1)
    poses = poses[beyond & clear(arm, poses)]
    if not count or not len(poses):
        return []
    poses = poses[:: max(1, len(poses) // 300)]
    poses = poses[[_is_way_clear(arm, room.middle_rad, q) for q in poses]]
    return _far_apart(poses, (poses - room.middle_rad) / (upper - lower), count)


def _is_way_clear(arm: Arm, start: Array, end: Array) -> bool:
    """Whether the straight joint move, and the approach from either side of its end, are clear."""
    way = start + np.linspace(0.0, 1.0, WAY_STEPS)[:, None] * (end - start)
    corners = end + APPROACH_rad * np.array(np.meshgrid(*[(-1.0, 1.0)] * len(end))).reshape(len(end), -1).T
    return bool(clear(arm, np.concatenate((way, corners))).all())


def _far_apart(poses: Array, places: Array, count: int) -> list[Array]:
    """Each next one the farthest from the room's middle and from those that are chosen."""
    if not len(poses):
        return []
    distance = np.linalg.norm(places, axis=1)
    found = []
    for _ in range(min(count, len(poses))):
        k = int(np.argmax(distance))
        found.append(poses[k])
        distance = np.minimum(distance, np.linalg.norm(places - places[k], axis=1))
    return found


def _plain(q: Array) -> tuple[float, ...]:
    return tuple(round(float(x), 6) for x in q)

"""The whole recording as a list of steps in the order in which they are taken, with the time that they need.

Poses come in blocks, each over the whole room in a shuffled order, with a reference pose again and again between them, so that
what changes with time is not taken for what changes with the pose. Each pose is approached from two opposite sides. A block is a
setup of its own: the workflow keeps one side of each block apart for its report. What needs another load comes last, so that it
is hung once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.design.candidates import joint_box, spread_poses
from calib.errors import CalibrationError
from calib.gap.plan.motions import (
    CollisionFreeBox,
    MotionLimits,
    clear,
    collision_free_box,
    demand,
    multisine,
    poses_of,
    ramps,
    shake,
)
from calib.points.points import FREE
from control.dynamics.static_pose import gravity_Nm
from control.errors import MissingModel
from control.model.arm import Arm
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.joint_path import JointPath

APPROACH_rad = 0.03  # of every joint before it stops: several times the play and the windup of a sound gear
SPREAD_FROM = 400  # poses that the rarer pull of gravity is looked for among
OUTSIDE_FROM = 3000
WAY_STEPS = 25


@dataclass(frozen=True, slots=True)
class PlanExtent:
    """How many poses of each kind: levels of each joint alone, spread over the room, outside of it, with the rarer pull; how long
    a run is, and how many there are to spare.
    """

    levels: int = 4
    spread: int = 16
    outside: int = 8
    pulled: int = 2
    run_s: float = 8.0
    spare: int = 2


@dataclass(frozen=True, slots=True)
class NamedPose:
    """A pose by name; `via_rad`: where to come from and go back to where the straight way is not clear."""

    name: str
    q_rad: tuple[float, ...]
    via_rad: tuple[float, ...] | None = None


def static_poses(arm: Arm, room: CollisionFreeBox, extent: PlanExtent) -> tuple[NamedPose, ...]:
    """All poses; the approach to each stays inside the joints' ranges and clear."""
    inner = room.inset(APPROACH_rad)
    by_kind = _alone(inner, extent.levels)
    by_kind += [("s", q) for q in spread_poses((inner.lower_rad, inner.upper_rad), extent.spread, edge_share=0.3)]
    by_kind += [("g", q) for q in _pulled(arm, inner, extent.pulled)]
    numbered = [NamedPose(f"{kind}{k + 1}", _plain(q)) for k, (kind, q) in enumerate(by_kind)]
    via = _plain(room.middle_rad)
    outside = _outside(arm, room, extent.outside)
    return (*numbered, *(NamedPose(f"o{k + 1}", _plain(q), via) for k, q in enumerate(outside)))


def _alone(inner: CollisionFreeBox, levels: int) -> list[tuple[str, Array]]:
    """Each joint through its travel while the others stand in the middle: also joint 2 while motor 3 stands."""
    poses = []
    for j in range(len(inner.lower_rad)):
        for share in np.linspace(0.0, 1.0, levels):
            q = inner.middle_rad.copy()
            q[j] = inner.lower_rad[j] + share * inner.width_rad[j]
            poses.append(("a", q))
    return poses


def _pulled(arm: Arm, inner: CollisionFreeBox, count: int) -> list[Array]:
    """For every joint that gravity pulls both ways, poses with the strongest of the rarer pull."""
    poses = spread_poses((inner.lower_rad, inner.upper_rad), SPREAD_FROM, edge_share=0.3)
    try:
        pull = gravity_Nm(arm, poses)
    except MissingModel:
        return []
    chosen = []
    for j in range(poses.shape[1]):
        rarer = -1.0 if (pull[:, j] > 0.0).mean() > 0.5 else 1.0
        strongest = np.argsort(-rarer * pull[:, j])
        chosen += [poses[k] for k in strongest[:count] if rarer * pull[k, j] > 0.02]
    return chosen


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
    chosen = []
    for _ in range(min(count, len(poses))):
        k = int(np.argmax(distance))
        chosen.append(poses[k])
        distance = np.minimum(distance, np.linalg.norm(places - places[k], axis=1))
    return chosen


def _plain(q: Array) -> tuple[float, ...]:
    return tuple(round(float(x), 6) for x in q)


REFERENCE = "ref"
BLOCK = 7  # poses of a block, about
GENTLE = 0.15  # of the joints' limits, for the last way: a link that swings as it stops rests on any flank, wound up anyhow
SETTLE_s, AVERAGE_s = 0.3, 0.3  # after a move; 30 camera frames
SHARE_LOADED = 0.4  # of the poses that are taken again with the load
MARGIN_rad = 0.02  # of the room that a controller's error may use
SEED = 0  # of the shuffling: the same plan every time, so that a recording can go on


@dataclass(frozen=True, slots=True)
class PlannedVisit:
    """A static pose, approached by all joints with these signs; `via_rad`: where to come from and go back to."""

    point: str
    repeat: int
    q_rad: tuple[float, ...]
    direction: tuple[int, ...]
    payload_kg: float
    via_rad: tuple[float, ...] | None = None
    setup: str = FREE

    @property
    def start_rad(self) -> tuple[float, ...]:
        """Where its approach begins."""
        return tuple(q - APPROACH_rad * d for q, d in zip(self.q_rad, self.direction, strict=True))


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """A motion from rest; `name` is that of its run in log.csv."""

    name: str
    kind: str
    path: JointPath
    payload_kg: float


Step = PlannedVisit | PlannedRun


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """What is asked for: poses, motions or both, how long, and with which load (0: none)."""

    has_poses: bool = True
    has_motions: bool = True
    payload_kg: float = 0.0
    is_quick: bool = False
    minutes: float | None = None


@dataclass(frozen=True, slots=True)
class RecordingPlan:
    """Steps in order, the room that they stay in, and the time that the arm needs for them."""

    room: CollisionFreeBox
    steps: tuple[Step, ...]
    duration_s: float

    @property
    def visits(self) -> tuple[PlannedVisit, ...]:
        """The static poses."""
        return tuple(step for step in self.steps if isinstance(step, PlannedVisit))

    @property
    def runs(self) -> tuple[PlannedRun, ...]:
        """The motions."""
        return tuple(step for step in self.steps if isinstance(step, PlannedRun))


def recording_plan(arm: Arm, request: PlanRequest, speed: float = 1.0) -> RecordingPlan:
    """Plan it; CalibrationError or ArmError where the arm has no room, or the time does not do. Nothing moves.

    `speed`: of the joints' limits, for moves between poses.
    """
    room = collision_free_box(arm)
    steps = _steps(arm, room, request, QUICK if request.is_quick else FULL)
    plan = RecordingPlan(room, steps, _duration_s(arm, steps, speed))
    if request.minutes is not None:
        plan = _of_length(arm, request, plan, speed)
    _require_clear(arm, plan)
    return plan


def plan_of(arm: Arm, room: CollisionFreeBox, steps: Sequence[Step], speed: float = 1.0) -> RecordingPlan:
    """These steps as a plan. CalibrationError where they leave the joints' ranges, or come near the floor."""
    plan = RecordingPlan(room, tuple(steps), _duration_s(arm, steps, speed))
    _require_clear(arm, plan)
    return plan


FULL = PlanExtent()
QUICK = PlanExtent(levels=2, spread=8, outside=3, pulled=1, run_s=6.0, spare=1)
LEAST = PlanExtent(levels=2, spread=2, outside=0, pulled=1)


def _of_length(arm: Arm, request: PlanRequest, plan: RecordingPlan, speed: float) -> RecordingPlan:
    """More or fewer poses and runs, until the time is used. CalibrationError where the least takes longer."""
    wanted_s = 60.0 * (request.minutes or 0.0)
    best = None
    for spread in (2, 4, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256):
        usual = LEAST if spread < 8 else QUICK if spread < 16 else FULL
        run_s = (QUICK if request.is_quick else FULL).run_s
        extent = dataclasses.replace(usual, spread=spread, run_s=run_s, spare=spread // 8)
        steps = _steps(arm, plan.room, request, extent)
        length_s = _duration_s(arm, steps, speed)
        if length_s > wanted_s:
            if best is None:
                raise CalibrationError(
                    f"--minutes {request.minutes:g}: the shortest useful recording takes {length_s / 60.0:.1f} minutes"
                )
            break
        best = RecordingPlan(plan.room, steps, length_s)
        if not request.has_poses and spread >= 32:
            break
    return best or plan


def _steps(arm: Arm, room: CollisionFreeBox, request: PlanRequest, extent: PlanExtent) -> tuple[Step, ...]:
    empty: list[Step] = []
    loaded: list[Step] = []
    if request.has_poses:
        poses = static_poses(arm, room.inset(MARGIN_rad), extent)
        draw = np.random.default_rng(SEED)
        blocks = _blocks(poses, draw)
        shuffled = [poses[k] for k in draw.permutation(len(poses)).tolist()]
        loaded_poses = shuffled[: round(SHARE_LOADED * len(poses))] if request.payload_kg > 0.0 else []
        for number, block in enumerate(blocks):
            empty += _visits(block, room, 0.0, number)
        for number, block in enumerate(_blocks(loaded_poses, draw), start=len(blocks)):
            loaded += _visits(block, room, request.payload_kg, number)
    if request.has_motions:
        runs = list(_runs(arm, room.inset(MARGIN_rad), request.payload_kg, extent))
        empty += [run for run in runs if not run.payload_kg]
        loaded += [run for run in runs if run.payload_kg]
    return (*empty, *loaded)


def _blocks(poses: Sequence[NamedPose], draw: np.random.Generator) -> list[list[NamedPose]]:
    """Every kind of pose dealt round the blocks, and each block shuffled."""
    count = min(len(poses), max(1, round(len(poses) / BLOCK)))
    blocks: list[list[NamedPose]] = [[] for _ in range(count)]
    shuffled = [poses[k] for k in draw.permutation(len(poses)).tolist()]
    for k, pose in enumerate(sorted(shuffled, key=lambda pose: pose.name[0])):
        blocks[k % count].append(pose)
    return [[block[k] for k in draw.permutation(len(block)).tolist()] for block in blocks]


def _visits(poses: Sequence[NamedPose], room: CollisionFreeBox, payload_kg: float, number: int) -> Iterator[PlannedVisit]:
    """A block: every pose from two opposite sides, every other one from the other pair of sides; the reference in between.

    The reference comes from all four sides first. In which order is another in each block, so that each side is held out for
    the report in some block: what is held out is what comes from the side that came last.
    """
    reference = NamedPose(REFERENCE, tuple(round(float(q), 6) for q in room.middle_rad))
    sides = _sides(len(room.lower_rad), number)
    setup = f"{FREE}{number + 1}" if number else FREE
    order = [(reference, side) for side in sides]
    for k, pose in enumerate(poses):
        if k == len(poses) // 2:
            order += [(reference, side) for side in sides[1::2]]
        order += [(pose, side) for side in sides[k % 2 :: 2]]
    order += [(reference, side) for side in sides[::2]]
    visits: dict[str, int] = {}
    for pose, side in order:
        visits[pose.name] = visits.get(pose.name, 0) + 1
        yield PlannedVisit(pose.name, visits[pose.name], pose.q_rad, side, payload_kg, pose.via_rad, setup)


def _sides(n: int, number: int) -> tuple[tuple[int, ...], ...]:
    """Straight, crossed, and each of them the other way; begun otherwise in each of four blocks."""
    straight = (1,) * n
    crossed = tuple(1 if j % 2 == 0 else -1 for j in range(n))
    first, second = (straight, crossed) if number % 2 == 0 else (crossed, straight)
    sides = (first, second, *(tuple(-s for s in side) for side in (first, second)))
    return sides if number % 4 in (0, 3) else (*sides[2:], *sides[:2])


def _runs(arm: Arm, room: CollisionFreeBox, payload_kg: float, extent: PlanExtent) -> Iterator[PlannedRun]:
    """Several kinds of motion, each at its own speed; some twice, for the noise; some with the load."""
    limits, run_s, spare = MotionLimits.of(arm), extent.run_s, extent.spare
    leg_s = run_s / 10.0
    quick = ramps(room, limits, (0.06, 0.12, 0.25, 0.5), leg_s)
    slow = ramps(room, limits, (0.015, 0.03), 2.0 * leg_s)
    swings = [multisine(room, limits, (0.15, 1.2), 0.6, run_s, k) for k in range(2 + spare)]
    wide = multisine(room, limits, (0.12, 0.3), 1.0, run_s, 2)
    todo: list[tuple[str, JointPath, float]] = [
        ("ramps", quick, 0.0),
        ("slow ramps", slow, 0.0),
        ("swing", swings[0], 0.0),
        ("fast", multisine(room, limits, (0.3, 1.6), 0.95, run_s, 1), 0.0),
        ("shake", shake(room, limits, (2.0, 9.0), run_s, 1), 0.0),
        ("wide", wide, 0.0),
        ("ramps", quick, 0.0),
        *(("swing", path, 0.0) for path in swings[1:-1]),
        ("swing", swings[0], 0.0),
    ]
    if spare > 1:
        # another place, where gravity pulls otherwise
        aside = [0.3 if j % 2 else 0.7 for j in range(len(room.lower_rad))]
        todo.insert(5, ("slow ramps", ramps(room, limits, (0.015, 0.03), 2.0 * leg_s, aside), 0.0))
    load = payload_kg if payload_kg > 0.0 else 0.0
    if load:
        todo += [("swing", swings[-1], load), ("wide", wide, load)]
        if spare > 1:
            todo.append(("ramps", quick, load))
    else:
        todo.append(("swing", swings[-1], 0.0))
    for number, (kind, path, mass) in enumerate(todo, start=1):
        yield PlannedRun(f"{number}", kind, path, mass)


def _duration_s(arm: Arm, steps: Sequence[Step], speed: float) -> float:
    """What the arm needs, without hanging loads."""
    limits = JointLimits.of(arm)
    quick, gentle = limits.scaled(speed), limits.scaled(GENTLE * speed)
    here = arm.rest.q_rad if arm.rest is not None else steps[0].q_rad if isinstance(steps[0], PlannedVisit) else None
    total_s = 0.0
    for step in steps:
        if isinstance(step, PlannedRun):
            start = step.path.knots[0].q_rad
            total_s += (JointMove(here, start, quick).duration_s if here else 0.0) + step.path.duration_s + SETTLE_s
            here = step.path.knots[-1].q_rad
            continue
        stops = [step.via_rad, step.start_rad] if step.via_rad else [step.start_rad]
        for stop in stops:
            total_s += JointMove(here, stop, quick).duration_s if here else 0.0
            here = stop
        total_s += JointMove(step.start_rad, step.q_rad, gentle).duration_s + SETTLE_s + AVERAGE_s
        here = step.q_rad
    return total_s


def _require_clear(arm: Arm, plan: RecordingPlan) -> None:
    """Everything that the arm will go through, looked at once more as a whole, before anything moves."""
    limits = MotionLimits.of(arm)
    for run in plan.runs:
        if not plan.room.holds(poses_of(run.path)) or demand(run.path, limits) > 1.0:
            raise CalibrationError(
                f"run {run.name} ({run.kind}) leaves the collision-free box or exceeds a limit; nothing was moved"
            )
    visits = [np.array((visit.start_rad, visit.q_rad)) for visit in plan.visits]
    if not visits:
        return
    poses = np.concatenate(visits)
    lower, upper = np.array(arm.limits_rad).T
    is_inside = ((poses >= lower) & (poses <= upper)).all()
    if not is_inside or not clear(arm, poses).all():
        raise CalibrationError("a planned pose leaves the joints' ranges or comes near the floor; nothing was moved")

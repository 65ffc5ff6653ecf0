"""Which poses to take next: candidates, choice, what each brings, and what else would bring how much."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from calib.design.boards import OTHER_TILTS, PlacedBoard, placed_boards, usual_setups
from calib.design.candidates import (
    FREE,
    View,
    free_candidates,
    joined,
    named,
    table_candidates,
    workspace_poses,
)
from calib.design.criteria import criterion_of
from calib.design.exchange import Group, select
from calib.design.information import Experiment, Standing, experiment_of, standing
from calib.design.order import clear_ways, visiting_order
from calib.design.reach import Rows
from calib.errors import CalibrationError
from calib.identify.assembly import Choice
from calib.points import Points
from control.model.arm import Arm
from control.model.table import SETUPS

WORKSPACE_POSES_COUNT = 400
ALTERNATIVE_COUNT = 12  # poses that alternatives are compared by
USUAL_COUNT = 12


@dataclass(frozen=True, slots=True)
class Request:
    """What is wanted: `count` poses, `free_count` of them free poses (None: as the criterion chooses).

    setups: those to plan in (None: the table's own); only: nothing but free poses, or nothing but the table's; noise_m:
    standard deviation of a coordinate of the tip (None: the camera's); view: the box that the camera sees (None: all).
    """

    count: int = USUAL_COUNT
    free_count: int | None = None
    setups: tuple[str, ...] | None = None
    only: Literal["free", "table"] | None = None
    criterion: str = "D"
    noise_m: float | None = None
    view: View | None = None


@dataclass(frozen=True, slots=True)
class PlannedPose:
    """One pose of the plan: q_rad is where the nominal arm would have its joints; `visit` from 1.

    gain: by how much it raises log det when taken after those before it in the plan; `after`: what is known then.
    """

    setup: str
    point: str
    repeat: int
    q_rad: tuple[float, ...]
    visit: int
    gain: float
    after: Standing


@dataclass(frozen=True, slots=True)
class Alternative:
    """What the best `count` poses of one kind alone would bring: cavities of one setup, or free poses."""

    setup: str
    count: int
    gain: float
    after: Standing


@dataclass(frozen=True, slots=True)
class Plan:
    """What to take next. `poses` in the order of their worth, `points` in that of the visit."""

    criterion: str
    noise_m: float
    poses: tuple[PlannedPose, ...]
    points: Points
    before: Standing
    alternatives: tuple[Alternative, ...]
    candidates: Mapping[str, int]
    combinations_count: int
    is_tied: bool
    blocked: tuple[tuple[str, str], ...]

    @property
    def after(self) -> Standing:
        """What is known with the whole plan."""
        return self.poses[-1].after


@dataclass(frozen=True, slots=True)
class _Field:
    """All poses as one experiment: those taken first, then the candidates by setup."""

    experiment: Experiment
    poses: Points
    taken: Rows
    by_setup: dict[str, Rows] = field(default_factory=dict)


def plan_poses(arm: Arm, taken: Points | None, request: Request, choice: Choice | None = None) -> Plan:
    """The poses to take next, and what they bring.

    `choice` as the identification will have it: what is fixed and freed, bounds, measured boards. CalibrationError for
    a request that cannot be met.
    """
    wanted = choice or Choice()
    criterion = criterion_of(request.criterion)
    noise_m = _noise_m(arm, request)
    setups = _setups(arm, taken, request, wanted)
    boards = placed_boards(arm, setups, taken, wanted.boards)
    others = _other_tilts(arm, setups, request)
    field = _field_of(arm, taken, request, wanted, {**boards, **others}, noise_m)
    chosen = select(field.experiment, criterion, field.taken, _groups(field, setups, request))
    alternatives = tuple(
        _alternative(field, request.criterion, setup)
        for setup in field.by_setup
        if len(field.by_setup[setup])
    )
    order = visiting_order(arm, field.poses.chosen(chosen), setups, boards.values())
    points = named(field.poses.chosen([chosen[k] for k in order]), taken)
    return Plan(
        criterion=request.criterion,
        noise_m=noise_m,
        poses=_planned_poses(field, chosen, points, order),
        points=points,
        before=standing(field.experiment, field.taken),
        alternatives=tuple(sorted(alternatives, key=lambda one: one.after.tip_m)),
        candidates={setup: len(rows) for setup, rows in field.by_setup.items() if setup not in others},
        combinations_count=field.experiment.rank,
        is_tied=field.experiment.is_tied,
        blocked=_blocked(arm, points, boards),
    )


def _noise_m(arm: Arm, request: Request) -> float:
    noise_m = request.noise_m
    if noise_m is None and arm.camera is not None:
        noise_m = arm.camera.position_noise_m
    if noise_m is None or not (np.isfinite(noise_m) and noise_m > 0.0):
        raise CalibrationError(
            "noise of a measured coordinate: expected a positive number of m, got"
            f" {'none' if noise_m is None else f'{noise_m:g}'}; write position_noise_m in [camera] or give --noise"
        )
    return noise_m


def _setups(arm: Arm, taken: Points | None, request: Request, choice: Choice) -> list[str]:
    """The setups to plan in."""
    if request.only == "free" or (request.free_count is not None and request.free_count == request.count):
        return []
    if request.setups is not None:
        return list(dict.fromkeys(request.setups))
    return usual_setups(arm, taken, choice.boards)


def _other_tilts(arm: Arm, setups: list[str], request: Request) -> dict[str, PlacedBoard]:
    """Tilts that are not asked for, to say what they would bring: the table's own and the other way."""
    if request.only == "free" or arm.table is None or arm.table.origin_m is None:
        return {}
    tilts = {"roll": arm.table.roll_tilt_rad, "pitch": arm.table.pitch_tilt_rad}
    more = [
        name
        for name in (*SETUPS, *OTHER_TILTS)
        if name not in setups and all(tilts[part] for part in tilts if part in name)
    ]
    return placed_boards(arm, more, None, {})


def _field_of(
    arm: Arm,
    taken: Points | None,
    request: Request,
    choice: Choice,
    boards: Mapping[str, PlacedBoard],
    noise_m: float,
) -> _Field:
    """Candidates of every kind, and all as one experiment."""
    sees_tip = taken is not None and any(
        setup != FREE and np.isfinite(tip).all() for setup, tip in zip(taken.setup, taken.tip_m, strict=True)
    )
    parts = {setup: table_candidates(arm, board, taken, sees_tip) for setup, board in boards.items()}
    if arm.camera is not None and request.only != "table":
        parts[FREE] = free_candidates(arm, boards.values(), request.view)
    if not any(len(part) for part in parts.values()):
        raise CalibrationError(_nothing_to_plan(arm, request))
    poses = joined([*([] if taken is None else [taken]), *parts.values()])
    unseen = {s: board.frame for s, board in boards.items() if board.is_known and s not in choice.boards}
    known = dataclasses.replace(choice, boards={**choice.boards, **unseen})
    workspace = workspace_poses(arm, boards.values(), 2 * WORKSPACE_POSES_COUNT)[:WORKSPACE_POSES_COUNT]
    starts = np.cumsum([0 if taken is None else len(taken), *(len(part) for part in parts.values())])
    return _Field(
        experiment_of(arm, poses, workspace, noise_m, known),
        poses,
        np.arange(starts[0]),
        {setup: np.arange(a, b) for setup, a, b in zip(parts, starts[:-1], starts[1:], strict=True)},
    )


def _nothing_to_plan(arm: Arm, request: Request) -> str:
    if request.only == "free" and arm.camera is None:
        return f"arm {arm.name} has no [camera], and free poses are worth nothing unless it sees the tip: add one"
    if arm.camera is None and arm.table is None:
        return (
            f"arm {arm.name} has neither a [table] nor a [camera]: there is nothing to measure the tip with"
        )
    if request.only == "table" and arm.table is None:
        return f"arm {arm.name} has no [table]: add one, or leave --only table away"
    return (
        "no pose is left to plan: every cavity within reach is taken, or none is, and no free pose is clear of the"
        " floor and in the camera's view"
    )


def _groups(field: _Field, setups: list[str], request: Request) -> list[Group]:
    """How many of which candidates to choose."""
    free = field.by_setup.get(FREE, np.zeros(0, dtype=np.intp))
    table = np.concatenate([np.zeros(0, dtype=np.intp), *(field.by_setup[setup] for setup in setups)])
    if request.count < 1:
        raise CalibrationError(f"number of poses: expected one or more, got {request.count}")
    if request.free_count is None:
        return [Group("poses", np.concatenate((table, free)), request.count)]
    if not 0 <= request.free_count <= request.count:
        raise CalibrationError(
            f"free poses: expected 0 to {request.count} (the number of all poses), got {request.free_count}"
        )
    return [
        Group("cavities", table, request.count - request.free_count),
        Group("free poses", free, request.free_count),
    ]


def _alternative(field: _Field, criterion: str, setup: str) -> Alternative:
    """The best few poses of one kind.

    Chosen for D or tip: where one kind alone leaves something undetermined, the indices O2 to O4 mean nothing.
    """
    rows = field.by_setup[setup]
    count = min(ALTERNATIVE_COUNT, len(rows))
    score = criterion_of("tip" if criterion == "tip" else "D")
    best = select(field.experiment, score, field.taken, [Group(setup, rows, count)])
    before, after = standing(field.experiment, field.taken), standing(field.experiment, [*field.taken, *best])
    return Alternative(setup, count, after.log_det - before.log_det, after)


def _planned_poses(
    field: _Field, chosen: list[int], points: Points, order: list[int]
) -> tuple[PlannedPose, ...]:
    """What each brings when taken after those before it; `points` are in the order of the visit."""
    found = []
    before = standing(field.experiment, field.taken)
    for k in range(len(chosen)):
        after, at = standing(field.experiment, [*field.taken, *chosen[: k + 1]]), order.index(k)
        found.append(
            PlannedPose(
                points.setup[at],
                points.point[at],
                points.repeat[at],
                tuple(points.q_rad[at].tolist()),
                at + 1,
                after.log_det - before.log_det,
                after,
            )
        )
        before = after
    return tuple(found)


def _blocked(arm: Arm, visited: Points, boards: Mapping[str, PlacedBoard]) -> tuple[tuple[str, str], ...]:
    """Neighbouring free poses between which a straight joint move would go through floor or board."""
    rows = [k for k, setup in enumerate(visited.setup) if setup == FREE]
    if len(rows) < 2:
        return ()
    clear = clear_ways(arm, visited.q_rad[rows], boards.values())
    return tuple(
        (visited.point[rows[k]], visited.point[rows[k + 1]])
        for k in range(len(rows) - 1)
        if not clear[k, k + 1]
    )

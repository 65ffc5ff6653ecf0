"""Plans the next poses: candidates, selection, gain of each pose, and alternatives."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.assembly import Choice, turn_noise_rad
from calib.arm_problem.checks import require_of_arm
from calib.design.boards import OTHER_TILTS, PlacedBoard, boards_in_the_way, placed_boards, usual_setups
from calib.design.candidates import (
    FREE,
    free_candidates,
    joined,
    named,
    table_candidates,
    workspace_poses,
)
from calib.design.criteria import criterion_of
from calib.design.exchange import Group, select
from calib.design.information import Experiment, experiment_of, uncertainty_of
from calib.design.order import clear_ways, visiting_order
from calib.design.plan import Alternative, Plan, PlannedPose, Request
from calib.design.reach import Rows
from calib.errors import CalibrationError
from calib.points.points import Points
from control.model.arm import Arm
from control.model.table import SETUPS

WORKSPACE_POSES_COUNT = 400
ALTERNATIVE_COUNT = 12  # number of poses by which alternatives are compared


@dataclass(frozen=True, slots=True)
class _Offer:
    """All poses as one experiment: first the recorded ones, then the candidates by setup."""

    experiment: Experiment
    poses: Points
    taken: Rows
    by_setup: dict[str, Rows]


def plan_poses(arm: Arm, taken: Points | None, request: Request, choice: Choice | None = None) -> Plan:
    """Plan the poses to record next.

    `choice` for the identification: fixed and freed parameters, bounds, measured boards. CalibrationError for
    a request that cannot be met.
    """
    wanted = choice or Choice()
    if taken is not None:
        require_of_arm(arm, taken, wanted)
    criterion_of(request.criterion)  # report an unknown criterion before anything takes time
    noise_m = _noise_m(arm, request)
    setups = _setups(arm, taken, request, wanted)
    boards = placed_boards(arm, setups, taken, wanted.boards)
    others = _other_tilts(arm, setups, request)
    in_the_way = boards_in_the_way(arm, taken, wanted.boards, boards)
    offer = _offer_of(arm, taken, request, wanted, {**boards, **others}, in_the_way, noise_m)
    chosen = _chosen(offer, request, setups)
    alternatives = [one for setup in offer.by_setup for one in _alternatives(offer, request.criterion, setup)]
    order = visiting_order(arm, offer.poses.chosen(chosen), setups, in_the_way)
    points = named(offer.poses.chosen([chosen[k] for k in order]), taken)
    return Plan(
        criterion=request.criterion,
        noise_m=noise_m,
        poses=_planned_poses(offer, chosen, points, order),
        points=points,
        before=uncertainty_of(offer.experiment, offer.taken),
        alternatives=tuple(sorted(alternatives, key=lambda one: one.after.tip_m)),
        candidates={setup: len(rows) for setup, rows in offer.by_setup.items() if setup not in others},
        combinations_count=offer.experiment.rank,
        is_tied=offer.experiment.is_tied,
        blocked=_blocked(arm, points, in_the_way),
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


def _turn_noise_rad(arm: Arm, taken: Points | None, request: Request) -> float | None:
    """The noise of measured orientations: as asked for, or as for the calibration if the points taken have some."""
    has_some = taken is not None and bool(np.isfinite(taken.orientation).any())
    if request.turn_noise_rad is not None or not has_some:
        return request.turn_noise_rad
    return turn_noise_rad(arm)


def _setups(arm: Arm, taken: Points | None, request: Request, choice: Choice) -> list[str]:
    """The setups to plan in."""
    if request.only == "free" or (request.free_count is not None and request.free_count == request.count):
        return []
    if request.setups is not None:
        return list(dict.fromkeys(request.setups))
    return usual_setups(arm, taken, choice.boards)


def _other_tilts(arm: Arm, setups: list[str], request: Request) -> dict[str, PlacedBoard]:
    """Tilts that were not requested, as alternatives: the table's own and the opposite ones."""
    if request.only == "free" or arm.table is None or arm.table.origin_m is None:
        return {}
    tilts = {"roll": arm.table.roll_tilt_rad, "pitch": arm.table.pitch_tilt_rad}
    more = [
        name
        for name in (*SETUPS, *OTHER_TILTS)
        if name not in setups and all(tilts[part] for part in tilts if part in name)
    ]
    return placed_boards(arm, more, None, {})


def _offer_of(
    arm: Arm,
    taken: Points | None,
    request: Request,
    choice: Choice,
    boards: Mapping[str, PlacedBoard],
    in_the_way: tuple[PlacedBoard, ...],
    noise_m: float,
) -> _Offer:
    """Candidates of all kinds as one experiment."""
    sees_tip = taken is not None and any(
        setup != FREE and np.isfinite(tip).all() for setup, tip in zip(taken.setup, taken.tip_m, strict=True)
    )
    parts = {setup: table_candidates(arm, board, taken, sees_tip) for setup, board in boards.items()}
    if arm.camera is not None and request.only != "table":
        parts[FREE] = free_candidates(arm, in_the_way, request.view)
    if not any(len(part) for part in parts.values()):
        raise CalibrationError(_nothing_to_plan(arm, request))
    poses = joined([*([] if taken is None else [taken]), *parts.values()])
    unseen = {s: board.frame for s, board in boards.items() if board.is_known and s not in choice.boards}
    known = dataclasses.replace(choice, boards={**choice.boards, **unseen})
    workspace = workspace_poses(arm, in_the_way, 2 * WORKSPACE_POSES_COUNT)[:WORKSPACE_POSES_COUNT]
    starts = np.cumsum([0 if taken is None else len(taken), *(len(part) for part in parts.values())])
    return _Offer(
        experiment_of(arm, poses, workspace, noise_m, known, _turn_noise_rad(arm, taken, request)),
        poses,
        np.arange(starts[0]),
        {setup: np.arange(a, b) for setup, a, b in zip(parts, starts[:-1], starts[1:], strict=True)},
    )


def _nothing_to_plan(arm: Arm, request: Request) -> str:
    if request.only == "free" and arm.camera is None:
        return f"arm {arm.name} has no [camera], and free poses need a camera that measures the tip: add one"
    if arm.camera is None and arm.table is None:
        return f"arm {arm.name} has neither a [table] nor a [camera]: nothing can measure the tip; add one"
    if request.only == "table" and arm.table is None:
        return f"arm {arm.name} has no [table]: add one, or omit --only table"
    return (
        "no pose is left to plan: no cavity within reach is left, and no free pose is clear of the floor and in the"
        " camera's view"
    )


def _groups(offer: _Offer, setups: list[str], request: Request) -> list[Group]:
    """The groups of candidates to select from."""
    free = offer.by_setup.get(FREE, np.zeros(0, dtype=np.intp))
    table = np.concatenate([np.zeros(0, dtype=np.intp), *(offer.by_setup[setup] for setup in setups)])
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


def _chosen(offer: _Offer, request: Request, setups: list[str]) -> list[int]:
    """Rows of the best poses, from several starts if boards are unknown.

    The first poses in an unknown frame only determine its pose: a greedy selection never leaves the first board,
    although others may be far better. So each kind alone, pairs of kinds and all of them, in equal shares, are tried.
    """
    criterion, groups = criterion_of(request.criterion), _groups(offer, setups, request)
    best = select(offer.experiment, criterion, offer.taken, groups)
    kinds = [*setups, *([FREE] if request.free_count is None and FREE in offer.by_setup else [])]
    if not offer.experiment.places_count or set(kinds) <= set(offer.poses.setup[: len(offer.taken)]):
        return best  # no frame is unknown, or recorded points already determine each
    singles, pairs = itertools.combinations(kinds, 1), itertools.combinations(kinds, 2)
    for some in dict.fromkeys([*singles, *pairs, tuple(kinds)]):
        shares = _equal_shares(offer, some, groups[0].count)
        if all(share.count <= len(share.rows) for share in shares):
            start = select(offer.experiment, criterion, offer.taken, [*shares, *groups[1:]])
            other = select(offer.experiment, criterion, offer.taken, groups, start)
            best = max(best, other, key=lambda rows: _worth(offer, request.criterion, rows))
    return best


def _equal_shares(offer: _Offer, kinds: tuple[str, ...], count: int) -> list[Group]:
    """Equal numbers of poses of each kind."""
    shares = [count // len(kinds) + (k < count % len(kinds)) for k in range(len(kinds))]
    return [Group(kind, offer.by_setup[kind], share) for kind, share in zip(kinds, shares, strict=True)]


def _worth(offer: _Offer, criterion: str, rows: list[int]) -> tuple[float, float]:
    """Value of a choice: by the criterion, then by log det."""
    after = uncertainty_of(offer.experiment, [*offer.taken, *rows])
    by_name = {"D": after.log_det, "tip": -after.tip_m, **after.indices.as_dict()}
    return by_name[criterion], after.log_det


def _alternatives(offer: _Offer, criterion: str, setup: str) -> list[Alternative]:
    """The best few poses of one kind, and all cavities of a setup.

    Chosen for D or tip: if one kind alone leaves something undetermined, the indices O2 to O4 are meaningless.
    """
    rows = offer.by_setup[setup]
    count = min(ALTERNATIVE_COUNT, len(rows))
    score = criterion_of("tip" if criterion == "tip" else "D")
    choices = [select(offer.experiment, score, offer.taken, [Group(setup, rows, count)])] if count else []
    if setup != FREE and len(rows) > count:
        choices.append(rows.tolist())
    before = uncertainty_of(offer.experiment, offer.taken)
    found = []
    for chosen in choices:
        after = uncertainty_of(offer.experiment, [*offer.taken, *chosen])
        found.append(Alternative(setup, len(chosen), after.log_det - before.log_det, after))
    return found


def _planned_poses(
    offer: _Offer, chosen: list[int], points: Points, order: list[int]
) -> tuple[PlannedPose, ...]:
    """The gain of each pose when added to the previous ones; `points` are in visiting order."""
    found = []
    before = uncertainty_of(offer.experiment, offer.taken)
    for k in range(len(chosen)):
        after, at = uncertainty_of(offer.experiment, [*offer.taken, *chosen[: k + 1]]), order.index(k)
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


def _blocked(arm: Arm, visited: Points, boards: tuple[PlacedBoard, ...]) -> tuple[tuple[str, str], ...]:
    """Neighbouring free poses between which a straight joint move would go through floor or board."""
    rows = [k for k, setup in enumerate(visited.setup) if setup == FREE]
    if len(rows) < 2:
        return ()
    clear = clear_ways(arm, visited.q_rad[rows], boards)
    return tuple(
        (visited.point[rows[k]], visited.point[rows[k + 1]])
        for k in range(len(rows) - 1)
        if not clear[k, k + 1]
    )

"""Plans the next poses: of which candidates, how many of each kind, gain of each, order of visits."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.arm_problem.assembly import Choice, turn_noise_rad
from calib.arm_problem.checks import require_of_arm
from calib.arrays import Array
from calib.design.candidates import (
    OTHER_TILTS,
    CameraBox,
    Mask,
    PlacedBoard,
    Rows,
    boards_in_the_way,
    body_points,
    free_candidates,
    is_clear_of,
    joined,
    named,
    placed_boards,
    table_candidates,
    usual_setups,
    workspace_poses,
)
from calib.design.information import Experiment, Group, criterion_of, experiment_of, select, uncertainty_of
from calib.design.plan import Alternative, Plan, PlannedPose
from calib.errors import CalibrationError
from calib.points.points import FREE, Points
from control.model.arm import Arm
from control.model.table import SETUPS

USUAL_COUNT = 12


@dataclass(frozen=True, slots=True)
class Request:
    """A request: `count` poses, `free_count` of them free poses (None: the criterion decides).

    setups: those to plan in (None: the table's own); only: only free poses, or only cavities; noise_m:
    standard deviation of a tip coordinate (None: the camera's); turn_noise_rad: of orientations measured beside tips (None: of
    points taken, if they have some); view: the camera's field of view (None: all).
    """

    count: int = USUAL_COUNT
    free_count: int | None = None
    setups: tuple[str, ...] | None = None
    only: Literal["free", "table"] | None = None
    criterion: str = "D"
    noise_m: float | None = None
    turn_noise_rad: float | None = None
    view: CameraBox | None = None


WAY_SAMPLES = 16
WAY_HEIGHT_M = 0.05  # of the nominal tip above floor and boards between poses; an uncalibrated arm may be 4 cm off
DETOUR_RAD = 100.0  # penalty for a path with a collision, so that any other order is better


def visiting_order(arm: Arm, planned: Points, setups: Sequence[str], boards: Iterable[PlacedBoard]) -> list[int]:
    """Indices of the planned poses in visiting order: setups in the order given, free poses last.

    Within each the sum of largest joint travels is kept small: nearest neighbour, then 2-opt.
    """
    standing = list(boards)
    order: list[int] = []
    last = np.array(arm.rest_rad)
    for setup in [*setups, FREE]:
        rows = [k for k, name in enumerate(planned.setup) if name == setup]
        if not rows:
            continue
        q = np.vstack((last, planned.q_rad[rows]))
        ways = np.abs(q[:, None] - q[None, :]).max(axis=2)
        if setup == FREE:  # between cavities the session lifts the arm
            ways = ways + DETOUR_RAD * ~clear_ways(arm, q, standing)
        order += [rows[k - 1] for k in short_path(ways)[1:]]
        last = planned.q_rad[order[-1]]
    return order


def clear_ways(arm: Arm, q_rad: Array, boards: Iterable[PlacedBoard]) -> Mask:
    """Mask (m, m): a straight joint move between these poses (m, n) is clear of floor and boards."""
    m = len(q_rad)
    first, second = np.triu_indices(m, 1)
    shares = np.linspace(0.0, 1.0, WAY_SAMPLES)[1:-1]
    between = q_rad[first, None] + shares[:, None] * (q_rad[second] - q_rad[first])[:, None]
    clear = is_clear_of(arm, body_points(arm, between.reshape(-1, q_rad.shape[1])), boards, WAY_HEIGHT_M)
    ways = np.ones((m, m), dtype=np.bool_)
    ways[first, second] = ways[second, first] = clear.reshape(len(first), len(shares)).all(axis=1)
    return ways


def short_path(ways: Array) -> list[int]:
    """A short path through all places of the matrix (m, m), from the first."""
    path, unvisited = [0], set(range(1, len(ways)))
    while unvisited:
        nearest = min(unvisited, key=lambda k: (ways[path[-1], k], k))
        path.append(nearest)
        unvisited.remove(nearest)
    return _untangled(path, ways)


def _untangled(path: list[int], ways: Array) -> list[int]:
    """2-opt with a free end: reverse a section wherever that makes the path shorter."""
    is_changed = True
    while is_changed:
        is_changed = False
        for i in range(1, len(path) - 1):
            for j in range(i + 1, len(path)):
                after = ways[path[i], path[j + 1]] - ways[path[j], path[j + 1]] if j + 1 < len(path) else 0.0
                if ways[path[i - 1], path[j]] - ways[path[i - 1], path[i]] + after < -1e-9:
                    path[i : j + 1] = path[i : j + 1][::-1]
                    is_changed = True
    return path


WORKSPACE_POSES_COUNT = 400
ALTERNATIVE_COUNT = 12  # number of poses by which alternatives are compared


@dataclass(frozen=True, slots=True)
class _Offer:
    """All poses as one experiment: first the recorded ones, then the candidates by setup."""

    experiment: Experiment
    poses: Points
    taken: Rows
    by_setup: dict[str, Rows]


def plan_poses(arm: Arm, recorded: Points | None, request: Request, choice: Choice | None = None) -> Plan:
    """Plan the poses to record next.

    `choice` for the identification: fixed and freed parameters, bounds, measured boards. CalibrationError for
    a request that cannot be met.
    """
    wanted = choice or Choice()
    if recorded is not None:
        require_of_arm(arm, recorded, wanted)
    criterion_of(request.criterion)  # report an unknown criterion before anything takes time
    noise_m = _noise_m(arm, request)
    setups = _setups(arm, recorded, request, wanted)
    boards = placed_boards(arm, setups, recorded, wanted.boards)
    others = _other_tilts(arm, setups, request)
    in_the_way = boards_in_the_way(arm, recorded, wanted.boards, boards)
    parts = _candidates(arm, recorded, request, {**boards, **others}, in_the_way)
    unseen = {s: board.frame for s, board in (boards | others).items() if board.is_known and s not in wanted.boards}
    turn_rad = _turn_noise_rad(arm, recorded, request)
    known = dataclasses.replace(wanted, boards={**wanted.boards, **unseen}, orientation_noise_rad=turn_rad)
    workspace = workspace_poses(arm, in_the_way, 2 * WORKSPACE_POSES_COUNT)[:WORKSPACE_POSES_COUNT]
    poses = joined([*([] if recorded is None else [recorded]), *parts.values()])
    offer = _offer_of(experiment_of(arm, poses, workspace, noise_m, known), poses, parts)
    chosen = _chosen(offer, request, setups)
    alternatives = [alone for setup in offer.by_setup for alone in _alternatives(offer, request.criterion, setup)]
    order = visiting_order(arm, offer.poses.chosen(chosen), setups, in_the_way)
    points = named(offer.poses.chosen([chosen[k] for k in order]), recorded)
    return Plan(
        criterion=request.criterion,
        noise_m=noise_m,
        poses=_planned_poses(offer, chosen, points, order),
        points=points,
        before=uncertainty_of(offer.experiment, offer.taken),
        alternatives=tuple(sorted(alternatives, key=lambda alone: alone.after.tip_m)),
        candidates={setup: len(rows) for setup, rows in offer.by_setup.items() if setup not in others},
        combinations_count=offer.experiment.rank,
        is_tied=offer.experiment.is_tied,
        blocked=_blocked(arm, points, in_the_way),
    )


def _noise_m(arm: Arm, request: Request) -> float:
    if arm.camera is None and arm.table is None:  # a noise alone would not help
        raise CalibrationError(_nothing_to_plan(arm, request))
    noise_m = request.noise_m
    if noise_m is None and arm.camera is not None:
        noise_m = arm.camera.position_noise_m
    if noise_m is None or not (np.isfinite(noise_m) and noise_m > 0.0):
        raise CalibrationError(
            "noise of a measured coordinate: expected a positive number of m, got"
            f" {'none' if noise_m is None else f'{noise_m:g}'}; write position_noise_m in [camera] or give --noise"
        )
    return noise_m


def _turn_noise_rad(arm: Arm, recorded: Points | None, request: Request) -> float | None:
    """The noise of measured orientations: as asked for, or as for the calibration if the points taken have some."""
    has_some = recorded is not None and bool(np.isfinite(recorded.orientation).any())
    if request.turn_noise_rad is not None or not has_some:
        return request.turn_noise_rad
    return turn_noise_rad(arm)


def _setups(arm: Arm, recorded: Points | None, request: Request, choice: Choice) -> list[str]:
    """The setups to plan in."""
    if request.only == "free" or (request.free_count is not None and request.free_count == request.count):
        return []
    if request.setups is not None:
        return list(dict.fromkeys(request.setups))
    return usual_setups(arm, recorded, choice.boards)


def _other_tilts(arm: Arm, setups: list[str], request: Request) -> dict[str, PlacedBoard]:
    """Tilts that were not requested, as alternatives: the table's own and the opposite ones."""
    if request.only == "free" or arm.table is None or arm.table.origin_m is None:
        return {}
    tilts = {"roll": arm.table.roll_tilt_rad, "pitch": arm.table.pitch_tilt_rad}
    more = [name for name in (*SETUPS, *OTHER_TILTS) if name not in setups and all(tilts[part] for part in tilts if part in name)]
    return placed_boards(arm, more, None, {})


def _candidates(
    arm: Arm, recorded: Points | None, request: Request, boards: Mapping[str, PlacedBoard], in_the_way: tuple[PlacedBoard, ...]
) -> dict[str, Points]:
    """Candidates of all kinds, by setup."""
    sees_tip = recorded is not None and any(
        setup != FREE and np.isfinite(tip).all() for setup, tip in zip(recorded.setup, recorded.tip_m, strict=True)
    )
    parts = {setup: table_candidates(arm, board, recorded, sees_tip) for setup, board in boards.items()}
    if arm.camera is not None and request.only != "table":
        parts[FREE] = free_candidates(arm, in_the_way, request.view)
    if not any(len(part) for part in parts.values()):
        raise CalibrationError(_nothing_to_plan(arm, request))
    return parts


def _offer_of(experiment: Experiment, poses: Points, parts: Mapping[str, Points]) -> _Offer:
    """`parts`: the candidates, which follow the recorded ones in `poses`."""
    counts = [len(part) for part in parts.values()]
    starts = np.cumsum([len(poses) - sum(counts), *counts])
    by_setup = {setup: np.arange(a, b) for setup, a, b in zip(parts, starts[:-1], starts[1:], strict=True)}
    return _Offer(experiment, poses, np.arange(starts[0]), by_setup)


def _nothing_to_plan(arm: Arm, request: Request) -> str:
    if request.only == "free" and arm.camera is None:
        return f"arm {arm.name} has no [camera], and free poses need a camera that measures the tip: add one"
    if arm.camera is None and arm.table is None:
        missing = "nothing can measure the tip; add [camera] with position_noise_m, or [table]"
        return f"arm {arm.name} has neither a [table] nor a [camera]: {missing}"
    if request.only == "table" and arm.table is None:
        return f"arm {arm.name} has no [table]: add one, or omit --only table"
    return (
        "no pose is left to plan: no cavity within reach is left, and no free pose is clear of the floor and in the camera's view"
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
        raise CalibrationError(f"free poses: expected 0 to {request.count} (the number of all poses), got {request.free_count}")
    return [Group("cavities", table, request.count - request.free_count), Group("free poses", free, request.free_count)]


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
    alternatives = []
    for chosen in choices:
        after = uncertainty_of(offer.experiment, [*offer.taken, *chosen])
        alternatives.append(Alternative(setup, len(chosen), after.log_det - before.log_det, after))
    return alternatives


def _planned_poses(offer: _Offer, chosen: list[int], points: Points, order: list[int]) -> tuple[PlannedPose, ...]:
    """The gain of each pose when added to the previous ones; `points` are in visiting order."""
    planned = []
    before = uncertainty_of(offer.experiment, offer.taken)
    for k in range(len(chosen)):
        after, at = uncertainty_of(offer.experiment, [*offer.taken, *chosen[: k + 1]]), order.index(k)
        planned.append(
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
    return tuple(planned)


def _blocked(arm: Arm, visited: Points, boards: tuple[PlacedBoard, ...]) -> tuple[tuple[str, str], ...]:
    """Neighbouring free poses between which a straight joint move would go through floor or board."""
    rows = [k for k, setup in enumerate(visited.setup) if setup == FREE]
    if len(rows) < 2:
        return ()
    clear = clear_ways(arm, visited.q_rad[rows], boards)
    return tuple((visited.point[rows[k]], visited.point[rows[k + 1]]) for k in range(len(rows) - 1) if not clear[k, k + 1])

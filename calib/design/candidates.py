"""Candidate poses: cavities of the board in each setup, and free poses within the limits, clear of floor and
board, seen by a camera.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.observations import Frame
from calib.arrays import Array, frozen
from calib.boards import best_motion
from calib.errors import CalibrationError
from calib.points.points import FREE, Points, make_points
from control.kinematics.chain import link_transforms
from control.model.arm import Arm, Table
from control.model.table import SETUPS, board_cavities, board_rotation
from control.motion.joint_limits import reach_m

Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]
LIMIT_MARGIN_RAD = 0.05  # an uncalibrated arm turns a little further than planned
TOUCH_M = 0.0005  # depth of a tip in a cavity
BOARD_EDGE_M = 0.03  # the board reaches this far beyond its outermost cavity
STEPS_LIMIT = 60
LONGEST_STEP_RAD = 0.4
DAMPING = 1e-4  # of J J', [m^2/rad^2]
SAME_POSTURE_RAD = 1e-3


def joint_box(arm: Arm, margin_rad: float = LIMIT_MARGIN_RAD) -> tuple[Array, Array]:
    """Lower and upper joint angles (n,) to plan within; a joint without limits gets one whole turn."""
    limits = np.array(arm.limits_rad)
    lower = np.where(np.isfinite(limits[:, 0]), limits[:, 0], -np.pi)
    upper = np.where(np.isfinite(limits[:, 1]), limits[:, 1], np.pi)
    margin = np.minimum(margin_rad, 0.25 * (upper - lower))
    return lower + margin, upper - margin


def spread_poses(box: tuple[Array, Array], count: int, edge_share: float = 0.0) -> Array:
    """Poses (count, n) spread evenly over the box by Halton's sequence (deterministic).

    In the second half, each angle is moved to the nearer end of its range with probability `edge_share`: informative poses
    are often there.
    """
    lower, upper = box
    places = np.column_stack([_radical_inverse(count, base) for base in _primes(len(lower))])
    if edge_share > 0.0:
        draw = np.random.default_rng(0).random(places.shape) < edge_share
        draw[: count // 2] = False
        places = np.where(draw, np.round(places), places)
    return np.asarray(lower + places * (upper - lower))


def _radical_inverse(count: int, base: int) -> Array:
    """Halton's sequence in one base: the digits of 1 .. count mirrored at the point."""
    rest, inverse, share = np.arange(1, count + 1), np.zeros(count), 1.0 / base
    while rest.any():
        inverse += share * (rest % base)
        rest, share = rest // base, share / base
    return inverse


def _primes(count: int) -> list[int]:
    primes: list[int] = []
    number = 2
    while len(primes) < count:
        if all(number % prime for prime in primes):
            primes.append(number)
        number += 1
    return primes


def postures(model: ArmModel, targets_m: Array, starts_rad: Array, box: tuple[Array, Array]) -> tuple[Array, Rows]:
    """Poses with the tip at the targets (c, 3): (q (p, n), which target each belongs to (p,)).

    By damped least squares from every start (s, n) within the box; equal postures are returned once.
    """
    q = np.tile(starts_rad, (len(targets_m), 1))
    which = np.repeat(np.arange(len(targets_m)), len(starts_rad))
    goal = targets_m[which]
    for _ in range(STEPS_LIMIT):
        slopes = model.slopes(model.nominal_dh, q)
        miss = goal - slopes.tips
        if np.max(np.abs(miss), initial=0.0) < 1e-9:
            break
        by_q = slopes.by_dh[:, :, list(model.theta_places)]
        damping = 1e-12 + DAMPING * np.minimum(1.0, 1e2 * np.einsum("mi,mi->m", miss, miss))
        square = np.einsum("mik,mjk->mij", by_q, by_q) + damping[:, None, None] * np.eye(3)
        step = np.einsum("mik,mi->mk", by_q, np.linalg.solve(square, miss[:, :, None])[:, :, 0])
        step *= np.minimum(1.0, LONGEST_STEP_RAD / np.maximum(1e-12, np.abs(step).max(axis=1, keepdims=True)))
        q = np.clip(q + step, *box)
    is_there = np.linalg.norm(goal - model.tips(model.nominal_dh, q), axis=1) < 1e-7
    return _different(q[is_there], which[is_there])


def _different(q: Array, which: Rows) -> tuple[Array, Rows]:
    """Remove duplicate postures."""
    keys = np.column_stack((which, np.round(q / SAME_POSTURE_RAD)))
    _, first = np.unique(keys, axis=0, return_index=True)
    first.sort()
    return q[first], which[first]


def body_points(arm: Arm, q_rad: Array) -> Array:
    """Points along the arm from the first joint's frame to the tip, (m, p, 3), base frame; the last is the tip."""
    frames = link_transforms(arm.dh, q_rad, arm.joints, arm.dh_convention)
    tips = frames[:, -1, :3, 3] + frames[:, -1, :3, :3] @ np.array(arm.tool.position_m)
    corners = np.concatenate((frames[:, 1:, :3, 3], tips[:, None]), axis=1)
    between = [corners[:, :-1] + share * (corners[:, 1:] - corners[:, :-1]) for share in (0.0, 0.25, 0.5, 0.75)]
    return np.concatenate((*between, tips[:, None]), axis=1)


def is_above_floor(arm: Arm, points_m: Array) -> Mask:
    """Mask (m, p) of the points (m, p, 3) above the floor of the arm's limits."""
    return np.asarray(points_m[:, :, 2] >= arm.limits.floor_z_m + arm.limits.floor_clearance_m - TOUCH_M)


def heights_over_board(points_m: Array, board: PlacedBoard) -> tuple[Array, Mask]:
    """Height of points (m, p, 3) above a board's plane, and which of them are over the board, both (m, p)."""
    local = (points_m - board.origin_m) @ board.rotation
    is_over = np.hypot(local[:, :, 0], local[:, :, 1]) <= board.reach_m + BOARD_EDGE_M
    return local[:, :, 2], is_over & board.has_plane


OTHER_TILTS = ("roll-", "pitch-", "roll+pitch")  # the opposite tilts, and both tilts at once
FLAT = 5e-3  # spread of cavities across their best line, as a share of that along it


@dataclass(frozen=True, slots=True)
class PlacedBoard:
    """The board of one setup: base_R_board (3, 3), origin_m (3,), cavities [m] in its own frame.

    `is_known`: the pose is known (or measured) and not identified. `has_plane`: the board's plane is
    approximately known; False if only collinear cavities were recorded.
    """

    setup: str
    rotation: Array
    origin_m: Array
    cavities_m: Mapping[str, tuple[float, float, float]]
    is_known: bool
    has_plane: bool = True

    @property
    def names(self) -> list[str]:
        """The cavities' names."""
        return list(self.cavities_m)

    @property
    def positions_m(self) -> Array:
        """The cavities in the base frame, (c, 3)."""
        local = np.array(list(self.cavities_m.values())).reshape(-1, 3)
        return np.asarray(local @ self.rotation.T + self.origin_m)

    @property
    def reach_m(self) -> float:
        """Distance of the outermost cavity from the board's origin, in its plane."""
        return max((math.hypot(x, y) for x, y, _ in self.cavities_m.values()), default=0.0)

    @property
    def frame(self) -> Frame:
        """The frame for the identification."""
        return Frame(f"table_{self.setup}", frozen(self.rotation), frozen(self.origin_m))


def usual_setups(arm: Arm, points: Points | None, measured: Mapping[str, Frame]) -> list[str]:
    """The default setups to plan for: the table's own, measured ones, and those of the points."""
    if arm.table is None:
        return []
    of_table = ["normal"] if arm.table.origin_m is not None else []
    of_table += ["roll"] if of_table and arm.table.roll_tilt_rad else []
    of_table += ["pitch"] if of_table and arm.table.pitch_tilt_rad else []
    seated = [] if points is None else [s for s, p in zip(points.setup, points.point, strict=True) if p in _all(arm)]
    return list(dict.fromkeys([*of_table, *measured, *(setup for setup in seated if setup != FREE)]))


def placed_boards(
    arm: Arm, setups: Sequence[str], points: Points | None, measured: Mapping[str, Frame]
) -> dict[str, PlacedBoard]:
    """The board in each of the setups. CalibrationError for a setup with an unknown board pose.

    Measured poses take precedence over the arm's [table], and that over an estimate from the setup's points.
    """
    if setups and arm.table is None:
        raise CalibrationError(
            f"setup {setups[0]}: arm {arm.name} has no [table]; add one, or plan free poses only (--only free)"
        )
    return {setup: _placed(arm, setup, points, measured) for setup in setups}


def boards_in_the_way(
    arm: Arm, recorded: Points | None, measured: Mapping[str, Frame], planned: Mapping[str, PlacedBoard]
) -> tuple[PlacedBoard, ...]:
    """Possible poses of the board while free poses are recorded: in every setup with a known pose."""
    boards = dict(planned)
    for setup in usual_setups(arm, recorded, measured):
        with contextlib.suppress(CalibrationError):
            boards.setdefault(setup, _placed(arm, setup, recorded, measured))
    return tuple(boards.values())


def _placed(arm: Arm, setup: str, points: Points | None, measured: Mapping[str, Frame]) -> PlacedBoard:
    table = arm.table or Table()
    if setup in measured:
        return PlacedBoard(setup, measured[setup].rotation, measured[setup].origin_m, _all(arm), is_known=True)
    fitted = None if table.known_pose else _fitted(arm, setup, points)
    if fitted is not None:
        return fitted
    if setup not in (*SETUPS, *OTHER_TILTS):
        raise CalibrationError(
            f"setup: expected some of {', '.join((*SETUPS, *OTHER_TILTS))}, or a setup with a measured board or with"
            f' recorded points; got "{setup}"'
        )
    if table.origin_m is None:
        raise CalibrationError(
            f"setup {setup}: the board's position is unknown: record three cavities and give them with --points,"
            " register the board, or write its approximate position as origin_m in [table]"
        )
    return PlacedBoard(setup, tilted(table, setup), np.array(table.origin_m), _all(arm), is_known=table.known_pose)


def tilted(table: Table, setup: str) -> Array:
    """base_R_board (3, 3) of one of the table's setups or of OTHER_TILTS."""
    if setup in SETUPS:
        return np.array(board_rotation(table, setup))
    roll = {"roll-": -1.0, "roll+pitch": 1.0}.get(setup, 0.0) * table.roll_tilt_rad
    pitch = {"pitch-": -1.0, "roll+pitch": 1.0}.get(setup, 0.0) * table.pitch_tilt_rad
    c, s = math.cos(roll), math.sin(roll)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    c, s = math.cos(pitch), math.sin(pitch)
    return np.asarray(np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) @ about_x)


def _fitted(arm: Arm, setup: str, points: Points | None) -> PlacedBoard | None:
    """The board placed by the nominal arm's tips in its cavities; if they are collinear, only those cavities."""
    known = _all(arm)
    rows = [] if points is None else [k for k, s in enumerate(points.setup) if s == setup and points.point[k] in known]
    if points is None or not rows:
        return None
    model = ArmModel(arm)
    local = np.array([known[points.point[k]] for k in rows])
    stands = best_motion(local, model.tips(model.nominal_dh, points.q_rad[rows]))
    spread = np.linalg.svd(local - local.mean(axis=0), compute_uv=False)
    seen = {points.point[k] for k in rows}
    is_whole = len(spread) > 1 and spread[1] > FLAT * spread[0] > 0.0
    cavities = {name: place for name, place in known.items() if is_whole or name in seen}
    return PlacedBoard(setup, stands.rotation, stands.shift_m, cavities, is_known=False, has_plane=is_whole)


def _all(arm: Arm) -> dict[str, tuple[float, float, float]]:
    return {} if arm.table is None else board_cavities(arm.table)


FREE_POSES_COUNT = 4000  # number drawn, before poses with collisions are removed
EDGE_SHARE = 0.4
APART_RAD = 0.15  # smallest difference between candidate free poses
FREE_HEIGHT_M = 0.10  # of a free pose's tip above floor and board: an uncalibrated arm may be 4 cm off
WORKSPACE_HEIGHT_M = 0.03  # of the tip in workspace poses
SMALL_ARM_m = 0.4  # an arm of less reach is off by less, and would have no pose that high
STARTS_COUNT = 12  # number of starts for postures; four times as many with more than three joints
POSTURES_LIMIT = 24  # per cavity; with more than three joints there are infinitely many
TAKEN_RAD = 0.3  # a cavity in a posture closer than this to a recorded one counts as recorded


@dataclass(frozen=True, slots=True)
class CameraBox:
    """The box that the camera sees, in the base frame: lower and upper corner [m]."""

    lower_m: tuple[float, float, float]
    upper_m: tuple[float, float, float]

    def shows(self, tips_m: Array) -> Mask:
        """Mask of the tips (m, 3) inside."""
        return np.asarray(((tips_m >= self.lower_m) & (tips_m <= self.upper_m)).all(axis=1))


def table_candidates(arm: Arm, board: PlacedBoard, recorded: Points | None, sees_tip: bool) -> Points:
    """Cavities of one setup in every posture of the arm, without those already recorded.

    `sees_tip`: a camera also measures the tip in the cavity, so it is known without the board.
    """
    model, box = ArmModel(arm), joint_box(arm)
    starts = STARTS_COUNT if arm.joint_count <= 3 else 4 * STARTS_COUNT
    q, which = postures(model, board.positions_m, spread_poses(box, starts), box)
    rows = np.flatnonzero(_is_clear_of_board(arm, q, board))
    rows = _first_of_each(rows, which)
    names = [board.names[which[row]] for row in rows]
    free = [k for k, row in enumerate(rows) if not _is_taken(recorded, board.setup, names[k], q[row])]
    rows, names = rows[free], [names[k] for k in free]
    tips = board.positions_m[which[rows]] if sees_tip else np.full((len(rows), 3), np.nan)
    return make_points([board.setup] * len(rows), names, [1] * len(rows), q[rows], tips)


def free_candidates(
    arm: Arm, boards: Iterable[PlacedBoard], view: CameraBox | None = None, count: int = FREE_POSES_COUNT
) -> Points:
    """Poses over the joints' ranges, clear of the floor and of the board in any setup, in the camera's view."""
    q = workspace_poses(arm, boards, count, EDGE_SHARE, FREE_HEIGHT_M)
    tips = ArmModel(arm).tips(arm.dh, q)
    if view is not None:
        q, tips = q[view.shows(tips)], tips[view.shows(tips)]
    apart = _apart(q)
    q, tips = q[apart], tips[apart]
    return make_points([FREE] * len(q), [""] * len(q), [1] * len(q), q, tips)


def _apart(q: Array) -> Rows:
    """Rows of poses that differ from all previous ones in some joint by APART_RAD.

    Only poses that are as near in joint 1 (and a little further, for rounding) are compared.
    """
    order = np.argsort(q[:, 0])
    along = q[order, 0]
    first, end = (np.searchsorted(along, q[:, 0] + way * APART_RAD) for way in (-1.001, 1.001))
    is_apart, rows = np.ones(len(q), dtype=bool), []
    for row, pose in enumerate(q):
        if is_apart[row]:
            rows.append(row)
            near = order[first[row] : end[row]]
            is_apart[near[np.abs(q[near] - pose).max(axis=1) < APART_RAD]] = False
    return np.array(rows, dtype=np.intp)


def scaled_height_m(arm: Arm, height_m: float) -> float:
    """A height above floor and boards, in proportion to the reach of a small arm."""
    return height_m * min(1.0, reach_m(arm) / SMALL_ARM_m)


def workspace_poses(
    arm: Arm, boards: Iterable[PlacedBoard], count: int, edge_share: float = 0.0, height_m: float = WORKSPACE_HEIGHT_M
) -> Array:
    """Collision-free poses (m, n), m <= count, spread over the joints' ranges, with this tip height above floor and boards."""
    q = spread_poses(joint_box(arm), count, edge_share)
    return np.asarray(q[is_clear_of(arm, body_points(arm, q), boards, scaled_height_m(arm, height_m))])


def is_clear_of(arm: Arm, points: Array, boards: Iterable[PlacedBoard], height_m: float) -> Mask:
    """Which poses of `body_points` are clear of the floor, their tips and what is over boards by this height."""
    lowest_m = arm.limits.floor_z_m + arm.limits.floor_clearance_m + height_m
    clear = is_above_floor(arm, points).all(axis=1) & (points[:, -1, 2] >= lowest_m)
    for board in boards:
        heights, is_over = heights_over_board(points, board)
        clear &= ~(is_over & (heights < height_m)).any(axis=1)
    return np.asarray(clear)


def joined(parts: Collection[Points]) -> Points:
    """Concatenate points, without extra columns."""
    present = [part for part in parts if len(part)]
    return make_points(
        [setup for part in present for setup in part.setup],
        [point for part in present for point in part.point],
        [repeat for part in present for repeat in part.repeat],
        np.concatenate([part.q_rad for part in present]),
        np.concatenate([part.tip_m for part in present]),
    )


def named(chosen: Points, recorded: Points | None) -> Points:
    """The points with names for free poses, and repeats, that no recorded point has."""
    have = Counter() if recorded is None else Counter(zip(recorded.setup, recorded.point, strict=True))
    highest = {} if recorded is None else _highest_repeats(recorded)
    points, repeats, number = [], [], 0
    for setup, point in zip(chosen.setup, chosen.point, strict=True):
        if setup == FREE:
            number += 1
            while (FREE, f"p{number}") in have:
                number += 1
            point = f"p{number}"
        highest[setup, point] = highest.get((setup, point), 0) + 1
        points.append(point)
        repeats.append(highest[setup, point])
    return make_points(chosen.setup, points, repeats, chosen.q_rad, chosen.tip_m)


def _highest_repeats(recorded: Points) -> dict[tuple[str, str], int]:
    highest: dict[tuple[str, str], int] = {}
    for setup, point, repeat in zip(recorded.setup, recorded.point, recorded.repeat, strict=True):
        highest[setup, point] = max(repeat, highest.get((setup, point), 0))
    return highest


def _is_clear_of_board(arm: Arm, q: Array, board: PlacedBoard) -> Mask:
    """Whether the arm, apart from the touching tip, is above the board (over it) and above the floor (elsewhere)."""
    points = body_points(arm, q)
    heights, is_over = heights_over_board(points, board)
    return np.asarray(np.where(is_over, heights >= -TOUCH_M, is_above_floor(arm, points)).all(axis=1))


def _first_of_each(rows: Rows, which: Rows) -> Rows:
    """At most POSTURES_LIMIT rows of each cavity."""
    seen: Counter[int] = Counter()
    chosen = []
    for row in rows:
        seen[int(which[row])] += 1
        if seen[int(which[row])] <= POSTURES_LIMIT:
            chosen.append(int(row))
    return np.array(chosen, dtype=np.intp)


def _is_taken(recorded: Points | None, setup: str, point: str, q_rad: Array) -> bool:
    """Whether the points contain this cavity in about this posture."""
    if recorded is None:
        return False
    rows = [k for k in range(len(recorded)) if (recorded.setup[k], recorded.point[k]) == (setup, point)]
    return bool(len(rows)) and float(np.abs(recorded.q_rad[rows] - q_rad).max(axis=1).min()) < TAKEN_RAD

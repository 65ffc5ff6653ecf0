"""How a session moves the arm: ports, clear ways, approaches from both sides of a gear's play, transfers,
free poses.

In: the arm's geometry and the board's place. Out: joint poses to pass in turn. The runtime implements the
ports (procedures.ports).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.boards import BoardPose
from calib.design.candidates import body_points
from calib.errors import SessionError
from control.errors import ArmError
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.rotation import logarithms
from control.model.arm import Arm
from control.model.table import board_cavities
from control.motion.joint_limits import reach_m
from control.tables import TableColumn, TableFormat, read_table

# Interfaces of a session to the arm, the hand that seats the tip, and the camera. The runtime implements
# them.


Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class SeenTip:
    """Mean tip that a camera saw, its standard deviation per axis, and the orientation of its target (w, x, y, z) if measured."""

    tip_m: Vector
    sd_m: Vector
    orientation: tuple[float, float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class RestSample:
    """Averaged encoders and motor currents, one value per joint.

    q_rad and its scatter q_sd_rad; current_A of the motors; direction: sign of each joint's last motion, 0
    unknown; temperature_C of the drives, empty if not measured. seen: the tip at the same time, if a
    camera saw it. count_rad: one count of each encoder at the joint, empty if not known.
    """

    q_rad: tuple[float, ...]
    q_sd_rad: tuple[float, ...]
    current_A: tuple[float, ...]
    direction: tuple[int, ...]
    temperature_C: tuple[float, ...] = ()
    seen: SeenTip | None = None
    count_rad: tuple[float, ...] = ()


class ArmPort(Protocol):
    """The arm, as moved and read by a session. Every call returns when it is complete."""

    def now_s(self) -> float:
        """Time of the session's clock."""

    def move_to_q(self, q_rad: Sequence[float]) -> None:
        """Move to joint angles and stop there."""

    def release(self) -> None:
        """Release the arm for hand guiding: drives off, without dropping it."""

    def hold(self) -> None:
        """Hold the present position by the drives."""

    def average(self, duration_s: float) -> RestSample:
        """Mean of encoders and currents over the next duration_s."""


class JogPort(ArmPort, Protocol):
    """An arm that can also be jogged."""

    def creep_to_q(self, q_rad: Sequence[float]) -> None:
        """Move slowly to nearby joint angles and stop there."""


class TipSeat(Protocol):
    """The hand that seats the tip: the operator's, or the mock hand."""

    def grip(self) -> None:
        """Return when the hand has the arm, so that the drives may let it go."""

    def seat(self, point_m: Vector) -> None:
        """Return when the tip is seated in the cavity at point_m (base frame)."""

    def let_go(self) -> None:
        """The hand is off the arm."""


class TipSensor(Protocol):
    """A device that measures the tip, in the base frame or in its own (SessionPlan.pose_frame)."""

    def measure(self, duration_s: float) -> SeenTip:
        """Mean over duration_s."""


class ArmGeometry:
    """The nominal geometry of an arm."""

    def __init__(self, arm: Arm) -> None:
        self._inverse = InverseKinematics(arm)
        self._rest = arm.rest.q_rad if arm.rest is not None else None

    def tip(self, q_rad: Sequence[float]) -> Vector:
        """Tip [m] in the base frame by the arm's own model."""
        return self._inverse.kinematics.tip(*q_rad)

    def nearest(self, point: Vector, q_near: Sequence[float]) -> Sequence[float]:
        """Joint angles within the limits for a tip position, on the branch nearest to q_near; ArmError if there are none."""
        return self._inverse.nearest(point, q_near)

    def posture(self, q_rad: Sequence[float]) -> Sequence[float]:
        """Near which to approach a point: where the arm is; without named branches its rest pose."""
        return q_rad if self._inverse.has_branches or self._rest is None else self._rest


# Collision-free paths between poses: straight if possible, else over a raised pose or the rest pose.
#
# Checked with the arm's own model, which may be centimetres off, so paths keep a margin.


MARGIN_m = 0.03  # above the board: possible error of an uncalibrated arm; poses above cavities are at 60 mm
EDGE_m = 0.03  # the board reaches this far beyond its outermost cavity
STEP_RAD = 0.05  # of the joint with the longest travel, between checks
HIGHER_m = (0.05, 0.1, 0.2)
Pose = tuple[float, ...]


class NoClearPath(ArmError):
    """All candidate paths come too close to the board or the floor."""


class ClearPaths:
    """Finds collision-free paths for one arm."""

    def __init__(self, arm: Arm, geometry: ArmGeometry) -> None:
        self._arm, self._geometry = arm, geometry
        cavities = [] if arm.table is None else [*board_cavities(arm.table).values()]
        self._reach_m = max((float(np.hypot(x, y)) for x, y, _ in cavities), default=0.0) + EDGE_m

    def stops(self, start_rad: Sequence[float], end_rad: Sequence[float], board: BoardPose | None) -> list[Pose]:
        """Poses to visit in order, the last of them end_rad. NoClearPath if there is no such path.

        `board`: its present pose; None if unknown, or without a board.
        """
        start, end = tuple(start_rad), tuple(end_rad)
        for way in self._candidates(start, end):
            if all(self._is_clear(a, b, board) for a, b in zip([start, *way[:-1]], way, strict=True)):
                return way
        raise NoClearPath(
            f"no collision-free path from {_spelled(start)} to {_spelled(end)} rad: direct, raised and through the rest pose"
            f" the arm comes within {1e3 * MARGIN_m:g} mm of the board or the floor; move the arm up, then `redo`"
        )

    def _candidates(self, start: Pose, end: Pose) -> list[list[Pose]]:
        ways = [[end]]
        for up_m in HIGHER_m:
            high_start, high_end = self._higher(start, up_m), self._higher(end, up_m)
            if high_start is not None and high_end is not None:
                ways.append([high_start, high_end, end])
        if self._arm.rest is not None:
            rest = tuple(self._arm.rest.q_rad)
            ways += [[rest, end]]
            ways += [
                [a, rest, b, end]
                for up_m in HIGHER_m
                if (a := self._higher(start, up_m)) is not None and (b := self._higher(end, up_m)) is not None
            ]
        return ways

    def _higher(self, q_rad: Pose, up_m: float) -> Pose | None:
        x, y, z = self._geometry.tip(q_rad)
        try:
            return tuple(self._geometry.nearest((x, y, z + up_m), q_rad))
        except ArmError:
            return None

    def _is_clear(self, start: Pose, end: Pose, board: BoardPose | None) -> bool:
        """Whether a straight joint move keeps clear; start and end may be lower."""
        first, last = np.array(start), np.array(end)
        count = 2 + int(np.abs(last - first).max() / STEP_RAD)
        q_rad = first + np.linspace(0.0, 1.0, count)[:, None] * (last - first)
        points = body_points(self._arm, q_rad)
        limits = self._arm.limits
        room = points[:, :, 2] - (limits.floor_z_m + limits.floor_clearance_m)
        if board is not None:
            local = (points - board.origin_m) @ board.rotation
            is_over = np.hypot(local[:, :, 0], local[:, :, 1]) <= self._reach_m
            room = np.where(is_over, local[:, :, 2], room)
        least = room.min(axis=1)
        return bool((least >= np.minimum(MARGIN_m, min(least[0], least[-1])) - 1e-9).all())


def _spelled(q_rad: Pose) -> str:
    return "(" + ", ".join(f"{q:.3f}" for q in q_rad) + ")"


# Moves between points: up along the board's normal, and across. The drives never take the tip down to the
# board.


FIRST_LIFT_m = 0.01  # out of the cavity first: a short joint move is straight to a tenth of a millimetre
NEAR = 0.9  # of the height above: below this, the arm lifts before any move


class Transfers:
    """Moves the arm from above one point to above the next."""

    def __init__(
        self, geometry: ArmGeometry, arm: ArmPort, approach_m: float, window_s: float, ways: ClearPaths | None = None
    ) -> None:
        """`ways`: finds paths around the board; without it, every path is assumed to be clear."""
        self._geometry, self._arm, self._ways = geometry, arm, ways
        self._approach_m, self._window_s = approach_m, window_s
        self._q_rad = tuple(arm.average(window_s).q_rad)
        self._normal: Vector | None = None  # of the board at which the arm is, None if it is free

    @property
    def is_at_point(self) -> bool:
        """Whether the tip is, or may be, at a point; then the arm lifts before any move."""
        return self._normal is not None

    def stands_at(self, normal: Vector) -> None:
        """Note that the tip is at a point of a board with this normal."""
        self._normal = normal

    def stands_over(self, origin_m: Vector, normal: Vector) -> None:
        """Note that the tip may be at a point, if it is lower than the points above this board's cavities."""
        height_m = sum(n * (a - b) for n, a, b in zip(normal, self._geometry.tip(self._q_rad), origin_m, strict=True))
        if height_m < NEAR * self._approach_m:
            self._normal = normal

    def plan(
        self, tip_m: Vector, normal: Vector, approach: int = 1, approaches: int = 1, posture_rad: Sequence[float] | None = None
    ) -> tuple[float, ...]:
        """Angles above a point, nearest to the posture, or to the geometry's; ArmError if it or the point is out of reach."""
        near = self._geometry.posture(self._q_rad) if posture_rad is None else posture_rad
        start = straight_above(tip_m, normal, self._approach_m)
        if approaches > 1:
            start = opposed_starts(self._geometry, tip_m, normal, self._approach_m, near)[approach - 1]
        above = tuple(self._geometry.nearest(start, near))
        self._geometry.nearest(tip_m, above)
        return above

    def lift(self) -> bool:
        """Move straight up from the present point, if at one; return whether it was.

        Starts from the arm's own pose, because an uncalibrated arm's cavities are off.
        """
        if self._normal is None:
            return False
        q_rad: Sequence[float] = self._arm.average(self._window_s).q_rad
        x, y, z = self._geometry.tip(q_rad)
        nx, ny, nz = self._normal
        for up_m in (FIRST_LIFT_m, self._approach_m):
            q_rad = self._geometry.nearest((x + up_m * nx, y + up_m * ny, z + up_m * nz), q_rad)
            self._arm.move_to_q(q_rad)
        self._q_rad, self._normal = tuple(q_rad), None
        return True

    def go(self, q_rad: Sequence[float], board: BoardPose | None = None) -> None:
        """Move up, and across to these angles, clear of the board. ArmError, after the lift, if there is no clear path."""
        self.lift()
        stops = [tuple(q_rad)] if self._ways is None else self._ways.stops(self._q_rad, q_rad, board)
        for stop in stops:
            self._arm.move_to_q(stop)
            self._q_rad = stop


# Approach directions to a point that reveal backlash in the joints.
#
# With two approaches, a point is reached by two straight paths that turn as many joints as possible in
# opposite directions. Every path ends downwards (a tip cannot come up through the board), so geometry
# allows two of three joints on most of a board.


SLANTS_RAD = (0.6, 0.95)  # of a slanted path against the normal: beyond 1 rad the tip would touch neighbouring cavities
SIDES = 8


def straight_above(tip_m: Vector, normal: Vector, height_m: float) -> Vector:
    """Start point of the approach straight down to tip_m (base frame)."""
    return _start(tip_m, normal, (0.0, 0.0, 0.0), height_m)


def opposed_starts(
    geometry: ArmGeometry, tip_m: Vector, normal: Vector, height_m: float, q_near: Sequence[float]
) -> tuple[Vector, Vector]:
    """Start points of two approaches to tip_m, each height_m above the board (base frame). ArmError if out of reach."""
    straight = straight_above(tip_m, normal, height_m)
    at_point = geometry.nearest(tip_m, q_near)
    turns = {straight: _turns(geometry, straight, at_point)}
    for across in _across(normal):
        start = _start(tip_m, normal, across, height_m)
        try:
            turns[start] = _turns(geometry, start, at_point)
        except ArmError:
            continue  # not from this side
    if len(turns) == 1:
        return (straight, straight)
    return max(combinations(turns, 2), key=lambda pair: _opposition(turns[pair[0]], turns[pair[1]]))


def _across(normal: Vector) -> list[Vector]:
    """Horizontal offsets per unit of height: all sides, slightly and strongly slanted."""
    nx, ny, nz = normal
    norm = math.hypot(nx, nz)
    u = (nz / norm, 0.0, -nx / norm)
    v = (ny * u[2] - nz * u[1], nz * u[0] - nx * u[2], nx * u[1] - ny * u[0])
    ways = []
    for slant in SLANTS_RAD:
        for side in range(SIDES):
            angle = 2.0 * math.pi * side / SIDES
            c, s = math.tan(slant) * math.cos(angle), math.tan(slant) * math.sin(angle)
            ways.append((c * u[0] + s * v[0], c * u[1] + s * v[1], c * u[2] + s * v[2]))
    return ways


def _start(tip_m: Vector, normal: Vector, across: Vector, height_m: float) -> Vector:
    x, y, z = (p + height_m * (n + a) for p, n, a in zip(tip_m, normal, across, strict=True))
    return x, y, z


def _turns(geometry: ArmGeometry, start: Vector, at_point: Sequence[float]) -> tuple[float, ...]:
    """Travel of each joint from start to the point [rad]."""
    return tuple(b - a for a, b in zip(geometry.nearest(start, at_point), at_point, strict=True))


def _opposition(first: Sequence[float], second: Sequence[float]) -> tuple[int, float]:
    """Number of joints that turn in opposite directions, and their smallest travel [rad]: more is better."""
    opposite = [min(abs(a), abs(b)) for a, b in zip(first, second, strict=True) if a * b < 0.0]
    return len(opposite), min(opposite, default=0.0)


# Free poses to record with a camera: spread over the joints' ranges, with them and the paths between well
# above the board.
#
# The choice is the same for the same arm and count.


CANDIDATES = 4000
MARGIN = 0.1  # of each joint's range, kept free at either end
CLEARANCE_m = 0.12  # of tip and elbow above the floor and the board: an uncalibrated arm is some 3 cm off
STILL_m = 1e-9  # a height that changes by less over all candidates does not depend on the joints
REACH = 0.95  # of the longest reach among the candidates: a stretched arm is hard to see
SEEN_CANDIDATES = 50_000  # of which few turn the last link so that a camera sees the target on it
SEEN_TILT_rad = 0.7  # beyond it corners of a printed target are hard to find
SEEN_SHARE = 0.4  # of the reach: a webcam that sees the whole arm sees so far around a place
WAY_STEPS = 25
UNLIMITED_rad = math.pi / 2  # range taken for a joint without limits


def chosen_free_poses(arm: Arm, count: int, seen_rad: Sequence[float] | None = None) -> dict[str, tuple[float, ...]]:
    """`count` poses by name f1, f2, ..., in an order with short paths; SessionError if there is no room.

    `seen_rad`: a pose in which a camera sees the target on the last link from the front. It sees it also where that link is
    turned by no more than SEEN_TILT_rad and has moved by no more than SEEN_SHARE of the reach; only such poses are taken.
    """
    lower, upper = _ranges(arm)
    draw = np.random.default_rng(count)
    unit = draw.uniform(0.0, 1.0, (CANDIDATES if seen_rad is None else SEEN_CANDIDATES, arm.joint_count))
    if seen_rad is not None:
        unit = unit[_is_seen(arm, lower + unit * (upper - lower), seen_rad)][:CANDIDATES]
    q_rad = lower + unit * (upper - lower)
    if len(q_rad) < count:
        raise SessionError(
            f"--free {count}: only {len(q_rad)} candidate poses of arm {arm.name} show the target as that of --seen does: give"
            " fewer, another pose, or the poses in a file"
        )
    space = _Space(arm, q_rad)
    is_clear = space.clearance_m(q_rad) > 0.0
    out_m = np.linalg.norm(space.kinematics.tips(q_rad), axis=1)
    is_clear &= out_m < REACH * out_m.max()
    if is_clear.sum() < count:
        raise SessionError(
            f"--free {count}: only {int(is_clear.sum())} of {CANDIDATES} candidate poses of arm {arm.name} are"
            f" {CLEARANCE_m:g} m above the table: give the poses in a file"
        )
    rows = _spread(unit[is_clear], count)
    ordered = _ordered(space, q_rad[is_clear][rows])
    return {f"f{k + 1}": tuple(round(float(q), 4) for q in pose) for k, pose in enumerate(ordered)}


def _is_seen(arm: Arm, q_rad: Array, seen_rad: Sequence[float]) -> npt.NDArray[np.bool_]:
    frames = ForwardKinematics(arm).link_transforms(np.vstack((seen_rad, q_rad)))[:, -1]
    turned = logarithms(frames[1:, :3, :3] @ frames[0, :3, :3].T)
    moved_m = np.linalg.norm(frames[1:, :3, 3] - frames[0, :3, 3], axis=1)
    near_m = SEEN_SHARE * reach_m(arm)
    return np.asarray((np.linalg.norm(turned, axis=1) <= SEEN_TILT_rad) & (moved_m <= near_m))


FREE_POSES = TableFormat(
    "pose",
    (
        TableColumn("point", "name of the pose; empty: f1, f2, ... by its place", is_name=True),
        TableColumn(
            "q{}_rad", "joint angles", is_required=True, lower=-6.0 * math.pi, upper=6.0 * math.pi, expected="an angle in radians"
        ),
    ),
    unwarned=".*",
    is_padded=True,
)


def read_free_poses(path: Path, joint_count: int) -> dict[str, tuple[float, ...]]:
    """Poses of a file with the columns q1_rad ... and, optionally, point. SessionError names file, line and column."""
    table = read_table(path, FREE_POSES, SessionError, joint_count)
    poses: dict[str, tuple[float, ...]] = {}
    for row, (name, q_rad) in enumerate(zip(table.words("point"), table.joints("q{}_rad").tolist(), strict=True)):
        pose = name or f"f{row + 1}"
        if pose in poses:
            raise SessionError(f"{table.place(row)}: pose {pose} appears twice")
        poses[pose] = tuple(q_rad)
    return poses


def _ranges(arm: Arm) -> tuple[Array, Array]:
    limits = np.array(arm.limits_rad)
    limits = np.where(np.isfinite(limits), limits, np.array([-UNLIMITED_rad, UNLIMITED_rad]))
    room = MARGIN * (limits[:, 1] - limits[:, 0])
    return limits[:, 0] + room, limits[:, 1] - room


class _Space:
    """How far the arm is above the floor and the board."""

    def __init__(self, arm: Arm, candidates_rad: Array) -> None:
        self.kinematics = ForwardKinematics(arm)
        self._lowest_m = max(arm.limits.floor_z_m, _board_top_m(arm)) + CLEARANCE_m
        heights_m = self._heights_m(candidates_rad)
        # An origin that no joint raises or lowers, such as the shoulder, belongs to the stand: it limits no pose.
        self._moving = np.ptp(heights_m, axis=0) > STILL_m

    def _heights_m(self, q_rad: Array) -> Array:
        """Heights of the links' origins and of the tip, shape (poses, links + 1)."""
        links = self.kinematics.link_transforms(q_rad)[:, :, 2, 3]
        return np.column_stack([links, self.kinematics.tips(q_rad)[:, 2]])

    def clearance_m(self, q_rad: Array) -> Array:
        """Height of the lowest moving point above floor and board, minus the required one, shape (poses,)."""
        heights_m = self._heights_m(q_rad)[:, self._moving]
        return np.asarray(heights_m.min(axis=1, initial=math.inf) - self._lowest_m)

    def is_clear(self, start_rad: Array, end_rad: Array) -> bool:
        """Whether a joint move stays half the clearance above the table."""
        shares = np.linspace(0.0, 1.0, WAY_STEPS)[:, None]
        way_rad = start_rad + shares * (end_rad - start_rad)
        return bool((self.clearance_m(way_rad) > -0.5 * CLEARANCE_m).all())


def _board_top_m(arm: Arm) -> float:
    table = arm.table
    return table.origin_m[2] if table is not None and table.origin_m is not None else 0.0


def _spread(unit: Array, count: int) -> list[int]:
    """Rows far from each other: each next one is the farthest from those chosen."""
    rows = [int(np.argmin(np.linalg.norm(unit - unit.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(unit - unit[rows[0]], axis=1)
    while len(rows) < count:
        rows.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(unit - unit[rows[-1]], axis=1))
    return rows


def _ordered(space: _Space, q_rad: Array) -> list[Array]:
    """Order the poses: each next one is the nearest with a clear path."""
    waiting, ordered = list(q_rad), list[Array]()
    here = waiting[0]
    while waiting:
        waiting.sort(key=lambda pose: float(np.linalg.norm(pose - here)))
        clear = [k for k, pose in enumerate(waiting) if not ordered or space.is_clear(here, pose)]
        here = waiting.pop(clear[0] if clear else 0)
        ordered.append(here)
    return ordered

"""The test cube of ISO 9283:1998, clause 6.8, and the largest one within reach, joint limits and above the floor."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.iso9283.criteria.checks import Iso9283Error, above_zero, position
from control.errors import ArmError
from control.kinematics.inverse import BRANCHES, InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.motion.checks import LEAST_SINGULAR_M_RAD
from control.motion.joint_limits import reach_m

CLEARANCE_m = 0.08  # of the cube above the floor: an uncalibrated arm is some 3 cm off
LIMIT_MARGIN_rad = 0.05  # to the joint limits, for overshooting runs
SMALLEST_EDGE_m = 0.02
_TOLERANCE_m = 0.005  # resolution of the edge
_STEPS = 9  # of the grid of centres, along each axis
_ROUNDS = 3  # number of refinements
BASE_COLUMN_m = 0.1  # around the base's vertical axis, kept free of the cube for the arm itself
_CHECKED = 5  # points along each edge

Solver = Callable[[Array], tuple[float, ...]]


def largest_cube(arm: Arm) -> TestCube:
    """The largest cube with edges along the base axes, to 5 mm of its edge; Iso9283Error if not even 2 cm fit.

    Its centre is straight ahead, towards the table, or along x; it is searched on a refined grid.
    """
    _require_volume(arm)
    found = [cube for solver in solvers(arm) if (cube := _grown(arm, solver, reach_m(arm))) is not None]
    if not found:
        raise Iso9283Error(
            f"arm {arm.name}: no test cube of {SMALLEST_EDGE_m:g} m fits within the joint limits and {CLEARANCE_m:g} m above"
            " the floor: give one with --cube-centre and --cube-edge"
        )
    return max(found, key=lambda cube: cube.edge_m)


def solver_of(arm: Arm, cube: TestCube) -> Solver:
    """Solver of joint angles for points of `cube`, on one branch that reaches all of it; Iso9283Error if there is none.

    A cube chosen by the user may be closer to floor and joint limits than a searched one.
    """
    _require_volume(arm)
    reasons = []
    for solver in solvers(arm, margin_rad=0.0):
        reason = _obstacle(arm, solver, cube, clearance_m=0.0)
        if not reason:
            return solver
        reasons.append(reason)
    raise Iso9283Error(
        f"arm {arm.name}: part of the test cube at {cube.centre_m} m with edge {cube.edge_m:g} m is out of reach:"
        f" {reasons[0]}; choose another with --cube-centre and --cube-edge, or omit both"
    )


def solvers(arm: Arm, margin_rad: float = LIMIT_MARGIN_rad) -> Iterator[Solver]:
    """Inverse kinematics on each branch, or from the rest pose if the arm has no named branches.

    A solver raises ArmError for points that are out of reach, near a limit or near-singular.
    """
    inverse = InverseKinematics(arm)
    limits = [(lower + margin_rad, upper - margin_rad) for lower, upper in arm.limits_rad]
    rest = arm.rest.q_rad if arm.rest is not None else (0.0,) * arm.joint_count

    def checked(q: tuple[float, ...]) -> tuple[float, ...]:
        if not all(lower <= a <= upper for a, (lower, upper) in zip(q, limits, strict=True)):
            raise Iso9283Error(f"a joint would be within {margin_rad:g} rad of its limit")
        return q

    if not inverse.has_branches:
        yield lambda point: checked(inverse.nearest(point_of(point), rest))
        return
    for branch in BRANCHES:
        yield lambda point, branch=branch: checked(inverse.solve(point_of(point), branch))  # type: ignore[misc]


def _require_volume(arm: Arm) -> None:
    """Iso9283Error for an arm whose tip moves on a surface."""
    if not InverseKinematics(arm).moves_freely:
        raise Iso9283Error(
            f"arm {arm.name}: its tip moves on a surface, as with two joints or axes that are all parallel; the test cube of"
            " ISO 9283 needs three directions"
        )


def _grown(arm: Arm, solver: Solver, reach: float) -> TestCube | None:
    """The largest cube of one solver with its centre in the plane ahead, where the table is (x if there is none)."""
    table = arm.table.origin_m if arm.table is not None else None
    x, y = (table[0], table[1]) if table is not None and np.hypot(table[0], table[1]) > 0.0 else (1.0, 0.0)
    ahead = np.array([x, y, 0.0]) / np.hypot(x, y)
    middle, span, best = reach * (0.5 * ahead + [0.0, 0.0, 0.5]), 0.5 * reach, None
    for _ in range(_ROUNDS):
        for forward in np.linspace(-span, span, _STEPS):
            for up in np.linspace(-span, span, _STEPS):
                centre = middle + forward * ahead + [0.0, 0.0, up]
                least = best.edge_m + _TOLERANCE_m if best is not None else SMALLEST_EDGE_m
                best = _largest_at(arm, solver, centre, least, reach) or best
        if best is None:
            return None
        middle, span = np.asarray(best.centre_m), 0.4 * span
    return best


def _largest_at(arm: Arm, solver: Solver, centre: Array, least_m: float, reach: float) -> TestCube | None:
    """The largest cube around a centre, None if not even `least_m` fits."""

    def fits(edge_m: float) -> TestCube | None:
        cube = TestCube(point_of(centre), edge_m)
        return None if _obstacle(arm, solver, cube, CLEARANCE_m) else cube

    best = fits(least_m)
    lower, upper = least_m, 1.2 * reach
    while best is not None and upper - lower > _TOLERANCE_m:
        edge = 0.5 * (lower + upper)
        larger = fits(edge)
        best, lower, upper = (larger, edge, upper) if larger else (best, lower, edge)
    return best


def _obstacle(arm: Arm, solver: Solver, cube: TestCube, clearance_m: float) -> str:
    """Why a cube is not completely within reach; empty if it is."""
    floor_m = arm.limits.floor_z_m + arm.limits.floor_clearance_m + clearance_m
    if cube.centre_m[2] - 0.5 * cube.edge_m < floor_m:
        return f"it goes below {floor_m:g} m"
    beside = np.maximum(np.abs(cube.centre_m[:2]) - 0.5 * cube.edge_m, 0.0)
    if np.hypot(beside[0], beside[1]) < (BASE_COLUMN_m if clearance_m else 0.0):
        return f"it comes within {BASE_COLUMN_m:g} m of the base's axis"
    grid = cube.grid(_CHECKED)
    try:
        q_rad = [solver(point) for point in grid]
    except (ArmError, Iso9283Error) as error:
        return str(error)
    jacobians = ForwardKinematics(arm).jacobians(q_rad)
    if (
        arm.joint_count >= 3
        and np.linalg.svd(jacobians, compute_uv=False)[:, -1].min() < LEAST_SINGULAR_M_RAD
    ):
        return "the arm is near-singular inside it"
    return ""


# The test cube, ISO 9283:1998 clause 6.8: its diagonal plane and the five poses on it.
#
# Corners C1 .. C4 go round the upper face, C5 .. C8 lie below them. Seen from above, C1 is at -x -y, C2 at -x +y,
# C3 at +x +y, C4 at +x -y (which corner is C1 is our choice). The plane through C1, C2, C7, C8 is used: from the edge
# above and near the base to the edge below and far from it, for a cube that stands in front of the arm.

Point = tuple[float, float, float]
FROM_THE_ENDS = 0.1  # of a diagonal's length: where P2 .. P5 are; the standard: 10 % +- 2 %
POSES = ("P1", "P2", "P3", "P4", "P5")
_CORNERS = (
    (-1, -1, 1),
    (-1, 1, 1),
    (1, 1, 1),
    (1, -1, 1),
    (-1, -1, -1),
    (-1, 1, -1),
    (1, 1, -1),
    (1, -1, -1),
)


@dataclass(frozen=True, slots=True)
class TestCube:
    """A cube with edges along the base frame's axes: centre and edge length in m."""

    __test__ = False  # not a test of pytest's

    centre_m: Point
    edge_m: float

    def __post_init__(self) -> None:
        """Iso9283Error for an invalid centre or edge."""
        position(self.centre_m, "test cube, centre")
        above_zero(self.edge_m, "test cube, edge")

    def corner(self, number: int) -> Array:
        """C1 .. C8 (3,) by number."""
        return np.asarray(self.centre_m) + 0.5 * self.edge_m * np.array(_CORNERS[number - 1])

    def poses(self) -> dict[str, Point]:
        """P1 in the middle, P2 .. P5 at a tenth of the diagonals from C1, C2, C7, C8: P2 and P4 on one diagonal."""
        ends = [self.corner(number) for number in (1, 2, 7, 8)]
        centre = np.asarray(self.centre_m)
        inner = [end + 2.0 * FROM_THE_ENDS * (centre - end) for end in ends]
        return {name: point_of(p) for name, p in zip(POSES, (centre, *inner), strict=True)}

    def on_plane(self, across: float, down: float) -> Point:
        """A point of the diagonal plane: `across` along y, `down` from the edge C1 C2 to C7 C8, each -1 .. 1."""
        half = 0.5 * self.edge_m
        return point_of(np.asarray(self.centre_m) + half * np.array([down, across, -down]))

    def grid(self, count: int) -> Array:
        """A grid of points in the cube (count^3, 3), its corners first."""
        steps = np.linspace(-1.0, 1.0, count)
        inner = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.asarray(self.centre_m) + 0.5 * self.edge_m * np.concatenate([np.array(_CORNERS), inner])


def point_of(values: Array) -> Point:
    """A position (3,) as three floats."""
    x, y, z = (float(v) for v in values)
    return x, y, z

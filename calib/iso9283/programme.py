"""The test programmes of ISO 9283 and the cube in the workspace that they are for."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.iso9283.pose_criteria import Iso9283Error, above_zero, position
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
    cubes = [cube for solver in solvers(arm) if (cube := _grown(arm, solver, reach_m(arm))) is not None]
    if not cubes:
        raise Iso9283Error(
            f"arm {arm.name}: no test cube of {SMALLEST_EDGE_m:g} m fits within the joint limits and {CLEARANCE_m:g} m above"
            " the floor: give one with --cube-centre and --cube-edge"
        )
    return max(cubes, key=lambda cube: cube.edge_m)


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

    def checked(q: tuple[float, ...]) -> tuple[float, ...]:
        if not all(lower <= a <= upper for a, (lower, upper) in zip(q, limits, strict=True)):
            raise Iso9283Error(f"a joint would be within {margin_rad:g} rad of its limit")
        return q

    if not inverse.has_branches:
        yield lambda point: checked(inverse.nearest(point_of(point), arm.rest_rad))
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
    if arm.joint_count >= 3 and np.linalg.svd(jacobians, compute_uv=False)[:, -1].min() < LEAST_SINGULAR_M_RAD:
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
_CORNERS = ((-1, -1, 1), (-1, 1, 1), (1, 1, 1), (1, -1, 1), (-1, -1, -1), (-1, 1, -1), (1, 1, -1), (1, -1, -1))


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


# The test programmes of ISO 9283:1998 as data: poses and paths in order.
#
# Names in the records: points.csv has the programme in `setup` (pose, from_x, from_y, from_z, distance, drift_1,
# drift_2, ..., load, posing) and the pose in `point`; log.csv has it in the column `programme` (approach, posing, line,
# circle, rectangle, weave) with `cycle` and the commanded `speed_m_s`.


PROGRAMMES = ("pose", "directions", "distance", "drift", "path", "cornering", "posing", "load", "weaving")
AXES = ("x", "y", "z")
SETTLING_CYCLES = 3  # number of recorded approaches to P1, for stabilization and overshoot
DRIFT_CYCLES = 10  # of one set of drift measurements
CORNERING_CYCLES = 3
POSING_SHARES = (0.125, 0.25, 0.5, 1.0)  # of the distance from P2 to P4
LOADS = 10  # equal steps up to the rated load
LINE_SHARE, CIRCLE_SHARE, RECTANGLE_SHARE = 0.8, 0.8, 0.6  # of the plane's width and of its fall line
WAVES, WAVE_POINTS, WEAVE_STROKE = 6, 12, 0.08  # strokes as a share of the cube's edge
WEAVE_SPEED_SHARE = 0.1
_SPACING_m = 0.02  # of way-points along the rectangle's legs, to keep them straight


@dataclass(frozen=True, slots=True)
class Extent:
    """Extent of a test. The defaults are the standard's, except for the drift, which the standard observes for hours."""

    repeats: int = 30
    path_cycles: int = 10
    speed_shares: tuple[float, ...] = (0.1, 0.5, 1.0)
    drift_s: float = 600.0
    drift_sets: int = 4
    rated_load_kg: float = 0.0
    programmes: tuple[str, ...] = PROGRAMMES

    def __post_init__(self) -> None:
        """Iso9283Error for counts that allow no evaluation, or unknown programmes."""
        if self.repeats < 2 or self.path_cycles < 2 or self.drift_sets < 2:
            raise Iso9283Error(
                "repeatability needs at least 2 repeats, 2 path cycles and 2 drift sets:"
                f" got {self.repeats}, {self.path_cycles} and {self.drift_sets}"
            )
        if not self.speed_shares or not all(0.0 < share <= 1.0 for share in self.speed_shares):
            raise Iso9283Error(f"speeds: expected shares of the rated speed above 0 and up to 1, got {self.speed_shares}")
        if not (math.isfinite(self.drift_s) and self.drift_s >= 0.0 and 0.0 <= self.rated_load_kg < 100.0):
            raise Iso9283Error(
                f"expected a drift time and a rated load of 0 or more, got {self.drift_s:g} s and {self.rated_load_kg:g} kg"
            )
        unknown = [name for name in self.programmes if name not in PROGRAMMES]
        if unknown or not self.programmes:
            raise Iso9283Error(f"programmes: expected some of {', '.join(PROGRAMMES)}; got {', '.join(unknown) or 'none'}")


@dataclass(frozen=True, slots=True)
class Visit:
    """Go to a pose from `via_m` (straight from the last pose if absent), rest, average. Base frame, m.

    `recorded`: name of the approach in log.csv, empty if it is not recorded. `not_before_s`: since the
    programme started. `payload_kg`: load at the tip.
    """

    setup: str
    point: str
    repeat: int
    tip_m: Point
    via_m: Point | None = None
    recorded: str = ""
    payload_kg: float = 0.0
    not_before_s: float = 0.0


@dataclass(frozen=True, slots=True)
class PathRun:
    """Run a Cartesian path once: way-points with speeds, base frame; `speed_m_s` is the commanded one."""

    programme: str
    cycle: int
    speed_m_s: float
    points_m: tuple[Point, ...]
    speeds_m_s: tuple[float, ...]


Step = Visit | PathRun


def steps(cube: TestCube, extent: Extent, rated_speed_m_s: float) -> list[Step]:
    """All of the extent's programmes, in order."""
    parts: dict[str, Iterator[Step]] = {
        "pose": pose_programme(cube, extent.repeats),
        "directions": direction_programme(cube, extent.repeats),
        "distance": distance_programme(cube, extent.repeats),
        "path": path_programme(cube, extent.path_cycles, extent.speed_shares, rated_speed_m_s),
        "cornering": cornering_programme(cube, extent.speed_shares, rated_speed_m_s),
        "weaving": weaving_programme(cube, min(SETTLING_CYCLES, extent.path_cycles), rated_speed_m_s),
        "posing": posing_programme(cube),
        "load": load_programme(cube, extent.rated_load_kg),
        "drift": drift_programme(cube, extent.drift_sets, extent.drift_s),
    }
    return [step for name, part in parts.items() if name in extent.programmes for step in part]


def pose_programme(cube: TestCube, repeats: int) -> Iterator[Step]:
    """P5, P4, P3, P2, P1 in turn, so that each is always reached from the same one."""
    poses = cube.poses()
    for repeat in range(1, repeats + 1):
        for name in reversed(poses):
            recorded = "approach" if name == "P1" and repeat <= SETTLING_CYCLES else ""
            yield Visit("pose", name, repeat, poses[name], recorded=recorded)


def direction_programme(cube: TestCube, repeats: int) -> Iterator[Step]:
    """P1, P2 and P4 from three perpendicular directions, parallel to the base axes, from inside the cube."""
    poses, centre = cube.poses(), np.asarray(cube.centre_m)
    for repeat in range(1, repeats + 1):
        for axis, letter in enumerate(AXES):
            for name in ("P1", "P2", "P4"):
                tip = np.asarray(poses[name])
                inward = 1.0 if tip[axis] <= centre[axis] else -1.0
                via = tip + 0.2 * cube.edge_m * inward * np.eye(3)[axis]
                yield Visit(f"from_{letter}", name, repeat, poses[name], point_of(via))


def distance_programme(cube: TestCube, repeats: int) -> Iterator[Step]:
    """Between P2 and P4."""
    poses = cube.poses()
    for repeat in range(1, repeats + 1):
        for name in ("P2", "P4"):
            yield Visit("distance", name, repeat, poses[name])


def drift_programme(cube: TestCube, sets: int, duration_s: float) -> Iterator[Step]:
    """Sets of ten visits of P1 from P2, spread over the duration."""
    poses = cube.poses()
    for k in range(sets):
        for repeat in range(1, DRIFT_CYCLES + 1):
            wait_s = duration_s * k / (sets - 1) if repeat == 1 else 0.0
            yield Visit(f"drift_{k + 1}", "P1", repeat, poses["P1"], poses["P2"], not_before_s=wait_s)


def posing_programme(cube: TestCube) -> Iterator[Step]:
    """From P2 towards P4 over several distances, three times each."""
    poses = cube.poses()
    start, end = np.asarray(poses["P2"]), np.asarray(poses["P4"])
    for share in POSING_SHARES:
        for repeat in range(1, SETTLING_CYCLES + 1):
            target = point_of(start + share * (end - start))
            yield Visit("posing", f"{1e3 * share * np.linalg.norm(end - start):.0f} mm", repeat, target, poses["P2"], "posing")


def load_programme(cube: TestCube, rated_load_kg: float) -> Iterator[Step]:
    """P1 with loads at the tip, from none to the rated load in ten steps, three times."""
    if rated_load_kg <= 0.0:
        return
    tip = cube.poses()["P1"]
    for repeat in range(1, SETTLING_CYCLES + 1):
        for k in range(LOADS + 1):
            yield Visit("load", f"P1 load {k}", repeat, tip, payload_kg=rated_load_kg * k / LOADS)


def path_programme(cube: TestCube, cycles: int, shares: Sequence[float], rated_speed_m_s: float) -> Iterator[PathRun]:
    """Straight line and circle on the diagonal plane at shares of the rated speed."""
    line = tuple(cube.on_plane(0.0, LINE_SHARE * d) for d in (-1.0, -0.5, 0.5, 1.0))
    circle = circle_points(cube, 24)
    for share in shares:
        speed = share * rated_speed_m_s
        for cycle in range(1, cycles + 1):
            yield PathRun("line", cycle, speed, line, (0.0, speed, speed, 0.0))
        for cycle in range(1, cycles + 1):
            yield PathRun("circle", cycle, speed, circle, (0.0, *[speed] * (len(circle) - 2), 0.0))


def circle_points(cube: TestCube, count: int) -> tuple[Point, ...]:
    """Once around on the diagonal plane, first point again at the end."""
    angles = 2.0 * np.pi * np.arange(count + 1) / count
    radius = CIRCLE_SHARE
    points = [cube.on_plane(radius * np.sin(a), -radius * np.cos(a) / np.sqrt(2.0)) for a in angles[:-1]]
    return (*points, points[0])


def cornering_programme(cube: TestCube, shares: Sequence[float], rated_speed_m_s: float) -> Iterator[Step]:
    """Three times around the rectangle E1 E2 E3 E4 E1 on the diagonal plane, without intentional rounding."""
    corners = rectangle_corners(cube)
    points: list[Point] = [corners[0]]
    for start, end in zip(corners, (*corners[1:], corners[0]), strict=True):
        a, b = np.asarray(start), np.asarray(end)
        count = max(2, round(float(np.linalg.norm(b - a)) / _SPACING_m))
        points += [point_of(a + (b - a) * k / count) for k in range(1, count + 1)]
    for share in shares:
        speed = share * rated_speed_m_s
        for cycle in range(1, CORNERING_CYCLES + 1):
            yield PathRun("rectangle", cycle, speed, tuple(points), (0.0, *[speed] * (len(points) - 2), 0.0))


def rectangle_corners(cube: TestCube) -> tuple[Point, ...]:
    """E1 .. E4 in the order of travel; E1 is where the path begins and ends at rest."""
    share = RECTANGLE_SHARE
    return tuple(cube.on_plane(share * a, share * d) for a, d in ((-1, -1), (1, -1), (1, 1), (-1, 1)))


def weaving_programme(cube: TestCube, cycles: int, rated_speed_m_s: float) -> Iterator[Step]:
    """A sine about the straight line of the path programme."""
    count = WAVES * WAVE_POINTS
    points = [
        cube.on_plane(WEAVE_STROKE * math.sin(2.0 * math.pi * k / WAVE_POINTS), LINE_SHARE * (2.0 * k / count - 1.0))
        for k in range(count + 1)
    ]
    speed = WEAVE_SPEED_SHARE * rated_speed_m_s
    for cycle in range(1, cycles + 1):
        yield PathRun("weave", cycle, speed, tuple(points), (0.0, *[speed] * (count - 1), 0.0))


def programme_document(cube: TestCube, extent: Extent, rated_speed_m_s: float) -> dict[str, object]:
    """programme.json: data for the evaluation besides the records."""
    return {
        "format": "iso9283-programme/1",
        "cube": {"centre_m": list(cube.centre_m), "edge_m": cube.edge_m, "plane": "C1-C2-C7-C8"},
        "poses_m": {name: list(tip) for name, tip in cube.poses().items()},
        "rectangle_m": [list(corner) for corner in rectangle_corners(cube)],
        "repeats": extent.repeats,
        "path_cycles": extent.path_cycles,
        "rated_speed_m_s": rated_speed_m_s,
        "speed_shares": list(extent.speed_shares),
        "drift_s": extent.drift_s,
        "drift_sets": extent.drift_sets,
        "rated_load_kg": extent.rated_load_kg,
        "programmes": list(extent.programmes),
    }

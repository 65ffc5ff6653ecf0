"""ISO 9283's test cube, the poses and paths on its plane, the programmes, and the cube that an arm reaches."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from calib.iso9283 import programme as programmes
from calib.iso9283.pose_criteria import Iso9283Error
from calib.iso9283.programme import CLEARANCE_m, Extent, PathRun, TestCube, Visit, largest_cube, solver_of, steps
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.description import load_arm
from tests.places import ARMS

CUBE = TestCube((0.4, 0.1, 0.3), 0.2)
SMALL = Extent(repeats=2, path_cycles=2, speed_shares=(0.5,), drift_s=10.0, drift_sets=2, rated_load_kg=1.0)


@pytest.fixture(scope="module")
def arm() -> Arm:
    return load_arm("right")


def test_p1_is_the_centre_and_the_others_lie_a_tenth_of_the_diagonal_from_the_ends() -> None:
    poses = {name: np.array(tip) for name, tip in CUBE.poses().items()}
    assert poses["P1"] == pytest.approx(CUBE.centre_m)
    for name, corner in (("P2", 1), ("P3", 2), ("P4", 7), ("P5", 8)):
        diagonal = np.sqrt(3.0) * CUBE.edge_m
        assert np.linalg.norm(poses[name] - CUBE.corner(corner)) == pytest.approx(0.1 * diagonal)
    assert np.linalg.norm(poses["P2"] - poses["P4"]) == pytest.approx(0.8 * np.sqrt(3.0) * CUBE.edge_m)


def test_all_poses_and_paths_lie_in_one_plane_within_the_cube() -> None:
    points = list(CUBE.poses().values())
    for step in steps(CUBE, Extent(), 0.5):
        if isinstance(step, PathRun):
            points += step.points_m
    centred = np.array(points) - CUBE.centre_m
    assert np.linalg.svd(centred, compute_uv=False)[2] < 1e-12
    assert np.abs(centred).max() <= 0.5 * CUBE.edge_m + 1e-12


def test_the_circle_is_one_and_as_wide_as_said() -> None:
    circle = np.array(programmes.circle_points(CUBE, 24))
    assert np.linalg.norm(circle - CUBE.centre_m, axis=1) == pytest.approx(0.8 * 0.5 * CUBE.edge_m)
    assert circle[0] == pytest.approx(circle[-1])


def test_by_default_the_counts_are_the_standards() -> None:
    visits = Counter((s.setup, s.point) for s in steps(CUBE, Extent(rated_load_kg=1.0), 0.5) if isinstance(s, Visit))
    assert {visits[("pose", p)] for p in CUBE.poses()} == {30}
    assert {visits[(f"from_{a}", p)] for a in "xyz" for p in ("P1", "P2", "P4")} == {30}
    assert visits[("distance", "P2")] == visits[("distance", "P4")] == 30
    assert visits[("drift_1", "P1")] == 10
    assert visits[("load", "P1 load 10")] == 3
    runs = Counter((s.programme, s.speed_m_s) for s in steps(CUBE, Extent(), 0.5) if isinstance(s, PathRun))
    assert runs == {
        **{(name, v): 10 for name in ("line", "circle") for v in (0.05, 0.25, 0.5)},
        **{("rectangle", v): 3 for v in (0.05, 0.25, 0.5)},
        ("weave", 0.05): 3,
    }


def test_posing_visits_lie_on_the_way_from_p2_to_p4_as_far_as_their_names_say() -> None:
    start, end = (np.asarray(CUBE.poses()[name]) for name in ("P2", "P4"))
    visits = [s for s in steps(CUBE, Extent(), 0.5) if isinstance(s, Visit) and s.setup == "posing"]
    along = (end - start) / np.linalg.norm(end - start)
    for visit in visits:
        away = np.asarray(visit.tip_m) - start
        assert float(visit.point.removesuffix(" mm")) == pytest.approx(1e3 * away @ along, abs=0.5)
        assert np.linalg.norm(away - (away @ along) * along) < 1e-12
    assert max(float(visit.point.removesuffix(" mm")) for visit in visits) <= 1e3 * np.linalg.norm(end - start) + 0.5


def test_no_two_visits_or_runs_have_the_same_name_so_that_a_recording_can_go_on() -> None:
    names = [
        (s.setup, s.point, s.repeat) if isinstance(s, Visit) else (s.programme, f"{s.speed_m_s}", s.cycle)
        for s in steps(CUBE, Extent(rated_load_kg=1.0), 0.5)
    ]
    assert len(set(names)) == len(names)


def test_the_three_approaches_to_a_pose_are_perpendicular_and_from_inside_the_cube() -> None:
    visits = [s for s in steps(CUBE, replace(SMALL, programmes=("directions",)), 0.5) if isinstance(s, Visit)]
    for name in ("P1", "P2", "P4"):
        ways = np.array([np.subtract(s.via_m or s.tip_m, s.tip_m) for s in visits if s.point == name and s.repeat == 1])
        assert ways @ ways.T == pytest.approx(np.diag([(0.2 * CUBE.edge_m) ** 2] * 3))
    assert all(np.abs(np.subtract(s.via_m or s.tip_m, CUBE.centre_m)).max() <= 0.5 * CUBE.edge_m for s in visits)


def test_drift_sets_are_spread_over_the_time() -> None:
    wanted = replace(SMALL, drift_sets=3, drift_s=100.0, programmes=("drift",))
    due = [s.not_before_s for s in steps(CUBE, wanted, 0.5) if isinstance(s, Visit) and s.repeat == 1]
    assert due == [0.0, 50.0, 100.0]


def test_without_a_rated_load_no_load_is_hung() -> None:
    assert not steps(CUBE, Extent(programmes=("load",)), 0.5)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"repeats": 1}, "at least 2 repeats"),
        ({"path_cycles": 0}, "at least 2 repeats, 2 path cycles"),
        ({"speed_shares": (0.5, 1.2)}, "shares of the rated speed"),
        ({"speed_shares": ()}, "shares of the rated speed"),
        ({"drift_s": float("nan")}, "drift time"),
        ({"rated_load_kg": -1.0}, "rated load"),
        ({"programmes": ("poses",)}, "expected some of pose, directions.*got poses"),
    ],
)
def test_what_is_no_test_is_refused(changes: dict[str, object], says: str) -> None:
    with pytest.raises(Iso9283Error, match=says):
        replace(SMALL, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(("centre", "edge"), [((0.4, 0.0, float("nan")), 0.2), ((0.4, 0.0, 0.3), 0.0)])
def test_a_cube_that_is_none_is_refused(centre: tuple[float, float, float], edge: float) -> None:
    with pytest.raises(Iso9283Error, match="test cube"):
        TestCube(centre, edge)


def test_the_largest_cube_is_within_reach_on_one_branch_and_no_larger_one_is(arm: Arm) -> None:
    cube = largest_cube(arm)
    solver = solver_of(arm, cube)
    grid = cube.grid(4)
    angles = np.array([solver(point) for point in grid])
    assert ForwardKinematics(arm).tips(angles) == pytest.approx(grid, abs=1e-8)
    limits = np.array(arm.limits_rad)
    assert (angles >= limits[:, 0]).all()
    assert (angles <= limits[:, 1]).all()
    assert cube.centre_m[2] - 0.5 * cube.edge_m >= CLEARANCE_m - 1e-9
    with pytest.raises(Iso9283Error, match="out of reach"):
        solver_of(arm, TestCube(cube.centre_m, 1.3 * cube.edge_m))


def test_a_cube_that_the_arm_does_not_reach_or_that_goes_through_the_floor_is_said(arm: Arm) -> None:
    with pytest.raises(Iso9283Error, match=r"out of reach.*--cube-centre"):
        solver_of(arm, TestCube((2.0, 0.0, 0.5), 0.1))
    edge_m = 0.08
    with pytest.raises(Iso9283Error, match="below 0 m"):
        solver_of(arm, TestCube((0.3, 0.0, 0.49 * edge_m), edge_m))
    solver_of(arm, TestCube((0.3, 0.0, 0.51 * edge_m), edge_m))  # just above it


def test_an_arm_with_one_joint_has_no_cube() -> None:
    with pytest.raises(Iso9283Error, match="its tip moves on a surface"):
        largest_cube(load_arm(ARMS / "pendulum.toml"))

"""Plans by the predicted error: better where the points are sure of it, as given where they are not, and never into the floor."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest

from calib.arrays import Array, norms
from calib.design.candidates import workspace_poses
from calib.errors import CalibrationError
from calib.points.points import Points, make_points
from calib.task_files import path_lines, sentences, stop_lines, waypoints_text
from calib.task_planning import (
    NOWHERE,
    Freedom,
    PathPlan,
    Room,
    StopsPlan,
    WayOfStops,
    backwards,
    best_place,
    lead_in_of,
    places_count,
    planned_path,
    planned_stops,
    shifted,
)
from calib.trust.prediction import Predictor
from calib.trust.trust import MapRequest, trust_in
from control.errors import PathError
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Vector3
from control.motion.waypoints import Waypoints, read_waypoints
from hil_mocks.scenario import EffectTable
from tests.cell import FRICTION, RIGHT, Cell, holding_cell, scenario

WIDTH_rad = 0.008
# Of every three points of the recording, two came with joint 1 turning forwards: a calibration puts its zero there.
BELIEVED = dataclasses.replace(RIGHT, links=(dataclasses.replace(RIGHT.links[0], theta_rad=-0.5 * WIDTH_rad), *RIGHT.links[1:]))
STOPS = Waypoints(((0.45, 0.05, 0.2), (0.45, -0.05, 0.2)), None)
LEAN_m = np.array([0.04, 0.0, -0.02])  # per metre of x: an error that grows outwards


def with_play(rng: np.random.Generator, q: Array, sides: Array) -> Array:
    """Tips of an arm whose joint 1 lags behind its encoder by half its play."""
    tips = ForwardKinematics(RIGHT).tips(q - 0.5 * WIDTH_rad * np.array([1.0, 0.0, 0.0]) * sides)
    return np.asarray(tips + rng.normal(0.0, 1.4e-4, tips.shape))


@cache
def played() -> Predictor:
    rng = np.random.default_rng(3)
    q = workspace_poses(RIGHT, (), 50)
    sides = np.sign(rng.normal(size=q.shape))
    sides[:, 0] = np.where(np.arange(len(q)) % 3 == 0, -1.0, 1.0)
    return predictor(BELIEVED, q, with_play(rng, q, sides), sides)


@cache
def leaning() -> Predictor:
    q = workspace_poses(RIGHT, (), 50)
    tips = ForwardKinematics(RIGHT).tips(q)
    noise = np.random.default_rng(4).normal(0.0, 1.4e-4, tips.shape)
    return predictor(RIGHT, q, tips + tips[:, :1] * LEAN_m + noise, np.ones(q.shape))


def predictor(arm: Arm, q: Array, tips: Array, sides: Array) -> Predictor:
    points: Points = make_points(["free"] * len(q), [f"p{k}" for k in range(len(q))], [1] * len(q), q, tips, sides)
    return trust_in(arm, points, MapRequest(poses_count=200, is_checked=False)).predictor


@cache
def path_moved() -> PathPlan:
    return planned_path(RIGHT, leaning(), SQUARE, Freedom((0.1, 0.0, 0.0), any_order=True))


@cache
def stops_with_play() -> StopsPlan:
    return planned_stops(BELIEVED, played(), STOPS, Freedom(any_order=True))


SQUARE = Waypoints(((0.45, 0.0, 0.2), (0.5, 0.05, 0.2), (0.55, 0.0, 0.2), (0.5, -0.05, 0.2)), (0.1,) * 4)


def seen_m(way: WayOfStops, cell: Cell) -> float:
    """Mean distance of the tip from the stops, by the mock's camera."""
    off = []
    for row in way.order:
        if way.has_lead_in[row]:
            cell.client.move_joints(way.lead_in_rad[row].tolist())
        cell.client.move_joints(way.poses.q_rad[row].tolist(), 0.4)
        cell.run(0.1)
        off.append(np.array(cell.client.average(0.05).tip_m) - way.waypoints.points[row])
    return float(norms(np.array(off)).mean())


def test_stops_that_keep_the_play_on_one_side_are_better_by_the_camera_of_a_mock_arm() -> None:
    plan = stops_with_play()
    assert (plan.chosen.poses.direction[:, 0] == 1.0).all()
    assert plan.chosen.cost.rms_m < 0.3 * plan.plain.cost.rms_m
    hidden = scenario(q_rad=(0.0, -0.5, -0.2), effect=(*FRICTION, EffectTable("backlash", 1, {"width_rad": WIDTH_rad})))
    with holding_cell(hidden, RIGHT, believed=BELIEVED) as cell:
        given_m, planned_m = seen_m(plan.plain, cell), seen_m(plan.chosen, cell)
    assert planned_m < 0.5 * given_m


def test_a_path_moves_to_where_the_error_is_least() -> None:
    plan = path_moved()
    assert plan.chosen.shift_m[0] == pytest.approx(-0.1)
    assert plan.chosen.cost.rms_m < 0.95 * plan.plain.cost.rms_m
    assert next(name for name, _ in plan.steps) == "place"
    given, planned = (norms(np.array(way.waypoints.points)[:, :1] * LEAN_m).mean() for way in (plan.plain, plan.chosen))
    assert planned < given


def test_what_the_points_are_not_sure_of_is_left_as_given() -> None:
    exact = dataclasses.replace(leaning().posterior, mean=np.zeros_like(leaning().posterior.mean))
    unsure = leaning()
    was, unsure.posterior = unsure.posterior, exact
    try:
        plan = planned_path(RIGHT, unsure, SQUARE, Freedom(any_order=True))
    finally:
        unsure.posterior = was
    assert plan.chosen is plan.plain
    assert plan.steps == ()
    assert "as given" in sentences(plan, None)[0]


def test_a_path_comes_to_its_start_in_the_direction_in_which_it_leaves() -> None:
    way = path_moved().chosen
    direction = way.motion.poses.direction[0]
    assert np.array_equal(np.sign(np.array(way.plan.q_start_rad) - way.lead_in_rad), direction)


def test_no_lead_in_goes_deeper_than_its_pose() -> None:
    room, q = Room(RIGHT), workspace_poses(RIGHT, (), 300, height_m=0.0)
    rng = np.random.default_rng(1)
    sides = np.sign(rng.normal(size=q.shape))
    allowed = room.has_lead_in(RIGHT, q, sides)
    assert 0.1 < allowed.mean() < 1.0
    before = lead_in_of(q, sides)
    heights, lead = (ForwardKinematics(RIGHT).tips(some)[:, 2] for some in (q, before))
    assert (lead[allowed] >= np.minimum(heights[allowed], 0.06) - 1e-6).all()
    lower, upper = np.array(RIGHT.limits_rad).T
    assert ((before[allowed] >= lower) & (before[allowed] <= upper)).all()


def test_the_best_place_is_found_and_places_out_of_reach_are_passed_over() -> None:
    asked: list[Vector3] = []

    def at(shift: Vector3) -> float | None:
        asked.append(shift)
        return None if shift[0] < -0.1 else (shift[0] + 0.06) ** 2 + (shift[1] - 0.2) ** 2

    best = best_place((0.2, 0.2, 0.0), at, lambda one, other: one < other)
    assert best is not None
    assert best[0] == pytest.approx((-0.05, 0.2, 0.0), abs=0.051)
    assert len(asked) <= places_count((0.2, 0.2, 0.0))
    assert len(set(asked)) == len(asked)
    assert best_place((0.1, 0.0, 0.0), lambda _: None, lambda one, other: True) is None


def test_the_table_moves_with_the_work() -> None:
    arm, waypoints = shifted(RIGHT, SQUARE, (0.1, 0.0, 0.02))
    assert RIGHT.table is not None
    assert arm.table is not None
    assert RIGHT.table.origin_m is not None
    assert arm.table.origin_m == pytest.approx(tuple(np.add(RIGHT.table.origin_m, (0.1, 0.0, 0.02))))
    assert waypoints.points[0] == pytest.approx((0.55, 0.0, 0.22))


def test_a_path_backwards_keeps_what_belongs_to_each_way_point() -> None:
    turned = Waypoints(SQUARE.points, (0.1, 0.2, 0.3, 0.4), ("a", "b", "c", "d"), ((1.0, 0.0, 0.0, 0.0),) * 4)
    back = backwards(turned)
    assert (back.points[0], back.speeds_m_s, back.places[0]) == (SQUARE.points[-1], (0.4, 0.3, 0.2, 0.1), "d")
    assert backwards(back) == turned


def test_the_written_path_is_the_planned_one(tmp_path: pytest.TempPathFactory) -> None:
    file = tmp_path / "path.csv"  # type: ignore[operator]
    way = path_moved().chosen
    file.write_text(waypoints_text(way.waypoints))
    read = read_waypoints(file)
    assert np.allclose(read.points, way.waypoints.points, atol=1e-9)
    assert read.speeds_m_s == pytest.approx(way.waypoints.speeds_m_s)
    assert path_lines(way, file)[1] == f"run {file}"


def test_every_stop_is_gone_to_once_from_its_lead_in() -> None:
    way = stops_with_play().chosen
    lines = stop_lines(way)
    assert sorted(way.order) == [0, 1]
    assert sum(line.startswith("wait") for line in lines) == 2
    assert sum(line.startswith("move") for line in lines) == 2 + int(way.has_lead_in.sum())
    assert way.travel_rad <= dataclasses.replace(way, order=(0, 1)).travel_rad
    assert math.isfinite(way.travel_rad)


def test_what_cannot_be_reached_as_given_is_an_error() -> None:
    far = Waypoints(((0.5, 0.0, 0.2), (2.0, 0.0, 0.2)), None)
    with pytest.raises(PathError, match="way-point 2"):
        planned_path(RIGHT, leaning(), far, Freedom((0.1, 0.1, 0.0)))
    with pytest.raises(CalibrationError, match="takes positions"):
        planned_stops(RIGHT, leaning(), dataclasses.replace(far, orientations=((1.0, 0.0, 0.0, 0.0),) * 2), Freedom())
    assert NOWHERE == (0.0, 0.0, 0.0)


def test_work_is_never_moved_through_the_floor_with_its_table() -> None:
    q, given = workspace_poses(RIGHT, (), 20), Waypoints(((0.5, 0.0, 0.1),), None)
    sunk, raised = (shifted(RIGHT, given, (0.0, 0.0, dz))[0] for dz in (-0.05, 0.05))
    assert Room(RIGHT).holds(raised, q)
    assert not Room(RIGHT).holds(sunk, q)
    assert Room(sunk).holds(sunk, q)  # a board that is let into the floor

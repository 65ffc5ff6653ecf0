"""Ways between poses keep clear of the board: straight, higher, over the rest pose, or not at all."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.arms import SEVEN
from calib.boards import BoardPose
from calib.session.moves import ArmGeometry, ClearPaths, EDGE_m, MARGIN_m, NoClearPath
from control.kinematics.kinematics import ForwardKinematics
from control.model.table import board_rotation, cavities, table_of
from tests.calib.session.session_arm import GEOMETRY, RIGHT

TABLE = table_of(RIGHT)
LEVEL = BoardPose(np.eye(3), np.array(TABLE.origin_m))
KINEMATICS = ForwardKinematics(RIGHT)


def lowest_over_board_m(stops, board: BoardPose) -> float:
    """Least height of tip and elbow over the board along joint moves from stop to stop."""
    ways = [np.linspace(a, b, 80) for a, b in itertools.pairwise(stops)]
    frames = KINEMATICS.link_transforms(np.concatenate(ways))[:, [2, 4], :3, 3]
    local = (frames - board.origin_m) @ board.rotation
    over = np.hypot(local[..., 0], local[..., 1]) <= 0.09 + EDGE_m
    return float(local[..., 2][over].min(initial=1.0))


@pytest.mark.parametrize("setup", ["normal", "roll", "pitch"])
def test_between_points_above_cavities_the_way_is_straight(setup: str) -> None:
    rotation = np.array(board_rotation(TABLE, setup))
    board, ways = BoardPose(rotation, np.array(TABLE.origin_m)), ClearPaths(RIGHT, GEOMETRY)
    here = RIGHT.rest.q_rad
    for place in cavities(TABLE, setup).values():
        there = tuple(GEOMETRY.nearest(tuple(np.add(place, 0.06 * rotation[:, 2])), here))
        assert ways.stops(here, there, board) == [there]
        here = there


def across_the_board(rng: np.random.Generator) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Two poses low beside the board, on either side of it, between which the straight way goes through it."""
    while True:
        sides = [rng.uniform((0.4, 0.15, 0.05), (0.55, 0.3, 0.08)) * (1.0, side, 1.0) for side in (-1.0, 1.0)]
        start, end = (tuple(GEOMETRY.nearest(tuple(side), RIGHT.rest.q_rad)) for side in sides)
        middle = tuple(0.5 * np.add(start, end))
        if lowest_over_board_m([start, middle, end], RAISED) < 0.0:
            return start, end


RAISED = BoardPose(np.eye(3), np.add(TABLE.origin_m, (0.0, 0.0, 0.12)))  # a board on a stand


def test_where_the_straight_way_is_blocked_another_one_is_found_and_is_clear() -> None:
    ways, rng = ClearPaths(RIGHT, GEOMETRY), np.random.default_rng(1)
    for _ in range(8):
        start, end = across_the_board(rng)
        stops = ways.stops(start, end, RAISED)
        assert len(stops) > 1
        assert stops[-1] == end
        assert lowest_over_board_m([start, *stops], RAISED) > 0.8 * MARGIN_m  # looked at in finer steps than planned


def test_where_no_way_is_clear_it_is_said() -> None:
    start, end = across_the_board(np.random.default_rng(2))
    high = BoardPose(np.eye(3), np.array((0.45, 0.0, 0.9)))  # nothing passes over it
    with pytest.raises(NoClearPath, match="no collision-free path from"):
        ClearPaths(replace(RIGHT, rest=None), GEOMETRY).stops(start, end, high)


def test_a_pose_that_is_low_may_be_left_and_reached() -> None:
    low = tuple(GEOMETRY.nearest((0.5, 0.0, 0.01), (0.0, -1.0, 0.0)))
    high = tuple(GEOMETRY.nearest((0.5, 0.0, 0.06), low))
    ways = ClearPaths(RIGHT, GEOMETRY)
    assert ways.stops(low, high, LEVEL) == [high]
    assert ways.stops(high, low, LEVEL) == [low]


def test_an_arm_with_free_joints_approaches_near_its_rest_pose_whatever_a_hand_has_made_of_them() -> None:
    seven, three = ArmGeometry(SEVEN), ArmGeometry(RIGHT)
    hanging, bent = (0.1, 1.9, 0.2, -1.0, 0.3, -1.2, 0.5), (0.1, -1.0, 0.2)
    assert SEVEN.rest is not None
    assert seven.posture(hanging) == SEVEN.rest.q_rad
    assert three.posture(bent) == bent  # its branch says all

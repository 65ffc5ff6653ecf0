"""The workspace of an arm: how far its body is from floor, board and base, in closed form, for floats and arrays alike."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from control.errors import ArmError
from control.model.table import board_cavities
from control.safety.workspace import LinkThickness, TiltedBoard, Workspace
from tests.cell import RIGHT

BARE = Workspace(floor_z_m=0.0, tolerance_m=0.01, board=None, base_top_m=0.4, base_radius_m=0.0)
TIP = "the tip would be below the floor or table"
BODY = "the arm would be below the floor or table"
BASE = "the arm would meet its own base"
LEVEL = TiltedBoard(origin_m=(0.5, 0.0, -0.02), radius_m=0.2, roll_slope=0.0, pitch_slope=0.0)


def arm_with_tip(x: float, y: float, z: float) -> list[tuple[float, float, float]]:
    return [(0.0, 0.0, 0.3), (0.0, 0.0, 0.5), (x, y, z)]


def test_the_tip_is_as_far_from_the_floor_as_it_is_above_it_less_the_tolerance() -> None:
    assert BARE.clearance([(0.3, 0.0, 0.5), (0.5, 0.0, -0.03)]) == (pytest.approx(-0.02), TIP)
    assert BARE.clearance([(0.3, 0.0, 0.5), (0.5, 0.0, 0.0)]).distance_m == math.inf
    assert BARE.clearance([(0.3, 0.0, -0.5), (0.5, 0.0, -0.03)]) == (pytest.approx(-0.49), BODY)


def test_an_arm_of_one_point_is_its_tip() -> None:
    assert BARE.clearance([(0.5, 0.0, -0.03)]) == (pytest.approx(-0.02), TIP)


def test_a_floor_just_at_its_tolerance_is_free_and_what_is_below_is_not() -> None:
    at, below = ([(0.3, 0.0, 0.5), (0.5, 0.0, z)] for z in (-0.01, math.nextafter(-0.01, -1.0)))
    assert BARE.clearance(at).distance_m == math.inf
    assert BARE.clearance(below).distance_m <= 0.0


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_the_last_link_is_held_above_the_floor_between_its_ends_too(share: float) -> None:
    """A tilted board reaches up under the middle of a link whose ends are beside it."""
    middle = (0.5, 0.2)
    narrow = Workspace(0.0, 0.0, TiltedBoard((*middle, -0.2), 0.01, 0.0, 0.0), 0.4, 0.0)
    along = np.array((0.8, -0.6, 0.0))
    elbow = np.array((*middle, -0.1)) - share * along
    corners = np.array([(0.0, 0.0, 0.3), elbow, elbow + along])
    found = list(narrow.clearances(corners[:, :, None]))
    heights = [float(distance[0]) for distance, _ in found]
    # One point is over the board, which lies lower than the floor.
    assert heights == pytest.approx([0.3, -0.1, -0.1, *(0.1 if each == share else -0.1 for each in (0.25, 0.5, 0.75))])
    assert [what for _, what in found] == [BODY, BODY, TIP, BODY, BODY, BODY]


def test_a_body_is_nearer_to_the_floor_by_its_thickness_and_the_tip_is_a_point() -> None:
    """Where two parts meet the thicker one counts."""
    body = LinkThickness((0.03, 0.05, 0.02))
    elbow_down = [(0.3, 0.0, 0.5), (0.4, 0.0, 0.03), (0.9, 0.0, 0.5)]
    assert BARE.clearance(elbow_down, body) == (pytest.approx(0.03 - 0.05 + 0.01), BODY)
    tip_down = [(0.3, 0.0, 0.5), (0.9, 0.0, 0.5), (0.9, 0.0, 0.0)]
    assert BARE.clearance(tip_down, LinkThickness((0.03, 0.02, 0.005))) == (pytest.approx(0.01), TIP)
    forearm = [(0.3, 0.2, 0.5), (0.3, 0.2, 0.2), (0.7, -0.2, 0.0)]
    for corners, body in ((forearm, LinkThickness((0.0, 0.0, 0.1))), (forearm[1:], LinkThickness((0.0, 0.1)))):
        assert BARE.clearance(corners, body) == (pytest.approx(0.05 - 0.1 + 0.01), BODY)


def test_a_body_is_nearer_to_the_base_by_its_thickness() -> None:
    workspace = replace(BARE, base_radius_m=0.1)
    assert workspace.clearance([(0.3, 0.0, 0.2), (0.3, 0.3, 0.2)], LinkThickness((0.0, 0.05))) == (pytest.approx(0.15), BASE)


def test_over_the_board_the_board_counts_and_beside_it_the_floor() -> None:
    workspace = replace(BARE, board=LEVEL)
    assert workspace.clearance(arm_with_tip(0.5, 0.0, -0.025)) == (pytest.approx(0.005), TIP)
    assert workspace.clearance(arm_with_tip(0.5, 0.2, -0.025)) == (pytest.approx(0.005), TIP)
    assert workspace.clearance(arm_with_tip(0.5, 0.2001, -0.025)) == (pytest.approx(-0.015), TIP)
    assert workspace.clearance(arm_with_tip(0.29, 0.0, -0.025)) == (pytest.approx(-0.015), TIP)


def test_a_board_above_the_floor_allows_no_less_than_the_floor() -> None:
    workspace = replace(BARE, board=replace(LEVEL, origin_m=(0.5, 0.0, 0.3)))
    assert workspace.clearance(arm_with_tip(0.5, 0.0, -0.005)).distance_m == math.inf
    assert workspace.clearance(arm_with_tip(0.5, 0.0, -0.015)) == (pytest.approx(-0.005), TIP)


@pytest.mark.parametrize(
    ("roll", "pitch", "at", "plane_m"),
    [
        (0.5, 0.0, (0.5, 0.1), 0.0),
        (0.5, 0.0, (0.5, -0.1), -0.05),
        (-0.5, 0.0, (0.5, 0.1), -0.05),
        (0.0, 0.5, (0.6, 0.0), -0.05),
        (0.0, 0.5, (0.4, 0.0), 0.0),
        (0.0, -0.5, (0.4, 0.0), -0.05),
        (0.5, 0.5, (0.6, -0.1), -0.05),
        (0.5, 0.25, (0.6, -0.1), -0.05),
        (0.25, 0.5, (0.6, -0.1), -0.05),
        (0.5, 0.5, (0.4, 0.1), 0.0),
    ],
)
def test_a_tilted_board_is_as_low_as_its_lower_tilt_or_flat(
    roll: float, pitch: float, at: tuple[float, float], plane_m: float
) -> None:
    workspace = replace(BARE, board=replace(LEVEL, roll_slope=roll, pitch_slope=pitch))
    distance_m, what = workspace.clearance(arm_with_tip(*at, -0.04))
    assert (distance_m, what) == (pytest.approx(-0.04 - (plane_m - 0.02 - 0.01)), TIP)


def test_the_base_is_a_rod_with_a_round_top() -> None:
    workspace = replace(BARE, base_radius_m=0.1)
    beside = [(0.3, 0.0, 0.2), (0.3, 0.3, 0.2)]
    assert workspace.clearance(beside) == (pytest.approx(0.2), BASE)
    through = [(-0.3, 0.05, 0.2), (0.3, 0.05, 0.2)]
    assert workspace.clearance(through) == (pytest.approx(-0.05), BASE)
    over = [(-0.3, 0.0, 0.45), (0.3, 0.0, 0.45)]
    assert workspace.clearance(over) == (pytest.approx(-0.05), BASE)
    slanted = [(0.05, -0.2, 0.1), (0.05, 0.2, 0.3)]
    assert workspace.clearance(slanted) == (pytest.approx(-0.05), BASE)
    standing = [(0.3, 0.0, 0.1), (0.3, 0.0, 0.3)]
    assert workspace.clearance(standing) == (pytest.approx(0.2), BASE)
    ends_there = [(0.5, 0.0, 0.2), (0.2, 0.0, 0.2)]
    assert workspace.clearance(ends_there) == (pytest.approx(0.1), BASE)
    assert workspace.clearance([(0.3, 0.0, 0.501), (0.3, 0.3, 0.501)]).distance_m == math.inf
    assert workspace.clearance([(0.3, 0.0, 0.5), (0.3, 0.3, 0.5)]).distance_m < math.inf


def test_below_the_origin_there_is_no_base() -> None:
    deep = replace(BARE, floor_z_m=-9.0, base_radius_m=0.1)
    assert deep.clearance([(0.0, 0.3, -0.4), (0.0, 0.0, -0.4)]) == (pytest.approx(0.3), BASE)


def test_the_body_that_hangs_on_the_base_does_not_count() -> None:
    workspace = replace(BARE, base_radius_m=0.1)
    corners = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.4), (0.5, 0.0, 0.3)]
    assert workspace.clearance(corners).distance_m == pytest.approx(-0.1)
    assert workspace.clearance([*corners, (0.6, 0.0, 0.3)], LinkThickness((0.0,) * 4, first_free=2)).distance_m == pytest.approx(
        0.4
    )


def test_without_a_radius_there_is_no_base() -> None:
    assert BARE.clearance([(-0.3, 0.0, 0.2), (0.3, 0.0, 0.2)]) == (math.inf, "")


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_position_that_is_no_number_is_refused(bad: float) -> None:
    with pytest.raises(ArmError, match="expected finite positions"):
        BARE.clearance([(0.0, 0.0, 0.3), (0.3, bad, 0.4)])


def test_arrays_say_what_floats_say() -> None:
    workspace = replace(BARE, board=replace(LEVEL, roll_slope=0.3, pitch_slope=-0.2), base_radius_m=0.1)
    chance = np.random.default_rng(4)
    corners = chance.uniform((-0.6, -0.6, -0.2), (0.7, 0.6, 0.5), (200, 4, 3))
    of_arrays, body = {}, LinkThickness((0.0, 0.05, 0.02, 0.04), first_free=1)
    for distance, what in workspace.clearances(corners.transpose(1, 2, 0), body):
        of_arrays[what] = np.minimum(of_arrays.get(what, math.inf), distance)
    for k, pose in enumerate(corners.tolist()):
        clearance = workspace.clearance(pose, body)
        least = min(float(distance[k]) for distance in of_arrays.values())
        assert clearance.distance_m == pytest.approx(least, abs=1e-12) or least > 0.0


def test_the_room_of_an_arm_is_what_its_file_says() -> None:
    limits = replace(RIGHT.limits, floor_clearance_m=0.02)
    workspace = Workspace.of(replace(RIGHT, limits=limits))
    assert workspace.floor_z_m == limits.floor_z_m + limits.floor_clearance_m
    assert (workspace.tolerance_m, workspace.base_radius_m) == (limits.floor_tolerance_m, limits.base_radius_m)
    assert workspace.base_top_m == RIGHT.links[0].d_m
    assert RIGHT.table is not None
    assert workspace.board is not None
    assert workspace.board.origin_m == RIGHT.table.origin_m
    outermost_m = max(math.hypot(x, y) for x, y, _ in board_cavities(RIGHT.table).values())
    assert workspace.board.radius_m == pytest.approx(outermost_m + 0.03)
    sunk = replace(RIGHT, links=(replace(RIGHT.links[0], d_m=-0.2), *RIGHT.links[1:]))
    assert Workspace.of(sunk).base_top_m == 0.0


def test_the_board_covers_its_outermost_cavity_and_a_margin_and_tilts_as_its_table() -> None:
    assert RIGHT.table is not None
    tilted = replace(RIGHT, table=replace(RIGHT.table, roll_tilt_rad=0.2, pitch_tilt_rad=-0.1))
    board = Workspace.of(tilted).board
    assert board is not None
    assert (board.roll_slope, board.pitch_slope) == (math.tan(0.2), math.tan(-0.1))
    for table in (None, replace(RIGHT.table, known_pose=False), replace(RIGHT.table, origin_m=None)):
        assert Workspace.of(replace(RIGHT, table=table)).board is None


def test_an_arm_is_far_from_all_where_no_way_of_that_length_leads_to_floor_or_base() -> None:
    workspace, body = replace(BARE, base_radius_m=0.06), LinkThickness((0.02, 0.0))
    corners = [(-0.3, 0.0, 0.9), (0.5, 0.0, 0.53)]  # over the base
    assert workspace.is_far(corners, body, 0.04)  # 0.53 - 0.02 - 0.04 > 0.4 + 0.06
    assert not workspace.is_far(corners, body, 0.0501)
    assert not workspace.is_far([(0.5, 0.0, 0.48), (-0.3, 0.0, 0.9)], body, 0.0)  # 0.46: at the base's reach
    exact = replace(BARE, base_top_m=0.5, base_radius_m=0.25)
    assert not exact.is_far([(0.5, 0.0, 0.75), (-0.3, 0.0, 0.9)], LinkThickness((0.0, 0.0)), 0.0)
    assert exact.is_far([(0.5, 0.0, 0.7501), (-0.3, 0.0, 0.9)], LinkThickness((0.0, 0.0)), 0.0)
    low = [(0.3, 0.0, 0.9), (0.5, 0.0, 0.01)]
    assert BARE.is_far(low, LinkThickness((0.0, 0.0)), 0.02)  # exactly to the tolerance below the floor
    assert not BARE.is_far(low, LinkThickness((0.0, 0.0)), 0.0201)


def test_an_arm_is_far_from_the_base_beyond_a_plane_before_it() -> None:
    workspace, body = replace(BARE, base_radius_m=0.06), LinkThickness((0.0, 0.02, 0.01), first_free=1)
    corners = [(0.0, 0.0, 0.4), (0.0, 0.2, 0.3), (0.0, 0.6, 0.3)]  # the first hangs on the base
    assert workspace.is_far(corners, body, 0.11)
    assert not workspace.is_far(corners, body, 0.1201)
    assert not workspace.is_far([corners[0], (0.0, -0.2, 0.3), (0.0, 0.6, 0.3)], body, 0.0)  # across the axis
    assert workspace.is_far([corners[0], corners[1]], body, 0.11)  # no line that is free of the base
    assert not workspace.is_far([corners[0], (0.0, 0.08, 0.3), (0.0, 0.6, 0.3)], body, 0.0)  # touches


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_arm_without_a_position_is_not_far(bad: float, axis: int) -> None:
    corner = [0.6, 0.0, 0.9]
    corner[axis] = bad
    assert not BARE.is_far([(0.3, 0.0, 0.9), corner], LinkThickness((0.0, 0.0)), 0.0)


def test_what_is_far_is_clear_however_it_moves_by_that_way() -> None:
    chance = np.random.default_rng(7)
    workspace = replace(BARE, board=replace(LEVEL, roll_slope=0.3, pitch_slope=-0.2), base_radius_m=0.1)
    body = LinkThickness((0.0, 0.05, 0.02, 0.04), first_free=1)
    far = 0
    for corners in chance.uniform((-0.6, -0.6, -0.1), (0.7, 0.6, 0.7), (2000, 4, 3)):
        if workspace.is_far(corners.tolist(), body, 0.05):
            far += 1
            way = chance.normal(size=(4, 3))
            moved = corners + 0.05 * way / np.linalg.norm(way, axis=1, keepdims=True)
            assert workspace.clearance(moved.tolist(), body).distance_m > 0.0
    assert far > 50


def test_a_link_that_points_at_the_base_is_as_far_from_it_as_its_end_is() -> None:
    workspace = replace(BARE, base_radius_m=0.06)
    assert workspace.clearance([(1.0, 0.0, 0.2), (0.5, 0.0, 0.25)]) == (pytest.approx(0.44), BASE)


def test_a_board_beside_the_middle_is_where_its_origin_is() -> None:
    beside = replace(BARE, board=replace(LEVEL, origin_m=(0.5, 0.3, -0.02)))
    assert beside.clearance(arm_with_tip(0.5, 0.3, -0.025)) == (pytest.approx(0.005), TIP)
    assert beside.clearance(arm_with_tip(0.5, -0.3, -0.025)) == (pytest.approx(-0.015), TIP)


def test_a_board_without_cavities_is_as_large_as_its_margin() -> None:
    assert RIGHT.table is not None
    bare = replace(RIGHT.table, circle_points=0, line_points=0, cavities_m={})
    board = Workspace.of(replace(RIGHT, table=bare)).board
    assert board is not None
    assert board.radius_m == 0.03

"""What can be measured next: reachable, clear, not taken; where a board stands; in which order to go."""

import dataclasses
import itertools

import numpy as np
import pytest

from benchmarks.calibration.chains import REFERENCE, REFERENCE_DH, board_points
from benchmarks.calibration.design_trial import ARM, table_points
from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.observations import Frame
from calib.design.candidates import (
    FREE_HEIGHT_M,
    OTHER_TILTS,
    CameraBox,
    body_points,
    free_candidates,
    joint_box,
    named,
    placed_boards,
    postures,
    spread_poses,
    table_candidates,
    tilted,
    usual_setups,
    workspace_poses,
)
from calib.design.planning import WAY_HEIGHT_M, clear_ways, visiting_order
from calib.errors import CalibrationError
from calib.points.points import make_points
from control.kinematics.chain import link_transforms
from control.model.arm import Arm, Link

SETUPS = ("normal", "roll", "pitch")
BOARDS = placed_boards(ARM, SETUPS, None, {})
ANGLES = {"normal": (0.0, 0.0), "roll": (np.radians(11.7), 0.0), "pitch": (0.0, np.radians(11.8))}
LOWER, UPPER = np.array(ARM.limits_rad).T


def test_no_part_of_the_arm_is_further_from_a_body_point_than_an_eighth_of_its_link():
    q = np.array([[0.3, -0.9, 1.1]])
    frames = link_transforms(ARM.dh, q, ARM.joints, ARM.dh_convention)[0]
    tip = frames[-1, :3, 3] + frames[-1, :3, :3] @ np.array(ARM.tool.position_m)
    corners = [*frames[1:, :3, 3], tip]
    points = body_points(ARM, q)[0]
    assert points[-1] == pytest.approx(tip)
    for begin, end in itertools.pairwise(corners):
        way = begin + np.linspace(0.0, 1.0, 41)[:, None] * (end - begin)
        nearest = np.linalg.norm(way[:, None] - points, axis=2).min(axis=1)
        assert nearest.max() <= 0.125 * np.linalg.norm(end - begin) + 1e-12


@pytest.mark.parametrize("setup", SETUPS)
def test_every_cavity_is_a_candidate_with_the_tip_in_it(setup):
    candidates = table_candidates(ARM, BOARDS[setup], None, sees_tip=False)
    places = dict(zip(map(str, range(1, 34)), board_points(*ANGLES[setup]), strict=True))
    assert set(candidates.point) == set(places)
    tips = REFERENCE.tips(REFERENCE_DH, candidates.q_rad)
    np.testing.assert_allclose(tips, [places[name] for name in candidates.point], atol=1e-7)
    assert ((candidates.q_rad > LOWER) & (candidates.q_rad < UPPER)).all()
    assert np.isnan(candidates.tip_m).all()


def test_free_poses_are_within_limits_above_the_floor_and_away_from_the_board():
    candidates = free_candidates(ARM, BOARDS.values())
    tips = REFERENCE.tips(REFERENCE_DH, candidates.q_rad)
    np.testing.assert_allclose(candidates.tip_m, tips, atol=1e-9)
    assert len(candidates) > 500
    assert ((candidates.q_rad > LOWER) & (candidates.q_rad < UPPER)).all()
    assert (tips[:, 2] >= FREE_HEIGHT_M - 1e-9).all()
    for setup in SETUPS:
        local = (tips - BOARDS[setup].origin_m) @ BOARDS[setup].rotation
        over = np.hypot(local[:, 0], local[:, 1]) < 0.12
        assert (local[over, 2] >= FREE_HEIGHT_M).all()


def test_no_two_free_poses_to_choose_from_are_nearly_the_same():
    q = free_candidates(ARM, BOARDS.values(), count=600).q_rad
    apart = np.abs(q[:, None] - q).max(axis=2) + 9.0 * np.eye(len(q))
    assert apart.min() >= 0.15


def test_camera_sees_only_what_is_in_its_view():
    view = CameraBox((0.2, -0.3, 0.0), (0.6, 0.3, 0.5))
    tips = free_candidates(ARM, [], view).tip_m
    assert len(tips)
    assert (tips >= view.lower_m).all()
    assert (tips <= view.upper_m).all()


def test_cavities_that_are_taken_are_not_proposed_again_though_the_arm_is_off_by_centimetres():
    _, taken = table_points(np.random.default_rng(3), ("normal",))
    some = taken.chosen(range(10))
    left = table_candidates(ARM, BOARDS["normal"], some, sees_tip=False)
    assert set(left.point) == {str(k) for k in range(11, 34)}
    assert len(table_candidates(ARM, BOARDS["roll"], some, sees_tip=False)) == 33


def test_arm_with_seven_joints_gets_many_postures_for_one_place():
    turns = (0.0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2)
    lengths = (0.3, 0.0, 0.3, 0.0, 0.4, 0.0, 0.2)
    links = tuple(Link("revolute", d, 0.0, 0.0, a) for d, a in zip(lengths, turns, strict=True))
    arm = Arm("seven", links, dh_convention="modified")
    place = np.array([[0.4, 0.1, 0.3]])
    box = joint_box(arm)
    model = ArmModel(arm)
    q, which = postures(model, place, spread_poses(box, 40), box)
    assert len(q) > 20
    assert (which == 0).all()
    np.testing.assert_allclose(model.tips(arm.dh, q), np.tile(place, (len(q), 1)), atol=1e-7)


def test_places_out_of_reach_have_no_posture():
    box = joint_box(ARM)
    q, which = postures(ArmModel(ARM), np.array([[2.0, 0.0, 0.0]]), spread_poses(box, 12), box)
    assert (len(q), len(which)) == (0, 0)


def test_places_within_reach_but_beyond_the_joints_limits_have_no_posture():
    """Behind the arm: joint 1 would have to turn half round."""
    place = np.array([[-0.5, 0.0, 0.3]])
    box = joint_box(ARM)
    anywhere = (np.full(3, -np.pi), np.full(3, np.pi))
    assert len(postures(ArmModel(ARM), place, spread_poses(anywhere, 12), anywhere)[0])
    assert not len(postures(ArmModel(ARM), place, spread_poses(box, 12), box)[0])


def test_spread_poses_fill_every_eighth_of_the_box():
    q = spread_poses((np.zeros(3), np.ones(3)), 64)
    assert len({tuple(row) for row in (q > 0.5).tolist()}) == 8


def test_of_the_later_half_of_spread_poses_a_share_of_the_angles_is_at_the_nearer_end():
    box = (np.array([-1.0, 0.0]), np.array([1.0, 3.0]))
    inside, drawn = spread_poses(box, 400), spread_poses(box, 400, edge_share=0.4)
    np.testing.assert_array_equal(drawn[:200], inside[:200])
    is_moved = drawn[200:] != inside[200:]
    assert 0.3 < is_moved.mean() < 0.5
    ends = np.where(inside[200:] > np.mean(box, axis=0), box[1], box[0])
    np.testing.assert_array_equal(drawn[200:][is_moved], ends[is_moved])


def test_new_names_do_not_collide_with_those_of_points_taken():
    taken = make_points(["free", "roll"], ["p1", "5"], [1, 2], np.zeros((2, 3)), np.zeros((2, 3)))
    planned = make_points(["free", "free", "roll"], ["", "", "5"], [1, 1, 1], np.zeros((3, 3)), np.zeros((3, 3)))
    found = named(planned, taken)
    assert found.point == ("p2", "p3", "5")
    assert found.repeat == (1, 1, 3)


def test_other_tilts_are_the_tables_own_turned_round():
    np.testing.assert_allclose(tilted(ARM.table, "roll-"), tilted(ARM.table, "roll").T)
    np.testing.assert_allclose(tilted(ARM.table, "pitch-"), tilted(ARM.table, "pitch").T)
    both = tilted(ARM.table, "roll+pitch")
    np.testing.assert_allclose(both, tilted(ARM.table, "pitch") @ tilted(ARM.table, "roll"))


def test_measured_board_goes_before_what_the_table_says():
    seen = Frame("table_normal", np.eye(3), np.array([0.45, 0.02, 0.01]))
    board = placed_boards(ARM, ("normal",), None, {"normal": seen})["normal"]
    np.testing.assert_allclose(board.origin_m, seen.origin_m)
    assert board.is_known


def test_unknown_board_stands_where_its_points_were_taken():
    """The nominal arm is some 2 cm off, and so is the board that is fitted to it."""
    loose = dataclasses.replace(ARM, table=dataclasses.replace(ARM.table, known_pose=False, origin_m=None))
    _, taken = table_points(np.random.default_rng(0), ("roll",))
    board = placed_boards(loose, ("roll",), taken, {})["roll"]
    assert not board.is_known
    assert np.linalg.norm(board.origin_m - [0.5, 0.0, 0.0]) < 0.06
    assert usual_setups(loose, taken, {}) == ["roll"]


def test_unknown_board_with_points_in_a_line_offers_only_those_cavities():
    loose = dataclasses.replace(ARM, table=dataclasses.replace(ARM.table, known_pose=False, origin_m=None))
    _, taken = table_points(np.random.default_rng(0), ("normal",))
    line = taken.chosen([k for k, name in enumerate(taken.point) if name in ("25", "29", "33")])
    board = placed_boards(loose, ("normal",), line, {})["normal"]
    assert board.names == ["25", "29", "33"]
    assert not board.has_plane


def test_setup_that_nobody_can_place_is_one_error_with_the_remedy():
    loose = dataclasses.replace(ARM, table=dataclasses.replace(ARM.table, known_pose=False, origin_m=None))
    with pytest.raises(CalibrationError, match="record three cavities"):
        placed_boards(loose, ("normal",), None, {})
    with pytest.raises(CalibrationError, match=r'expected some of normal, roll, pitch, roll-.*got "yaw"'):
        placed_boards(ARM, ("yaw",), None, {})
    with pytest.raises(CalibrationError, match=r"has no \[table\]"):
        placed_boards(dataclasses.replace(ARM, table=None), ("normal",), None, {})
    assert "roll-" in OTHER_TILTS


def path_rad(start, q):
    return np.abs(np.diff(np.vstack((start, q)), axis=0)).max(axis=1).sum()


def test_setups_stay_together_and_ways_are_short():
    """Against the best of fifty random orders with the setups together."""
    rng = np.random.default_rng(5)
    parts = [table_candidates(ARM, board, None, sees_tip=False) for board in BOARDS.values()]
    free = free_candidates(ARM, BOARDS.values())
    q = np.vstack([*(part.q_rad[::3] for part in parts), free.q_rad[:12]])
    setups = [setup for setup in SETUPS for _ in range(11)] + ["free"] * 12
    shuffled = rng.permutation(len(q))
    points = make_points([setups[k] for k in shuffled], [""] * len(q), [1] * len(q), q[shuffled], np.zeros((len(q), 3)))
    order = visiting_order(ARM, points, SETUPS, BOARDS.values())
    assert sorted(order) == list(range(len(q)))
    visited = [points.setup[k] for k in order]
    assert list(dict.fromkeys(visited)) == [*SETUPS, "free"]
    assert sum(a != b for a, b in itertools.pairwise(visited)) == 3
    start = np.array(ARM.rest.q_rad)
    random = [
        path_rad(start, np.vstack([rng.permutation(points.q_rad[np.array(points.setup) == s]) for s in [*SETUPS, "free"]]))
        for _ in range(50)
    ]
    assert path_rad(start, points.q_rad[order]) < 0.75 * min(random)


def test_way_through_the_floor_is_not_clear():
    """Of sixty poses with the tip low there are two between which it would dip below the height for ways."""
    q = workspace_poses(ARM, [], 4000, height_m=WAY_HEIGHT_M)
    start_m = REFERENCE.tips(REFERENCE_DH, q)[:, 2]
    low = q[np.argsort(start_m)[:60]]
    clear = clear_ways(ARM, low, BOARDS.values())
    assert clear.diagonal().all()
    assert (clear == clear.T).all()
    first, second = np.argwhere(~clear)[0]
    way = low[first] + np.linspace(0, 1, 40)[:, None] * (low[second] - low[first])
    assert REFERENCE.tips(REFERENCE_DH, way)[:, 2].min() < WAY_HEIGHT_M <= start_m.min()


def test_ways_between_proposed_free_poses_are_clear():
    q = free_candidates(ARM, BOARDS.values(), count=400).q_rad[:60]
    assert clear_ways(ARM, q, BOARDS.values()).all()

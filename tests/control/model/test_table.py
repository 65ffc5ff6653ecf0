"""Cavities of the calibration table: numbering, tilts about the board's own axes, boards that are not known."""

import math

import pytest

from control.errors import ArmError, MissingModel
from control.model import table as tables
from control.model.arm import Table
from control.model.description import load_arm

BOARD = load_arm("right").table


def test_points_1_to_24_run_counter_clockwise_from_the_boards_x_axis():
    cavities = tables.cavities(BOARD)
    assert list(cavities) == [str(number) for number in range(1, 34)]
    assert cavities["1"] == pytest.approx((0.59, 0.0, 0.0))
    assert cavities["7"] == pytest.approx((0.5, 0.09, 0.0))
    assert cavities["13"] == pytest.approx((0.41, 0.0, 0.0))


def test_points_25_to_33_run_along_x_from_minus_to_plus_80_mm():
    cavities = tables.cavities(BOARD)
    assert [cavities[str(n)] for n in range(25, 34)] == [pytest.approx((0.42 + 0.02 * i, 0.0, 0.0)) for i in range(9)]


def test_a_positive_roll_lifts_the_boards_left_side_and_leaves_its_x_axis():
    cavities = tables.cavities(BOARD, "roll")
    angle = math.radians(11.7)
    assert cavities["7"] == pytest.approx((0.5, 0.09 * math.cos(angle), 0.09 * math.sin(angle)))
    assert cavities["33"] == pytest.approx((0.58, 0.0, 0.0))


def test_a_positive_pitch_lowers_the_boards_far_side_and_leaves_its_y_axis():
    cavities = tables.cavities(BOARD, "pitch")
    angle = math.radians(11.8)
    assert cavities["1"] == pytest.approx((0.5 + 0.09 * math.cos(angle), 0.0, -0.09 * math.sin(angle)))
    assert cavities["7"] == pytest.approx((0.5, 0.09, 0.0))


@pytest.mark.parametrize("setup", tables.SETUPS)
def test_every_setup_is_a_rotation_about_the_boards_centre(setup):
    normal, tilted = tables.cavities(BOARD), tables.cavities(BOARD, setup)
    for a in ("3", "20", "30"):
        assert math.dist(tilted[a], BOARD.origin_m) == pytest.approx(math.dist(normal[a], BOARD.origin_m))
        assert math.dist(tilted[a], tilted["11"]) == pytest.approx(math.dist(normal[a], normal["11"]))
    (a, b, c), (d, e, f), (g, h, i) = tables.board_rotation(BOARD, setup)
    assert a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) == pytest.approx(1.0)


def test_named_cavities_stand_in_the_boards_frame_and_tilt_with_it():
    board = Table(origin_m=(0.5, 0.0, 0.1), roll_tilt_rad=0.2, cavities_m={"hole": (0.0, 0.1, 0.0)})
    assert tables.cavities(board) == {"hole": (0.5, 0.1, 0.1)}
    assert tables.cavities(board, "roll")["hole"] == pytest.approx((0.5, 0.1 * math.cos(0.2), 0.1 + 0.1 * math.sin(0.2)))


def test_a_board_whose_pose_is_unknown_has_cavities_in_its_own_frame_only():
    board = Table(origin_m=(0.5, 0.0, 0.0), known_pose=False, cavities_m={"hole": (0.0, 0.1, 0.0)})
    assert tables.board_cavities(board) == {"hole": (0.0, 0.1, 0.0)}
    with pytest.raises(MissingModel, match="known_pose"):
        tables.cavities(board)


def test_an_unknown_setup_lists_the_valid_ones():
    with pytest.raises(ArmError, match='normal, roll, pitch, got "yaw"'):
        tables.cavities(BOARD, "yaw")


def test_an_arm_without_a_table_says_what_to_add():
    with pytest.raises(MissingModel, match=r"add \[table\]\. Without one a camera"):
        tables.table_of(load_arm("right").__class__("bare", ()))

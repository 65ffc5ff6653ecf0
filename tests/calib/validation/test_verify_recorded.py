"""Two models on recorded poses: tips measured by a camera, or seated in a board that stood nobody knows where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.calibration.chains import board_session
from calib.errors import CalibrationError
from calib.points.points import Points, make_points
from calib.validation.statistics import difference
from calib.validation.verify import LEAST_POSES, compare, compare_arms, comparison_text
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Effect, Table, Tool
from control.model.description import load_arm
from tests.places import ARMS

RIGHT = load_arm("right")
PANDA = load_arm(ARMS / "panda.toml")


def seen_session() -> tuple[Arm, Points]:
    """The true arm, and the rolled board's cavities seen by a camera without noise."""
    true, q, tips, setups = board_session(np.random.default_rng(4), ("roll",), noise_m=0.0)
    return RIGHT.with_dh(true), make_points(setups, [str(k) for k in range(33)], [1] * 33, q, tips)


def test_predictions_are_compared_where_the_tip_was_seen() -> None:
    true, points = seen_session()
    tips = points.tip_m.copy()
    tips[3] = np.nan  # point "3" is a cavity, too, but one pose places no board
    comparison = compare_arms(RIGHT, true, replace(points, tip_m=tips))
    assert len(comparison.point) == 32
    assert "3" not in comparison.point
    assert comparison.of("roll").before.mean_m > 0.005
    assert comparison.of("roll").after.max_m < 1e-9


def test_tips_are_taken_in_the_frame_that_the_arm_says() -> None:
    true, points = seen_session()
    frame = Effect("base_frame", None, {"x_m": 0.1, "y_m": -0.2, "rz_rad": 0.5})
    c, s = np.cos(0.5), np.sin(0.5)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    in_camera = (points.tip_m - [0.1, -0.2, 0.0]) @ rotation
    comparison = compare_arms(RIGHT, replace(true, effects=(frame,)), replace(points, tip_m=in_camera))
    assert comparison.of("roll").after.max_m < 1e-9
    assert comparison.of("roll").before.mean_m > 0.05  # as wrong as the frame is far


def test_static_effects_of_a_model_are_part_of_its_prediction() -> None:
    """An encoder that says too little by 1 %: the model that has it agrees, the one that has not is off by millimetres."""
    true, points = seen_session()
    said_too_little = replace(points, q_rad=points.q_rad / [1.0, 1.01, 1.0])
    scaled = replace(true, effects=(Effect("encoder_scale", 2, {"scale": 0.01}),))
    comparison = compare_arms(true, scaled, said_too_little)
    assert comparison.of("roll").after.max_m < 1e-9
    assert comparison.of("roll").before.mean_m > 0.003


def seated(arm: Arm, setups: int, poses: int) -> Points:
    """A tip seated in two sockets of a board that stands elsewhere in each setup, in several poses; no camera."""
    rng = np.random.default_rng(9)
    sockets = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]])
    names, places = [], []
    for setup in range(setups):
        turn = rng.uniform(-0.5, 0.5)
        c, s = np.cos(turn), np.sin(turn)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        board = sockets @ rotation.T + rng.uniform([0.4, -0.2, 0.1], [0.6, 0.2, 0.4])
        names += [(f"s{setup}", f"hole_{k % 2}") for k in range(poses)]
        places += [board[k % 2] for k in range(poses)]
    m = len(names)
    seeds = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.8, 0.5]) + rng.uniform(-0.4, 0.4, (m, 7))
    q = reaching(arm, np.array(places), seeds)
    unseen = np.full((m, 3), np.nan)
    return make_points([a for a, _ in names], [b for _, b in names], list(range(m)), q, unseen)


def reaching(arm: Arm, tips: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Joint angles (m, n) near q that take the tips there, by Newton."""
    kinematics = ForwardKinematics(arm)
    for _ in range(30):
        step = np.einsum("mnk,mk->mn", np.linalg.pinv(kinematics.jacobians(q)), tips - kinematics.tips(q))
        q = q + step * np.minimum(1.0, 0.4 / np.maximum(1e-12, np.abs(step).max(axis=1, keepdims=True)))
    return q


def test_a_board_nobody_measured_tells_models_apart_by_their_consistency() -> None:
    """The real Panda's case: the true model agrees with itself, the nominal one does not; poses of a socket are no repeats."""
    rows = np.random.default_rng(3).uniform(-1, 1, PANDA.dh.shape) * [0.002, 0.01, 0.002, 0.01]
    true = replace(PANDA.with_dh(PANDA.dh + rows), tool=Tool((0.02, 0.0, 0.12)))
    points = seated(true, 2, 8)
    comparison = compare_arms(replace(PANDA, tool=true.tool), true, points)
    assert len(comparison.point) == 16
    assert "hole_0, pose 4" in comparison.point
    assert comparison.of("all").after.max_m < 1e-8
    assert comparison.of("all").before.mean_m > 0.001
    assert np.isnan(comparison.after_half_width_m).all()


def test_too_few_poses_place_no_board() -> None:
    points = seated(replace(PANDA, tool=Tool((0.02, 0.0, 0.12))), 1, LEAST_POSES - 1)
    with pytest.raises(CalibrationError, match="no measured tips"):
        compare_arms(PANDA, PANDA, points)
    with pytest.raises(CalibrationError, match="no measured tips"):
        compare_arms(replace(PANDA, table=None), PANDA, seated(PANDA, 1, 6))


def test_rows_of_one_name_and_pose_are_repeats() -> None:
    true, points = seen_session()
    twice = points.chosen([0, 0, 1, 1])
    scatter = np.outer([1e-4, -1e-4, 0.0, 0.0], [1.0, 0.0, 0.0])
    shaken = replace(twice, tip_m=twice.tip_m + scatter)
    comparison = compare_arms(RIGHT, true, shaken)
    assert comparison.point == ("0", "1")
    assert comparison.before_half_width_m[0] > 0.0


def test_a_table_without_cavities_of_these_names_is_no_reference() -> None:
    arm = replace(RIGHT, table=Table(cavities_m={"a": (0.0, 0.0, 0.0)}, known_pose=False))
    _, points = seen_session()
    with pytest.raises(CalibrationError, match="named cavities"):
        compare_arms(arm, arm, replace(points, tip_m=np.full((33, 3), np.nan)))


def test_a_tracker_of_unknown_place_is_put_where_each_model_fits_best_and_that_is_said() -> None:
    true, points = seen_session()
    c, s = np.cos(0.7), np.sin(0.7)
    away = points.tip_m @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T + [4.07, -1.2, 0.3]
    bare = [replace(arm, table=None) for arm in (RIGHT, true)]
    comparison = compare_arms(*bare, replace(points, tip_m=away))
    assert comparison.of("roll").after.max_m < 1e-9
    assert 1e-3 < comparison.of("roll").before.mean_m < 0.05
    assert "says where the frame of the measured tips stands" in comparison.cautions[-1]
    with pytest.raises(CalibrationError, match="measured in a frame that stands elsewhere"):
        compare_arms(RIGHT, true, replace(points, tip_m=away))  # its table says where


def test_where_a_target_sits_on_the_last_link_is_no_error_of_the_arm_before() -> None:
    """Pictures show a board on the jaw; a file that has the tip elsewhere is as right as one that has it there."""
    _, points = seen_session()
    on_jaw = replace(RIGHT, tool=Tool((0.012, -0.009, 0.02)), table=None)
    tip = replace(on_jaw, tool=RIGHT.tool)
    seen = replace(
        points,
        tip_m=ForwardKinematics(on_jaw).tips(points.q_rad) + np.array([4.07, -1.2, 0.3]),
        orientation=np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)),
    )
    same = compare_arms(tip, on_jaw, seen)
    assert same.of("roll").before.max_m < 1e-6
    assert "the tool of" in same.cautions[-1]
    tips_alone = replace(seen, orientation=np.full((len(points), 4), np.nan))  # the tip itself was measured: its tool counts
    assert compare_arms(tip, on_jaw, tips_alone).of("roll").before.max_m > 1e-3


def test_copies_count_once_and_identical_errors_have_no_interval() -> None:
    true, points = seen_session()
    twice = points.chosen([*range(33), *range(10)])
    comparison = compare_arms(RIGHT, true, twice)
    assert len(comparison.setup) == 33
    assert "copies" in comparison.cautions[0]
    same = difference(np.full(12, 0.004), np.full(12, 0.001))
    assert np.isnan(same.half_width_m)
    assert same.in_words() == "no significant difference: +3.000 mm at all 12 points alike, which tells no interval"
    flat = np.tile([0.003, 0.0, 0.0], (12, 1))
    table = comparison_text(compare(["a"] * 12, [str(k) for k in range(12)], flat, flat, flat))
    assert "unknown" in table
    assert "nan" not in table


def test_fewer_tips_than_place_a_frame_are_compared_in_the_base_frame() -> None:
    true, points = seen_session()
    few = points.chosen(range(LEAST_POSES - 1))
    comparison = compare_arms(RIGHT, true, few)
    assert len(comparison.point) == LEAST_POSES - 1
    assert comparison.of("roll").after.max_m < 1e-9
    assert comparison.of("roll").before.mean_m > 0.005

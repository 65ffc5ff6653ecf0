"""Points of which no calibration can be made are recognised, and the message says what to do; legitimate ones pass."""

import dataclasses

import numpy as np
import pytest

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.checks import require_columns_meant, require_sound, require_usable
from calib.arm_problem.misread import doubts_of_arm
from calib.arm_problem.observations import Observations
from calib.arm_problem.problem import ArmProblem
from calib.errors import CalibrationError, UnusablePointsError
from calib.identify.identification import identify
from calib.identify.objective import LeastSquares
from calib.points.points import Points, make_points
from control.model.arm import Arm, Link, Table, Tool
from control.model.description import load_arm
from tests.calib.simulated import RIGHT, board_points, seated, true_dh, with_rows

POINTS = board_points(np.random.default_rng(1), true_dh(np.random.default_rng(1), size=0.9))
UNMEASURED = with_rows(POINTS, tip_m=np.full((99, 3), np.nan))


def checked(points, arm=RIGHT):
    return require_usable(arm, points, problem_of(arm, points))


def turned(change):
    """Angles changed by a function, tips as they are."""
    return lambda points: with_rows(points, q_rad=change(np.array(points.q_rad)))


def moved(change):
    """Tips changed by a function, angles as they are."""
    return lambda points: with_rows(points, tip_m=change(np.array(points.tip_m)))


COUNTS = np.array([drive.encoder_counts_per_rev * drive.gear_ratio / (2 * np.pi) for drive in RIGHT.drives])
WRONG_ANGLES = {
    "degrees": (turned(np.degrees), "joint angles look like degrees"),
    "counts": (turned(lambda q: np.round(q * COUNTS)), "look like encoder counts"),
    "swapped": (turned(lambda q: q[:, [1, 0, 2]]), "columns q1_rad and q2_rad look swapped"),
    "turned in a ring": (turned(lambda q: q[:, [2, 0, 1]]), "columns q1_rad, q2_rad and q3_rad look swapped"),
    "sign": (turned(lambda q: q * [1, 1, -1]), "the sign of q3_rad looks inverted"),
    "zero": (turned(lambda q: q + np.array([0, np.pi / 2, 0])), "q2_rad looks -90 deg short"),
}
WRONG_TIPS = {
    "millimetres": (moved(lambda tip: 1e3 * tip), "positions look like millimetres"),
    "x and y": (moved(lambda tip: tip[:, [1, 0, 2]]), "columns x_m and y_m look swapped"),
}


@pytest.mark.parametrize("name", [*WRONG_ANGLES, *WRONG_TIPS])
def test_columns_that_mean_something_else_are_recognised(name) -> None:
    change, says = (WRONG_ANGLES | WRONG_TIPS)[name]
    with pytest.raises(UnusablePointsError, match=f"{says}.*the nominal arm would then be .* mm"):
        checked(change(POINTS))


@pytest.mark.parametrize("name", WRONG_ANGLES)
def test_angles_are_held_against_the_cavities_where_nothing_was_measured(name) -> None:
    change, says = WRONG_ANGLES[name]
    with pytest.raises(UnusablePointsError, match=says):
        checked(change(UNMEASURED))


def test_degrees_within_three_turns_are_recognised() -> None:
    small = POINTS.chosen(np.flatnonzero(np.abs(np.degrees(POINTS.q_rad)).max(axis=1) < 60.0))
    q = np.degrees(small.q_rad) * [1, 0.2, 1]
    assert len(small) > 10
    with pytest.raises(UnusablePointsError):
        checked(with_rows(small, q_rad=q))


def test_two_readings_that_fit_alike_are_both_named() -> None:
    dh = RIGHT.dh.copy()
    dh[2, 0] = 0.0  # without its offset the arm is its own mirror image
    points = turned(lambda q: q * [-1, 1, 1])(board_points(np.random.default_rng(4), dh))
    with pytest.raises(UnusablePointsError, match=r"q1_rad looks .* y_m looks"):
        checked(points, RIGHT.with_dh(dh))


def test_points_of_another_arm_are_refused() -> None:
    q = np.random.default_rng(0).uniform(-1, 1, (99, 3))
    with pytest.raises(UnusablePointsError, match="check that the points are of this arm"):
        checked(with_rows(POINTS, q_rad=q))


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_points_that_fit_another_arm_better_are_told_of(seed) -> None:
    rng = np.random.default_rng(seed)
    points = board_points(rng, true_dh(rng, size=1.0))
    (said,) = checked(points, load_arm("left"))
    assert said.startswith("these points fit the arm right better than arm left")
    assert checked(points) == ()


def six_joints(seed: int, count: int, zeros_deg: float) -> tuple[Arm, Points]:
    """A six-joint arm whose zeros are off, and poses within a small box, in a tracker's frame five metres away."""
    arm, rng = arm_with(6), np.random.default_rng(seed)
    model, q = ArmModel(arm), rng.uniform(-1.3, 1.3, (200 * count, 6))
    tips = model.tips(arm.dh, q)
    near = np.argsort(np.linalg.norm(tips - np.median(tips, axis=0), axis=1))[:count]
    off = np.zeros_like(arm.dh)
    off[:, 1] = np.radians(zeros_deg) * rng.choice([-1.0, 1.0], 6)
    seen = model.tips(arm.dh + off, q[near]) + np.array([5.0, -0.4, 0.3]) + rng.normal(0.0, 2e-4, (count, 3))
    names = [str(k) for k in range(count)]
    return arm, make_points(["free"] * count, names, [1] * count, q[near], seen)


@pytest.mark.parametrize("seed", range(4))
def test_radians_and_metres_in_a_small_box_far_away_pass_although_zeros_are_off(seed) -> None:
    arm, points = six_joints(seed, 40, 1.8)
    choice = Choice(freed=("tool",)).for_points(arm, points)
    assert require_usable(arm, points, problem_of(arm, points, choice), choice) == ()


@pytest.mark.parametrize("seed", range(4))
def test_an_arm_that_leaves_more_of_the_spread_is_no_rival_on_few_poses(seed) -> None:
    arm, points = six_joints(seed, 16, 1.8)
    choice = Choice(freed=("tool",)).for_points(arm, points)
    assert doubts_of_arm(arm, points, choice) == ()


def test_an_arm_that_is_off_by_as_much_as_its_bounds_allow_has_no_horn_on_another_tooth() -> None:
    """On few poses one of ten horns needs somewhat smaller deviations by chance."""
    arm = load_arm("so101")
    lower, upper = np.array(arm.limits_rad).T
    doubted = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        off = rng.uniform(-1.0, 1.0, arm.dh.shape) * (4e-3, np.radians(2.0), 4e-3, np.radians(2.0))
        q_rad = rng.uniform(0.8 * lower, 0.8 * upper, (20, 5))
        tips = ArmModel(arm).tips(arm.dh + off, q_rad) + rng.normal(0.0, 5e-4, (20, 3))
        points = make_points(["free"] * 20, [str(k) for k in range(20)], [1] * 20, q_rad, tips)
        doubted += len(doubts_of_arm(arm, points, Choice().for_points(arm, points)))
    assert doubted == 0


def test_an_offset_that_its_bound_turns_round_makes_no_other_arm() -> None:
    dh = RIGHT.dh.copy()
    dh[2, 0] = -25e-6
    arm = RIGHT.with_dh(dh)
    dh[2, 0] = 0.004
    points = board_points(np.random.default_rng(3), dh)
    assert not any("d3" in said for said in checked(points, arm))


def test_a_file_is_taken_at_its_word_on_request_and_the_doubt_stays_aloud() -> None:
    wrong = WRONG_TIPS["x and y"][0](POINTS)
    with pytest.raises(UnusablePointsError, match="--as-given"):
        checked(wrong)
    (said,) = require_columns_meant(RIGHT, dataclasses.replace(wrong, is_as_given=True), Choice())
    assert "columns x_m and y_m look swapped" in said
    assert said.count("% of their spread") == 2


def test_a_choice_is_completed_once_and_then_stays() -> None:
    arm, points = six_joints(1, 20, 0.5)
    seen = dataclasses.replace(points, extra={"frame": ("camera",) * 20})
    for given in (points, seen):
        once = Choice(freed=("tool",)).for_points(arm, given)
        assert once.for_points(arm, given) == once


def test_what_a_new_arm_looks_like_passes_without_a_word() -> None:
    rng = np.random.default_rng(2)
    for _ in range(10):  # 20 to 50 mm of initial error
        assert checked(board_points(rng, true_dh(rng, size=1.0))) == ()
    assert checked(UNMEASURED) == ()


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        (range(3), "3 different points are too few"),
        (range(24, 33), "one straight line"),
        ([0, 1] * 20, "2 different points are too few"),
    ],
)
def test_points_that_tell_too_little_are_refused(rows, says) -> None:
    with pytest.raises(UnusablePointsError, match=says):
        checked(POINTS.chosen(list(rows)))


def test_a_number_that_is_none_is_named_by_line_and_column() -> None:
    q = np.array(POINTS.q_rad)
    q[7, 1] = np.nan
    with pytest.raises(UnusablePointsError, match=r"joint angle of point 8 \(q2_rad\)"):
        checked(with_rows(POINTS, q_rad=q))


def test_a_few_copies_are_told_and_most_being_copies_is_refused() -> None:
    warnings = checked(POINTS.chosen([*range(99), 0, 5]))
    assert len(warnings) == 1
    assert "poses 1 and 100 (lines 2 and 101), 6 and 101 (lines 7 and 102)" in warnings[0]
    with pytest.raises(UnusablePointsError, match=r"and 96 more are identical.*remove the copies"):
        checked(POINTS.chosen([*range(99), *range(99)]))


def test_a_setup_that_the_table_does_not_know_is_named() -> None:
    strange = make_points(["tilt"] * 99, POINTS.point, POINTS.repeat, POINTS.q_rad, UNMEASURED.tip_m)
    with pytest.raises(CalibrationError, match='setup "tilt"'):
        checked(strange)


def arm_with(joints: int) -> Arm:
    """Alternating axes, 0.2 m links, two sockets on a board of unknown place."""
    links = tuple(Link("revolute", 0.1, 0.0, 0.2, np.pi / 2 if j % 2 else -np.pi / 2) for j in range(joints))
    cavities = {"a": (0.0, 0.0, 0.0), "b": (0.05, 0.0, 0.0)}
    return Arm("made up", links, tool=Tool((0.05, 0.0, 0.1)), table=Table(known_pose=False, cavities_m=cavities))


@pytest.mark.parametrize("joints", [1, 2, 6, 7])
def test_arms_of_any_number_of_joints_pass(joints) -> None:
    arm, rng = arm_with(joints), np.random.default_rng(joints)
    model, q = ArmModel(arm), rng.uniform(-1.5, 1.5, (40, joints))
    tips = model.tips(true_dh(rng, arm), q)
    points = make_points(["free"] * 40, [str(k) for k in range(40)], [1] * 40, q, tips)
    assert checked(points, arm) == ()


def test_two_sockets_on_a_line_pass_when_taken_in_many_postures() -> None:
    arm, rng = arm_with(7), np.random.default_rng(3)
    model = ArmModel(arm)
    dh = true_dh(rng, arm, size=0.3)
    socket = np.repeat([[0.5, 0.1, 0.2], [0.55, 0.1, 0.2]], 20, axis=0)
    q = np.array([seated(model, dh, place[None], rng.uniform(-0.8, 0.8, 7))[0] for place in socket])
    reached = np.linalg.norm(model.tips(dh, q) - socket, axis=1) < 1e-6
    rows = np.flatnonzero(reached)
    assert len(rows) > 20
    names = ["a"] * 20 + ["b"] * 20
    points = make_points(["front"] * 40, names, [1] * 40, q, np.full((40, 3), np.nan)).chosen(rows)
    assert checked(points, arm) == ()


def test_shapes_that_do_not_fit_and_angles_beyond_three_turns_are_refused() -> None:
    with pytest.raises(UnusablePointsError, match="expected"):
        Observations.of_tips(POINTS.q_rad, POINTS.tip_m[:-1])
    problem = ArmProblem(ArmModel(RIGHT), Observations.of_tips(np.degrees(POINTS.q_rad), POINTS.tip_m))
    with pytest.raises(UnusablePointsError, match="more than three turns"):
        require_sound(problem)


@pytest.mark.parametrize("seed", range(6))
def test_an_arm_with_small_offsets_and_deviations_up_to_the_bounds_is_not_taken_for_its_mirror_image(seed) -> None:
    rng = np.random.default_rng(seed)
    offsets = rng.choice([0.003, 0.02, -0.05], 4 + 2 * (seed % 2))
    links = tuple(Link("revolute", float(d), 0.0, 0.2, float(rng.choice([np.pi / 2, -np.pi / 2]))) for d in offsets)
    arm = Arm("own", links, tool=Tool((0.05, 0.0, 0.1)))
    bounds = np.array([0.005, np.radians(2.0)] * 2)
    q = rng.uniform(-1.5, 1.5, (40, len(links)))
    tips = ArmModel(arm).tips(arm.dh + bounds * rng.choice([-1.0, 1.0], arm.dh.shape), q)
    names = [str(k) for k in range(40)]
    points = make_points(["free"] * 40, names, [1] * 40, q, tips + rng.normal(0.0, 0.0002, (40, 3)))
    assert checked(points, arm) == ()


def test_the_frame_of_a_tracker_is_free_unless_something_ties_it_to_the_base() -> None:
    arm = arm_with(6)
    tips = np.ones((5, 3))
    points = make_points(["free"] * 5, ["a"] * 5, [1] * 5, np.zeros((5, 6)), tips)
    assert Choice().for_points(arm, points).freed == ("base",)
    assert Choice(fixed=["base"]).for_points(arm, points) == Choice(fixed=["base"])
    assert Choice().for_points(RIGHT, points) == Choice()
    assert Choice().for_points(arm, with_rows(points, tip_m=np.full((5, 3), np.nan))) == Choice()


def test_a_tracker_that_stands_anywhere_is_found_by_what_it_measured() -> None:
    arm, rng = arm_with(6), np.random.default_rng(5)
    model, q = ArmModel(arm), rng.uniform(-1.5, 1.5, (60, 6))
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    tips = model.tips(true_dh(rng, arm), q) @ turned.T + [2.0, -1.0, 0.5] + rng.normal(0.0, 1e-4, (60, 3))
    points = make_points(["free"] * 60, [str(k) for k in range(60)], [1] * 60, q, tips)
    problem = problem_of(arm, points, Choice().for_points(arm, points))
    found = identify(problem, objective=LeastSquares(), starts_count=1)
    assert found.noise_m == pytest.approx(1e-4, rel=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_a_tool_and_a_frame_that_nobody_knows_are_started_together_from_places_measured_once(seed) -> None:
    rng, arm = np.random.default_rng(seed), arm_with(6)
    q, tool = rng.uniform(-1.3, 1.3, (60, 6)), np.array([0.05, 0.0, 0.1]) + rng.uniform(-0.1, 0.1, 3)
    true = dataclasses.replace(arm, tool=Tool((float(tool[0]), float(tool[1]), float(tool[2]))))
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    tips = ArmModel(true).tips(arm.dh, q) @ turned.T + np.array([2.0, -1.0, 0.5])
    points = make_points(["free"] * 60, [str(k) for k in range(60)], [1] * 60, q, tips)
    problem = problem_of(arm, points, Choice(freed=("tool",)).for_points(arm, points))
    start = problem.solution(np.zeros(len(problem.parameters)))
    assert start.tool_m == pytest.approx(tool, abs=1e-6)
    assert np.abs(problem.residuals(np.zeros(len(problem.parameters)))).max() < 1e-6

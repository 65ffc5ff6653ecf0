"""Poses with measured orientation: exact derivatives, more determined, intervals that cover, misread columns refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.arm_problem.assembly import Choice, lever_m, problem_of
from calib.arm_problem.misread import doubts_of_turns
from calib.arm_problem.posed import whole_problem
from calib.calibration import CalibrationPlan, calibrate
from calib.design.information import experiment_of, uncertainty_of
from calib.errors import CalibrationError, PointsFileError, UnusablePointsError
from calib.identify.identification import identify
from calib.identify.objective import objective_named
from calib.identify.outliers import find_outliers
from calib.iso9283.evaluate_poses import pose_criterion
from calib.iso9283.recorded import pose_groups
from calib.points.points import Points, make_points, read_points
from calib.points.writer import write_points
from calib.validation.verify import compare_turns
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Camera, Link, Tool

QUARTER = np.pi / 2
DH = np.array(
    [
        [0.33, 0, 0.05, QUARTER],
        [0, QUARTER, 0.44, 0],
        [0, 0, 0.035, QUARTER],
        [0.42, 0, 0, -QUARTER],
        [0, 0, 0, QUARTER],
        [0.08, 0, 0, 0],
    ]
)
POSITION_NOISE_m, TURN_NOISE_rad = 1.4e-4, 5e-4
IN_THE_FLANGE, OFF_AXIS = (0.0, 0.0, 0.0), (0.02, 0.03, 0.1)
TARGET = np.array([0.3, -1.2, 0.5])
BASE = Choice(fixed=("base",))
KNOWN_TARGET = Choice(fixed=("base", "target"))
POSES = 40


def session(
    seed: int, tool: tuple[float, float, float] = OFF_AXIS, target: np.ndarray = TARGET
) -> tuple[Arm, np.ndarray, Points]:
    """A nominal 6-joint arm, the true deviations (24,), and what a tracker saw of it."""
    rng = np.random.default_rng(seed)
    camera = Camera(POSITION_NOISE_m, orientation_noise_rad=TURN_NOISE_rad)
    arm = Arm("six", tuple(Link("revolute", *row) for row in DH.tolist()), camera=camera, tool=Tool(tool))
    off = rng.uniform(-1, 1, (6, 4)) * np.array([0.002, 0.01, 0.002, 0.01])
    true, q = ForwardKinematics(arm.with_dh(DH + off)), rng.uniform(-1.6, 1.6, (POSES, 6))
    turned = true.link_transforms(q)[:, -1, :3, :3] @ Rotation.from_rotvec(target).as_matrix()
    seen = Rotation.from_rotvec(rng.normal(0, TURN_NOISE_rad, (POSES, 3))) * Rotation.from_matrix(turned)
    tips = true.tips(q) + rng.normal(0, POSITION_NOISE_m, (POSES, 3))
    names = [str(k) for k in range(POSES)]
    quaternion = seen.as_quat()[:, [3, 0, 1, 2]]
    points = make_points(["free"] * POSES, names, [1] * POSES, q, tips, orientation=quaternion)
    return arm, off.ravel(), points


def without_orientation(points: Points) -> Points:
    return dataclasses.replace(points, orientation=np.full((len(points), 4), np.nan))


@pytest.mark.parametrize("choice", [BASE, KNOWN_TARGET, Choice(freed=("base",), effects=("encoder_scale:2",))])
def test_the_jacobian_of_orientations_is_exact(choice: Choice) -> None:
    arm, _, points = session(1)
    whole = whole_problem(problem_of(arm, points, choice))
    rng = np.random.default_rng(2)
    x = rng.uniform(-0.3, 0.3, len(whole.parameters))
    x[24:] *= 0.02  # frames and target are scaled by 100 bounds
    jacobian, h = whole.residuals_and_jacobian(x)[1], 1e-6
    slopes = [(whole.residuals(x + h * e) - whole.residuals(x - h * e)) / (2 * h) for e in np.eye(len(x))]
    assert np.abs(jacobian - np.stack(slopes, axis=2)).max() < 1e-7


def test_chunks_and_strides_are_the_rows_of_the_whole() -> None:
    arm, _, points = session(1)
    mixed = np.array(points.orientation)
    mixed[::3] = np.nan
    whole = whole_problem(problem_of(arm, dataclasses.replace(points, orientation=mixed), BASE))
    x = np.full(len(whole.parameters), 0.01)
    residuals = whole.residuals(x)
    assert len(residuals) == len(whole) == POSES + np.isfinite(mixed[:, 0]).sum()
    for rows in (slice(0, 30), slice(30, 50), slice(45, 60), slice(None, None, 7), slice(2, None, 3)):
        assert np.array_equal(whole.residuals(x, rows), residuals[rows])
        assert np.allclose(whole.expanded(x, rows).residuals, residuals[rows], atol=1e-15)


@pytest.mark.parametrize(
    ("seen", "cause"), [(True, "probably the camera misread it"), (False, "not seated, or the camera misread it")]
)
def test_a_tip_whose_orientation_was_measured_sat_in_no_cavity(seen: bool, cause: str) -> None:
    arm, _, points = session(4)
    tips = np.array(points.tip_m)
    tips[7] += [0.0, 0.0, 0.004]
    misread = dataclasses.replace(points if seen else without_orientation(points), tip_m=tips)
    problem = problem_of(arm, misread, BASE)
    (outlier,) = find_outliers(problem, identify(problem, starts_count=1).x)
    assert outlier.row == 7
    assert outlier.words.endswith(cause)


def test_full_poses_determine_more_than_positions() -> None:
    arm, off, points = session(3, tool=IN_THE_FLANGE, target=np.zeros(3))
    by_position = identify(problem_of(arm, without_orientation(points), KNOWN_TARGET), starts_count=1)
    by_pose = identify(problem_of(arm, points, KNOWN_TARGET), starts_count=1)
    assert (by_position.rank, by_pose.rank) == (22, 23)  # of 24: d2 and d3 move together; alpha6 moves no tip
    assert by_pose.condition_number < 0.01 * by_position.condition_number  # theta6 hardly moves it
    assert by_pose.orientation is not None
    assert by_pose.orientation.mean_after_rad < 2 * TURN_NOISE_rad
    (alpha5,) = [one for one in by_pose.estimates if one.parameter.name == "alpha5"]
    assert abs(alpha5.deviation - off[4 * 4 + 3]) < 4 * alpha5.sd


@pytest.mark.parametrize("objective", ["lsq", "e2"])
def test_intervals_cover_and_are_narrower_than_without(objective: str) -> None:
    hits, total, ratios = 0, 0, []
    for seed in range(5):
        arm, off, points = session(100 + seed)
        wanted = objective_named(objective)
        by_pose = identify(problem_of(arm, points, BASE), objective=wanted, starts_count=1)
        alone = identify(problem_of(arm, without_orientation(points), BASE), objective=wanted, starts_count=1)
        for k, one in enumerate(by_pose.estimates[:24]):
            if one.is_determined:
                total += 1
                hits += one.interval[0] <= off[k] <= one.interval[1]
                ratios.append(one.sd / alone.estimates[k].sd if alone.estimates[k].is_determined else 0.0)
    assert total >= 80
    assert hits / total > 0.88  # 95 % nominal, of some 90 correlated parameters
    assert np.median(ratios) < 0.8


def test_the_target_is_found_and_the_calibration_says_what_the_orientations_were() -> None:
    arm, _, points = session(5)
    made = calibrate(arm, points, CalibrationPlan(BASE, starts_count=1))
    assert made.found.orientation is not None
    target = Rotation.from_matrix(made.found.orientation.target) * Rotation.from_rotvec(TARGET).inv()
    assert target.magnitude() < 0.02  # the last link's own theta and alpha may stand in its place
    assert made.held is not None
    assert [text for text in made.warnings if "orientation" in text] == []
    loud = dataclasses.replace(arm, camera=Camera(POSITION_NOISE_m, orientation_noise_rad=5e-3))
    warned = calibrate(loud, points, CalibrationPlan(BASE, starts_count=1)).warnings
    assert [text for text in warned if "--orientation-noise" in text] != []


def misordered(points: Points) -> np.ndarray:
    return np.array(points.orientation)[:, [1, 2, 3, 0]]


def inverted(points: Points) -> np.ndarray:
    return np.array(points.orientation) * np.array([1.0, -1.0, -1.0, -1.0])


def shuffled(points: Points) -> np.ndarray:
    return np.array(points.orientation)[::-1]


@pytest.mark.parametrize(
    ("wrong", "choice", "says"),
    [
        (misordered, BASE, "look like x, y, z, w"),
        (inverted, BASE, "look inverted"),
        (shuffled, BASE, "remove qw to qz"),
        (lambda points: points.orientation, KNOWN_TARGET, "leave out --fix target"),
    ],
)
def test_misread_orientations_are_refused_with_the_reading(wrong, choice: Choice, says: str) -> None:  # type: ignore[no-untyped-def]
    arm, _, points = session(6)
    problem = problem_of(arm, dataclasses.replace(points, orientation=wrong(points)), choice)
    with pytest.raises(UnusablePointsError, match=says):
        doubts_of_turns(problem)


def test_a_required_accuracy_is_one_of_positions() -> None:
    arm, _, points = session(7)
    with pytest.raises(CalibrationError, match="is one of positions"):
        identify(problem_of(arm, points, BASE), accuracy_limit_m=1e-3)


def test_the_noise_is_the_stated_one_the_arms_or_a_usual_one() -> None:
    arm, _, _ = session(8)
    assert lever_m(arm) == pytest.approx(POSITION_NOISE_m / TURN_NOISE_rad)
    assert lever_m(arm, 1e-3) == pytest.approx(POSITION_NOISE_m / 1e-3)
    assert lever_m(dataclasses.replace(arm, camera=None)) == pytest.approx(0.00014 / 0.002)


def test_orientations_survive_a_file(tmp_path: Path) -> None:
    _, _, points = session(9)
    some = np.array(points.orientation)
    some[3] = np.nan
    write_points(tmp_path / "points.csv", dataclasses.replace(points, orientation=some))
    again, warnings = read_points(tmp_path / "points.csv", 6)
    assert warnings == ()
    assert np.allclose(again.orientation, some, atol=2e-9, equal_nan=True)
    assert np.isnan(again.orientation[3]).all()


HEAD = "setup,point,repeat,q1_rad,x_m,y_m,z_m,qw,qx,qy,qz\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (HEAD + "a,1,1,0.1,0,0,0,0.9,0,0,0\n", "unit quaternion w, x, y, z (length 1 within 0.002)"),
        (HEAD + "a,1,1,0.1,0,0,0,1,0,0,\n", "column qz: got an empty cell"),
        (HEAD + "a,1,1,0.1,,,,1,0,0,0\n", "column x_m: got an empty cell"),
        (HEAD + "a,1,1,0.1,0,0,0,1,0,0,nine\n", "column qz"),
        (HEAD.replace(",qz", "") + "a,1,1,0.1,0,0,0,1,0,0\n", "column qz is missing beside qw"),
        ("setup,point,repeat,q1_rad,qw,qx,qy,qz\na,1,1,0.1,1,0,0,0\n", "x_m, y_m, z_m are missing beside qw"),
    ],
)
def test_a_bad_quaternion_names_line_and_column(text: str, says: str, tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(PointsFileError) as caught:
        read_points(file)
    assert says in str(caught.value)


def test_a_verification_compares_orientations_with_the_target_where_it_fits_each_model() -> None:
    arm, off, points = session(11)
    turned = compare_turns(arm, arm.with_dh(DH + off.reshape(6, 4)), points)
    assert turned is not None
    assert float(np.mean(turned.after_rad)) < 2 * TURN_NOISE_rad < 0.2 * float(np.mean(turned.before_rad))
    assert "mrad before" in turned.in_words()
    assert compare_turns(arm, arm, without_orientation(points)) is None


def test_a_plan_with_orientations_expects_to_know_more() -> None:
    arm, _, points = session(12, tool=IN_THE_FLANGE)
    workspace = np.random.default_rng(1).uniform(-1.5, 1.5, (50, 6))
    rows = list(range(20))
    alone = uncertainty_of(experiment_of(arm, points, workspace, POSITION_NOISE_m, BASE), rows)
    with_turns = experiment_of(
        arm, points, workspace, POSITION_NOISE_m, dataclasses.replace(BASE, orientation_noise_rad=TURN_NOISE_rad)
    )
    both = uncertainty_of(with_turns, rows)
    assert both.log_det > alone.log_det + 10.0
    assert both.tip_m < alone.tip_m
    assert both.rank >= alone.rank


def test_iso_9283_takes_the_angles_from_quaternions() -> None:
    arm, _, points = session(13)
    visits, turn, rng = 6, np.array([0.002, -0.001, 0.003]), np.random.default_rng(0)
    rows = [k for k in range(2) for _ in range(visits)]
    q = np.repeat(points.q_rad[:1], len(rows), axis=0)  # one pose under two names, turned to both sides
    link = Rotation.from_matrix(ForwardKinematics(arm).link_transforms(q)[:, -1, :3, :3])
    sides = np.array([turn if k == 0 else -turn for k in rows])
    off = Rotation.from_rotvec(sides + rng.normal(0.0, 1e-4, (len(rows), 3)))
    seen = (off * link * Rotation.from_rotvec(TARGET)).as_quat()[:, [3, 0, 1, 2]]
    tips = ForwardKinematics(arm).tips(q) + rng.normal(0, 1e-4, (len(rows), 3))
    names = [f"P{k + 1}" for k in rows]
    made = make_points(["normal"] * len(rows), names, list(range(len(rows))), q, tips, orientation=seen)
    groups, notes = pose_groups(made, arm, Path("points.csv"))
    figures = pose_criterion(groups).figures
    for letter, angle in zip("abc", turn, strict=True):
        values = {f.where.split()[0]: f.value for f in figures if f.symbol == f"AP_{letter}"}
        assert sorted(values.values()) == pytest.approx(sorted([angle, -angle]), abs=2e-4)
        assert all(f.value < 6e-4 for f in figures if f.symbol == f"RP_{letter}")
    assert any("target where it fits" in note for note in notes)

"""Points with covariances: exact derivatives, better estimates where noise has a direction, columns that are checked."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.posed import whole_problem
from calib.calibration import CalibrationPlan, calibrate, points_in_base
from calib.errors import CalibrationError, PointsFileError, UnusablePointsError
from calib.identify.identification import identify
from calib.identify.objective import objective_named
from calib.identify.solver import best_of_starts, prior_of
from calib.points.points import COVARIANCE, Points, base_points_for, make_points, matrices_of, points_for, read_points, triangles
from calib.points.writer import write_points
from calib.validation.verify import compare_arms
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Tool
from control.model.description import load_arm
from tests.calib.simulated import RIGHT, true_dh

POSES = 40
ALONG_m, ACROSS_m, TURN_rad = 1.5e-3, 1e-4, 1e-3
CAMERA = Rotation.from_rotvec([-1.2, 0.4, 0.9])
CAMERA_m = np.array([0.3, -0.2, 0.8])


def session(seed: int) -> tuple[Arm, Points]:
    """A true arm, and what a camera saw of its nominal one: far worse along the view, which turns from pose to pose."""
    rng = np.random.default_rng(seed)
    true = RIGHT.with_dh(true_dh(rng))
    lower = [drive.joint_lower_rad for drive in RIGHT.drives]
    upper = [drive.joint_upper_rad for drive in RIGHT.drives]
    q = rng.uniform(lower, upper, (POSES, 3))
    rays = rng.normal(size=(POSES, 3)) + np.array([0.0, 0.0, 2.0])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    position = ACROSS_m**2 * np.eye(3) + (ALONG_m**2 - ACROSS_m**2) * rays[:, :, None] * rays[:, None, :]
    turn = np.tile(TURN_rad**2 * np.eye(3), (POSES, 1, 1))
    noise = np.einsum("mij,mj->mi", np.linalg.cholesky(position), rng.normal(size=(POSES, 3)))
    tips = CAMERA.inv().apply(ForwardKinematics(true).tips(q) - CAMERA_m) + noise
    link = Rotation.from_matrix(ForwardKinematics(true).link_transforms(q)[:, -1, :3, :3])
    seen = Rotation.from_rotvec(rng.normal(0.0, TURN_rad, (POSES, 3))) * CAMERA.inv() * link
    return true, make_points(
        ["free"] * POSES,
        [str(k) for k in range(POSES)],
        [1] * POSES,
        q,
        tips,
        extra={"frame": ("camera",) * POSES},
        orientation=seen.as_quat()[:, [3, 0, 1, 2]],
        covariance=np.column_stack((triangles(position), triangles(turn))),
    )


def unweighted(points: Points) -> Points:
    return dataclasses.replace(points, covariance=np.full((len(points), 12), np.nan))


def over_workspace_m(true: Arm, dh: np.ndarray) -> float:
    """Rms change of distances between tips over the workspace: what no frame can take up."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.0, 1.0, (200, 3))
    a, b = ForwardKinematics(true).tips(q), ForwardKinematics(RIGHT.with_dh(dh)).tips(q)
    return float(np.sqrt(np.mean((np.linalg.norm(a[1:] - a[:-1], axis=1) - np.linalg.norm(b[1:] - b[:-1], axis=1)) ** 2)))


@pytest.mark.parametrize("name", ["lsq", "e2", "e1"])
def test_derivatives_of_weighted_points_are_exact(name: str) -> None:
    _, points = session(1)
    whole = whole_problem(problem_of(RIGHT, points, Choice(freed=("camera",))))
    rng = np.random.default_rng(2)
    x = 0.02 * rng.uniform(-1.0, 1.0, len(whole.parameters))
    jacobian, h = whole.residuals_and_jacobian(x)[1], 1e-6
    slopes = [(whole.residuals(x + h * e) - whole.residuals(x - h * e)) / (2 * h) for e in np.eye(len(x))]
    assert np.abs(jacobian - np.stack(slopes, axis=2)).max() < 1e-7
    expanded, objective = whole.expanded(x), objective_named(name)
    pull, bend = objective.expansion(expanded.residuals, 1e-3, None)
    gradient, gram = expanded.sums(pull, bend)
    rows = jacobian.reshape(-1, len(x))
    assert np.allclose(gradient, rows.T @ pull.ravel(), atol=1e-9)
    matrix = (
        np.zeros((len(pull), 3, 3)) + np.eye(3)
        if bend is None
        else (np.einsum("im,ij->mij", bend, np.eye(3)) if bend.ndim == 2 else np.moveaxis(bend, 2, 0))
    )
    wanted = np.einsum("mik,mij,mjl->kl", jacobian, matrix, jacobian)
    assert np.allclose(gram, wanted, atol=1e-9 * np.abs(wanted).max())


def test_weights_make_the_estimate_better_and_its_intervals_hold() -> None:
    ratios, scores, scatter = [], [], []
    for seed in range(2):
        true, points = session(10 + seed)
        plan = Choice().for_points(RIGHT, points)
        lsq = objective_named("lsq")
        weighed = identify(problem_of(RIGHT, points, plan), objective=lsq, starts_count=1)
        alike = identify(problem_of(RIGHT, unweighted(points), plan), objective=lsq, starts_count=1)
        ratios.append(over_workspace_m(true, weighed.dh) / over_workspace_m(true, alike.dh))
        scatter.append(weighed.weighted)
        for one, value in zip(weighed.estimates[:16], true.dh.ravel(), strict=True):
            if one.is_determined:
                scores.append((one.value - value) / one.sd)
    assert np.median(ratios) < 0.5
    assert 0.8 < np.mean(scatter) < 1.2  # the residuals are what the covariances say
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.6


def test_full_poses_determine_all_that_this_arm_has() -> None:
    """4 n + 6 parameters for n joints, one fewer where two axes are parallel (Mooring, Roth and Driels, 1991)."""
    _, points = session(3)
    choice = Choice(freed=("camera", "tool"))
    by_pose = identify(problem_of(RIGHT, points, choice), starts_count=1)
    position = dataclasses.replace(points, orientation=np.full((POSES, 4), np.nan))
    by_position = identify(problem_of(RIGHT, position, choice), starts_count=1)
    assert by_pose.rank in (17, 18)  # the axes are parallel to 2 degrees, and nominally
    assert by_position.rank in (14, 15)
    assert by_pose.rank >= by_position.rank + 3


def test_a_calibration_from_a_camera_leaves_the_table_where_it_is() -> None:
    _, points = session(4)
    nominal = dataclasses.replace(RIGHT, tool=Tool(RIGHT.tool.position_m))
    made = calibrate(nominal, points, CalibrationPlan(objective=objective_named("lsq"), starts_count=1, leave_out=2))
    assert not [effect for effect in made.arm.effects if effect.effect == "base_frame"]
    assert [frame.name for frame in made.found.solution.frames if frame.is_free] == ["camera"]
    assert made.floor is not None
    assert made.floor.source == "the covariances of the points"
    assert not made.suspects.outliers
    in_base = points_in_base(made)
    assert in_base is not None
    assert not in_base.in_camera_frame
    assert np.abs(in_base.tip_m - ForwardKinematics(made.arm).tips(points.q_rad)).max() < 5.0 * ALONG_m
    first = matrices_of(in_base.covariance[0, :6])
    assert np.linalg.eigvalsh(first) == pytest.approx([ACROSS_m**2, ACROSS_m**2, ALONG_m**2], rel=1e-3)
    compared = compare_arms(nominal, made.arm, points)  # a camera's frame is put where each model fits best
    assert np.mean(np.linalg.norm(compared.after_m, axis=1)) < 0.3 * np.mean(np.linalg.norm(compared.before_m, axis=1))


def test_covariances_survive_a_file_and_commands_that_need_the_base_frame_refuse_a_cameras(tmp_path: Path) -> None:
    _, points = session(5)
    file = tmp_path / "points.csv"
    write_points(file, points)
    again, warnings = read_points(file, 3)
    assert warnings == ()
    assert np.allclose(again.covariance, points.covariance, rtol=1e-6, atol=0.0)
    with pytest.raises(UnusablePointsError, match=r"gap: the points are in a camera's frame .* points_base\.csv"):
        base_points_for(RIGHT, [file], "gap")
    write_points(tmp_path / "other.csv", dataclasses.replace(points, extra={}))
    with pytest.raises(UnusablePointsError, match="cannot be used together"):
        points_for(RIGHT, [file, tmp_path / "other.csv"])
    with pytest.raises(CalibrationError, match="neither fix nor free base"):
        Choice(freed=("camera",), fixed=("base",))


HEAD = "setup,point,repeat,q1_rad,x_m,y_m,z_m," + ",".join(COVARIANCE[:6])
GOOD = "free,1,1,0,0,0,0,1e-8,0,0,1e-8,0,1e-8\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (f"{HEAD}\n" + GOOD.replace("1e-8,0,1e-8", "1e-8,0,"), "column cov_zz_m2: got an empty cell"),
        (f"{HEAD}\n" + GOOD.replace("1e-8,0,0,1e-8", "1e-8,5e-8,0,1e-8"), "expected a positive definite covariance, got 1e-08"),
        (f"{HEAD}\n" + GOOD.replace("0,0,0,0,1e-8", "0,,,,1e-8"), "column x_m: got an empty cell, expected a number, since its"),
        (HEAD.replace(",cov_yz_m2", "") + "\n" + GOOD, "column cov_yz_m2 is missing beside cov_xx_m2"),
        (HEAD.replace("x_m,y_m,z_m,", "", 1) + "\n" + GOOD, "columns x_m, y_m, z_m are missing beside cov_xx_m2"),
    ],
)
def test_a_bad_covariance_names_line_and_column(text: str, says: str, tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(PointsFileError) as caught:
        read_points(file)
    assert says in str(caught.value)


@pytest.mark.parametrize("is_known", [False, True], ids=["", "with tolerances"])
def test_a_search_does_not_turn_the_arm_to_where_weights_are_least(is_known: bool) -> None:
    """A board on a loose arm: camera and base could turn together, which no tip feels, but weights that stand still would."""
    arm, rng = load_arm("so101"), np.random.default_rng(7)
    arm = arm if is_known else dataclasses.replace(arm, tolerances=None)
    lower, upper = np.array(arm.limits_rad).T
    q = rng.uniform(0.5 * lower, 0.5 * upper, (POSES, 5))
    at = ForwardKinematics(arm).link_transforms(q + rng.choice([-0.0087, 0.0087], q.shape))[:, -1]
    seen = CAMERA.inv() * Rotation.from_matrix(at[:, :3, :3])
    covariance = [triangles(np.diag(sd) ** 2) for sd in ([1e-4, 1e-4, 2e-3], [3e-3, 3e-3, 2e-4])]
    points = make_points(
        ["free"] * POSES,
        [str(k) for k in range(POSES)],
        [1] * POSES,
        q,
        CAMERA.inv().apply(at[:, :3, 3] - CAMERA_m),
        extra={"frame": ("camera",) * POSES},
        orientation=seen.as_quat()[:, [3, 0, 1, 2]],
        covariance=np.tile(np.concatenate(covariance), (POSES, 1)),
    )
    whole = whole_problem(problem_of(arm, points, Choice(freed=("camera", "tool"))))
    objective = objective_named("e2")
    best = best_of_starts(whole, objective, 1, 0, prior_of(whole, objective))
    turns = [k for k, parameter in enumerate(whole.parameters) if parameter.name in ("theta1", "alpha1", "theta2")]
    assert np.abs(best.x[turns]).max() < 1e-3

"""The identification problem: residuals vanish at the truth, every column is the slope that it claims to be."""

import dataclasses

import numpy as np
import pytest

from benchmarks.calibration.chains import MODIFIED, MODIFIED_DH
from calib.arm_problem.arm_model import ArmModel, Bounds
from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.observations import Frame, Observations, left_jacobian, rotation_of, rotation_vector, turned_slope
from calib.arm_problem.problem import ArmProblem
from calib.errors import CalibrationError, UnusablePointsError
from calib.points.points import make_points
from control.model.arm import Table
from control.model.description import load_arm
from tests.calib.arms import arm_of
from tests.calib.identify.problems import ARMS, problem_with_everything_free

CAVITIES = {"a": (0.0, 0.0, 0.0), "b": (0.05, 0.0, 0.0), "c": (0.0, 0.04, 0.0)}


@pytest.mark.parametrize("name", ARMS)
def test_every_column_is_the_slope_of_the_residuals(name) -> None:
    rng = np.random.default_rng(1)
    problem = problem_with_everything_free(name, rng)
    x = rng.uniform(-0.3, 0.3, len(problem.parameters))
    _, jacobian = problem.residuals_and_jacobian(x)
    h = 1e-6  # of a scaled unknown; central differences are then good to some 1e-9
    numeric = np.stack(
        [(problem.residuals(x + h * unit) - problem.residuals(x - h * unit)) / (2 * h) for unit in np.eye(len(x))], axis=2
    )
    np.testing.assert_allclose(jacobian, numeric, atol=3e-9)


@pytest.mark.parametrize("name", ARMS)
def test_a_slice_of_the_poses_gives_the_same_rows(name) -> None:
    rng = np.random.default_rng(2)
    problem = problem_with_everything_free(name, rng)
    x = rng.uniform(-0.3, 0.3, len(problem.parameters))
    residuals, jacobian = problem.residuals_and_jacobian(x)
    some = slice(7, 19)
    part, part_jacobian = problem.residuals_and_jacobian(x, some)
    np.testing.assert_allclose(part, residuals[some], atol=1e-15)
    np.testing.assert_allclose(part_jacobian, jacobian[some], atol=1e-13)
    np.testing.assert_allclose(problem.residuals(x, some), residuals[some], atol=1e-13)


@pytest.mark.parametrize("name", ARMS)
def test_the_solution_is_what_the_residuals_were_computed_with(name) -> None:
    rng = np.random.default_rng(3)
    problem = problem_with_everything_free(name, rng)
    x = rng.uniform(-0.3, 0.3, len(problem.parameters))
    found, observed = problem.solution(x), problem.observed
    q = observed.q_rad + sum(found.corrections[correction.name] * correction.slope_rad for correction in observed.corrections)
    tips = problem.model.tips(found.dh, q, found.tool_m)
    references = np.array([found.frames[k].to_base(p) for k, p in zip(observed.frame, observed.position_m, strict=True)])
    np.testing.assert_allclose(problem.residuals(x), references - tips, atol=1e-12)


def test_unknowns_without_a_nominal_value_have_no_limit_and_others_have_their_bound() -> None:
    problem = problem_with_everything_free("reference", np.random.default_rng(0))
    by_name = {parameter.name: parameter for parameter in problem.parameters}
    assert "theta1" not in by_name
    assert "one_y" not in by_name
    assert "kept_x" not in by_name
    assert by_name["L2"].limit == 1.0
    assert by_name["L2"].scale == 0.005
    assert not by_name["tool_x"].has_bound
    assert by_name["base_rz"].limit == np.inf


def test_a_name_that_is_none_is_refused_with_the_valid_ones() -> None:
    observed = Observations.of_tips(np.zeros((5, 3)), np.zeros((5, 3)))
    model = ArmModel(load_arm("right"))
    with pytest.raises(CalibrationError, match=r"no parameter tool_x.*: expected one of d1, theta1, .*alpha4"):
        ArmProblem(model, observed, fixed=("tool_x",))
    with pytest.raises(CalibrationError, match="no parameter L9"):
        ArmProblem(model, observed, bounds=Bounds(own={"L9": 0.1}))
    with pytest.raises(CalibrationError, match="every parameter is fixed"):
        ArmProblem(model, observed, fixed=[p.name for p in ArmProblem(model, observed).parameters])


@pytest.mark.parametrize("seed", range(5))
def test_rotations_go_there_and_back(seed) -> None:
    vector = np.random.default_rng(seed).normal(size=3)
    vector *= np.random.default_rng(seed).uniform(1e-9, 3.1) / np.linalg.norm(vector)
    rotation = rotation_of(vector)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation_vector(rotation), vector, atol=1e-9)
    small = 1e-6 * np.array([0.3, -1.0, 0.5])
    turned = rotation_of(left_jacobian(vector) @ small) @ rotation
    np.testing.assert_allclose(rotation_of(vector + small), turned, atol=1e-11)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-3, 0.0999, 0.1001, 3.0])
def test_how_a_turned_torque_follows_the_turn_is_its_difference(angle_rad) -> None:
    rng = np.random.default_rng(4)
    vector, torque = rng.normal(size=(2, 3))
    vector *= angle_rad / np.linalg.norm(vector)
    steps = 1e-4 * np.eye(3)  # large: near nought the Jacobian's own quotients keep few digits
    ahead, behind = ([left_jacobian(vector + way * step).T @ torque for step in steps] for way in (1.0, -1.0))
    slopes = (np.array(ahead) - np.array(behind)).T / 2e-4
    np.testing.assert_allclose(turned_slope(vector, torque), slopes, atol=3e-9)


def session_points(arm, rng, frames, visits=6, tool_m=None):
    """Sockets a, b, c of boards that stand at `frames`, each in several postures: (q, setup, point)."""
    model, rows = ArmModel(arm), []
    tool = model.nominal_tool_m if tool_m is None else tool_m
    for frame in frames:
        for name, cavity in CAVITIES.items():
            wanted = frame.to_base(np.array([cavity]))[0]
            for _ in range(visits):
                q = np.array([0.0, -0.5, 0.3, 0.4]) + rng.uniform(-0.6, 0.6, arm.joint_count)
                for _ in range(50):
                    slopes = model.slopes(model.nominal_dh, q[None], tool)
                    step = np.linalg.pinv(slopes.by_dh[0][:, list(model.theta_places)])
                    q = q + 0.7 * step @ (wanted - slopes.tips[0])
                rows.append((q, frame.name.removeprefix("board_"), name))
    return np.array([row[0] for row in rows]), [row[1] for row in rows], [row[2] for row in rows]


def test_an_unknown_tool_and_unknown_boards_are_found_before_the_search_begins() -> None:
    """Pivot calibration and rigid fits are exact where the geometry is: the residuals start at nothing."""
    rng = np.random.default_rng(5)
    arm = arm_of(MODIFIED, MODIFIED_DH)
    tool = np.array([0.02, -0.01, 0.12])
    near = ArmModel(arm).tips(arm.dh, np.array([[0.0, -0.5, 0.3, 0.4]]), tool)[0]
    frames = [
        Frame(f"board_{name}", rotation_of(rng.normal(size=3)), near + rng.uniform(-0.05, 0.05, 3)) for name in ("left", "right")
    ]
    q, setup, point = session_points(arm, rng, frames, tool_m=tool)
    arm = dataclasses.replace(
        arm, tool=dataclasses.replace(arm.tool, known=False), table=Table(known_pose=False, cavities_m=CAVITIES)
    )
    points = make_points(setup, point, [1] * len(q), q, np.full((len(q), 3), np.nan))
    problem = problem_of(arm, points)
    start = problem.solution(np.zeros(len(problem.parameters)))
    np.testing.assert_allclose(start.tool_m, tool, atol=1e-8)
    np.testing.assert_allclose(problem.residuals(np.zeros(len(problem.parameters))), 0.0, atol=1e-8)
    for frame, true in zip(start.frames[1:], frames, strict=True):
        np.testing.assert_allclose(frame.rotation, true.rotation, atol=1e-6)


def test_each_pose_gets_the_reference_that_it_has() -> None:
    arm = load_arm("right")
    tip = np.array([[np.nan] * 3, [0.4, 0.1, 0.2], [np.nan] * 3])
    points = make_points(["roll", "free", "normal"], ["1", "f1", "1"], [1, 1, 1], np.zeros((3, 3)), tip)
    known = problem_of(arm, points).observed
    assert [known.frames[k].name for k in known.frame] == ["table_roll", "base", "table_normal"]
    freed = problem_of(arm, points, Choice(freed=("table",)))
    assert [frame.name for frame in freed.free_frames] == ["table_roll", "table_normal"]
    based = problem_of(arm, points, Choice(freed=("base",)))
    assert [frame.name for frame in based.free_frames] == ["base"]
    np.testing.assert_allclose(based.references_m, problem_of(arm, points).references_m, atol=1e-15)


@pytest.mark.parametrize(
    ("setup", "point", "says"),
    [
        ("free", "1", 'setup "free": its poses have no measured tip'),
        ("roll", "99", r'point "99" of setup "roll" \(pose 2\).*it has 1, 2, 3 \.\.\. 33'),
    ],
)
def test_a_pose_without_a_reference_is_refused(setup, point, says) -> None:
    points = make_points(["roll", setup], ["1", point], [1, 1], np.zeros((2, 3)), np.full((2, 3), np.nan))
    with pytest.raises(UnusablePointsError, match=says):
        problem_of(load_arm("right"), points)


def test_what_can_be_freed_is_listed() -> None:
    with pytest.raises(CalibrationError, match='expected some of base, camera, table, tool, got "elbow"'):
        Choice(freed=("elbow",))

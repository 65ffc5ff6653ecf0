"""The public names: documented, typed, light to import, and one family of errors."""

from __future__ import annotations

import ast
import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import armwright
from benchmarks.arms import SIX, circle_in_place
from calib.points.writer import write_points

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "python.md").read_text("utf-8")
HEAVY = ("numpy", "scipy", "mujoco", "matplotlib", "can", "serial", "msgspec", "rich", "ruckig", "textual", "mcap")


def test_importing_it_loads_nothing_heavy_and_none_of_its_own_modules() -> None:
    program = "import sys, armwright; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert not set(HEAVY) & set(loaded)
    assert [name for name in loaded if name.startswith(("armwright.", "control", "calib", "console"))] == []


def test_the_page_names_what_is_exported_and_nothing_else() -> None:
    tables = PAGE[PAGE.index("## Names") :]
    named = {name for row in re.findall(r"^\| .*", tables, re.M) for name in re.findall(r"`([A-Za-z_]\w*)`", row)}
    assert named == set(armwright.__all__)
    assert set(dir(armwright)) == {*armwright.__all__, "__version__"}


def test_help_shows_types_by_the_names_that_their_authors_gave_them() -> None:
    signatures = [
        f"{name}.{method}{inspect.signature(member)}"
        for name in armwright.__all__
        for method, member in inspect.getmembers(getattr(armwright, name), inspect.isfunction)
        if member.__module__.startswith("armwright.")
    ]
    assert len(signatures) > 40
    assert [signature for signature in signatures if "numpy." in signature or "typing." in signature] == []


def test_what_a_type_checker_sees_is_what_is_loaded() -> None:
    tree = ast.parse((ROOT / "armwright" / "__init__.py").read_text("utf-8"))
    checked = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.name: node.module for node in checked.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert list(armwright.__all__) == sorted(seen)
    for name, module in seen.items():
        found = getattr(armwright, name)
        assert found is getattr(sys.modules[str(module)], name)


def test_a_name_that_there_is_not_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'load_robot'"):
        getattr(armwright, "load_robot")  # noqa: B009 - the point is that there is none


def functions() -> list[tuple[str, object]]:
    """Every public function and method."""
    found: list[tuple[str, object]] = []
    for name in armwright.__all__:
        public = getattr(armwright, name)
        found.append((name, public))
        if inspect.isclass(public) and public.__module__.startswith("armwright"):
            found += [
                (f"{name}.{member}", value.fget if isinstance(value, property) else value)
                for member, value in vars(public).items()
                if not member.startswith("_") and (callable(value) or isinstance(value, property))
            ]
    return found


@pytest.mark.parametrize(("name", "public"), functions(), ids=lambda value: value if isinstance(value, str) else "")
def test_every_public_name_is_documented_and_typed(name: str, public: object) -> None:
    assert inspect.getdoc(public), name
    if inspect.isfunction(public):
        signature = inspect.signature(public)
        assert signature.return_annotation is not inspect.Signature.empty, name
        for parameter in signature.parameters.values():
            assert parameter.name == "self" or parameter.annotation is not inspect.Parameter.empty, name


def test_every_error_is_an_armwright_error() -> None:
    errors = [
        public
        for name in armwright.__all__
        if inspect.isclass(public := getattr(armwright, name)) and issubclass(public, Exception)
    ]
    assert len(errors) >= 10
    assert all(issubclass(error, armwright.ArmwrightError) for error in errors)


def test_a_path_with_orientations_is_planned_and_sampled_for_six_joints() -> None:
    waypoints = circle_in_place(SIX, tilt_rad=0.1)
    assert waypoints.orientations is not None
    rows = [[*point, *turned] for point, turned in zip(waypoints.points, waypoints.orientations, strict=True)]
    trajectory = armwright.plan_path(SIX, rows, 0.1)
    samples = trajectory.sample([0.0, 0.5 * trajectory.duration_s, trajectory.duration_s])
    assert samples.joint_rad.shape == (3, 6)
    assert samples.tip_m[-1] == pytest.approx(waypoints.points[-1], abs=1e-6)


def test_tip_poses_of_six_joints_go_there_and_back() -> None:
    kinematics = armwright.Kinematics(SIX)
    near = np.array([[0.2, -0.5, 0.6, 0.3, 0.4, -0.2], [0.1, -0.4, 0.5, 0.2, 0.5, 0.1]])
    poses = kinematics.pose(near)
    assert poses[:, :3] == pytest.approx(kinematics.forward(near))
    found = kinematics.inverse(poses, near + 0.05)
    assert found.shape == (2, 6)
    assert kinematics.pose(found) == pytest.approx(poses, abs=1e-6)
    with pytest.raises(armwright.BadTarget, match="a unit quaternion"):
        kinematics.inverse([*poses[0, :3], 2.0, 0.0, 0.0, 0.0])
    with pytest.raises(armwright.MissingModel, match="`inverse` with different near_rad"):
        kinematics.solutions(poses[0, :3])


def test_points_may_be_a_file(tmp_path: Path) -> None:
    arm, file = armwright.load_arm("right"), tmp_path / "points.csv"
    q_rad = [[0.1 * k, -0.5, 0.5] for k in range(5)]
    write_points(file, armwright.make_points(q_rad, armwright.Kinematics(arm).forward(q_rad)))
    comparison = armwright.verify(arm, arm, file)
    assert comparison.of("all").after.mean_m == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(armwright.CalibrationError, match="setup: expected one of free, all, got 'al'"):
        comparison.of("al")
    file.write_text("setup,point,repeat,q1_rad,x_m,y_m,z_m\nfree,1,1,0,0,0,0\n", encoding="utf-8")
    for look in (armwright.calibrate, armwright.find_gap, lambda arm, points: armwright.verify(arm, arm, points)):
        with pytest.raises(armwright.CalibrationError, match=r"points\.csv, line 1: "):
            look(arm, str(file))


def test_what_an_interactive_session_prints_is_one_line(tmp_path: Path) -> None:
    points = armwright.make_points(np.zeros((4, 5)), np.zeros((4, 3)))
    assert repr(points) == "<Points: 4 poses of 5 joints, 4 measured tips, setups free>"
    assert repr(armwright.plan_path(SIX, circle_in_place(SIX).points)).startswith(f"<Trajectory of arm {SIX.name}: ")
    log = tmp_path / "log.csv"
    log.write_text("run,t_s,q1_rad,q2_rad\na,0,0,0\na,0.5,0,0\n")
    assert repr(armwright.read_recording(log)) == "<Series log.csv: 2 samples of 2 joints, 0.50 s, 1 run>"


def test_wrong_input_is_one_error_of_the_family_that_says_the_shape() -> None:
    arm = armwright.load_arm("right")
    two_joints = armwright.make_points([[1.0, 2.0]], [[1.0, 2.0, 3.0]])
    with pytest.raises(armwright.BadTarget, match=r"expected shape \(..., 3\), got \(2,\)"):
        armwright.Kinematics(arm).forward([1.0, 2.0])
    with pytest.raises(armwright.PathError, match=r"expected shape \(m, 3\), or \(m, 7\) .*, got \(2, 2\)"):
        armwright.plan_path(arm, [[1.0, 2.0], [3.0, 4.0]])
    with pytest.raises(armwright.CalibrationError, match=r"tip_m: expected shape \(1, 3\), got \(1, 2\)"):
        armwright.make_points([[1.0, 2.0, 3.0]], [[1.0, 2.0]])
    for look in (armwright.calibrate, armwright.find_gap, lambda arm, points: armwright.verify(arm, arm, points)):
        with pytest.raises(armwright.CalibrationError, match="points: 2 joints, but arm right has 3"):
            look(arm, two_joints)
    with pytest.raises(armwright.RuntimeGone, match="start one with `armwright serve`"):
        armwright.connect(arm, "/nowhere.sock")

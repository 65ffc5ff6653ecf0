"""`armwright calibrate`: the operator's way from points.csv to a calibrated arm, with right and wrong input."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.points.points import Points, read_points
from calib.validation.verify import errors_of
from console.main import main
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.description import load_arm, save_arm
from control.model.table import SETUPS, cavities, table_of
from tests.places import REAL

pytestmark = pytest.mark.usefixtures("unrendered")  # tests/calib/report looks at the page

PANDA = REAL / "mukca_panda_1"
HEADER = "setup,point,repeat,q1_rad,q2_rad,q3_rad,x_m,y_m,z_m\n"


def session(seed: int = 0) -> tuple[np.ndarray, np.ndarray, list[str], list[str]]:
    """Angles, measured tips, setups and points of a table session of an arm whose geometry is a little off."""
    rng = np.random.default_rng(seed)
    arm = load_arm("right")
    true = ForwardKinematics(arm.with_dh(arm.dh + rng.uniform(-1, 1, (4, 4)) * [0.002, 0.01, 0.002, 0.01]))
    inverse, q, setups, points = InverseKinematics(arm), [], [], []
    for setup in SETUPS:
        for name, place in cavities(table_of(arm), setup).items():
            q.append(inverse.nearest(place, q[-1] if q else (0.0, -1.0, 0.0)))
            setups.append(setup)
            points.append(name)
    tips = true.tips(q) + rng.normal(0.0, 0.00014, (len(q), 3))
    return np.array(q), tips, setups, points


def written(path: Path, q: np.ndarray, tips: np.ndarray, setups: list[str], points: list[str]) -> Path:
    rows = (
        f"{setup},{point},1,{','.join(f'{v:.9f}' for v in angles)},{','.join(f'{v:.7f}' for v in tip)}\n"
        for setup, point, angles, tip in zip(setups, points, q, tips, strict=True)
    )
    path.write_text(HEADER + "".join(rows))
    return path


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("points") / "points.csv", *session())


def calibrate(points: Path, out: Path, *more: str) -> int:
    return main(["calibrate", "--points", str(points), "--out", str(out), *more])


def test_points_become_a_calibrated_arm_a_judgement_and_files_for_other_tools(points, tmp_path, capsys) -> None:
    assert calibrate(points, tmp_path / "out", "--export", "urdf,mjcf,json") == 0
    said = capsys.readouterr().out
    assert said.startswith("The result is good")
    assert "These 99 points determine 10 of 16 parameters" in said
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert files == {"arm.toml", "calibration.json", "report.html", "arm.urdf", "arm.xml", "arm.json"}
    arm = load_arm(tmp_path / "out" / "arm.toml")
    assert arm.calibration is not None
    assert set(arm.calibration.inputs) == {"points.csv", "right.toml"}
    content = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert content["format"] == "calibration/1"
    assert content["verdict"]["grade"] == "good"
    assert content["held_out"]["mean_after_m"] < 0.0003
    assert content["outliers"] == []
    assert "Held-out points" in (tmp_path / "out" / "report.html").read_text()


def test_results_are_never_overwritten(points, tmp_path, capsys) -> None:
    (tmp_path / "calibration.json").write_text("precious")
    assert calibrate(points, tmp_path) == 2
    assert "never overwritten" in capsys.readouterr().err
    assert (tmp_path / "calibration.json").read_text() == "precious"
    assert not (tmp_path / "arm.toml").exists()


def test_a_real_panda_calibrates_with_the_same_command(tmp_path, capsys) -> None:
    """A ball in sockets of boards at unknown places, no camera. Reference figures in the data's notes: consistency 7.97 mm
    nominal, 0.46 fitted; 0.80 on setups left out.
    """
    options = ["--arm", str(PANDA / "arm.toml"), "--points", str(PANDA / "points.csv")]
    assert main(["calibrate", *options, "--out", str(tmp_path), "--json", "--starts", "1"]) == 0
    content = json.loads(capsys.readouterr().out)
    arm = load_arm(tmp_path / "arm.toml")
    recorded, _ = read_points(PANDA / "points.csv", arm.joint_count)
    assert consistency_m(arm, recorded).mean() <= 0.00047
    assert content["held_out"]["mean_after_m"] <= 0.00080
    assert content["parameters"]["d1"]["deviation"] == pytest.approx(0.0, abs=1e-9)  # the boards take it up
    assert len(content["frames"]) == 3
    assert arm.tool.known
    assert arm.tool.position_m[2] == pytest.approx(0.14, abs=0.01)


def consistency_m(arm: Arm, recorded: Points) -> np.ndarray:
    """Distance of each predicted ball centre to the mean of its socket, (m,)."""
    tips = ForwardKinematics(arm).tips(recorded.q_rad)
    sockets = np.array([f"{s}/{p}" for s, p in zip(recorded.setup, recorded.point, strict=True)])
    means = {socket: tips[sockets == socket].mean(axis=0) for socket in set(sockets)}
    return np.linalg.norm(tips - np.array([means[socket] for socket in sockets]), axis=1)


def test_an_accuracy_that_cannot_be_met_is_said(points, tmp_path, capsys) -> None:
    assert calibrate(points, tmp_path, "--accuracy", "0.1mm", "--starts", "1") == 0
    assert "0.1 mm cannot be met" in capsys.readouterr().out
    assert json.loads((tmp_path / "calibration.json").read_text())["accuracy"]["is_met"] is False


def test_fixed_and_freed_parameters_and_bounds_are_what_was_asked_for(points, tmp_path) -> None:
    more = ["--fix", "theta4,alpha4", "--free", "base", "--bound", "lengths=8mm", "--bound", "L2=1mm"]
    assert calibrate(points, tmp_path, *more, "--objective", "lsq", "--starts", "1") == 0
    found = json.loads((tmp_path / "calibration.json").read_text())["parameters"]
    assert "theta4" not in found
    assert {"base_x", "base_rz"} <= set(found)
    assert found["d1"]["bound"] == 0.008
    assert found["L2"]["bound"] == 0.001
    assert [e.effect for e in load_arm(tmp_path / "arm.toml").effects] == ["base_frame"]


def test_a_base_that_was_fixed_stays_so_for_whoever_reads_the_file(points, tmp_path) -> None:
    save_arm(replace(load_arm("right"), table=None), tmp_path / "bare.toml")  # nothing says where tips are measured
    more = ["--arm", str(tmp_path / "bare.toml"), "--starts", "1"]
    for out, fix in (("placed", []), ("fixed", ["--fix", "base"])):
        assert calibrate(points, tmp_path / out, *more, *fix) == 0
    placed, fixed = (load_arm(tmp_path / out / "arm.toml") for out in ("placed", "fixed"))
    moved, _ = read_points(points, fixed.joint_count)
    moved = replace(moved, tip_m=moved.tip_m + np.array([0.0, 0.0, 0.01]))
    assert any(value for effect in placed.effects for value in effect.parameters.values())
    assert [set(effect.parameters.values()) for effect in fixed.effects] == [{0.0}]
    assert errors_of(fixed, moved).mean(axis=0) == pytest.approx([0.0, 0.0, 0.01], abs=0.001)


def test_a_point_in_the_wrong_place_is_named_and_can_be_left_out(tmp_path, capsys) -> None:
    q, tips, setups, names = session(1)
    tips[10] += [0.003, 0.0, 0.0]
    file = written(tmp_path / "points.csv", q, tips, setups, names)
    assert calibrate(file, tmp_path / "with", "--starts", "1") == 0
    assert 'point 11 of setup "normal" (pose 11) is 3.0' in capsys.readouterr().out
    assert calibrate(file, tmp_path / "without", "--without", "normal:11", "--starts", "1") == 0
    assert json.loads((tmp_path / "without" / "calibration.json").read_text())["points"] == 98


SPOILED = {
    "degrees": (lambda q, t: (np.degrees(q), t), "look like degrees"),
    "counts": (lambda q, t: (q * 100 * 2048 / (2 * np.pi), t), "look like encoder counts"),
    "swapped joints": (lambda q, t: (q[:, [1, 0, 2]], t), "q1_rad and q2_rad look swapped"),
    "swapped coordinates": (lambda q, t: (q, t[:, [1, 0, 2]]), "x_m and y_m look swapped"),
    "millimetres": (lambda q, t: (q, 1e3 * t), "look like millimetres"),
    "another arm": (lambda q, t: (np.sin(37.0 * q), t), "check that the points are of this arm"),
    "three points": (lambda q, t: (q[:3], t[:3]), "too few"),
    "a line": (lambda q, t: (q[24:33], t[24:33]), "one straight line"),
    "copies": (lambda q, t: (np.tile(q[:33], (3, 1)), np.tile(t[:33], (3, 1))), "copies, not repeats"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_spoiled_points_are_recognised_and_nothing_is_written(name, tmp_path, capsys) -> None:
    spoil, says = SPOILED[name]
    q, tips, setups, names = session()
    q, tips = spoil(q, tips)
    file = written(tmp_path / "points.csv", q, tips, *(list(np.resize(x[:33], len(q))) for x in (setups, names)))
    assert calibrate(file, tmp_path / "out") == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--objective", "e3"], "expected one of e2, e1, lsq, huber"),
        (["--bound", "L2=8"], "expected a number with one of the units m, cm, mm, um"),
        (["--bound", "L9=8mm"], "no parameter L9"),
        (["--fix", "elbow"], "no parameter elbow"),
        (["--free", "elbow"], "expected some of base, camera, table, tool"),
        (["--without", "normal:99"], "no such pose"),
        (["--leave-out", "1"], "--leave-out"),
        (["--accuracy=-1mm"], "expected a length above 0"),
        (["--export", "stl"], "expected one or more of urdf, mjcf, json"),
        (["--effect", "backlash:7"], "a joint from 1 to 3"),
        (["--boards", "nowhere.json"], "nowhere.json: cannot be read"),
    ],
)
def test_wrong_options_are_one_clear_error(points, tmp_path, capsys, more, says) -> None:
    assert calibrate(points, tmp_path / "out", *more) == 2
    error = capsys.readouterr().err
    assert says in error.splitlines()[-1]
    assert not (tmp_path / "out").exists()

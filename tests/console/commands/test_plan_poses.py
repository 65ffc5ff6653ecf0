"""`armwright plan-poses` as a user runs it: right input, wrong input."""

import json

import numpy as np
import pytest

from calib.points.points import make_points, read_points
from calib.points.writer import write_points
from console.main import main
from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm

ARM = load_arm("right")


def said(capsys, *arguments: str) -> tuple[int, str, str]:
    """Exit status, standard output, standard error."""
    try:
        status = main(["plan-poses", *arguments])
    except SystemExit as end:
        status = int(end.code or 0)
    output = capsys.readouterr()
    return status, output.out, output.err


def points_file(path):
    """Thirty poses that a camera saw."""
    q = np.random.default_rng(0).uniform([-2.0, -1.2, -0.8], [2.0, 0.5, 1.0], (30, 3))
    names = [f"p{k}" for k in range(1, 31)]
    write_points(path, make_points(["free"] * 30, names, [1] * 30, q, ForwardKinematics(ARM).tips(q)))
    return str(path)


def test_plan_is_printed_with_what_each_pose_brings(capsys):
    status, out, err = said(capsys, "--count", "5", "--only", "free")
    assert (status, err) == (0, "")
    assert "Poses by value" in out
    rows = [line.split() for line in out.splitlines() if line.startswith("  free") and " p" in line]
    assert len(rows) == 5
    assert sorted(int(row[2]) for row in rows) == [1, 2, 3, 4, 5]
    assert "the tip's uncertainty over the workspace" in out


def test_points_taken_are_counted_and_their_names_not_used_again(capsys, tmp_path):
    taken = points_file(tmp_path / "points.csv")
    status, out, _ = said(capsys, "--points", taken, "--free", "3", "--out", str(tmp_path / "plan"))
    assert status == 0
    assert "30 points recorded" in out
    planned, warnings = read_points(tmp_path / "plan" / "plan.csv", 3)
    assert planned.point == ("p31", "p32", "p33")
    assert planned.setup == ("free",) * 3
    assert not warnings


def test_json_is_one_document_and_files_are_named_on_standard_error(capsys, tmp_path):
    status, out, err = said(capsys, "--count", "3", "--only", "table", "--json", "--out", str(tmp_path))
    assert status == 0
    content = json.loads(out)
    assert content["format"] == "plan/1"
    assert content == json.loads((tmp_path / "plan.json").read_text())
    assert "plan.csv" in err


def test_measured_boards_are_taken_from_boards_json(capsys, tmp_path):
    board = {"origin_m": [0.45, 0.0, 0.02], "rotation": np.eye(3).tolist()}
    file = tmp_path / "boards.json"
    file.write_text(json.dumps({"format": "boards/1", "boards": {"desk": board}}))
    status, out, _ = said(capsys, "--boards", str(file), "--setups", "desk", "--only", "table", "--count", "4")
    assert status == 0
    assert "33 desk" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--criterion", "E"], "criterion: expected one of D, O1, O2, O3, O4, O5, tip"),
        (["--setups", "yaw"], 'got "yaw"'),
        (["--setups", ","], "--setups: expected names"),
        (["--count", "0"], "number of poses: expected one or more, got 0"),
        (["--count", "500", "--only", "table"], "500 poses were requested, but only 99 are available"),
        (["--free", "3", "--only", "table"], "contradict each other"),
        (["--count", "3", "--free", "4"], "free poses: expected 0 to 3"),
        (["--noise", "0mm"], "--noise: expected a length above 0, got 0mm"),
        (["--noise", "0.2"], '--noise: expected a number with one of the units m, cm, mm, um, got "0.2"'),
        (["--view", "1", "0", "0", "1", "0", "1"], "--view: expected x from smaller to larger"),
        (["--only", "both"], "invalid choice: 'both'"),
        (["--count", "many"], "invalid int value: 'many'"),
        (["--points", "nowhere.csv"], "nowhere.csv"),
        (["--boards", "nowhere.json"], "nowhere.json"),
        (["--arm", "nowhere.toml"], "nowhere.toml"),
    ],
)
def test_wrong_input_is_one_clear_error_and_exit_status_2(capsys, arguments, message):
    status, out, err = said(capsys, *arguments)
    assert status == 2
    assert out == ""
    assert message in err
    assert "Traceback" not in err

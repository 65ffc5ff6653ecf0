"""`armwright gap`: from points to a named effect in a new arm.toml, or an honest answer."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.gap.static.cases import Hidden, case
from calib.points.points import Points
from console.main import main
from control.model.description import load_arm, save_arm
from tests.calib.gap.series.prescribed import arm_with_friction, log_of, write_log


def written(path: Path, points: Points) -> Path:
    header = ["setup", "point", "repeat", "t_s", "payload_kg"]
    header += [form.format(j) for form in ("q{}_rad", "dir{}", "i{}_A") for j in (1, 2, 3)] + ["x_m", "y_m", "z_m"]
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for k in range(len(points)):
            numbers = [*points.q_rad[k], *map(int, points.direction[k]), *points.current_A[k], *points.tip_m[k]]
            start = [points.setup[k], points.point[k], points.repeat[k], points.t_s[k], points.payload_kg[k]]
            writer.writerow([*start, *numbers])
    return path


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("gap") / "points.csv"
    return written(file, case(21, (Hidden("backlash", 1, 0.006),)))


@pytest.mark.usefixtures("unrendered")  # tests/calib/gap/maps has such a page rendered
def test_a_hidden_play_is_named_and_added_to_a_new_arm(points, tmp_path, capsys) -> None:
    assert main(["gap", "--points", str(points), "--out", str(tmp_path)]) == 0
    assert "Named: backlash on joint 1" in capsys.readouterr().out
    content = json.loads((tmp_path / "gap.json").read_text())
    assert content["format"] == "gap/2"
    assert [e["effect"] for e in content["effects"]] == ["link_geometry", "backlash"]
    assert content["gap"]["before"] > 5.0
    assert content["gap"]["after"] < 1.1
    arm = load_arm(tmp_path / "arm.toml")
    assert [(e.effect, e.joint) for e in arm.effects] == [("backlash", 1)]
    assert arm.effects[0].parameters["width_rad"] == pytest.approx(0.006, rel=0.05)
    assert "<svg" in (tmp_path / "report.html").read_text()


@pytest.mark.usefixtures("unrendered")
def test_without_the_effect_in_the_list_the_answer_is_unknown(points, tmp_path, capsys) -> None:
    assert main(["gap", "--points", str(points), "--out", str(tmp_path), "--without", "backlash", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert [e["effect"] for e in content["effects"]] == ["link_geometry"]
    assert "joint 1" in content["unknown"]["where"]
    assert load_arm(tmp_path / "arm.toml").effects == ()


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--without", "ghost"], 'got "ghost"'),
        (["--points", "nowhere.csv"], "nowhere.csv: cannot be read"),
        (["--log", "no.csv"], "no.csv: cannot be read"),
    ],
)
def test_wrong_input_is_one_clear_error_and_nothing_is_written(points, tmp_path, capsys, more, says) -> None:
    assert main(["gap", "--points", str(points), "--out", str(tmp_path / "out"), *more]) == 2
    assert says in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_neither_poses_nor_time_series_is_an_error(tmp_path, capsys) -> None:
    assert main(["gap", "--out", str(tmp_path)]) == 2
    assert "give --points for static poses, --log for time series" in capsys.readouterr().err


def test_a_log_alone_names_a_hidden_friction(tmp_path, capsys) -> None:
    arm = arm_with_friction()
    save_arm(arm, tmp_path / "arm.toml")
    hidden = log_of(arm, lambda j, q, speed, link: 0.2 * np.abs(link) * np.sign(speed) * (j == 1))
    write_log(hidden, tmp_path / "log.csv.gz")
    arguments = ["gap", "--arm", str(tmp_path / "arm.toml"), "--log", str(tmp_path / "log.csv.gz")]
    assert main([*arguments, "--out", str(tmp_path / "gap")]) == 0
    assert "Named: load_friction on joint 2" in capsys.readouterr().out
    (added,) = [e for e in load_arm(tmp_path / "gap" / "arm.toml").effects if e.effect == "load_friction"]
    assert added.parameters["fraction"] == pytest.approx(0.2, rel=0.05)


def test_a_result_is_never_overwritten(points, tmp_path, capsys) -> None:
    (tmp_path / "gap.json").write_text("precious")
    assert main(["gap", "--points", str(points), "--out", str(tmp_path)]) == 2
    assert "never overwritten" in capsys.readouterr().err
    assert (tmp_path / "gap.json").read_text() == "precious"

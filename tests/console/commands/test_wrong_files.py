"""Whatever takes a table tells a file that is not the right one, by one error, and writes nothing."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest

from calib.points.points import make_points
from calib.points.writer import write_points
from console.main import main
from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm

POINTS = (
    "calibrate --points {} --out OUT",
    "gap --points {} --out OUT",
    "trust --points {} --out OUT",
    "verify --against ARM --points {} --out OUT",
    "plan-path --points {} way.csv --out OUT",
    "plan-poses --points {} --noise 1mm",
    "check-up --points {} --recorded right.csv --out OUT",
    "check-up --points right.csv --recorded {} --out OUT",
)
OTHERS = ("iso9283 --points {} --out OUT", "calibrate-distances --points {} --out OUT")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Arms of four and three joints with a table of points each, and what a user may take for such a table."""
    folder = tmp_path_factory.mktemp("wrong")
    for name, joints in (("right", 4), ("other", 3)):
        file = folder / f"{name}.toml"
        assert main(["new", "--out", str(file), "--joints", str(joints), "--yes"]) == 0
        arm, random = load_arm(file), np.random.default_rng(joints)
        lower, upper = np.array(arm.limits_rad).T
        q_rad = random.uniform(lower, upper, (30, joints))
        tips_m = ForwardKinematics(arm).tips(q_rad) + random.normal(0.0, 2e-4, (30, 3))
        names = [f"p{k}" for k in range(30)]
        for table, angles in ((name, q_rad), (f"{name}_deg", np.degrees(q_rad))):
            points = make_points(["free"] * 30, names, [1] * 30, angles, tips_m)
            write_points(folder / f"{table}.csv", points)
    (folder / "way.csv").write_text("x_m,y_m,z_m\n0.3,0,0.4\n0.3,0.1,0.4\n")
    (folder / "empty.csv").write_text("")
    return folder


def refused(line: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    words = [*line.replace("OUT", "out").replace("ARM", "right.toml").split(), "--arm", "right.toml"]
    assert main(words) == 2
    assert not [*Path("out").glob("*")], "nothing is written"


@pytest.mark.parametrize("line", [*POINTS, *OTHERS])
@pytest.mark.parametrize(
    ("file", "says"),
    [
        ("missing.csv", "missing.csv: cannot be read"),
        ("empty.csv", "empty.csv, line 1: required column"),
        ("other.csv", ": is the file of another arm?"),
        ("right.toml", "right.toml, line 1: required column"),
    ],
)
def test_a_file_that_is_no_table_of_this_arm_is_named(
    line: str, file: str, says: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(line.format(file), folder, monkeypatch)
    assert says in capsys.readouterr().err or (line.startswith("iso9283") and file == "other.csv")


@pytest.mark.parametrize("line", POINTS)
def test_angles_in_degrees_are_told_by_every_command_that_takes_points(
    line: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(line.format("right_deg.csv"), folder, monkeypatch)
    assert "the joint angles look like degrees" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("import-points right.csv --arm other.toml --out out", 'column "q4_rad" is of joint 4, arm other has 3'),
        ("import-points right.csv --arm right.toml --out out.csv", "expected a folder"),
        ("calibrate-distances --arm right.toml --points right.csv --out out", "distance_of is missing beside angles"),
        ("mock --cell right.toml", "got an arm.toml (give it with --arm)"),
        ("arm model.urdf", "got XML (`armwright new --from-urdf`"),
        ("new --joints 3 --axes zzz --out new.toml --yes", "axes: expected one across the arm"),
    ],
)
def test_what_was_meant_otherwise_is_said(
    line: str, says: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    Path("model.urdf").write_text("<robot/>")
    assert main(line.split()) == 2
    assert says in capsys.readouterr().err
    assert not Path("out", "points.csv").exists()


def test_an_arm_without_its_option_is_told_it(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["export-arm", "my_arm.toml", "--export", "urdf", "--out", "x"])
    assert "my_arm.toml: the arm's file follows --arm" in capsys.readouterr().err


def test_a_question_that_nobody_answers_ends_with_the_option_that_answers_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stdin", Terminal())
    sheet = tmp_path / "sheet.csv"
    sheet.write_text("q1;q2;q3;x [mm];y [mm];z [mm]\n0;0;0;1;2;3\n")
    assert main(["import-points", str(sheet), "--arm", "right", "--out", str(tmp_path / "out")]) == 2
    assert "answer with --angles NAME; NAME is one of rad, deg" in capsys.readouterr().err

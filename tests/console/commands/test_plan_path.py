"""`armwright plan-path`: what it writes is what `run`, `script` and `session` take, and what it refuses before it writes."""

import argparse
import json
from pathlib import Path

import pytest

from calib.points.writer import write_points
from console.commands.calibration.session import OPTIONS, plan_from_options
from console.lines import Grammar, parse_lines
from console.main import main
from console.specs.table import COMMANDS
from control.model.description import load_arm
from tests.calib.trust.test_trust import recorded

PATH = "x_m,y_m,z_m\n0.45,0,0.2\n0.5,0.05,0.2\n0.55,0,0.2\n"


@pytest.fixture
def files(tmp_path: Path) -> list[str]:
    every = recorded().points
    write_points(tmp_path / "points.csv", every.chosen(list(range(0, len(every), 6))))
    (tmp_path / "path.csv").write_text(PATH)
    return ["plan-path", str(tmp_path / "path.csv"), "--points", str(tmp_path / "points.csv")]


def test_stops_for_the_session_and_as_a_script(files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    line = [*files, "--out", str(out), "--stops", "--any-order", "--tolerance", "30mm"]
    assert main(line) == 0
    printed = capsys.readouterr().out
    content = json.loads((out / "task.json").read_text())
    assert content["format"] == "task/1"
    assert content["as_planned"]["rms_m"] <= content["as_given"]["rms_m"]
    assert all(sentence in printed for sentence in content["in_words"])
    lines = parse_lines((out / "script.txt").read_text().splitlines(), Grammar(COMMANDS, {}))
    assert len(lines) >= 2 * len(content["stops"])
    args = argparse.Namespace(**dict.fromkeys(OPTIONS), out=str(tmp_path / "session"))
    args.plan = str(out / "poses.csv")
    plan = plan_from_options(args, load_arm("right"))
    assert plan is not None
    assert [target.q_rad for target in plan.targets] == [pytest.approx(stop["q_rad"], abs=1e-6) for stop in content["stops"]]
    assert main(line) == 2
    assert "never overwritten" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--shift", "0.1", "0.1", "-0.1"], "--shift: expected 0 to 1 m"),
        (["--shift", "100", "0", "0"], "--shift: expected 0 to 1 m"),
        (["--tolerance", "0.5"], "expected a number with one of the units"),
        (["--payload", "-1"], "expected a mass not below 0"),
        (["--arm", "nobody"], "nobody"),
    ],
)
def test_wrong_input_writes_nothing(
    options: list[str], said: str, files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*files, "--out", str(tmp_path / "out"), *options]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()

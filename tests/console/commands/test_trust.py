"""`armwright trust`: what it writes, and what it refuses before it writes."""

import json
from pathlib import Path

import numpy as np
import pytest

from calib.points.points import make_points
from calib.points.writer import write_points
from console.main import main
from tests.calib.trust.test_trust import recorded

PATH = "x_m,y_m,z_m\n0.45,0,0.2\n0.5,0.05,0.2\n0.55,0,0.2\n"


@pytest.fixture
def points(tmp_path: Path) -> Path:
    every = recorded().points
    some = every.chosen(list(range(0, len(every), 6)))
    file = tmp_path / "points.csv"
    write_points(file, make_points(some.setup, some.point, some.repeat, some.q_rad, some.tip_m, some.direction))
    return file


def test_the_map_and_its_words(points: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, path = tmp_path / "out", tmp_path / "path.csv"
    path.write_text(PATH)
    visits = tmp_path / "visits.csv"
    some = recorded().points.chosen([0, 1, 2, 3])
    write_points(visits, make_points(["pose"] * 4, ["P1", "P1", "P2", "P2"], [1, 2, 1, 2], some.q_rad, some.tip_m))
    line = ["trust", "--points", str(points), "--out", str(out), "--tolerance", "30mm", "--task", str(path)]
    line += ["--visits", str(visits)]
    assert main([*line, "--payload", "0", "--payload", "1"]) == 0
    printed = capsys.readouterr().out
    content = json.loads((out / "trust.json").read_text())
    assert content["format"] == "trust/1"
    assert [one["where"] for one in content["iso9283"]] == ["pose P1", "pose P2"]
    assert "AP_p predicted [mm]" in printed
    assert all(sentence in printed for sentence in content["in_words"])
    assert content["tasks"][0]["lower"] <= content["tasks"][0]["probability"] <= content["tasks"][0]["upper"]
    with np.load(out / "map.npz") as chart:
        assert chart["expected_m"].shape == (4, content["poses"], 3)
        assert chart["within_95_m"].max() >= content["within_95_m"]["largest"]
    page = (out / "report.html").read_text()
    assert page.count("<svg") == 4
    assert main(line) == 2
    assert "never overwritten" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--tolerance", "0.5"], "expected a number with one of the units"),
        (["--tolerance=-1mm"], "expected a length above 0"),
        (["--task", "path.csv"], "give the --tolerance"),
        (["--visits", "none.csv"], "none.csv"),
        (["--payload", "-1"], "expected a mass not below 0"),
        (["--arm", "nobody"], "nobody"),
    ],
)
def test_wrong_input_writes_nothing(
    options: list[str], said: str, points: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["trust", "--points", str(points), "--out", str(tmp_path / "out"), *options]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()

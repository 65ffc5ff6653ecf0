"""`armwright trust --design`: what it writes, that it goes on where it was stopped, and what it refuses."""

import contextlib
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from console.main import main
from control.model.description import load_arm, save_arm
from control.model.tolerances import ArmTolerances, JointTolerances, Spread

TOLERANCES = "[joint.2]\nbacklash_rad = { from = 1e-3, to = 2e-3 }\nencoder_zero_rad = { sd = 2e-3 }\n"


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    file = tmp_path_factory.mktemp("tolerances") / "t.toml"
    file.write_text(TOLERANCES)
    study = ["trust", "--design", "right", "--tolerances", str(file), "--arms", "30"]
    return [*study, "--workers", "1", "--tolerance", "2mm"]


@pytest.fixture(scope="module")
def whole(line: list[str], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A study that ran to its end, and what it printed."""
    out, printed = tmp_path_factory.mktemp("whole") / "out", io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main([*line, "--out", str(out)]) == 0
    return out, printed.getvalue()


def test_the_report_and_its_words(line: list[str], whole: tuple[Path, str], capsys: pytest.CaptureFixture[str]) -> None:
    out, printed = whole
    assert sorted(file.name for file in out.iterdir()) == ["map.npz", "report.html", "tolerances.json"]
    content = json.loads((out / "tolerances.json").read_text())
    assert (content["format"], content["arms"]) == ("tolerances/1", 30)
    assert all(sentence in printed for sentence in content["in_words"])
    assert [one["stage"] for one in content["stages"]] == ["as built", "calibrated", "corrected"]
    assert {cost["name"] for cost in content["stages"][0]["costs"]} == {
        "joint 2: encoder zero",
        "joint 2: backlash",
        "encoder steps",
        "measuring noise",
    }
    for stage in content["stages"]:
        assert stage["kept_m"]["5 %"]["value"] <= stage["kept_m"]["95 %"]["value"]
        assert 0.0 <= stage["share_within_tolerance"]["lower"] <= stage["share_within_tolerance"]["upper"] <= 1.0
    with np.load(out / "map.npz") as chart:
        assert chart["within_95_m"].shape == (3, len(chart["tip_m"]))
        assert chart["kept_m"].shape == (3, 30)
    assert (out / "report.html").read_text().count("<svg") == 3
    assert main([*line, "--out", str(out)]) == 2
    assert "never overwritten" in capsys.readouterr().err


@pytest.mark.usefixtures("unrendered")
def test_a_study_that_was_stopped_is_finished_and_another_one_refused(
    line: list[str], whole: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    (out / "unfinished").mkdir(parents=True)
    (out / "unfinished" / "study.json").write_text('{"key": "of another"}')
    assert main([*line, "--out", str(out)]) == 2
    assert "another study" in capsys.readouterr().err
    (out / "unfinished" / "study.json").unlink()
    assert main([*line, "--out", str(out)]) == 0
    assert not (out / "unfinished").exists()
    for name in ("map.npz", "tolerances.json"):
        assert (out / name).read_bytes() == (whole[0] / name).read_bytes()


def test_without_a_file_the_tolerances_of_the_arm_count(
    line: list[str], whole: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    loose = JointTolerances(encoder_zero_rad=Spread(sd=2e-3), backlash_rad=Spread(lowest=1e-3, highest=2e-3))
    right = load_arm("right")
    designed = tuple((link.d_m, link.theta_rad, link.L_m, link.alpha_rad) for link in right.links)
    calibrated = right.with_dh(right.dh + 1e-3)  # what was built since is not what is studied
    own = replace(calibrated, tolerances=ArmTolerances(joint={"2": loose}, about=designed))
    save_arm(own, tmp_path / "mine.toml")
    study = ["trust", "--design", str(tmp_path / "mine.toml"), *line[line.index("--arms") :], "--out", str(tmp_path / "out")]
    assert main(study) == 0
    figures, of_file = (json.loads((out / "tolerances.json").read_text()) for out in (tmp_path / "out", whole[0]))
    assert list(figures["inputs"]) == ["mine.toml"]
    assert figures["stages"] == of_file["stages"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--design", "right"], "--design: give --tolerances"),
        (["--design", "so101"], "noise_m is missing: expected"),
        (["--tolerances", "right"], "--points: give points.csv of the real arm; or --design"),
        (["--points", "p.csv", "--arms", "100"], "--arms: belongs to --design"),
        (["--design", "right", "--tolerances", "none.toml"], "none.toml: cannot be read"),
        (["--design", "nobody", "--tolerances", "right"], "nobody"),
        (["--design", "right", "--tolerances", "right", "--arms", "3"], "--arms: expected 20 to"),
        (["--design", "right", "--tolerances", "right", "--seed", "-1"], "--seed: expected 0 or more"),
        (["--design", "right", "--tolerances", "right", "--task", "p.csv"], "--task: needs --points"),
        (["--design", "right", "--tolerances", "right", "--tolerance", "1"], "one of the units"),
        (["--design", "right", "--tolerances", "right", "--workers", "0"], "--workers: expected 1 or more"),
        (["--design", "right", "--tolerances", "right", "--payload", "1", "--payload", "2"], "one mass"),
        (["--design", "right", "--tolerances", "right", "--payload=-1"], "expected a mass not below 0"),
    ],
)
def test_wrong_input_writes_nothing(options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trust", "--out", str(tmp_path / "out"), *options]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()

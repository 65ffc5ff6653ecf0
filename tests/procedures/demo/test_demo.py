"""The whole job of `armwright demo` on the stepped bench, with a smaller table: what was hidden is found and corrected."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks.arms import TWO
from calib.arrays import norms
from console.commands import demo as demo_command
from console.main import main
from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Table
from control.model.description import load_arm
from procedures.demo import gap
from procedures.demo.job import JobOutcome, run
from procedures.survey import Programme, places, ways
from tests.places import RIGHT_TOML, ROOT

DEMO = ROOT / "hil_mocks" / "scenarios" / "demo.toml"


@pytest.fixture(scope="module")
def quick_hand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's scenario with a hand that is quick at the table."""
    path = tmp_path_factory.mktemp("scenario") / "quick.toml"
    text = DEMO.read_text("utf-8")
    assert "[hand]" in text
    path.write_text(text.replace("[hand]", "[hand]\nspeed_m_s = 0.7"), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The reference arm with 5 of its 33 cavities."""
    path = tmp_path_factory.mktemp("arm") / "arm.toml"
    text = RIGHT_TOML.read_text("utf-8").replace("circle_points = 24", "circle_points = 3")
    path.write_text(text.replace("line_points = 9", "line_points = 2"), encoding="utf-8")
    return path


def is_self_contained(html: str) -> bool:
    """Whether nothing is loaded from elsewhere: all that is referred to is in the page itself."""
    loaded = re.findall(r"""\b(?:src|href|data|action)\s*=\s*["']([^"']*)""", html)
    loaded += re.findall(r"""url\(["']?([^)]*)\)""", html)
    return all(reference.startswith(("data:", "#")) for reference in loaded)


def small_programme(table: Table, has_paths: bool) -> Programme:
    """Three points above each of two tilts, and the paths faster."""
    chosen = places(table, ("normal", "roll"))[::2]
    return Programme(chosen, ways(table, ("normal",)) if has_paths else (), path_speed_m_s=0.4)


@pytest.fixture
def outcomes(monkeypatch: pytest.MonkeyPatch, nobody_below: None) -> list[JobOutcome]:
    """What demos come to; each measures two tilts, and tunes."""
    seen: list[JobOutcome] = []

    def kept(*arguments: object) -> JobOutcome:
        seen.append(run(*arguments))  # type: ignore[arg-type]  # as the command calls it
        return seen[-1]

    monkeypatch.setattr(demo_command.job, "run", kept)
    monkeypatch.setattr(demo_command.job, "SETUPS", ("normal", "roll"))
    return seen


def is_corrected(outcome: JobOutcome) -> bool:
    before_m = float(norms(outcome.verification.before_m).mean())
    after_m = float(norms(outcome.verification.after_m).mean())
    return before_m > 5e-3 and after_m < min(0.6e-3, 0.1 * before_m)


@pytest.mark.parametrize(("seed", "is_drawn"), [(1, True), pytest.param(12, False, marks=pytest.mark.nightly)])
def test_what_is_hidden_is_found_and_corrected(
    arm_file: Path,
    quick_hand: Path,
    tmp_path: Path,
    seed: int,
    is_drawn: bool,
    monkeypatch: pytest.MonkeyPatch,
    outcomes: list[JobOutcome],
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(demo_command.job, "programme_of", lambda table: small_programme(table, is_drawn))
    scenario = [] if is_drawn else ["--scenario", str(quick_hand)]
    if not is_drawn:  # paths and pictures take seconds, and the first seed has had them
        monkeypatch.setattr(demo_command.job, "write_report", lambda path, shown: path.write_text("", "utf-8"))
    out = tmp_path / "demo"
    assert main(["demo", "--arm", str(arm_file), "--seed", str(seed), "--out", str(out), *scenario]) == 0
    assert str(out / "report.html") in capsys.readouterr().out
    assert is_corrected(outcomes[0])
    assert_results_are_complete(out, load_arm(arm_file))
    html = (out / "report.html").read_text("utf-8")
    if is_drawn:
        assert is_self_contained(html)
        assert "<svg" in html or "data:image" in html


def assert_results_are_complete(out: Path, nominal: Arm) -> None:
    """Every file is there; the calibrated arm says where it is from and puts its tip elsewhere; ten points of two tilts."""
    assert {path.name for path in out.iterdir()} >= {
        "points.csv",
        "arm_calibrated.toml",
        "calibration.json",
        "report.html",
        "scenario.toml",
        "verification.txt",
    }
    calibrated = load_arm(out / "arm_calibrated.toml")
    assert calibrated.calibration is not None
    assert calibrated.calibration.source
    tip_m, nominal_tip_m = (ForwardKinematics(arm).tips([[0.0, -0.5, 0.3]]) for arm in (calibrated, nominal))
    assert 1e-3 < float(norms(tip_m - nominal_tip_m)[0]) < 0.1
    with (out / "points.csv").open(newline="") as file:
        points = list(csv.DictReader(file))
    assert len(points) == 10
    assert {row["setup"] for row in points} == {"normal", "roll"}


def test_results_are_never_overwritten(tmp_path: Path) -> None:
    wanted = tmp_path / "demo"
    assert demo_command.free_folder(wanted) == wanted
    wanted.mkdir()
    assert demo_command.free_folder(wanted) == wanted  # empty: as good as not there
    wanted.mkdir()
    (wanted / "report.html").write_text("first")
    assert demo_command.free_folder(wanted) == tmp_path / "demo-2"
    (tmp_path / "demo-2").write_text("a file is in the way")
    assert demo_command.free_folder(wanted) == tmp_path / "demo-3"
    assert (wanted / "report.html").read_text() == "first"
    with pytest.raises(ArmError, match="expected a folder, new or old, got a file"):
        demo_command.free_folder(wanted / "report.html")


@pytest.mark.parametrize(
    ("html", "is_so"),
    [
        ('<svg xmlns="http://www.w3.org/2000/svg"><use href="#a"/></svg><img src="data:image/png;base64,AA">', True),
        ('<script src="https://cdn.example/x.js"></script>', False),
        ('<link href="//cdn.example/x.css">', False),
        ("<style>@font-face{src:url(https://x/y.woff)}</style>", False),
        ('<img src="picture.png">', False),
    ],
)
def test_the_check_for_self_contained_pages_sees_what_is_loaded(html: str, is_so: bool) -> None:
    assert is_self_contained(html) is is_so


def test_a_seed_is_kept_with_the_results() -> None:
    import tomllib

    scenario = tomllib.loads(demo_command.seeded_scenario("demo", 77, was_homed=False).decode())
    assert scenario["seed"] == 77
    assert scenario["true_dh"]["theta_rad"] > 0.0


def test_an_arm_that_cannot_run_paths_is_refused_before_anything_is_recorded(tmp_path: Path) -> None:
    nothing: Any = None  # neither bench nor mock is looked at
    with pytest.raises(ArmError, match=r"circle above the board's setup normal: .*out of reach"):
        gap.run(TWO, nothing, nothing, tmp_path, nothing)
    assert not list(tmp_path.iterdir())

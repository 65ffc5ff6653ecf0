"""`armwright iso9283` on a stepped mock arm whose hidden geometry is known, and its command line."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.arms import FOUR, SIX, TWO
from calib.errors import CalibrationError
from calib.iso9283 import pose_criteria
from calib.iso9283.programme import Extent, PathRun, TestCube
from calib.points.points import read_points
from console.main import main
from control.hardware.measurement import Average
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.description import load_arm, save_arm
from procedures.iso9283 import HOW, plan, rated_speed_m_s, record
from procedures.mock import SteppedBench
from procedures.tour import Bench
from tests.places import ROOT

pytestmark = pytest.mark.usefixtures("nobody_below")

DEMO = ROOT / "hil_mocks" / "scenarios" / "demo.toml"
CUBE = TestCube((0.40, 0.0, 0.30), 0.2)
EXTENT = Extent(repeats=2, path_cycles=2, speed_shares=(1.0,), programmes=("pose", "path"))
RATED_m_s = 0.4
CAMERA_m = 0.00014  # noise of one frame, per axis
FRAMES = 100 * HOW.settings.average_s


@dataclass
class Recorded:
    """A recording that was interrupted and gone on with, and the true tip at each visit."""

    out: Path
    true_m: np.ndarray
    visits_before: int


Criterion = dict[str, Any]


class Interrupted(Exception):
    """Somebody ends the program."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Recorded]:
    """Two visits of each pose and two runs of each path, interrupted after the seventh step."""
    arm, out = load_arm("right"), tmp_path_factory.mktemp("iso9283") / "recorded"
    # the shipped demo arm, but homed already and at rest near the cube
    text = DEMO.read_text("utf-8") + "\n[start]\nhomed = true\nq_rad = [0.0, -0.2, -0.3]\n"
    scenario = out.parent / "scenario.toml"
    scenario.write_text(text, "utf-8")
    planned = plan(arm, CUBE, EXTENT, RATED_m_s)
    bench = SteppedBench(arm, scenario, out.parent / "log")
    try:
        client = bench.start(arm)
        client.enable()
        true: list[tuple[float, float, float]] = []
        average = client.average

        def watched(duration_s: float) -> Average:
            result = average(duration_s)
            true.append(bench.rig.tip_m())
            return result

        client.average = watched  # type: ignore[method-assign]
        mine = Bench(client, next((out.parent / "log").glob("*.armlog")), None)
        done = 0

        def advance(what: str, share: float) -> None:
            nonlocal done
            done += 1
            if done == 8:
                raise Interrupted

        with pytest.raises(Interrupted):
            record(arm, mine, planned, out, advance)
        before = len(true)
        record(arm, mine, planned, out, lambda what, share: None)
        bench.stop()
        yield Recorded(out, np.array(true), before)
    finally:
        bench.close()


def evaluated(recorded: Recorded, *more: str) -> dict[str, Criterion]:
    """Criteria by name, by the command line."""
    out = recorded.out.parent / "evaluated"
    arguments = ["--points", str(recorded.out / "points.csv"), "--log", str(recorded.out / "log.csv"), "--out", str(out)]
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["iso9283", *arguments, *more, "--json"]) == 0
    document = json.loads((out / "iso9283.json").read_text("utf-8"))
    assert json.loads(printed.getvalue()) == document
    assert (out / "iso9283.html").stat().st_size > 10_000
    return {criterion["name"]: criterion for criterion in document["criteria"]}


@pytest.fixture(scope="module")
def criteria(recorded: Recorded) -> dict[str, Criterion]:
    """Of the recording, evaluated once."""
    return evaluated(recorded)


def test_an_interrupted_recording_goes_on_and_holds_every_visit_once(recorded: Recorded) -> None:
    points, _ = read_points(recorded.out / "points.csv")
    assert recorded.visits_before == 7
    assert len(points) == len(recorded.true_m) == 10
    names = list(zip(points.setup, points.point, points.repeat, strict=True))
    assert len(set(names)) == 10


def test_accuracy_and_repeatability_are_those_of_the_true_tip_within_the_cameras_noise(
    recorded: Recorded, criteria: dict[str, Criterion]
) -> None:
    points, _ = read_points(recorded.out / "points.csv")
    noise_m = CAMERA_m / np.sqrt(FRAMES)  # of one visit, per axis: 0.03 mm
    figures = criteria["Pose accuracy and pose repeatability"]["figures"]
    for name, commanded in CUBE.poses().items():
        rows = [k for k, other in enumerate(points.point) if other == name]
        said = {f["symbol"]: f["value"] for f in figures if f["where"] == name}
        true = pose_criteria.pose_accuracy(commanded, recorded.true_m[rows]).total_m
        assert true > 5e-3  # the hidden geometry error
        assert said["AP_p"] == pytest.approx(true, abs=4 * noise_m / np.sqrt(2))
        # Two visits are equally far from their mean: RP is half their distance, of play (0.6 mrad at 0.5 m) and noise.
        assert 0.05 * noise_m < said["RP_l"] < 0.6e-3 * 0.5 + 6 * noise_m


def test_paths_are_as_far_off_as_the_geometry_and_repeat_within_the_noise(criteria: dict[str, Criterion]) -> None:
    path = {f["symbol"]: f["value"] for f in criteria["Path accuracy and path repeatability"]["figures"]}
    assert 5e-3 < path["AT_p"] < 40e-3
    assert path["RT_p"] < 8 * CAMERA_m  # single frames: the largest l + 3 S of 100 points, two cycles
    speed = {f["symbol"]: f["value"] for f in criteria["Path velocity characteristics"]["figures"]}
    assert abs(speed["AV"]) < 3.0  # %: links 4 mm longer or shorter than believed
    settled = criteria["Position stabilization time"]["values"]
    assert set(settled) == {"t", "t (encoders)"}


def test_what_the_recording_did_not_hold_is_said(criteria: dict[str, Criterion]) -> None:
    for name in ("Exchangeability", "Static compliance", "Weaving deviations", "Drift of pose characteristics"):
        assert not criteria[name]["figures"]
        assert criteria[name]["needs"]


def test_a_band_that_is_given_is_used(recorded: Recorded, capsys: pytest.CaptureFixture[str]) -> None:
    figures = evaluated(recorded, "--band-m", "0.005")["Position overshoot"]["figures"]
    assert all("5.000 mm (the given limit band)" in figure["remark"] for figure in figures)
    assert capsys.readouterr().err == ""  # our own columns are no surprise


def test_a_folder_with_the_records_of_another_programme_is_left_alone(recorded: Recorded) -> None:
    arm = load_arm("right")
    planned = plan(arm, TestCube(CUBE.centre_m, 0.18), EXTENT, RATED_m_s)
    before = (recorded.out / "points.csv").read_bytes()
    with pytest.raises(CalibrationError, match="another plan or arm"):
        record(arm, Bench(None, Path("none"), None), planned, recorded.out, lambda what, share: None)  # type: ignore[arg-type]
    assert (recorded.out / "points.csv").read_bytes() == before


def test_the_rated_speed_is_one_that_the_planner_need_not_slow() -> None:
    arm = load_arm("right")
    rated = rated_speed_m_s(arm, CUBE)
    assert 0.2 < rated <= arm.limits.tip_speed_m_s
    path = plan(arm, CUBE, Extent(speed_shares=(1.0,), programmes=("path",)), rated).paths
    line = next(by_speed for points, by_speed in path.items() if len(points) == 4)
    assert not line[rated].slowdowns


def test_the_plan_is_said_and_nothing_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["iso9283", "--mock", "--plan-only", "--programmes", "pose", "--out", str(tmp_path / "d")]) == 0
    assert "everything is within reach" in capsys.readouterr().out
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "expected one of --points FILE, --record and --mock, got none"),
        (["--mock", "--record"], "got --record and --mock"),
        (["--mock", "--repeats", "1"], "at least 2 repeats"),
        (["--mock", "--programmes", "poses"], "expected some of pose, directions"),
        (["--mock", "--cube-edge", "0.2"], "give both --cube-centre X Y Z and --cube-edge"),
        (["--mock", "--cube-edge", "0.2", "--cube-centre", "2", "0", "1"], "out of reach"),
        (["--mock", "--rated-speed=-1"], "--rated-speed: expected a rated path speed in m/s above 0 and up to 1, got -1"),
        (["--mock", "--speed", "2"], "--speed: expected a fraction"),
        (["--mock", "--rated-load-kg", "5"], "--rated-load-kg: expected at most 2.3"),
        (["--points", "absent.csv"], "absent.csv: cannot be read"),
        (["--points", "p.armlog"], "p.armlog: a recording, expected points.csv"),
        (["--record", "--socket", "/nonexistent.sock"], "no runtime answers"),
    ],
)
def test_wrong_input_is_one_message_and_nothing_moves(
    arguments: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "d"
    assert main(["iso9283", *arguments, "--out", str(out)]) == 2
    assert says in capsys.readouterr().err
    assert not out.exists()


def test_an_arm_that_reaches_only_a_surface_is_refused_before_anything_is_planned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, arm = tmp_path / "out", tmp_path / "two.toml"
    save_arm(TWO, arm)
    assert main(["iso9283", "--arm", str(arm), "--mock", "--out", str(out)]) == 2
    assert "its tip moves on a surface" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize("arm", [FOUR, SIX], ids=lambda arm: arm.name)
def test_paths_corners_and_weaving_are_planned_for_more_than_three_joints(arm: Arm) -> None:
    x, y, z = ForwardKinematics(arm).tip(*arm.rest.q_rad) if arm.rest else (0.0, 0.0, 0.0)
    cube = TestCube((x, y, z), 0.06)
    programmes = ("pose", "path", "cornering", "weaving")
    planned = plan(arm, cube, Extent(repeats=2, path_cycles=2, speed_shares=(1.0,), programmes=programmes), 0.1)
    names = {step.programme for step in planned.steps if isinstance(step, PathRun)}
    assert len(names) >= 3
    assert len(planned.paths) >= 3

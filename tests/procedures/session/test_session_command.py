"""`armwright session` as an operator runs it: on the stepped mock by script, interrupted and resumed, and with wrong input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from calib.arm_problem.assembly import problem_of
from calib.identify.identification import identify
from calib.points.points import read_points
from console.main import main
from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm
from hil_mocks.scenario import load_scenario
from tests.places import RIGHT_TOML

# The demo's arm, homed already and with a quick hand: the same records in a third of the time.
SCENARIO = """
name = "quick"
seed = 12
[start]
homed = true
[plant]
timestep_s = 0.001
[true_dh]
d_m = 0.004
theta_rad = 0.026
L_m = 0.004
alpha_rad = 0.026
[[effect]]
effect = "backlash"
joint = 1
parameters = { width_rad = 0.0006 }
[hand]
speed_m_s = 0.7
seating_noise_m = 0.00005
"""


@pytest.fixture
def files(tmp_path: Path, nobody_below: None) -> Path:
    """A folder with the reference arm with six of its cavities, the scenario, and the operator's scripts."""
    text = RIGHT_TOML.read_text("utf-8").replace("circle_points = 24", "circle_points = 4")
    (tmp_path / "arm.toml").write_text(text.replace("line_points = 9", "line_points = 2"), encoding="utf-8")
    (tmp_path / "quick.toml").write_text(SCENARIO, encoding="utf-8")
    return tmp_path


def session(files: Path, script: str, *options: str) -> int:
    """One run of the command with the answers of a script."""
    (files / "script.txt").write_text(script, encoding="utf-8")
    given = ["--arm", str(files / "arm.toml"), "--out", str(files / "s"), "--replay", str(files / "script.txt")]
    return main(["session", *given, *options])


WANTED = ("--setups", "normal,roll", "--points", "1,3", "--free", "2", "--camera", "--mock")


def test_a_session_by_script_is_interrupted_resumed_and_calibrates(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also with --approaches 2; redo, skip, bad and a note on the way; the end is a calibration that is right."""
    first = "# set up\nauto 3\nredo\nnote seated twice\nboard\nskip roll 1 2\n\nauto 1\nbad\nquit\n"
    options = (*WANTED, "--approaches", "2", "--payload", "0.2", "--scenario", str(files / "quick.toml"))
    assert session(files, first, *options) == 0
    said = capsys.readouterr().out
    assert "begun: 10 points, 0 recorded" in said
    assert "  < redo\nredo: normal 3\n" in said
    assert said.count("O") >= 1
    assert said.count(" min left") == said.count(" recorded; model error") - 2, "from the third record on"
    assert "the same command continues" in said

    assert session(files, "status\nauto\n", "--mock") == 0
    said = capsys.readouterr().out
    assert "resumed: 10 points, " in said
    assert "skipped: 1 (repeat 2))" in said
    assert said.rstrip().endswith(f"8 points recorded, 0 left: {files / 's' / 'points.csv'}")

    arm = load_arm(files / "arm.toml")
    points, warnings = read_points(files / "s" / "points.csv", 3)
    assert warnings == ()
    assert points.setup.count("free") == 2
    assert sorted(set(points.repeat)) == [1, 2]
    assert (points.payload_kg == 0.2).all()
    assert (np.diff(np.sort(points.t_s)) > 0.5).all(), "times go on where the session was resumed"
    events = [json.loads(line)["event"] for line in (files / "s" / "journal.jsonl").read_text().splitlines()]
    assert [events.count(name) for name in ("redo", "skip", "bad", "note", "resumed")] == [1, 1, 1, 1, 1]

    identification = identify(problem_of(arm, points))
    true_dh = np.array(arm.dh)
    for name, deviation in load_scenario(files / "quick.toml").drawn_deviations(4).items():
        link, key = name[4:].split("_")[:2]
        true_dh[int(link) - 1, ["d", "theta", "L", "alpha"].index(key)] += deviation
    q_rad = np.random.default_rng(1).uniform([-0.3, -1.2, -0.1], [0.3, -0.8, 0.4], (50, 3))  # over the board
    true, calibrated = (ForwardKinematics(arm.with_dh(dh)).tips(q_rad) for dh in (true_dh, identification.dh))
    off_m = np.linalg.norm(calibrated - true, axis=1)
    before_m = np.linalg.norm(ForwardKinematics(arm).tips(q_rad) - true, axis=1)
    assert before_m.mean() > 15e-3
    assert off_m.mean() < 0.05 * before_m.mean()


@pytest.mark.nightly
def test_a_board_that_the_camera_measures_is_found_where_it_was_hidden(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--setups", "normal", "--points", "1-6", "--board", "measured", "--camera", "--mock")
    assert session(files, "auto\n", *options, "--scenario", str(files / "quick.toml")) == 0
    said = capsys.readouterr().out
    assert "pose from 5 cavities" in said
    assert said.count("hold the arm by hand") == 5
    entry = json.loads((files / "s" / "boards.json").read_text())["boards"]["normal"]
    assert len(entry["residual_m"]) == 6
    shift_m = np.subtract(entry["origin_m"], (0.5, 0.0, 0.0))
    assert 2e-3 < np.linalg.norm(shift_m) < 0.04, "it does not stand where the file says"
    given = ["--arm", str(files / "arm.toml"), "--markers", str(files / "s" / "markers.csv"), "--out", str(files / "r")]
    capsys.readouterr()
    assert main(["register", *given, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((files / "r" / "boards.json").read_text())
    again = printed["boards"]["normal"]
    np.testing.assert_allclose(again["origin_m"], entry["origin_m"], atol=1e-7)


def refused(files: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    """The one message of a session that is refused."""
    capsys.readouterr()
    assert session(files, "", *options) == 2
    error = capsys.readouterr().err
    assert error.count("armwright: ") == 1
    assert "Traceback" not in error
    return error


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--points", "1,9"), "the table has no cavity 9; it has 1, 2"),
        (("--points", "4-1"), "expected an ascending range, got 4-1"),
        (("--setups", "tilted"), 'expected one of normal, roll, pitch, roll-, pitch-, roll+pitch, got "tilted"'),
        (("--setups", ""), "the session has no points"),
        (("--repeats", "0"), "--repeats: expected 1 to 100, got 0"),
        (("--payload", "-1"), "expected 0 to 100 kg"),
        (("--free", "3"), "add --camera"),
        (("--free", "0", "--camera"), "expected 1 to 500 poses"),
        (("--free", "absent.csv", "--camera"), "absent.csv: cannot be read"),
        (("--board", "measured"), "needs --camera"),
        (("--seat", "jog", "--board", "unknown"), "guide the tip by hand"),
        (("--plan", "absent.csv"), "absent.csv: cannot be read"),
        (("--plan", "x.csv", "--points", "1"), "omit --points"),
        (("--mock", "--scenario", "nonsense"), "scenario nonsense"),
        (("--socket", "/nowhere/s"), "no runtime answers at /nowhere/s"),
    ],
)
def test_wrong_input_is_one_message(files: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], said: str) -> None:
    assert said in refused(files, capsys, *options)
    assert not (files / "s").exists(), "nothing is left behind"


def test_a_session_is_not_resumed_with_another_arm_plan_or_kind_of_arm(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = ("--points", "1,2", "--setups", "normal")
    assert session(files, "quit\n", *wanted, "--mock", "--scenario", str(files / "quick.toml")) == 0
    assert "normal 3 is new" in refused(files, capsys, "--points", "1-3", "--setups", "normal", "--mock")
    assert "started with another scenario" in refused(files, capsys, "--mock", "--scenario", "ideal")
    assert "this session belongs to a mock arm: add --mock" in refused(files, capsys)
    text = (files / "arm.toml").read_text("utf-8")
    (files / "arm.toml").write_text("# only a remark\n" + text, encoding="utf-8")
    assert session(files, "quit\n", "--mock") == 0
    (files / "arm.toml").write_text(text.replace("L_m = 0.4", "L_m = 0.401"), encoding="utf-8")
    assert "started with arm 'right' and another version of its file" in refused(files, capsys, "--mock")
    assert "this session began with arm 'right'" in refused(files, capsys, *wanted, "--mock")


def test_a_plan_file_says_which_cavities_and_free_poses(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = files / "plan.csv"
    plan.write_text("setup,point,repeat,q1_rad,q2_rad,q3_rad\nroll-,2,1,,,\nfree,a,1,0.1,-0.5,0.4\nroll-,5,2,0.05,-1.1,0.2\n")
    assert session(files, "quit\n", "--plan", str(plan), "--camera", "--mock", "--scenario", str(files / "quick.toml")) == 0
    targets = json.loads((files / "s" / "session.json").read_text())["targets"]
    assert [(t["setup"], t["point"], t["repeat"], t.get("q_rad")) for t in targets] == [
        ("roll-", "2", 1, None),
        ("free", "a", 1, [0.1, -0.5, 0.4]),
        ("roll-", "5", 2, [0.05, -1.1, 0.2]),
    ]
    plan.write_text("setup,point\nfree,a\n")
    assert "line 2: a free pose needs q1_rad to q3_rad" in refused(files, capsys, "--plan", str(plan), "--camera")
    plan.write_text("setup,point,q1_rad,q2_rad,q3_rad\nfree,a,9,0,0\n")
    assert "line 2: joint 1 at 9 rad is outside its range" in refused(files, capsys, "--plan", str(plan), "--camera")


def test_a_session_of_pictures_names_each_and_records_angles_alone_and_is_resumed(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--free", "3", "--pictures", "--mock", "--scenario", str(files / "quick.toml"))
    assert session(files, "\nskip\n\n\nquit\n", *options) == 0
    said = capsys.readouterr().out
    assert "take the picture free_f1_1.png; Enter records the angles" in said
    assert "free f2 recorded\n" in said
    assert session(files, "auto\n", "--mock") == 0
    points, _ = read_points(files / "s" / "points.csv", 3)
    assert points.point == ("f2", "f3")
    assert np.isnan(points.tip_m).all()
    assert session(files, "", "--free", "3", "--camera", "--mock") == 2
    assert "began with camera False, got True" in capsys.readouterr().err
    with_cavities = ("--points", "1", "--free", "1", "--pictures", "--mock", "--out", str(files / "t"))
    assert main(["session", "--arm", str(files / "arm.toml"), *with_cavities]) == 2
    assert "--pictures is of free poses alone" in capsys.readouterr().err

"""`armwright verify`: on recorded points, on the stepped mock, and the pieces that drive one arm by two models."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.points.points import make_points, read_points
from calib.points.writer import write_points
from console.commands.calibration import verify as verify_command
from console.main import main
from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model import table as tables
from control.model.arm import Arm, Calibration, Effect, Link, Tool
from control.model.description import load_arm, save_arm
from control.model.fingerprint import fingerprint
from control.recording.record import FileSink, Layout
from procedures import survey as verify_places
from procedures import verify
from procedures.survey import (
    MOVING,
    Model,
    ModelPair,
    SurveyedPath,
    active_model,
    nominal_of,
    places,
    planned,
    planned_tips_m,
    poses_at,
    recorded,
    track_of,
    wait_until_recorded,
    ways,
)
from procedures.survey import run as run_way
from tests.places import ARMS

RIGHT = load_arm("right")
TABLE = tables.table_of(RIGHT)
NEAR = (0.0, 0.15, 0.75)
# What is off about the arm: 10 to 20 mm at the tip. The calibrated arm knows it exactly, the scenario hides it exactly.
HIDDEN = {"link1_d_m": 0.003, "link2_theta_rad": 0.02, "link3_theta_rad": -0.015, "link4_d_m": -0.002}
COLUMNS = ("d_m", "theta_rad", "L_m", "alpha_rad")


def true_arm() -> Arm:
    dh = RIGHT.dh.copy()
    for name, value in HIDDEN.items():
        link, column = re.fullmatch(r"link(\d)_(.*)", name).groups()  # type: ignore[union-attr]
        dh[int(link) - 1, COLUMNS.index(column)] += value
    return RIGHT.with_dh(dh)


TRUE = true_arm()
PAIR = ModelPair(Model(RIGHT), Model(TRUE))


@pytest.fixture
def calibrated(tmp_path: Path) -> Path:
    """The true arm as calibration would leave it."""
    path = tmp_path / "calibrated.toml"
    made = Calibration("right.toml", {"table.csv": "ab" * 32}, "2026-01-01", "E2", "0.1.0")
    save_arm(replace(TRUE, calibration=made), path)
    return path


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    """40 poses with tips as a camera would see them, two looks at each."""
    rng = np.random.default_rng(6)
    q = np.repeat(rng.uniform([-0.5, -1.0, -0.5], [0.5, -0.3, 0.5], (40, 3)), 2, axis=0)
    tips = ForwardKinematics(TRUE).tips(q) + rng.normal(0.0, 0.00014, (80, 3))
    names = [str(k // 2) for k in range(80)]
    path = tmp_path / "seen.csv"
    write_points(path, make_points(["free"] * 80, names, [1, 2] * 40, q, tips))
    return path


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures take seconds, and another test has them."""
    monkeypatch.setattr(verify, "write_verification_report", lambda path, shown: path.write_text("", "utf-8"))


def test_recorded_points_show_that_the_calibrated_arm_is_better(
    calibrated: Path, measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["verify", "--arm", str(calibrated), "--points", str(measured), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "The calibrated arm is better by" in said
    assert "note: missing beside the calibrated arm, or changed: table.csv" in said
    content = json.loads((out / "verify.json").read_text("utf-8"))
    assert content["driven"] is False
    assert len(content["points"]) == 40
    assert content["points"][0]["after"]["half_width_m"] is not None
    assert content["by_setup"]["free"]["after"]["mean_m"] < 0.0004
    assert content["by_setup"]["free"]["before"]["mean_m"] > 0.005
    assert set(content["inputs"]) == {"right.toml", "calibrated.toml", "seen.csv"}
    assert "<svg" in (out / "report.html").read_text("utf-8")
    assert not (out / "points.csv").exists()


@pytest.mark.usefixtures("undrawn")
def test_another_program_gets_the_figures_and_nothing_else(
    calibrated: Path, measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    given = ["--arm", str(calibrated), "--points", str(measured), "--out", str(out), "--json"]
    assert main(["verify", *given]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((out / "verify.json").read_text("utf-8"))


@pytest.mark.usefixtures("undrawn")
def test_an_effect_that_was_not_used_is_named_once_with_its_joints(
    calibrated: Path, measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    friction = tuple(
        Effect(f"{kind}_friction", joint, {parameter: 0.1})
        for joint in (1, 2, 3)
        for kind, parameter in (("coulomb", "torque_Nm"), ("viscous", "coefficient_Nm_s_rad"))
    )
    rubbing = tmp_path / "rubbing.toml"
    save_arm(replace(load_arm(calibrated), effects=friction), rubbing)
    given = ["--against", "right", "--points", str(measured), "--out", str(tmp_path / "out")]
    assert main(["verify", "--arm", str(rubbing), *given]) == 0
    assert "not used here: coulomb_friction of 1, 2, 3; viscous_friction of 1, 2, 3\n" in capsys.readouterr().out


@pytest.mark.usefixtures("undrawn")
def test_the_frame_of_the_tips_is_placed_or_taken_for_the_bases_as_calibrate_is_told(
    calibrated: Path, measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points, _ = read_points(measured, 3)
    write_points(tmp_path / "moved.csv", replace(points, tip_m=points.tip_m + np.array((0.02, -0.01, 0.03))))
    bare = tmp_path / "bare.toml"
    save_arm(replace(load_arm(calibrated), table=None, calibration=None), bare)

    def mean_m(out: str, arm: Path, *more: str) -> float:
        given = ["--arm", str(arm), "--against", "right", "--points", str(tmp_path / "moved.csv"), *more]
        assert main(["verify", *given, "--out", str(tmp_path / out)]) in (0, 1)
        return float(json.loads((tmp_path / out / "verify.json").read_text())["by_setup"]["free"]["after"]["mean_m"])

    assert mean_m("told", calibrated) == pytest.approx(0.0374, abs=0.001)  # by the table, where it was
    assert mean_m("free", calibrated, "--free", "base") < 0.0004
    assert mean_m("bare", bare) < 0.0004
    assert mean_m("fixed", bare, "--fix", "base") == pytest.approx(0.0374, abs=0.001)
    capsys.readouterr()
    given = ["--arm", str(bare), "--against", "right", "--mock", "--free", "base"]
    assert main(["verify", *given, "--out", str(tmp_path / "none")]) == 2
    assert "give them with --points" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_an_arm_that_is_worse_ends_with_status_1(
    calibrated: Path, measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["verify", "--arm", "right", "--against", str(calibrated), "--points", str(measured)]
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 1
    assert "The calibrated arm is worse by" in capsys.readouterr().out


@pytest.mark.usefixtures("undrawn")
def test_a_folder_with_something_in_it_is_left_alone(
    calibrated: Path, measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "report.html").write_text("first")
    arguments = ["verify", "--arm", str(calibrated), "--points", str(measured), "--out", str(tmp_path / "out")]
    assert main(arguments) == 2
    assert "out: is not empty, and nothing is overwritten: choose another folder" in capsys.readouterr().err
    assert (tmp_path / "out" / "report.html").read_text() == "first"
    assert not (tmp_path / "out-2").exists()


def test_the_wrong_input_is_named_and_nothing_is_written(
    calibrated: Path, measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "out")
    panda = ARMS / "panda.toml"
    wrong = (
        (["--arm", "right", "--points", str(measured)], "has no [calibration]"),
        (["--arm", str(calibrated), "--points", str(tmp_path / "none.csv")], "cannot be read"),
        (["--arm", str(calibrated), "--against", str(panda), "--mock"], "7 joints, 8 links and modified DH: not the same arm"),
        (["--arm", str(calibrated), "--mock", "--repeats", "0"], "--repeats: expected 1 or more, got 0"),
        (["--arm", str(calibrated), "--mock", "--height", "0.9"], "verification point normal v1"),
        (["--arm", str(calibrated), "--mock", "--scenario", "nowhere"], "scenario nowhere"),
        (["--arm", str(calibrated), "--socket", str(tmp_path / "no.sock")], "armwright serve"),
    )
    for arguments, expected in wrong:
        assert main(["verify", *arguments, "--out", out]) == 2, arguments
        assert expected in capsys.readouterr().err
        assert not list(tmp_path.glob("out*")), arguments


@pytest.mark.usefixtures("undrawn", "nobody_below")
def test_on_the_mock_arm_both_models_are_driven_and_measured(
    calibrated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The scenario hides what the calibrated arm knows: what is left is the camera's noise, 0.14 mm per axis over 20 frames."""
    hidden = ", ".join(f"{name} = {value}" for name, value in HIDDEN.items())
    scenario = tmp_path / "hidden.toml"
    scenario.write_text(
        'name = "hidden"\n[plant]\ntimestep_s = 0.001\n[start]\nhomed = true\n'
        f'[[effect]]\neffect = "link_geometry"\nparameters = {{ {hidden} }}\n'
    )
    monkeypatch.setattr(verify_places, "POINTS", 2)
    monkeypatch.setattr(verify_command, "ways", lambda *where: ways(*where)[1:])  # the line alone: the circle takes seconds
    out = tmp_path / "out"
    arguments = ["--arm", str(calibrated), "--mock", "--scenario", str(scenario), "--setups", "roll"]
    assert main(["verify", *arguments, "--repeats", "2", "--path-speed", "0.4", "--out", str(out)]) == 0
    assert "Along trajectories: better by" in capsys.readouterr().out
    content = json.loads((out / "verify.json").read_text("utf-8"))
    assert content["driven"] is True
    assert content["by_setup"]["roll"]["before"]["mean_m"] > 0.005
    assert content["by_setup"]["roll"]["after"]["mean_m"] < 0.0003
    assert content["trajectories"]["by_setup"]["roll"]["after"]["mean_m"] < 0.0006
    points, _ = read_points(out / "points.csv", 3)
    assert points.extra["model"] == ("nominal",) * 4 + ("calibrated",) * 4
    assert points.repeat == (1, 1, 2, 2) * 2
    wanted = [float(x) for x in points.extra["wanted_x_m"]]
    assert wanted[:4] == pytest.approx(wanted[4:])
    assert abs(points.tip_m[4:, 0] - wanted[4:]).max() < 0.0005
    error_m = content["points"][0]["before"]["error_m"]
    assert error_m[0] == pytest.approx(points.tip_m[[0, 2], 0].mean() - wanted[0], abs=1e-7)


def test_no_verification_pose_is_a_cavity_of_the_board() -> None:
    for setup in tables.SETUPS:
        cavities = np.array(list(tables.cavities(TABLE, setup).values()))
        normal = np.array(tables.board_rotation(TABLE, setup))[:, 2]
        for place in places(TABLE, (setup,)):
            assert (place.tip_m - cavities[0]) @ normal == pytest.approx(0.05)
        for way in ways(TABLE, (setup,)):
            heights = (np.array(way.waypoints.points) - cavities[0]) @ normal
            np.testing.assert_allclose(heights, 0.05, atol=1e-12)
    flat = replace(TABLE, circle_points=0, line_points=1)
    with pytest.raises(ArmError, match="at least"):
        places(flat, ("normal",))


GEARED = Model(replace(TRUE, effects=(Effect("backlash", 1, {"width_rad": 0.01}),)))


class Asked:
    """A client that notes what it is asked for."""

    def __init__(self) -> None:
        self.as_encoders: list[bool] = []

    def move_joints(self, q_rad: object, speed: float, as_encoders: bool = False) -> None:
        self.as_encoders.append(as_encoders)

    def run_path(self, path: object, as_encoders: bool = False) -> None:
        self.as_encoders.append(as_encoders)

    def status(self) -> dict[str, float]:
        return {"run": 4, "override": 0.5}


def test_gears_are_corrected_by_the_runtime_for_the_model_that_knows_them_and_not_for_the_other() -> None:
    way = ways(TABLE, ("normal",))[1]
    for model, as_encoders in ((PAIR.nominal, True), (GEARED, False)):
        asked = Asked()
        path = planned(way, model, 0.15, NEAR)
        ran = run_way(path, model, GEARED, asked, 0.5)  # type: ignore[arg-type]
        assert asked.as_encoders == [as_encoders, as_encoders]
        assert (ran.number, ran.pace) == (4, 0.5)
        assert (ran.path is path) is not as_encoders


def test_where_recorded_set_points_are_encoders_the_path_says_what_was_planned(tmp_path: Path) -> None:
    path = planned(ways(TABLE, ("normal",))[1], GEARED, 0.15, NEAR)
    rows = np.zeros(50, dtype=[("t_s", "f8")])
    rows["t_s"] = 3.0 + 0.002 * np.arange(50)
    planned_m = planned_tips_m(rows, GEARED, SurveyedPath(1, path, 0.5))
    for k in (0, 20, 49):
        expected = GEARED.seen(np.array([path.spline.at(0.5 * 0.002 * (k + 1))[0]]))[0]
        assert planned_m[k] == pytest.approx(expected, abs=1e-12)


def test_points_are_reached_by_either_model_on_one_branch() -> None:
    wanted = places(TABLE, ("normal", "pitch"))
    for model in (PAIR.nominal, PAIR.calibrated):
        poses = poses_at(wanted, model, NEAR)
        np.testing.assert_allclose(
            model.tips(np.array([pose.q_rad for pose in poses])), [place.tip_m for place in wanted], atol=1e-9
        )
    both = [np.array([pose.q_rad for pose in poses_at(wanted, model, NEAR)]) for model in (PAIR.nominal, PAIR.calibrated)]
    assert abs(both[0] - both[1]).max() < 0.1


def test_a_calibrated_base_frame_and_tool_are_driven_too() -> None:
    """A camera frame that is turned and moved: points in it come out where the camera sees them."""
    frame = Effect("base_frame", None, {"x_m": 0.01, "y_m": -0.02, "z_m": 0.005, "rz_rad": 0.03})
    model = Model(replace(TRUE, effects=(frame,), tool=Tool((0.002, 0.001, 0.003))))
    wanted = places(TABLE, ("normal",))
    poses = poses_at(wanted, model, NEAR)
    seen = model.tips(np.array([pose.q_rad for pose in poses]))
    np.testing.assert_allclose(seen, [place.tip_m for place in wanted], atol=1e-9)
    c, s = np.cos(0.03), np.sin(0.03)
    in_base = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ wanted[0].tip_m + [0.01, -0.02, 0.005]
    np.testing.assert_allclose(model.kinematics.tip(*poses[0].q_rad), in_base, atol=1e-9)


def status(arm: Arm, **changes: object) -> dict[str, object]:
    q_rad = [0.1, -0.5, 0.2]
    tip_m = list(ForwardKinematics(arm).tip(*q_rad))
    return {"is_homed": True, "joint_rad": q_rad, "tip_m": tip_m, "fingerprint": fingerprint(arm)} | changes


def test_what_the_runtime_believes_is_found_out_and_never_assumed() -> None:
    assert active_model(status(RIGHT), PAIR) is PAIR.nominal
    assert active_model(status(TRUE), PAIR) is PAIR.calibrated
    with pytest.raises(ArmError, match="uses another arm"):
        active_model(status(load_arm("left")), PAIR)
    with pytest.raises(ArmError, match="not homed"):
        active_model(status(RIGHT, is_homed=False), PAIR)


def test_the_nominal_arm_is_found_beside_the_calibrated_one_first(tmp_path: Path) -> None:
    made = Calibration("right.toml", {}, "2026-01-01", "E2", "0.1.0")
    save_arm(replace(TRUE, calibration=made), tmp_path / "calibrated.toml")
    arm = load_arm(tmp_path / "calibrated.toml")
    assert nominal_of(arm, None).path == RIGHT.path
    save_arm(replace(RIGHT, name="mine"), tmp_path / "right.toml")
    assert nominal_of(arm, None).name == "mine"
    for source in ("elsewhere.toml", "calibrated.toml"):  # an arm is never its own nominal one
        lost = replace(arm, calibration=replace(made, source=source))
        with pytest.raises(ArmError, match="neither beside it nor in this folder"):
            nominal_of(lost, None)


def recording(path: Path, delay_s: float, offset_m: float) -> np.ndarray:
    """Two runs of 2 s at 500 Hz, a camera at 100 Hz whose frames come `delay_s` late; returns the true path of run 2."""
    layout = Layout.of(3)
    sink = FileSink(path, layout.header({"arm": "right"}))
    times = np.arange(0.0, 4.0, 0.002)
    q = np.column_stack([0.3 * np.sin(times), -0.6 + 0.2 * np.cos(1.3 * times), 0.1 * times])
    late = np.array([np.interp(times - delay_s, times, column) for column in ForwardKinematics(RIGHT).tips(q).T]).T
    for k, time_s in enumerate(times):
        row = dict.fromkeys(layout.names, 0)
        seen = late[k] + offset_m if k % 5 == 0 else [np.nan] * 3
        row |= {"t_s": time_s, "cycle": k, "run": 1 if time_s < 2.0 else 2, "mode": MOVING}
        row |= {f"q{j + 1}_set_rad": q[k, j] for j in range(3)} | dict(zip(("x_m", "y_m", "z_m"), seen, strict=True))
        sink.write(layout.packing.pack(*row.values()))
    sink.close()
    return ForwardKinematics(RIGHT).tips(q[times >= 2.0])


def test_a_cameras_delay_is_no_error_of_the_arm(tmp_path: Path) -> None:
    """30 ms late at some 0.3 m/s would be 9 mm; the delay is known to half a millisecond then, 0.15 mm."""
    recording(tmp_path / "a.armlog", 0.03, 0.004)
    track = track_of(tmp_path / "a.armlog", Model(RIGHT), SurveyedPath(2), "run")
    error = track.measured_m - track.planned_m
    np.testing.assert_allclose(error, 0.004, atol=0.0002)
    assert len(track.time_s) == 197  # three frames were taken before the run
    with pytest.raises(ArmError, match="contains no run 7"):
        track_of(tmp_path / "a.armlog", Model(RIGHT), SurveyedPath(7), "run")


def test_a_growing_recording_is_read_as_far_as_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.armlog"
    recording(path, 0.0, 0.0)
    with path.open("ab") as file:
        file.write(b"torn")
    assert len(recorded(path)) == 2000
    wait_until_recorded(path, 3.9, lambda duration_s: pytest.fail("it is there already"))
    with pytest.raises(ArmError, match="has stopped growing"):
        wait_until_recorded(path, 5.0, lambda duration_s: None)


def test_a_fixed_row_more_is_the_same_arm(calibrated: Path, tmp_path: Path) -> None:
    arm = load_arm(calibrated)
    bend = Link("fixed", 0.0, 0.0, 0.0, 0.0005)
    file = tmp_path / "tilted.toml"
    save_arm(replace(arm, links=(*arm.links[:2], bend, *arm.links[2:])), file)
    assert nominal_of(load_arm(file), "right").joint_count == 3

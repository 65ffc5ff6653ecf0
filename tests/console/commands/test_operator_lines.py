"""Operator lines: what the shell takes a script takes, and nothing follows a line that failed."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from pathlib import Path

import pytest

from benchmarks.arms import SIX
from console.commands import script
from console.commands.moving import tracker_place
from console.lines import NOT_HERE, Grammar, LineError, LineOutcome, parse_lines, replay
from console.main import main
from console.places import PlacesError, find_place, read_places, save_place
from console.specs.table import COMMANDS
from control.errors import ArmError
from control.model.arm import Camera, Effect
from control.model.description import save_arm
from control.model.end_effector import CameraStream
from control.safety.modes import Mode
from firmware_iface.mocap.bodies import RigidPose, compose
from hil_mocks.scenario import EffectTable
from tests.cell import RIGHT, STRETCHED, Cell, handled, holding_cell, scenario, with_drive

GRAMMAR = Grammar(COMMANDS, {"arm": "right", "socket": None})


def played(cell: Cell, *lines: str, grammar: Grammar = GRAMMAR) -> list[LineOutcome]:
    """Replay lines on a stepped mock arm."""
    outcomes: list[LineOutcome] = []
    replay(parse_lines(lines, grammar), lambda: cell.client, outcomes.append)
    return outcomes


# ---- the grammar


def test_a_line_is_the_subcommand_with_its_options() -> None:
    line = GRAMMAR.line("  move --joints 0 -0.8 0.1 --speed 0.2   # gently")
    assert line is not None
    assert (line.command, line.given.joints, line.given.speed) == ("move", [0.0, -0.8, 0.1], 0.2)
    assert (line.given.arm, line.given.waits) == ("right", True)
    copied = GRAMMAR.line("armwright move --joints 0 -0.8 0.1 --speed 0.2")
    assert copied is not None
    assert vars(copied.given) == vars(line.given)
    begun = GRAMMAR.line("run 'my path.csv' &  # and on")
    assert begun is not None
    assert (begun.text, begun.given.waits) == ("run 'my path.csv' &", False)


@pytest.mark.parametrize("text", ["", "   ", "# nothing", "\t#move"])
def test_remarks_are_no_lines(text: str) -> None:
    assert GRAMMAR.line(text) is None


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("dance", "unknown command"),
        ("move --joints zero", "expected a number"),
        ("move --knots 1", "unrecognized arguments"),
        ("jog --joint 1 --by nan", "expected a number, got 'nan'"),
        ("move --tip 0.4 0 inf", "expected a number, got 'inf'"),
        ("move --arm left --tip 0.4 0 0.4", "all lines use --arm right"),
        ("stop --socket /tmp/other.sock", "all lines use --socket"),
        ("jog --joint 1", "--by"),
        ("run 'unclosed", "No closing quotation"),
        ("stop &", "`&` is only for motions"),
        ("&", "is only for motions"),
        *((f"{name}", "its own terminal") for name in NOT_HERE if name in {c.name for c in COMMANDS}),
    ],
)
def test_a_line_that_is_wrong_says_why(text: str, what: str) -> None:
    with pytest.raises(LineError, match=what.replace("`", ".")):
        GRAMMAR.line(text)


def test_every_wrong_line_of_a_file_is_named_before_anything_is_done() -> None:
    with pytest.raises(LineError) as error:
        parse_lines(["stop", "dance", "", "move --joints x"], GRAMMAR)
    assert "line 2: dance" in str(error.value)
    assert "line 4: argument --joints" in str(error.value)


# ---- replay


def test_a_script_jogs_moves_pauses_goes_on_and_marks(tmp_path: Path) -> None:
    places = tmp_path / "places.toml"
    with holding_cell() as cell:
        outcomes = played(
            cell,
            "jog --joint 1 --by 0.05 --speed 0.3",
            "jog --axis z --by 0.02",
            f"mark here --places {places}",
            "move --joints 0.8 -0.3 0.6 &",
            "wait 0.3",
            "pause",
            "wait 1",
            "status",
            "resume",
            "wait",
            f"go here --places {places} --speed 1",
        )
        assert [outcome.status for outcome in outcomes] == [0] * 11
        assert "PAUSED" in outcomes[7].transcript
        assert cell.rig.joint_rad()[0] == pytest.approx(STRETCHED[0] + 0.05, abs=3e-3)
        assert cell.mode is Mode.HOLDING


def test_a_plan_alone_is_that_of_the_motion_which_is_then_run(tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    file.write_text("x_m,y_m,z_m\n0.35,0.1,0.35\n0.3,0.15,0.4\n")
    save_arm(SIX, tmp_path / "six.toml")
    grammar = Grammar(COMMANDS, {"arm": str(tmp_path / "six.toml"), "socket": None})
    lines = (f"run {file} --speed 0.1 --plan-only", f"run {file} --speed 0.1")
    with holding_cell(scenario((2.0, -0.3, -0.9, 0.4, 1.2, -0.5)), arm=SIX) as cell:  # far from the rest pose
        planned, done = played(cell, *lines, grammar=grammar)
    assert "begins at " in planned.transcript
    assert planned.transcript.splitlines()[0] == done.transcript.splitlines()[0]
    assert "planned from where the arm is now" in planned.transcript


def test_a_pose_beyond_the_limits_is_marked_with_a_word(tmp_path: Path) -> None:
    narrower = with_drive(RIGHT, 1, joint_upper_rad=0.08)  # it stands at 0.1
    save_arm(narrower, tmp_path / "narrower.toml")
    grammar = Grammar(COMMANDS, {"arm": str(tmp_path / "narrower.toml"), "socket": None})
    with holding_cell(believed=narrower) as cell:
        said = played(cell, f"mark here --places {tmp_path}/p.toml", f"teach {tmp_path}/w.csv", grammar=grammar)
        for outcome in said:
            assert outcome.status == 0
            assert "joint 1 is at 0.1" in outcome.transcript
            assert "outside its limits (-2.6 to 0.08 rad)" in outcome.transcript


@pytest.mark.parametrize(
    ("angles", "why"), [("9 9 9", "outside of its range"), ("0 0", "--joints: expected 3 joint angles in rad, got 2")]
)
def test_a_script_ends_at_the_first_line_that_fails(angles: str, why: str) -> None:
    with holding_cell() as cell:
        before = cell.rig.joint_rad()
        outcomes = played(cell, f"move --joints {angles}", "move --joints 0.3 -0.5 0.3")
        assert [outcome.status for outcome in outcomes] == [2]
        assert why in outcomes[0].transcript
        assert cell.rig.joint_rad() == pytest.approx(before, abs=1e-3)


def test_nothing_follows_a_motion_that_somebody_stopped() -> None:
    with holding_cell() as cell:
        begun_s = cell.rig.clock.now_s()

        def stop_in_between() -> None:
            if cell.mode is Mode.MOVING and cell.rig.clock.now_s() - begun_s > 0.3:
                handled(cell, {"do": "stop"}, 9)

        cell.watchers.append(stop_in_between)
        outcomes = played(cell, "move --joints 0.9 -0.3 0.6 --speed 1", "move --joints 0 -0.6 0.2")
        assert [outcome.status for outcome in outcomes] == [1]
        assert "stopped before its end" in outcomes[0].transcript


@pytest.mark.usefixtures("nobody_below")
def test_what_depends_on_the_arm_is_refused_where_the_runtime_has_another_and_the_stop_is_not(tmp_path: Path) -> None:
    file = tmp_path / "edited.toml"
    links = (RIGHT.links[0], dataclasses.replace(RIGHT.links[1], L_m=0.35), *RIGHT.links[2:])
    save_arm(dataclasses.replace(RIGHT, links=links), file)
    way = tmp_path / "way.csv"
    way.write_text("x_m,y_m,z_m\n0.5,0,0.3\n0.5,0.1,0.3\n")
    save_place(tmp_path / "places.toml", "here", STRETCHED)
    places = f"--places {tmp_path / 'places.toml'}"
    lines = (
        "move --tip 0.45 0.1 0.25",
        "move --joints 0.3 -0.5 0.3",
        f"run {way}",
        f"go here {places}",
        "jog --joint 1 --by 0.01",
        f"mark there {places}",
        f"teach {tmp_path / 'taught.csv'}",
    )
    grammar = Grammar(COMMANDS, {"arm": str(file), "socket": None})
    with holding_cell() as cell:
        run = cell.runtime.run_number
        for line in lines:
            (outcome,) = played(cell, line, grammar=grammar)
            assert outcome.status == 2, line
            assert f"link 2, L_m: 0.4, in {file} 0.35" in outcome.transcript
        assert (cell.runtime.run_number, cell.mode) == (run, Mode.HOLDING)
        assert list(read_places(tmp_path / "places.toml")) == ["here"]
        assert not (tmp_path / "taught.csv").exists()
        status, stop, off = played(cell, "status", "stop", "off", grammar=grammar)
        assert f"in {file} 0.35" in status.transcript
        assert [outcome.status for outcome in (status, stop, off)] == [0, 0, 0]


def test_a_jog_against_the_end_of_a_range_fails_in_words() -> None:
    with holding_cell() as cell:
        outcomes = played(cell, "jog --joint 3 --by 2.0")
        assert outcomes[0].status == 2
        outcomes = played(cell, "jog --axis x --by 0.16")
        assert outcomes[0].status in (1, 2)
        assert "range" in outcomes[0].transcript or "singular" in outcomes[0].transcript


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ("--joint 1 --by 45", "--by: expected an angle within +-2 pi rad, got 45 (this looks like degrees: write 0.785398)"),
        ("--axis rz --by -30", "got -30 (this looks like degrees: write -0.523599)"),
        ("--axis z --by 10", "--by: expected a step within +-1 m, got 10 (this looks like millimetres: write 0.01)"),
    ],
)
def test_a_jog_in_degrees_or_millimetres_is_refused_with_what_to_write(step: str, said: str) -> None:
    with holding_cell() as cell:
        (outcome,) = played(cell, f"jog {step}")
        assert outcome.status == 2
        assert said in outcome.transcript
        assert cell.mode is Mode.HOLDING


def test_way_points_taught_by_hand_make_a_path_that_runs(tmp_path: Path) -> None:
    file = tmp_path / "taught.csv"
    with holding_cell() as cell:
        outcomes = played(cell, f"teach {file}", f"teach {file}")
        assert [outcome.status for outcome in outcomes] == [0, 2]  # twice the same point
        assert "has not moved" in outcomes[1].transcript
        outcomes = played(
            cell,
            "move --joints 0.3 -0.6 0.2",
            f"teach {file}",
            "move --joints 0.3 -0.4 0.3",
            f"teach {file}",
            "move --joints 0.8 -0.4 0.3",
            f"run {file} --speed 0.2",
        )
        assert [outcome.status for outcome in outcomes] == [0] * 6
        assert cell.client.status()["q_rad"] == pytest.approx([0.3, -0.4, 0.3], abs=3e-3)


def test_six_joints_run_what_they_were_taught_with_its_orientation(tmp_path: Path) -> None:
    file, arm = tmp_path / "taught.csv", tmp_path / "six.toml"
    save_arm(SIX, arm)
    grammar = Grammar(COMMANDS, {"arm": str(arm), "socket": None})
    with holding_cell(scenario(SIX.rest.q_rad if SIX.rest else None), SIX) as cell:
        outcomes = played(
            cell,
            f"teach {file} --orientation",
            "move --joints 0.1 1.35 -0.35 0.2 0.95 0.1",
            f"teach {file}",
            f"teach {file}",
            grammar=grammar,
        )
        assert [outcome.status for outcome in outcomes] == [0, 0, 0, 2]
        assert "has not moved" in outcomes[3].transcript
        assert file.read_text().startswith("x_m,y_m,z_m,qw,qx,qy,qz\n")
        outcomes = played(cell, f"run {file} --speed 0.1", grammar=grammar)
        assert [outcome.status for outcome in outcomes] == [0], outcomes[0].transcript
        assert cell.client.status()["q_rad"] == pytest.approx([0.1, 1.35, -0.35, 0.2, 0.95, 0.1], abs=3e-3)
        x, y, z = cell.client.status()["tip_m"]
        turned = " ".join(f"{value:.6f}" for value in cell.client.status()["tip_orientation"])
        outcomes = played(cell, f"move --tip {x} {y} {z + 0.02} --orientation {turned}", grammar=grammar)
        assert [outcome.status for outcome in outcomes] == [0]


def test_a_place_that_is_marked_is_where_the_joints_are_and_not_their_encoders(tmp_path: Path) -> None:
    places, scale = tmp_path / "places.toml", Effect("encoder_scale", 2, {"scale": 0.01})
    knowing = dataclasses.replace(RIGHT, effects=(*RIGHT.effects, scale))
    hidden = scenario(effect=(EffectTable("encoder_scale", 2, dict(scale.parameters)),))
    save_arm(knowing, tmp_path / "arm.toml")
    grammar = Grammar(COMMANDS, {"arm": str(tmp_path / "arm.toml"), "socket": None})
    with holding_cell(hidden, believed=knowing) as cell:
        cell.client.home()
        outcomes = played(
            cell,
            "move --joints 0.2 -0.9 0.3",
            f"mark here --places {places}",
            "move --joints 0.3 -0.6 0.2",
            f"go here --places {places}",
            f"mark here --places {places}",
            grammar=grammar,
        )
        assert [outcome.status for outcome in outcomes] == [0] * 5
        assert cell.rig.joint_rad() == pytest.approx((0.2, -0.9, 0.3), abs=2e-3)
        assert "replacing another" in outcomes[4].transcript
        assert "replacing another" not in outcomes[1].transcript


def test_an_error_is_seen_when_it_comes_and_not_again_with_the_output(capsys: pytest.CaptureFixture[str]) -> None:
    with holding_cell() as cell:
        outcomes = played(cell, "move --joints 9 9 9")
    assert capsys.readouterr().err.count("outside of its range") == 1
    assert "outside of its range" in outcomes[0].transcript
    assert not outcomes[0].output


def test_a_file_of_something_else_is_not_taught_into(tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text("setup,point\n")
    with holding_cell() as cell:
        assert played(cell, f"teach {file}")[0].status == 2
    assert file.read_text() == "setup,point\n"


# ---- the command


def test_check_says_what_would_be_done_and_needs_no_runtime(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "lines.txt"
    file.write_text("# to the table\nenable\n\nmove --joints 0 -0.8 0\n")
    assert main(["script", str(file), "--check"]) == 0
    assert capsys.readouterr().out == "2: enable\n4: move --joints 0 -0.8 0\n"
    file.write_text("enable\nmve\n")
    assert main(["script", str(file), "--check"]) == 2
    error = capsys.readouterr().err
    assert "line 2: mve: unknown command" in error
    assert "nothing was run" in error


def test_json_carries_status_and_words_of_every_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "lines.txt"
    file.write_text("status\nmove --joints 9 9 9\nstop\n")
    with holding_cell() as cell:
        monkeypatch.setattr(script, "in_control", lambda given: cell.client)
        given = argparse.Namespace(file=str(file), arm="right", socket=None, check=False, json=True)
        assert script.run_script(given) == 2
    content = json.loads(capsys.readouterr().out)
    assert content["status"] == 2
    assert [(line["number"], line["status"]) for line in content["lines"]] == [(1, 0), (2, 2)]
    assert "HOLDING" in content["lines"][0]["transcript"]


QUICK = """
name = "quick"
[start]
homed = true
[plant]
timestep_s = 0.001
[hand]
speed_m_s = 0.8
seating_noise_m = 0.00005
"""


@pytest.mark.nightly
@pytest.mark.usefixtures("nobody_below")
def test_a_script_runs_a_whole_small_calibration(tmp_path: Path) -> None:
    """Session with a mock arm, calibration, and what the result says: three lines of a file."""
    answers = tmp_path / "answers.txt"
    answers.write_text("auto\n")
    quick = tmp_path / "quick.toml"
    quick.write_text(QUICK)
    out = tmp_path / "s"
    lines = [
        f"session --mock --scenario {quick} --out {out} --setups normal,roll --points 1,9,17,25,33 --replay {answers}",
        f"calibrate --points {out / 'points.csv'} --out {tmp_path / 'c'}",
        f"arm {tmp_path / 'c' / 'arm.toml'}",
    ]
    outcomes: list[LineOutcome] = []

    def none() -> None:
        raise AssertionError("no line needs a runtime")

    replay(parse_lines(lines, GRAMMAR), none, outcomes.append)  # type: ignore[arg-type]
    assert [outcome.status for outcome in outcomes] == [0, 0, 0], outcomes[-1].transcript
    assert (tmp_path / "c" / "calibration.json").exists()
    assert "10 points recorded" in outcomes[0].transcript


# ---- places


def test_a_place_is_kept_beside_the_others(tmp_path: Path) -> None:
    file = tmp_path / "places.toml"
    file.write_text("[corner]\ntip_m = [0.5, 0.1, 0.1]\n")
    save_place(file, "rest", (0.0, 0.15, 0.75))
    save_place(file, "rest", (0.1, 0.15, 0.75))
    places = read_places(file)
    assert places["corner"].tip_m == (0.5, 0.1, 0.1)
    assert places["rest"].q_rad == (0.1, 0.15, 0.75)
    with pytest.raises(PlacesError, match="no place 'home'; expected one of corner, rest"):
        find_place(file, "home")


def test_rest_is_the_arms_own_pose_unless_the_file_has_another(tmp_path: Path) -> None:
    own, file = (0.0, 0.15, 0.75), tmp_path / "places.toml"
    assert find_place(file, "rest", own).q_rad == own
    file.write_text("[corner]\ntip_m = [0.5, 0.1, 0.1]\n")
    assert find_place(file, "rest", own).q_rad == own
    save_place(file, "rest", (0.1, 0.15, 0.75))
    assert find_place(file, "rest", own).q_rad == (0.1, 0.15, 0.75)


@pytest.mark.parametrize(
    "text",
    [
        "[a]\n",
        "[a]\nx = 1\n",
        "[a]\nq_rad = 1\n",
        "[a]\nq_rad = []\n",
        "[a]\ntip_m = [1.0, 2.0]\n",
        '[a]\nq_rad = ["1"]\n',
        "[a]\nq_rad = [nan]\n",
        "a = 1\n",
        "[a",
        "[a]\nq_rad=[1.0]\ntip_m=[1.0,2.0,3.0]\n",
    ],
)
def test_a_places_file_that_is_wrong_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "places.toml"
    file.write_text(text)
    with pytest.raises(PlacesError, match=r"places\.toml"):
        read_places(file)


@pytest.mark.parametrize("content", [b"[a", b"\xff"])
def test_marking_in_a_file_that_is_no_places_file_leaves_it_as_it_is(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "places.toml"
    file.write_bytes(content)
    with pytest.raises(PlacesError, match=r"places\.toml: not valid TOML"):
        save_place(file, "rest", (0.0,))
    assert file.read_bytes() == content
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("name", ["", "a b", "a.b", "[x]"])
def test_a_name_that_toml_would_not_take_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(PlacesError, match="letters, digits"):
        save_place(tmp_path / "places.toml", name, (0.0,))


# ---- where the tip is meant to be


@pytest.mark.parametrize("where", ["base_frame", "stream"])
def test_a_tip_that_is_said_in_the_trackers_frame_goes_there(where: str) -> None:
    """A tracker 2 m away, turned by 90 deg about z: its x is the base's y."""
    turn_rad, origin_m = 0.5 * math.pi, (2.0, -0.3, 0.5)
    if where == "base_frame":
        values = dict(zip(("x_m", "y_m", "z_m", "rz_rad"), (*origin_m, turn_rad), strict=True))
        arm = dataclasses.replace(RIGHT, effects=(*RIGHT.effects, Effect("base_frame", None, values)))
    else:
        half = 0.5 * turn_rad
        stream = CameraStream("vicon", "tool", origin_m=origin_m, orientation=(math.cos(half), 0.0, 0.0, math.sin(half)))
        arm = dataclasses.replace(RIGHT, camera=Camera(stream=stream))
    place = compose(tracker_place(arm), RigidPose((0.4, 1.5, 0.0), (1.0, 0.0, 0.0, 0.0)))
    assert place.position_m == pytest.approx((2.0 - 1.5, -0.3 + 0.4, 0.5))
    with pytest.raises(ArmError, match="does not say where the tracker's frame is"):
        tracker_place(RIGHT)

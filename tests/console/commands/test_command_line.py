"""The command line: help that answers at once, and bad input as one message with exit status 2 and nothing moved."""

from __future__ import annotations

import argparse
import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from console.main import main, parser
from console.options import CommandSpec, runner
from console.specs.table import COMMANDS, FOR_TASKS, GROUPS
from control.model.description import load_arm, save_arm
from control.model.reference import sections
from control.recording.record import END_FIELDS, JOINT_FIELDS, JOINT_SIDE_FIELDS, LEAD_FIELD, SCALAR_FIELDS
from control.safety.modes import Mode
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import FaultTable
from tests.cell import RIGHT, scenario, wired_to, with_drive
from tests.places import RIGHT_TOML, ROOT

HEAVY = (
    "numpy",
    "scipy",
    "mujoco",
    "matplotlib",
    "can",
    "serial",
    "msgspec",
    "rich",
    "ruckig",
    "textual",
    "shtab",
    "mcap",
    "PIL",
)


def test_no_help_imports_anything_heavy_and_each_says_what_its_command_does() -> None:
    # One process for all: a module that one help had imported would be found by the check after the last.
    program = f"""
import sys, io, contextlib
from console.specs.table import COMMANDS, FOR_TASKS, GROUPS
from console.main import main, parser
for arguments in [["--help"], *([command.name, "--help"] for command in COMMANDS)]:
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        try:
            main(arguments)
        except SystemExit as end:
            assert end.code == 0, arguments
    assert "usage: armwright" in out.getvalue() and len(out.getvalue()) > 100, arguments
heavy = [name for name in {HEAVY} if name in sys.modules]
assert not heavy, heavy
of_model = {{name for name in sys.modules if name.startswith("control.model.")}}
assert of_model == {{"control.model.board_kinds"}}, of_model
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=120)
    assert ended.returncode == 0, ended.stderr


def test_who_only_asks_the_runtime_waits_for_no_mathematics() -> None:
    program = f"""
import sys
from console.main import main
from control.model.reference import sections
for line in ["status", "stop", "enable", "home", "hold", "off", "pause", "resume", "guide", "wait", "acknowledge"]:
    assert main([line]) != 0, line
heavy = [name for name in {HEAVY} if name in sys.modules and name != "msgspec"]
assert not heavy, heavy
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=120)
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: str(command.name))
def test_every_command_has_a_module_that_runs_it(command: CommandSpec) -> None:
    assert callable(runner(command.module_name, command.name))


def test_every_module_of_a_command_is_in_the_table() -> None:
    folder = ROOT / "console" / "commands"
    modules = {
        ".".join(path.relative_to(folder).with_suffix("").parts)
        for path in folder.rglob("*.py")
        if re.search(r"^def run(_\w+)?\(args", path.read_text("utf-8"), re.MULTILINE)
    }
    assert modules == {command.module_name for command in COMMANDS}


@pytest.mark.parametrize("name", ["requests", "moving"])
def test_a_module_of_several_commands_has_a_line_for_each(name: str) -> None:
    module = importlib.import_module(f"console.commands.{name}")
    table = module.REQUESTS if name == "requests" else module.MOTIONS
    assert set(table) == {command.name for command in COMMANDS if command.module_name == name}


def test_without_a_command_the_help_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "usage: armwright" in capsys.readouterr().out


def test_the_help_lists_each_command_once_under_its_job() -> None:
    listed = parser().format_help().partition("COMMAND\n\n")[2].splitlines()
    under, job = dict[str, str](), ""
    for line in listed:
        if found := re.fullmatch(r"  (\S.*):", line):
            job = found[1]
        elif found := re.match(r"    (\S+)(  |$)", line):
            assert found[1] not in under
            under[found[1]] = job
    assert under == {command.name: job for job, group in GROUPS.items() for command in group}


def test_a_command_does_not_wait_for_the_options_of_others() -> None:
    top = parser()
    assert top.parse_args(["status", "--json"]).module == "status"
    (commands,) = (action for action in top._actions if isinstance(action, argparse._SubParsersAction))
    assert {name for name, sub in commands.choices.items() if sub.is_made} == {"status"}


@pytest.mark.parametrize("word", FOR_TASKS)
def test_a_word_for_a_task_leads_to_commands_that_there_are(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert word not in {command.name for command in COMMANDS}
    assert set(FOR_TASKS[word]) <= {command.name for command in COMMANDS}
    with pytest.raises(SystemExit):
        main([word])
    assert f"did you mean {' or '.join(FOR_TASKS[word])}?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("word", "meant"), [("recrod", "gap or session"), ("Urfd", "new or export-arm"), ("calibrat", "calibrate")]
)
def test_a_mistyped_word_leads_where_the_right_one_does(word: str, meant: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([word])
    assert f"did you mean {meant}" in capsys.readouterr().err


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("armwright 0.")


def test_an_option_that_a_command_does_not_have_shows_the_usage_of_that_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["jog", "--joint", "1", "--by", "0.1", "--spede", "1"])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("usage: armwright jog")
    assert "unrecognized arguments: --spede 1" in error


@pytest.mark.parametrize(
    "arguments",
    [
        ("gap", "--minutes", "nan"),
        ("gap", "--payload", "inf"),
        ("plot", "--from", "nan"),
        ("view", "--fps", "nan"),
        ("serve", "--rate", "nan"),
        ("jog", "--by", "-inf"),
    ],
)
def test_what_is_no_number_is_refused_with_its_option(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, str, str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([arguments[0], f"{arguments[1]}={arguments[2]}"])
    assert ended.value.code == 2
    assert f"argument {arguments[1]}: expected a number, got '{arguments[2]}'" in capsys.readouterr().err


def said_by(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Standard error of a command that ends with status 2; exactly one message, no traceback."""
    assert main(list(arguments)) == 2
    error = capsys.readouterr().err
    assert error.count("armwright: ") == 1
    assert error.startswith("armwright: ")
    assert "Traceback" not in error
    return error


def changed(tmp_path: Path, old: str, new: str) -> str:
    """The reference arm.toml with one thing changed, as a file."""
    text = RIGHT_TOML.read_text("utf-8")
    assert old in text
    path = tmp_path / "changed.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("command", ["arm", "serve", "check"])
def test_an_unknown_key_in_arm_toml_is_one_message_with_file_and_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    arm = changed(tmp_path, "gear_ratio = 100.0", "geer_ratio = 100.0")
    error = said_by(capsys, command, *([arm] if command == "arm" else ["--arm", arm]))
    assert "changed.toml" in error
    assert "geer_ratio" in error


def test_an_arm_that_is_not_there_is_one_message(capsys: pytest.CaptureFixture[str]) -> None:
    assert "nowhere.toml" in said_by(capsys, "arm", "nowhere.toml")


def test_way_points_out_of_reach_name_the_point_and_by_how_much(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "points.csv"
    file.write_text("x_m,y_m,z_m\n0.5,0.0,0.1\n1.5,0.0,0.1\n")
    error = said_by(capsys, "run", str(file), "--plan-only", "--speed", "0.1")
    assert "points.csv" in error
    assert "3" in error  # line of the file, way-point 2
    assert "out" in error


def test_a_plan_without_a_runtime_says_from_which_pose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "points.csv"
    file.write_text("x_m,y_m,z_m\n0.4,0.0,0.3\n0.35,0.1,0.3\n")
    assert main(["run", str(file), "--arm", "right", "--plan-only", "--speed", "0.1"]) == 0
    assert "planned from [rest], because no runtime answers: `run` plans from where" in capsys.readouterr().out


@pytest.mark.parametrize(
    "content", [None, "", "a,b\n1,2\n", "x_m,y_m,z_m\n0.5,zero,0.1\n", "x_m,y_m,z_m\n0.5,0,nan\n0.5,0,0.1\n"]
)
def test_a_way_point_file_that_is_wrong_is_one_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str | None
) -> None:
    file = tmp_path / "points.csv"
    if content is not None:
        file.write_text(content)
    assert "points.csv" in said_by(capsys, "run", str(file), "--plan-only")


@pytest.mark.parametrize("command", ["status", "enable", "home", "off", "acknowledge", "guide", "hold"])
def test_without_a_runtime_every_client_command_says_how_to_start_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    assert "armwright serve" in said_by(capsys, command, "--socket", str(tmp_path / "none.sock"))


def test_a_move_needs_one_target(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--joints or --tip" in said_by(capsys, "move", "--socket", str(tmp_path / "none.sock"))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--rate", "5000"], "50 to 1200 Hz"),
        (["--can-option", "port"], "KEY=VALUE"),
        (["--encoder", "/dev/ttyNONE9"], "/dev/ttyNONE9"),
        (["--can-interface", "telegraph"], "telegraph"),
    ],
)
def test_a_bad_option_of_serve_is_one_message_and_nothing_is_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    error = said_by(capsys, "serve", "--socket", str(tmp_path / "a.sock"), "--log", str(tmp_path / "log"), *options)
    assert said in error
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    error = said_by(capsys, "demo", "--out", str(tmp_path / "file" / "below"))
    assert str(tmp_path / "file") in error


def test_a_scenario_that_is_not_there_is_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "none.toml" in said_by(capsys, "demo", "--scenario", "none.toml", "--out", str(tmp_path / "out"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (FaultTable("wrong_protocol", "encoder", value=9), "protocol"),
        (FaultTable("wrong_identity", "motor2", value=4711), "4711"),
        (FaultTable("wrong_counts", "motor3", value=500), "got 500"),
    ],
)
@pytest.mark.parametrize("command", ["serve", "check"])
def test_a_wrong_board_is_one_message_and_nothing_moves(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    fault: FaultTable,
    said: str,
    command: str,
) -> None:
    arm = with_drive(RIGHT, 2, motor_serial_number=0xD0002)
    with SteppedRig(arm, scenario(fault=(fault,))) as rig:
        save_arm(wired_to(arm, rig), tmp_path / "arm.toml")
        for module in ("console.commands.serve", "control.server.process"):
            monkeypatch.setattr(f"{module}.MonotonicClock", lambda: rig.clock)
        options = ["--socket", str(tmp_path / "a.sock"), "--log", str(tmp_path / "log")] if command == "serve" else []
        error = said_by(capsys, command, "--arm", str(tmp_path / "arm.toml"), *options)
        assert said in error
        assert {board.output for board in rig.robot.motor_boards} == {("voltage", 0.0)}
        assert [path.name for path in tmp_path.iterdir()] == ["arm.toml"]


def test_check_names_every_board_of_an_arm_that_is_well(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with SteppedRig(RIGHT, scenario()) as rig:
        save_arm(wired_to(RIGHT, rig), tmp_path / "arm.toml")
        monkeypatch.setattr("console.commands.serve.MonotonicClock", lambda: rig.clock)
        arguments = ["check", "--arm", str(tmp_path / "arm.toml"), "--camera-port", str(rig.camera_port)]
        assert main(arguments) == 0
    out = capsys.readouterr().out
    for name in ("enc0", "joint 1", "joint 2", "joint 3", "all boards answer"):
        assert name in out
    with SteppedRig(RIGHT, scenario()) as rig:
        save_arm(wired_to(RIGHT, rig), tmp_path / "arm-2.toml")
        monkeypatch.setattr("console.commands.serve.MonotonicClock", lambda: rig.clock)
        arguments = ["check", "--arm", str(tmp_path / "arm-2.toml"), "--camera-port", str(rig.camera_port)]
        assert main([*arguments, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert set(content) == {"format", "arm", "encoder_boards", "motor_boards", "boards", "rights"}
    assert [board["channels"] for board in content["encoder_boards"]] == [3]
    assert [board["encoder_counts_per_turn"] for board in content["motor_boards"]] == [2048] * 3


def test_an_arm_is_described_for_people_and_programs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["arm", "right"]) == 0
    assert "arm right" in capsys.readouterr().out
    assert main(["arm", "left", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["joints"] == load_arm("left").joint_count


def test_arm_keys_prints_every_key_of_every_section_or_those_of_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["arm", "--keys"]) == 0
    everything = capsys.readouterr().out
    for section in sections():
        assert main(["arm", "--keys", section.header.strip("[]")]) == 0
        shown = capsys.readouterr().out
        assert section.header in shown
        assert [key.name for key in section.keys if f"{key.name} " not in shown] == []
        assert [key.name for key in section.keys if key.text.split()[0] not in shown] == []
        assert shown in everything


def test_arm_keys_prints_the_keys_of_a_scenario_as_its_reader_has_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["arm", "--keys", "scenario"]) == 0
    shown = capsys.readouterr().out
    keys = (" tick_s    > 0 (0.001) ", "[[fault]]", "*kind ", " digital_pins     0 to 8 (8) ", ' firmware  "python", "c" ')
    assert [key for key in keys if key not in shown] == []
    assert " path " not in shown, "the reader sets it, and refuses it in a file"


def test_arm_keys_prints_the_columns_of_a_recording(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["arm", "--keys", "armlog"]) == 0
    printed = {line.split()[0] for line in capsys.readouterr().out.splitlines() if line}
    columns = [column.format(1) for column, _ in (*SCALAR_FIELDS, *JOINT_FIELDS, *JOINT_SIDE_FIELDS, *END_FIELDS, LEAD_FIELD)]
    assert set(columns) <= printed


def test_arm_keys_has_a_spread_for_a_value_and_not_for_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["arm", "--keys", "tolerances.toml"]) == 0
    shown = capsys.readouterr().out
    assert " backlash_rad              spread   total play" in shown
    assert "[every_joint.backlash_rad]" not in shown


def test_a_section_of_arm_toml_that_there_is_not_is_told_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["arm", "--keys", "drive.hom"]) == 2
    assert "did you mean drive.home?" in capsys.readouterr().err


def test_status_explains_the_modes_without_a_runtime(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", "--modes"]) == 0
    shown = capsys.readouterr().out
    assert [mode.name for mode in Mode if mode.value not in shown] == []

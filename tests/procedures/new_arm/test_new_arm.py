"""`armwright new`: from answers or a model to a commented arm.toml that homes and moves on the mock."""

from __future__ import annotations

import dataclasses
import io
import re
from pathlib import Path

import numpy as np
import pytest

from calib.arm_import import read_arm
from calib.export import export_text
from console.main import main
from control.kinematics.kinematics import Corners, ForwardKinematics
from control.model.board_kinds import KINDS
from control.model.description import load_arm
from firmware_iface.serial_link import PortHere
from hil_mocks.scenario import load_scenario
from procedures.arm_sheet import sheet
from procedures.new_arm.answers import usual_ports
from procedures.new_arm.motors import SERVOS
from tests.cell import open_cell
from tests.thirds import third_of

RIGHT = load_arm("right")
SEEN_rad = 0.005


def new(tmp_path: Path, *options: str, name: str = "mine.toml") -> tuple[int, Path]:
    file = tmp_path / name
    return main(["new", "--out", str(file), *options]), file


@pytest.mark.parametrize("joints", range(2, 8))
def test_every_number_of_joints_makes_an_arm_with_the_boards_that_it_needs(joints: int, tmp_path: Path) -> None:
    status, file = new(tmp_path, "--joints", str(joints), "--yes")
    arm = load_arm(file)
    assert status == 0
    assert arm.joint_count == len(arm.drives) == joints
    assert len(arm.encoder_boards) == (2 if joints > 3 else 1) + (joints > 6)
    assert arm.rest is not None
    corners = Corners(arm).batch(np.array([arm.rest.q_rad]))
    assert min(float(corner[2, 0]) for corner in corners) >= 0.0
    keys = [line for line in file.read_text(encoding="utf-8").splitlines() if " = " in line]
    assert sum("# " in line for line in keys) > 40


@pytest.mark.parametrize("joints", third_of([2, 4]))
def test_it_homes_and_moves_on_the_mock_at_once(joints: int, tmp_path: Path) -> None:
    _, file = new(tmp_path, "--joints", str(joints), "--yes")
    arm = load_arm(file)
    assert arm.rest is not None
    with open_cell(load_scenario("demo"), arm=arm) as cell:
        cell.client.enable()
        cell.client.home()
        target = [angle + 0.2 for angle in arm.rest.q_rad]
        cell.run(cell.start_move(target) + 0.5)
        assert cell.faults == []
        assert np.abs(np.array(cell.rig.joint_rad()) - target).max() < SEEN_rad


def test_a_kind_of_board_for_each_joint_is_written_and_runs_on_the_mock_at_once(tmp_path: Path) -> None:
    kinds = ("moteus", "odrive", "roboclaw", "dynamixel")
    options = ("--axes", "zyyz", "--boards", *kinds, "--ports", "/dev/claw", "/dev/servos", "--yes")
    status, file = new(tmp_path, *options)
    arm = load_arm(file)
    assert status == 0
    assert tuple(board.kind for board in arm.boards) == kinds
    assert [board.port for board in arm.boards] == ["", "", "/dev/claw", "/dev/servos"]
    assert [drive.home is not None for drive in arm.drives] == [True, False, True, False]
    assert arm.encoder_boards == ()
    assert arm.rest is not None
    with open_cell(load_scenario("demo"), arm=arm, period_s=1.0 / arm.usual_rate_Hz) as cell:
        cell.client.enable()
        cell.client.home()
        target = [angle + 0.2 for angle in arm.rest.q_rad]
        cell.run(cell.start_move(target) + 0.8)
        assert cell.faults == []
        assert np.abs(np.array(cell.rig.joint_rad()) - target).max() < SEEN_rad


def test_a_bought_board_beside_reference_boards_takes_none_of_their_channels(tmp_path: Path) -> None:
    _, file = new(tmp_path, "--joints", "3", "--boards", "reference", "vesc", "reference", "--yes")
    arm = load_arm(file)
    assert [(drive.encoder_board, drive.encoder_channel) for drive in arm.drives] == [(0, 0), (-1, -1), (0, 1)]
    assert [drive.motor_node for drive in arm.drives] == [1, -1, 3]


def test_the_lengths_are_where_the_joints_are(tmp_path: Path) -> None:
    options = ("--axes", "zyy", "--lengths", "0.1", "0.4", "0.35", "--convention", "modified", "--yes")
    _, file = new(tmp_path, *options)
    arm = load_arm(file)
    tips = ForwardKinematics(arm).tips(np.array([[0.0, 0.0, 0.0], [0.0, np.pi / 2, 0.0], [0.0, 0.0, np.pi / 2]]))
    assert np.allclose(tips, [[0, 0, 0.85], [0.75, 0, 0.1], [0.35, 0, 0.5]], atol=1e-12)


def test_masses_are_written_without_the_last_bits_of_a_sum(tmp_path: Path) -> None:
    assert main(["new", "--out", str(tmp_path / "a.toml"), "--boards", "feetech", "--yes"]) == 0
    assert re.findall(r"0{6}\d|9{6}\d", (tmp_path / "a.toml").read_text(encoding="utf-8")) == []


def test_answers_are_asked_for_and_a_bad_one_is_asked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [
        "nine",
        "4",
        "zyyz",
        "100 300 250 50",
        "0.1 0.3 0.25 0.05",
        "vesk",
        "reference",
        "100",
        "1024",
        "no",
        "/dev/a /dev/a",
        "/dev/a /dev/b",
        "slcan:/dev/ttyS1",
    ]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(lines) + "\n"))
    status, file = new(tmp_path)
    said = capsys.readouterr().out
    arm = load_arm(file)
    assert status == 0
    assert "a whole number from 2 to 7, got 'nine'" in said
    assert "this looks like millimetres: write 0.1" in said
    assert "expected kinds of reference, roboclaw, " in said
    assert "2 different serial ports, of encoder board 1, encoder board 2, got /dev/a /dev/a" in said
    assert [drive.gear_ratio for drive in arm.drives] == [100.0] * 4
    assert [drive.encoder_counts_per_rev for drive in arm.drives] == [1024] * 4
    assert all(drive.home is None for drive in arm.drives)
    assert [board.port for board in arm.encoder_boards] == ["/dev/a", "/dev/b"]
    assert arm.can is not None
    assert (arm.can.interface, arm.can.channel) == ("slcan", "/dev/ttyS1")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--joints", "8"), "from 2 to 7, got '8'"),
        (("--axes", "zyq"), "3 letters of x, y, z"),
        (("--joints", "3", "--lengths", "0.1", "0.2"), "expected 3 lengths in m, got 2"),
        (("--joints", "2", "--lengths", "80", "300"), "this looks like millimetres: write 0.08"),
        (("--joints", "3", "--gears", "100", "50"), "one value for all or 3 of them, got 2"),
        (("--joints", "3", "--gears", "-3"), "above 0, got -3"),
        (("--joints", "3", "--counts", "2048.5"), "whole numbers of 1 or more"),
        (("--joints", "4", "--ports", "/dev/a"), "2 different serial ports"),
        (("--joints", "3", "--can", "can0"), "expected INTERFACE:CHANNEL"),
        (("--joints", "3", "--boards", "plc"), "expected kinds of reference, roboclaw"),
        (("--joints", "3", "--boards", "vesc", "moteus"), "one value for all or 3 of them, got 2"),
        (("--joints", "2", "--boards", "odrive", "cia402"), "no cia402 beside odrive on one CAN bus"),
        (("--joints", "2", "--boards", "odrive", "reference"), "no odrive beside reference motor boards"),
        (("--joints", "2", "--boards", "vesc", "--ports", "/dev/a"), "omit the option that says /dev/a"),
        (("--joints", "2", "--boards", "feetech", "--can", "x:y"), "omit the option that says x:y"),
        (("--joints", "3", "--boards", "roboclaw", "--ports", "/dev/a"), "2 different serial ports, of roboclaw1"),
        (("--joints", "3", "--home", "maybe"), "expected yes or no"),
        (("--joints", "3", "--name", "../up"), "name: expected a name of 1 to 64"),
        (("--tip", "hand"), "--from-urdf or --from-mjcf"),
        (("--from-urdf", "nowhere.urdf"), "nowhere.urdf: cannot be read"),
    ],
)
def test_a_wrong_option_is_one_error_and_nothing_is_written(
    options: tuple[str, ...], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, file = new(tmp_path, *options, "--yes")
    assert status == 2
    assert says in capsys.readouterr().err
    assert not file.exists()


def test_an_existing_file_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.toml").write_text("mine", encoding="utf-8")
    status, file = new(tmp_path, "--yes")
    assert status == 2
    assert "is not overwritten" in capsys.readouterr().err
    assert file.read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize("form", ["urdf", "mjcf"])
def test_a_model_gives_the_same_arm_with_limits_torque_and_friction(form: str, tmp_path: Path) -> None:
    model = tmp_path / f"right.{form}"
    model.write_text(export_text(RIGHT, form), encoding="utf-8")
    out = tmp_path / "again.toml"
    assert main(["arm", f"--from-{form}", str(model), "--out", str(out)]) == 0
    arm = load_arm(out)
    q = np.random.default_rng(3).uniform(-1.0, 1.0, (20, 3))
    assert np.abs(ForwardKinematics(arm).tips(q) - ForwardKinematics(RIGHT).tips(q)).max() < 1e-9
    assert arm.limits_rad == RIGHT.limits_rad
    again = tmp_path / f"again.{form}"
    again.write_text(export_text(arm, form), encoding="utf-8")
    first, second = read_arm(model, form), read_arm(again, form)
    assert [j.torque_Nm for j in second.joints] == pytest.approx([j.torque_Nm for j in first.joints])


def test_a_hanging_arm_has_no_floor_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hanging = dataclasses.replace(RIGHT, gravity_m_s2=(0.0, 0.0, 9.81))
    model = tmp_path / "hanging.xml"
    model.write_text(export_text(hanging, "mjcf"), encoding="utf-8")
    assert main(["arm", "--from-mjcf", str(model), "--out", str(tmp_path / "h.toml")]) == 0
    assert "no floor is watched" in capsys.readouterr().out
    assert load_arm(tmp_path / "h.toml").gravity_m_s2 == (0.0, 0.0, 9.81)


def test_a_speed_that_no_placeholder_motor_reaches_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    strong = 'effort="300" velocity="10"'
    text = export_text(RIGHT, "urdf")
    text = re.sub(r'effort="[^"]*" velocity="[^"]*"', strong, text)
    model = tmp_path / "quick.urdf"
    model.write_text(text, encoding="utf-8")
    assert main(["arm", "--from-urdf", str(model), "--out", str(tmp_path / "quick.toml")]) == 0
    assert "do not reach: joint 1 10 rad/s, here 2.1" in capsys.readouterr().out
    assert load_arm(tmp_path / "quick.toml").drive(1).joint_speed_limit_rad_s == 2.1


def test_ports_that_keep_their_names_are_suggested_first() -> None:
    here = [PortHere("/dev/ttyUSB0", "", "/dev/serial/by-id/usb-FTDI-if00"), PortHere("/dev/ttyS0", "")]
    assert usual_ports(1, here) == ("/dev/serial/by-id/usb-FTDI-if00",)
    assert usual_ports(2, here) == ("/dev/ttyACM0", "/dev/ttyACM1")
    assert usual_ports(1, []) == ("/dev/ttyACM0",)


def test_a_model_whose_joints_do_not_move_its_tip_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    joints = "".join(
        f'<joint name="{parent}{child}" type="continuous"><origin xyz="0 0 0.1"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 0 1"/></joint>'
        for parent, child in ("ab", "bc")
    )
    (tmp_path / "spin.urdf").write_text(f'<robot name="spin"><link name="a"/><link name="b"/><link name="c"/>{joints}</robot>')
    out = tmp_path / "arm.toml"
    assert main(["arm", "--from-urdf", str(tmp_path / "spin.urdf"), "--out", str(out)]) == 2
    assert "no joint moves its tip" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(("kind", "joints"), [("feetech", 6), ("dynamixel", 7)])
def test_an_arm_of_smart_servos_has_those_of_a_data_sheet_and_moves_on_the_mock(
    kind: str, joints: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, file = new(tmp_path, "--joints", str(joints), "--boards", kind, "--yes")
    assert status == 0
    assert f"{kind}, by the data sheets: joint 1 " in capsys.readouterr().out
    arm = load_arm(file)
    sheets = {(servo.supply_V, servo.current_A) for servo in SERVOS[kind]}
    assert {(drive.supply_V, drive.current_limit_A) for drive in arm.drives} <= sheets
    assert arm.rest is not None
    with open_cell(load_scenario("demo"), arm=arm, period_s=1.0 / arm.usual_rate_Hz) as cell:
        cell.client.enable()
        target = [angle + 0.2 for angle in arm.rest.q_rad]
        cell.run(cell.start_move(target) + 0.8)
        assert cell.faults == []
        assert np.abs(np.array(cell.rig.joint_rad()) - target).max() < 0.01  # six counts of a servo


@pytest.mark.parametrize("kind", ["feetech", "dynamixel"])
def test_a_model_without_masses_makes_an_arm_of_smart_servos_whose_rotors_nobody_knows(kind: str, tmp_path: Path) -> None:
    bare = re.sub("<inertial>.*?</inertial>", "", chain([(-1.0, 1.0)] * 3, 2.0, 0.1))
    (tmp_path / "bare.urdf").write_text(bare)
    status, file = new(tmp_path, "--from-urdf", str(tmp_path / "bare.urdf"), "--boards", kind, "--yes")
    assert status == 0
    assert all(0.0 < drive.joint_acceleration_limit_rad_s2 < 100.0 for drive in load_arm(file).drives)


def chain(ranges: list[tuple[float, float] | None], effort: float, kg: float) -> str:
    """A URDF of revolute joints with these limits, continuous where there is none, about y and z in turn."""
    parts = ['<robot name="chain"><link name="l0"/>']
    for number, limits in enumerate(ranges, start=1):
        kind = "continuous" if limits is None else "revolute"
        ends = "" if limits is None else f'lower="{limits[0]!r}" upper="{limits[1]!r}" '
        parts.append(
            f'<joint name="j{number}" type="{kind}"><origin xyz="0.02 0 0.15"/><parent link="l{number - 1}"/>'
            f'<child link="l{number}"/><axis xyz="0 {number % 2} {(number + 1) % 2}"/>'
            f'<limit {ends}effort="{effort}" velocity="2.5"/></joint><link name="l{number}"><inertial><mass value="{kg}"/>'
            '<origin xyz="0 0 0.05"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
    return "".join([*parts, "</robot>"])


@pytest.mark.parametrize("kind", third_of(["reference", *KINDS]))
def test_whatever_ranges_a_model_has_what_new_writes_is_read(kind: str, tmp_path: Path) -> None:
    """Ranges from a few milliradians to many turns, on either side of zero; loads from a toy's to an industrial arm's."""
    random = np.random.default_rng(2)
    for number in range(5):
        ranges: list[tuple[float, float] | None] = []
        for _ in range(int(random.integers(2, 8))):
            lower = float(random.uniform(-7.0, 1.0))
            ranges.append(None if random.random() < 0.2 else (lower, lower + float(10.0 ** random.uniform(-2.3, 1.0))))
        model, kg = tmp_path / f"{number}.urdf", float(10.0 ** random.uniform(-2.0, 0.0))
        model.write_text(chain(ranges, float(10.0 ** random.uniform(0.0, 2.0)), kg))
        status, file = new(tmp_path, "--from-urdf", str(model), "--boards", kind, "--yes", name=f"{number}.toml")
        assert status == 0
        arm = load_arm(file)
        for drive, limits in zip(arm.drives, ranges, strict=True):
            assert drive.joint_upper_rad - drive.joint_lower_rad <= arm.unique_rad(drive)
            assert limits is None or limits[0] <= drive.joint_lower_rad < drive.joint_upper_rad <= limits[1]


@pytest.mark.parametrize(("kind", "most_V"), [("roboclaw", 34.0), ("moteus", 44.0), ("reference", 48.0)])
def test_motors_have_a_supply_that_their_boards_bear_and_are_enabled_on_the_mock(
    kind: str, most_V: float, tmp_path: Path
) -> None:
    (tmp_path / "strong.urdf").write_text(chain([(-1.0, 1.0)] * 3, 50.0, 2.0))
    status, file = new(tmp_path, "--from-urdf", str(tmp_path / "strong.urdf"), "--boards", kind, "--yes")
    assert status == 0
    arm = load_arm(file)
    assert max(drive.supply_V for drive in arm.drives) <= most_V
    with open_cell(load_scenario("demo"), arm=arm, period_s=1.0 / arm.usual_rate_Hz) as cell:
        cell.client.enable()
        assert cell.faults == []


def test_a_message_about_a_model_names_its_element_and_not_the_file_that_was_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "heavy.urdf"
    text = export_text(RIGHT, "urdf")
    model.write_text(re.sub(r'<mass value="([^"]+)"', lambda m: f'<mass value="{1e4 * float(m[1])}"', text))
    assert main(["arm", "--from-urdf", str(model), "--out", str(tmp_path / "arm.toml")]) == 2
    said = capsys.readouterr().err
    assert re.search(r"heavy\.urdf, line \d+, link \w+: mass_kg of \[\[link\]\] \d: .* grams.* give --as-given", said)
    assert "arm.toml," not in said
    assert not (tmp_path / "arm.toml").exists()
    assert main(["arm", "--from-urdf", str(model), "--as-given", "--out", str(tmp_path / "arm.toml")]) == 0
    assert load_arm(tmp_path / "arm.toml").as_given


def test_what_it_has_chosen_itself_is_called_a_placeholder_until_the_word_is_taken_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, file = new(tmp_path, "--joints", "4", "--yes")
    arm, payload = load_arm(file), sheet(load_arm(file)).payload
    assert arm.placeholders == ("masses", "motors")
    assert payload is not None
    assert 0.9 * payload.everywhere_kg < arm.limits.payload_limit_kg <= payload.everywhere_kg
    urdf = tmp_path / "mine.urdf"
    urdf.write_text(export_text(arm, "urdf"), encoding="utf-8")
    _, modelled = new(tmp_path, "--from-urdf", str(urdf), "--yes", name="modelled.toml")
    assert load_arm(modelled).placeholders == ("motors",)
    capsys.readouterr()
    assert main(["arm", str(file)]) == 0
    assert "masses and motors: PLACEHOLDERS" in capsys.readouterr().out
    text = file.read_text(encoding="utf-8")
    file.write_text(re.sub("^placeholders.*$", "placeholders = []", text, flags=re.MULTILINE), encoding="utf-8")
    assert main(["arm", str(file)]) == 0
    assert "PLACEHOLDERS" not in capsys.readouterr().out

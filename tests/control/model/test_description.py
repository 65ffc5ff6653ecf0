"""arm.toml is read strictly, its errors say where and what, and what is written is read back exactly."""

import dataclasses
import math
import pickle
import tomllib
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

import control
from control.errors import ArmError, ArmFileError, MissingModel
from control.files import NotWritten
from control.model.arm import Arm, Calibration, Drive, Effect
from control.model.arm_checks import check_arm
from control.model.description import arm_names, load_arm, parse_arm, save_arm
from control.model.reader import Rejected
from tests.places import ARMS, ROOT

RIGHT = resources.files("control.arms").joinpath("right.toml").read_text(encoding="utf-8")
FILE = Path("my_arm.toml")


def _rejected(text: str) -> ArmFileError:
    with pytest.raises(ArmFileError) as caught:
        parse_arm(text, FILE)
    return caught.value


def _edited(old: str, new: str, count: int = 1) -> str:
    assert old in RIGHT
    return RIGHT.replace(old, new, count)


def test_the_package_control_is_ours() -> None:
    assert Path(control.__file__).parent == ROOT / "control"


def test_both_arms_ship_and_differ_only_in_the_mirrored_offset() -> None:
    right, left = load_arm("right"), load_arm("left")
    known = ("koch", "openmanipulatorx", "pincherx100", "reactorx150", "reactorx200", "so100", "so101")
    assert arm_names() == tuple(
        sorted((*known, "left", "right", "viperx300", "viperx300s", "widowx200", "widowx250", "widowx250s"))
    )
    difference = left.dh - right.dh
    assert difference[2, 0] == pytest.approx(0.024)
    assert np.count_nonzero(difference) == 1
    assert dataclasses.replace(left, name="right").with_dh(right.dh) == right


def test_the_right_arm_has_the_geometry_of_the_paper() -> None:
    half = math.pi / 2
    expected = [[0.076, 0, 0, half], [0, half, 0.4, 0], [-0.012, 0, 0, half], [0.3543, 0, 0, half]]
    assert load_arm("right").dh.tolist() == expected
    assert load_arm("right").joints == (True, True, True, False)


def test_the_default_arm_waits_where_it_is_safe() -> None:
    for name in arm_names():
        arm = load_arm(name)
        assert arm.rest is not None
        assert arm.limits.floor_z_m <= 0.0
        for angle, (lower, upper) in zip(arm.rest.q_rad, arm.limits_rad, strict=True):
            assert lower + 0.1 < angle < upper - 0.1


def test_an_index_pulse_of_the_default_arm_lies_half_a_motor_turn_above_its_switch() -> None:
    for drive in load_arm("right").drives:
        assert drive.home is not None
        distance = drive.home.index_rad - drive.home.switch_rad
        assert distance == pytest.approx(math.pi / drive.gear_ratio, abs=1e-6)


def test_an_unknown_name_lists_the_names_that_ship() -> None:
    with pytest.raises(ArmFileError, match=" or ".join(f'"{name}"' for name in arm_names())):
        load_arm("wright")
    with pytest.raises(ArmFileError, match=r"unknown name \(did you mean viperx300s\?\)"):
        load_arm("vx300s")


def test_a_file_that_is_not_there_is_named() -> None:
    with pytest.raises(ArmFileError, match=r"nowhere\.toml.*No such file"):
        load_arm("nowhere.toml")


def test_a_directory_and_a_binary_file_are_no_arm(tmp_path: Path) -> None:
    with pytest.raises(ArmFileError, match="a readable file"):
        load_arm(tmp_path)
    (tmp_path / "x.toml").write_bytes(b'name = "\xff"')
    with pytest.raises(ArmFileError, match="UTF-8"):
        load_arm(tmp_path / "x.toml")


def test_optional_sections_may_be_absent_and_what_needs_them_says_so() -> None:
    panda, pendulum = load_arm(ARMS / "panda.toml"), load_arm(ARMS / "pendulum.toml")
    assert panda.joint_count == 7
    assert panda.dh_convention == "modified"
    assert not panda.tool.known
    assert panda.table is not None
    assert panda.table.cavities_m["hole_1"] == (0.05, 0.0, 0.0)
    assert pendulum.drive(1).joint_upper_rad == math.inf
    assert pendulum.gravity_m_s2 == (9.81, 0.0, 0.0)
    with pytest.raises(MissingModel, match=r"joint 3 has no \[\[drive\]\]"):
        panda.drive(3)


def test_wiring_follows_from_the_joint_number_unless_the_file_says_otherwise() -> None:
    drive = Drive(4, 1.0, 4096, 0.1, 1.0, 12.0)
    assert (drive.encoder_board, drive.encoder_channel, drive.motor_node) == (1, 0, 4)
    assert Drive(1, 1.0, 4096, 0.1, 1.0, 12.0, motor_node=7).motor_node == 7


def test_drives_come_in_the_order_of_the_joints_whatever_the_file_has() -> None:
    text = _edited("[[drive]]\njoint = 1\n", "[[drive]]\njoint = 0\n")
    text = text.replace("joint = 3\n", "joint = 1\n").replace("joint = 0\n", "joint = 3\n")
    assert [drive.joint for drive in parse_arm(text, FILE).drives] == [1, 2, 3]


@pytest.mark.parametrize(
    ("old", "new", "key", "expected", "got"),
    [
        ("d_m = -0.012", 'd_m = "x"', "d_m of [[link]] 3", "a finite number", "'x'"),
        ("joint_upper_rad = 0.8", "joint_upper_rad = 45.8", "joint_upper_rad of [[drive]] 2", "four turns", "45.8"),
        ("switch_rad = 0.1", "switch_rad = 1.1", "home.switch_rad of [[drive]] 2", "within the joint's", "1.1"),
        ("d_m = -0.012", "d_m = nan", "d_m of [[link]] 3", "a finite number", "nan"),
        ("d_m = -0.012", "d_m = true", "d_m of [[link]] 3", "a finite number", "true"),
        ("d_m = -0.012", "d_mm = -12", "d_mm of [[link]] 3", "one of the keys", "an unknown key"),
        ("d_m = -0.012\n", "\n", "d_m of [[link]] 3", "a length", "nothing"),
        ("d_m = -0.012", "d_m = [1]", "d_m of [[link]] 3", "a finite number", "[1]"),
        ("alpha_rad = 0.0", "alpha_rad = 90.0", "alpha_rad of [[link]] 2", "within +-2 pi", "90.0"),
        ("gear_ratio = 120.0", "gear_ratio = 0", "gear_ratio of [[drive]] 2", "a positive", "0"),
        ("gear_ratio = 120.0", "gear_ratio = -1", "gear_ratio of [[drive]] 2", "a positive", "-1"),
        ("joint_upper_rad = 0.8", "joint_upper_rad = -1.9", "joint_upper_rad of [[drive]] 2", "more than", "-1.9"),
        ("joint_upper_rad = 0.8", "joint_upper_rad = inf", "joint_upper_rad of [[drive]] 2", "finite", "inf"),
        ("motor_node = 2", "motor_node = 1", "motor_node of [[drive]] 2", "one joint per motor node", "1 a second"),
        ("motor_node = 2", "motor_node = 16", "motor_node of [[drive]] 2", "1 to 15", "16"),
        ("encoder_channel = 1", "encoder_channel = 0", "encoder_channel of [[drive]] 2", "one joint per", "second"),
        ("encoder_channel = 1", "encoder_channel = 3", "encoder_channel of [[drive]] 2", "0, 1 or 2", "3"),
        ("encoder_channel = 1", "encoder_board = 1", "encoder_board of [[drive]] 2", "below 1", "1"),
        ("joint = 2\n", "joint = 4\n", "joint of [[drive]] 2", "from 1 to 3", "4"),
        ("joint = 2\n", "joint = 1\n", "joint of [[drive]] 2", "one [[drive]] per joint", "1 a second"),
        ("joint = 2\n", "joint = 2.0\n", "joint of [[drive]] 2", "whole number", "2.0"),
        ('mode = "voltage"', 'mode = "torque"', "pid.mode of [[drive]] 1", '"voltage" or', "'torque'"),
        ('joint = "fixed"', 'joint = "prismatic"', "joint of [[link]] 4", '"revolute" or "fixed"', "prismatic"),
        ("[0.50, 0.0, 0.0]", "[0.50, 0.0]", "table.origin_m", "a list of 3", "2 of them"),
        ("[0.50, 0.0, 0.0]", "[0.5, 0.0, nan]", "table.origin_m[3]", "a finite number", "nan"),
        ("origin_m = [0.50, 0.0, 0.0]", "", "table.origin_m", "the board's position", "nothing"),
        ("circle_radius_m = 0.09", "", "table.circle_radius_m", "the circle's radius", "nothing"),
        ("0.20420352248333654", "11.7", "table.roll_tilt_rad", "within +-pi/2", "11.7"),
        ("[0.008, 0.008, 0.0006]", "[0.008, 0.001, 0.001]", "inertia_kg_m2 of [[link]] 3", "principal", "0.008"),
        ("[0.008, 0.008, 0.0006]", "[0.1, -0.1, 0.1]", "inertia_kg_m2[2] of [[link]] 3", "not below 0", "-0.1"),
        ("q_rad = [0.0, 0.15, 0.75]", "q_rad = [0.0, 0.9, 0.75]", "rest.q_rad", "joint 2 within", "0.9"),
        ("q_rad = [0.0, 0.15, 0.75]", "q_rad = [0.0]", "rest.q_rad", "3 joint angles", "1 of them"),
        ("watchdog_s = 0.2", "watchdog_s = 9.0", "limits.watchdog_s", "from 0.005 to 1 s", "9.0"),
        ("following_error_rad = 0.05", "following_error_rad = 100.0", "limits.following_error_rad", "up to 0.5 rad", "100.0"),
        ("stale_s = 0.02", "stale_s = 2.0", "limits.stale_s", "up to 0.5 s", "2.0"),
        ('name = "right"', 'name = "../../up"', "name", "without / and", "'../../up'"),
        ('name = "right"', 'name = ".hidden"', "name", "does not begin with .", "'.hidden'"),
        ("[[link]]", '[[link]]\njoint_name = "joint 2"', "joint_name of [[link]] 1", "not joint N", "'joint 2'"),
        ("[[link]]", '[[link]]\nlink_name = "tip"', "link_name of [[link]] 1", "tip or world", "'tip'"),
        ("[camera]", "[camera]\nlens = 1", "camera.lens", "one of the keys", "an unknown key"),
        ("[camera]", '[camera]\nstream = { system = "vicon" }', "camera.stream.body", "text", "nothing"),
        ("[camera]", '[camera]\nstream = { system = "x", body = "a" }', "camera.stream.system", '"vicon"', "'x'"),
        (
            "[camera]",
            '[camera]\nstream = { system = "vicon", body = "a", base_body = "a" }',
            "camera.stream.base_body",
            "another body",
            '"a"',
        ),
        (
            "[camera]",
            '[camera]\nstream = { system = "vicon", body = "a", orientation = [1.0, 0.0, 0.0, 1.0] }',
            "camera.stream.orientation",
            "unit quaternion",
            "[1.0",
        ),
        ("[can]", "[cam]", "cam", "one of the keys", "an unknown key"),
        ("[[link]]", "[link]", "", "valid TOML", ""),
        ("mass_kg = 0.6", "mass_kg = ", "", "valid TOML", "Invalid value"),
        ('name = "right"', 'name = "right', "", "valid TOML", ""),
    ],
)
def test_an_error_names_line_key_expected_and_got(old: str, new: str, key: str, expected: str, got: str) -> None:
    text = _edited(old, new)
    error = _rejected(text)
    assert error.key == key
    assert expected in error.expected
    assert got in error.got
    assert error.line is not None
    assert str(error).startswith(f"my_arm.toml, line {error.line}: ")


def test_the_line_is_the_one_that_is_wrong() -> None:
    text = _edited("gear_ratio = 120.0", "gear_ratio = -120.0")
    assert _rejected(text).line == text[: text.index("-120.0")].count("\n") + 1


def test_a_syntax_error_at_the_end_names_the_last_line() -> None:
    assert _rejected('name = "x"\nlist = [1,\n').line == 3


def test_a_near_miss_is_suggested_and_degrees_are_guessed() -> None:
    assert "did you mean gear_ratio?" in str(_rejected(_edited("gear_ratio = 120", "gear_rato = 120")))
    assert "looks like degrees" in str(_rejected(_edited("alpha_rad = 0.0", "alpha_rad = 90.0")))


def test_a_table_in_place_of_a_list_of_tables_gets_the_remedy() -> None:
    error = _rejected('name = "x"\n[link]\njoint = "revolute"\n')
    assert "[[...]]" in str(error)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "a name"),
        ('name = "x"', "a list"),
        ('name = "x"\nlink = []', "at least one [[link]]"),
        ('name = "x"\n[[link]]\njoint = "fixed"\nd_m=0\ntheta_rad=0\nL_m=0\nalpha_rad=0', 'joint = "revolute"'),
    ],
)
def test_an_arm_needs_a_name_and_a_joint(text: str, expected: str) -> None:
    assert expected in _rejected(text).expected


EFFECT = '\n[[effect]]\neffect = "{}"\n{}\n'


@pytest.mark.parametrize(
    ("name", "rest", "key", "expected"),
    [
        ("friction", "", "effect", "one of link_geometry"),
        ("backlash", "parameters = { width_rad = 0.01 }", "joint", "the joint of the effect"),
        ("backlash", "joint = 4\nparameters = { width_rad = 0.01 }", "joint", "a joint from 1 to 3"),
        ("backlash", "joint = 1", "parameters", "width_rad of the effect backlash"),
        ("backlash", "joint = 1\nparameters = { width_rad = -0.1 }", "parameters.width_rad", "not below 0"),
        ("backlash", "joint = 1\nparameters = { width_mm = 1 }", "parameters", "width_rad"),
        ("backlash", 'joint = 1\nparameters = { width_rad = "a" }', "parameters.width_rad", "a finite"),
        ("link_flexure", "joint = 1\nparameters = { EI_Nm2 = 0 }", "parameters.EI_Nm2", "a positive number"),
        ("belt_coupling", "joint = 3\nparameters = { ratio = 0.5 }", "joint", "no joint"),
        ("link_flexure", "joint = 5\nparameters = { EI_Nm2 = 1 }", "joint", "a link from 1 to 4"),
        ("link_geometry", "parameters = { link5_d_m = 0.1 }", "parameters.link5_d_m", "a link from 1 to 4"),
        ("link_geometry", "parameters = { link1_q_m = 0.1 }", "parameters.link1_q_m", "link<i>_d_m"),
        ("link_inertia", "joint = 1\nparameters = { }", "parameters", "exactly one"),
        ("cogging", "joint = 1\nparameters = { amplitude_Nm = 1, order = 7, phase_rad = 0, x = 1 }", "parameters.x", "one of"),
    ],
)
def test_an_effect_that_formats_md_does_not_know_is_rejected(name: str, rest: str, key: str, expected: str) -> None:
    error = _rejected(RIGHT + EFFECT.format(name, rest))
    assert error.key == f"{key} of [[effect]] 1"
    assert expected in error.expected


def test_effects_are_read_and_each_may_stand_once_a_joint() -> None:
    text = RIGHT + EFFECT.format("backlash", "joint = 1\nparameters = { width_rad = 0.01 }")
    assert parse_arm(text, FILE).effects == (Effect("backlash", 1, {"width_rad": 0.01}),)
    twice = text + EFFECT.format("backlash", "joint = 1\nparameters = { width_rad = 0.02 }")
    assert "each effect once" in _rejected(twice).expected
    thermal = EFFECT.format("thermal_drift", "parameters = { final_rad = 0.01, time_constant_s = 60 }")
    assert parse_arm(RIGHT + thermal, FILE).effects[0].joint is None


def _calibrated() -> tuple[Calibration, np.ndarray]:
    seeded = np.random.default_rng(3)
    dh = load_arm("right").dh + seeded.normal(0.0, 1e-3, (4, 4))
    made = Calibration("right.toml", {"points.csv": "0" * 64}, "2026-01-01", "E2", "0.1.0")
    return made, dh


def test_a_saved_arm_is_read_back_exactly(tmp_path: Path) -> None:
    made, dh = _calibrated()
    effects = (Effect("belt_coupling", None, {"ratio": 0.1 + 0.2}), Effect("backlash", 2, {"width_rad": 1e-3}))
    arm = dataclasses.replace(load_arm("right").with_dh(dh), calibration=made, effects=effects)
    save_arm(arm, tmp_path / "new.toml")
    again = load_arm(tmp_path / "new.toml")
    assert again == arm
    assert again.dh.tobytes() == dh.tobytes()
    assert again.path == tmp_path / "new.toml"


@pytest.mark.parametrize("name", ["panda.toml", "pendulum.toml"])
def test_arms_with_few_sections_survive_a_round_trip(name: str, tmp_path: Path) -> None:
    arm = load_arm(ARMS / name)
    save_arm(arm, tmp_path / name)
    assert load_arm(tmp_path / name) == arm


def test_a_calibrated_arm_says_where_it_comes_from(tmp_path: Path) -> None:
    made, dh = _calibrated()
    save_arm(dataclasses.replace(load_arm("right").with_dh(dh), calibration=made), tmp_path / "c.toml")
    table = tomllib.loads((tmp_path / "c.toml").read_text())["calibration"]
    assert table["from"] == "right.toml"
    assert table["inputs"] == {"points.csv": "0" * 64}


def test_saving_never_overwrites(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text("mine")
    with pytest.raises(ArmFileError, match="never overwritten"):
        save_arm(load_arm("right"), path)
    assert path.read_text() == "mine"
    with pytest.raises(NotWritten, match=r"not written: .*choose another place"):
        save_arm(load_arm("right"), path / "arm.toml")
    save_arm(load_arm("right"), tmp_path / "new" / "arm.toml")
    assert load_arm(tmp_path / "new" / "arm.toml") == load_arm("right")


def test_with_dh_takes_only_a_finite_table_of_the_right_shape() -> None:
    arm = load_arm("right")
    for bad in (np.zeros((3, 4)), np.full((4, 4), np.nan)):
        with pytest.raises(ArmError, match="expected a finite DH table"):
            arm.with_dh(bad)
    assert not arm.dh.flags.writeable


def test_an_arm_can_be_sent_to_another_process() -> None:
    arm = load_arm("right")
    assert pickle.loads(pickle.dumps(arm)) == arm


def test_a_counter_too_narrow_for_the_count_at_its_index_is_refused() -> None:
    """Homing would set it to a count that it cannot hold: the joint would be wrong by whole turns of the counter."""
    arm = load_arm("right")

    def narrow(bits: int) -> Arm:
        drives = (dataclasses.replace(drive, encoder_bits=bits) for drive in arm.drives)
        return dataclasses.replace(arm, drives=tuple(drives))

    check_arm(narrow(16))
    with pytest.raises(Rejected, match=r"encoder_bits.*a counter that holds 23840 \+- 4096 counts"):
        check_arm(narrow(15))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[tolerances.link.9]\nL_m = { sd = 1e-3 }", "link.9: expected a number from 1 to 4"),
        ("[tolerances.every_link]\nL_m = { sd = 1e-3, within = 1e-3 }", "every_link.L_m: expected one of { within }, { sd }"),
        ("[tolerances.every_link]\nL_m = { sd = 0.0 }", "every_link.L_m: expected a deviation above 0"),
        (
            "[tolerances.every_joint]\nencoder_zero_rad = { within = 0.0 }",
            "every_joint.encoder_zero_rad: expected a deviation above 0",
        ),
        ("[tolerances.every_joint]\nbacklash_rad = { sd = 1e-3 }", "every_joint.backlash_rad: expected no value below 0"),
        ("[tolerances]\nabout = [[0.0, 0.0, 0.4, 0.0]]", "about: expected a row for each of the 4 links"),
    ],
)
def test_a_tolerance_that_no_part_can_have_is_refused(text: str, said: str) -> None:
    assert said in str(_rejected(f"{RIGHT}\n{text}\n"))

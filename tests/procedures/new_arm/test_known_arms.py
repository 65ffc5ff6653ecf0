"""The arms that people own: `new --like` makes each of them, it is well and moves on the mock; servos by their data sheets."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from armwright import CalibrationError, calibrate, make_points
from console.main import main
from control.errors import ArmFileError
from control.kinematics.kinematics import Corners, ForwardKinematics
from control.model.arm import Arm
from control.model.description import arm_names, arm_text, load_arm, parse_arm, save_arm
from control.model.drive import SERVOS
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import Scenario, Start, load_scenario
from procedures.arm_sheet import sheet, warnings
from procedures.doctor.boards import open_boards, sample
from procedures.doctor.finding import Level, as_text, worst
from procedures.doctor.judging import judge
from tests.cell import holding_cell, open_cell, wired_to
from tests.procedures.bringup.test_bought import SURVEY, brought
from tests.procedures.bringup.test_bringup import said_of
from tests.thirds import third_of

OWNED = tuple(name for name in arm_names() if load_arm(name).boards)
SEEN_rad = 0.01  # six counts of a servo
# Of arms whose upper arm stands upright at zero; the others' is at the middle of its range there.
STRETCHED_rad = {
    **dict.fromkeys(("openmanipulatorx", "pincherx100"), (0.0, 0.6, -0.6, 0.3)),
    **dict.fromkeys(("reactorx150", "reactorx200", "viperx300", "widowx200", "widowx250"), (0.0, 0.8, -0.8, 0.3, 0.0)),
    **dict.fromkeys(("viperx300s", "widowx250s"), (0.0, 0.8, -0.8, 0.0, 0.3, 0.0)),
}


def test_every_servo_arm_that_is_known_is_tried_here() -> None:
    assert set(OWNED) >= {"koch", "so100", "so101", *STRETCHED_rad}


@pytest.mark.parametrize("name", third_of(OWNED, 1))
def test_a_known_arm_is_well_moves_and_is_let_go_on_the_mock(name: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    assert main(["new", "--like", name, "--out", str(file)]) == 0
    arm = load_arm(file)
    assert arm.rest is not None
    figures = sheet(arm)
    assert list(warnings(figures)) == []
    assert figures.payload is not None
    assert 0.0 < figures.payload.moving_kg < figures.payload.everywhere_kg
    period_s = 1.0 / arm.usual_rate_Hz
    with open_cell(load_scenario("demo"), arm=arm, period_s=period_s) as cell:
        cell.client.enable()
        target = [angle + 0.2 for angle in arm.rest.q_rad]
        cell.run(cell.start_move(target) + 0.8)
        assert cell.faults == []
        assert np.abs(np.array(cell.rig.joint_rad()) - target).max() < SEEN_rad
        cell.client.off()
        cell.until(lambda: not any(cell.torques()), 1.0)


@pytest.mark.parametrize("name", third_of(OWNED, 2))
def test_the_doctor_finds_a_known_arm_well(name: str) -> None:
    arm = load_arm(name)
    period_s = 1.0 / arm.usual_rate_Hz
    with SteppedRig(arm, load_scenario("ideal")) as rig:
        wired = wired_to(arm, rig)
        boards = open_boards(wired, rig.clock, period_s)
        findings = [*boards.findings, *judge(sample(boards, rig.clock, period_s, 0.2), wired)]
        boards.close()
    assert worst(findings) is Level.OK, as_text(findings)


def test_the_doctor_names_joints_by_their_drives_where_arm_toml_lacks_one() -> None:
    arm = load_arm(OWNED[0])
    period_s = 1.0 / arm.usual_rate_Hz
    with SteppedRig(arm, load_scenario("ideal")) as rig:
        wired = wired_to(arm, rig)
        boards = open_boards(dataclasses.replace(wired, drives=wired.drives[1:]), rig.clock, period_s)
        boards.close()
    timed = {finding.what.split(":")[0] for finding in boards.findings if "answers with its counts" in finding.what}
    assert timed >= {f"joint {drive.joint}" for drive in arm.drives[1:]}
    assert "joint 1" not in timed
    assert "gripper" in timed
    assert f"joint {arm.joint_count + 1}" not in timed


def test_what_the_runtime_says_of_a_joint_has_its_number_and_its_name() -> None:
    arm = load_arm("viperx300s")
    q_rad = (0.0, arm.drives[1].joint_upper_rad - 0.01, *[0.0] * 4)
    with holding_cell(Scenario(start=Start(q_rad=q_rad)), arm, period_s=1.0 / arm.usual_rate_Hz) as cell:
        [warning] = [text for text in cell.client.status()["warnings"] if "end of its range" in text]
    assert warning.startswith("joint 2 (shoulder) is 0.0")


@pytest.mark.parametrize("name", OWNED)
def test_a_known_arm_rests_above_the_floor_and_its_range_is_within_a_turn_of_its_servos(name: str) -> None:
    arm = load_arm(name)
    assert arm.rest is not None
    assert min(float(corner[2, 0]) for corner in Corners(arm).batch(np.array([arm.rest.q_rad]))) >= 0.0
    for drive in arm.drives:
        servo = SERVOS[drive.servo]
        assert drive.joint_upper_rad - drive.joint_lower_rad < 2.0 * math.pi
        assert servo.kind == {board.name: board.kind for board in arm.boards}[drive.board]
        assert drive.joint_speed_limit_rad_s < (servo.free_rad_s or math.inf)


def test_a_servo_gives_the_values_of_its_data_sheet_and_the_file_may_say_others(tmp_path: Path) -> None:
    arm = load_arm("koch")
    shoulder, elbow = arm.drives[1], arm.drives[2]
    assert (shoulder.supply_V, elbow.supply_V) == (12.0, 5.0)
    assert shoulder.torque_constant_Nm_A * shoulder.current_limit_A == pytest.approx(1.5)  # N m, stalled
    assert shoulder.supply_V / shoulder.resistance_ohm == pytest.approx(1.4)  # A, stalled
    measured = dataclasses.replace(elbow, torque_constant_Nm_A=0.31)
    drives = (*arm.drives[:2], measured, *arm.drives[3:])
    save_arm(dataclasses.replace(arm, drives=drives), tmp_path / "mine.toml")
    assert load_arm(tmp_path / "mine.toml").drives == drives
    text = arm_text(arm)
    assert text.count("torque_constant_Nm_A") == text.count("resistance_ohm") == 0
    assert parse_arm(text.replace("XL330-M288", "XM430-W350"), Path("other.toml")).drives[2].supply_V == 12.0


def found_bad(built: Arm, believed: Arm, level: Level = Level.BAD) -> str:
    """What the doctor finds bad, or worth a warning, of boards that are those of another arm than the file says."""
    period_s = 1.0 / believed.usual_rate_Hz
    with SteppedRig(built, load_scenario("ideal")) as rig:
        boards = open_boards(wired_to(believed, rig), rig.clock, period_s)
        boards.close()
    return "\n".join(f"{finding.what}: {finding.measured}" for finding in boards.findings if finding.level is level)


def test_servos_whose_ids_are_in_another_order_are_named_where_their_types_differ() -> None:
    koch = load_arm("koch")
    turned = [dataclasses.replace(board, address=7 - board.address) for board in koch.boards]
    said = found_bad(dataclasses.replace(koch, boards=tuple(turned)), koch)
    assert '"shoulder_pan" (id 1)' in said
    assert "expected XL430-W250, as arm.toml has it there, it is XL330-M288: are the ids in another order?" in said


def test_servos_of_another_voltage_are_named_before_they_are_driven() -> None:
    owned = load_arm("so101")
    text = arm_text(owned).replace("STS3215-12V", "STS3215-7.4V")
    weak = parse_arm(text, Path("weak.toml"))
    assert weak.drives[0].supply_V == 7.4
    assert "expected a servo for 12 V, as arm.toml has it, what is stored in it allows 4.0 to 8.6 V" in found_bad(weak, owned)
    assert found_bad(weak, weak) == ""
    assert found_bad(owned, weak).startswith("joint 1: supply: 12.0 V")


def test_a_middle_that_is_not_at_its_zero_count_is_told_where_the_joint_then_reads_outside_its_range() -> None:
    owned = load_arm("so101")
    unset = dataclasses.replace(owned.drives[1], zero_count=owned.drives[1].zero_count + 1700)  # as it was screwed on
    built = dataclasses.replace(owned, drives=(owned.drives[0], unset, *owned.drives[2:]))
    assert found_bad(built, owned, Level.WARN) == "joint 2: where it stands: 2.207 rad"
    assert found_bad(owned, owned, Level.WARN) == ""


def test_bringup_finds_servos_of_one_type_whose_ids_are_in_another_order(tmp_path: Path) -> None:
    draft = load_arm("so101")
    first, second, *rest = draft.boards
    swapped = (dataclasses.replace(first, address=second.address), dataclasses.replace(second, address=first.address), *rest)
    outcome, _ = brought(tmp_path, draft, SURVEY, real=dataclasses.replace(draft, boards=swapped))
    sentences = said_of(outcome)
    assert 'joint 1: SWAPPED MOTOR: board "shoulder_lift" (output 1) moves it' in sentences
    assert 'joint 2: SWAPPED MOTOR: board "shoulder_pan" (output 1) moves it' in sentences


@pytest.mark.parametrize(("joint", "teeth"), [(2, 1), pytest.param(3, -1, marks=pytest.mark.nightly)])
def test_a_horn_on_another_tooth_is_told_before_points_are_fitted(joint: int, teeth: int) -> None:
    arm, random = load_arm("so101"), np.random.default_rng(joint)
    tooth_rad = teeth * 2.0 * math.pi / 25
    lower, upper = np.array(arm.limits_rad).T
    q_rad = 0.5 * (lower + upper) + 0.4 * (upper - lower) * random.uniform(-1.0, 1.0, (40, 5))
    dh = arm.dh + random.uniform(-1.0, 1.0, arm.dh.shape) * (0.001, 0.01, 0.001, 0.01)
    standing = q_rad.copy()
    standing[:, joint - 1] += tooth_rad
    tips = ForwardKinematics(arm.with_dh(dh)).tips(standing) + random.normal(0.0, 5e-4, (40, 3))
    zero_count = 2048 - round(tooth_rad * 4096 / (2.0 * math.pi))
    with pytest.raises(
        CalibrationError, match=rf"horn is on another tooth: turn it by one, or set its zero_count to {zero_count}"
    ):
        calibrate(arm, make_points(q_rad, tips))
    drive = dataclasses.replace(arm.drives[joint - 1], zero_count=zero_count)
    drives = (*arm.drives[: joint - 1], drive, *arm.drives[joint:])
    calibrate(dataclasses.replace(arm, drives=drives), make_points(standing, tips))


def test_two_servos_of_a_joint_are_one_motor_of_their_summed_current() -> None:
    one, two = load_arm("widowx250").drives[:2]
    assert (one.servos, two.servos) == (1, 2)
    assert two.torque_constant_Nm_A == one.torque_constant_Nm_A
    assert two.supply_V / two.resistance_ohm == pytest.approx(2.0 * one.supply_V / one.resistance_ohm)
    assert two.current_limit_A == 2.0 * one.current_limit_A


@pytest.mark.parametrize("name", third_of(OWNED))
def test_the_current_of_every_servo_holds_the_arm(name: str) -> None:
    """Measured or reckoned, of one servo or of two: the torque of what is reported is that of the motors."""
    arm = load_arm(name)
    assert arm.rest is not None
    stretched = STRETCHED_rad.get(name, (0.0, 0.4, 0.1, 0.1, 0.0))
    with open_cell(load_scenario("ideal"), arm=arm, period_s=1.0 / arm.usual_rate_Hz) as cell:
        cell.client.enable()
        cell.run(cell.start_move(stretched) + 2.0)
        current_A = cell.connection.hardware.feedback.current_A
        true = cell.rig.robot.plant.bridges.currents_A()
    assert max(map(abs, true)) > 0.1
    for joint, drive in enumerate(arm.drives):
        assert current_A[joint] == pytest.approx(true[joint], abs=0.02 * drive.current_limit_A)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('servo = "XL330-M288"', 'servo = "XL331"', 'expected "XL330-M288" or "XL430-W250" or'),
        ('servo = "XL330-M288"', "servo = 330", "got 330"),
        ('servo = "XL330-M288"', 'servo = "STS3215-12V"', 'the servo of a board of kind "feetech"'),
        ('servo = "XL430-W250"', 'servo = "XL430-W250"\nservos = 0', "servos of [[drive]] 1: expected"),
    ],
)
def test_a_servo_that_cannot_be_is_refused_with_its_line(old: str, new: str, said: str) -> None:
    text = arm_text(load_arm("koch")).replace(old, new, 1)
    with pytest.raises(ArmFileError) as refused:
        parse_arm(text, Path("mine.toml"))
    assert said in str(refused.value)
    assert str(refused.value).startswith("mine.toml, line ")


@pytest.mark.parametrize("spelled", ["so-101", "SO101", "Widow_X 250"])
def test_a_known_arm_is_found_as_people_spell_it(spelled: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    assert main(["new", "--like", spelled, "--out", str(file)]) == 0
    known = "so101" if "101" in spelled else "widowx250"
    assert load_arm(file).links == load_arm(known).links

"""LeRobot's calibration: its zeros and ranges in arm.toml, and identified zeros in its own file."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import msgspec
import pytest

from calib.arm_import.lerobot import LeRobotMotor, given_back, read_calibration, taken_over
from calib.errors import ImportedModelError
from console.main import main
from control.model.arm import Arm
from control.model.description import arm_names, load_arm
from control.model.drive import JointMap
from tests.cell import with_drive

SO101 = load_arm("so101")
MIDDLES = {
    "shoulder_pan": 2010,
    "shoulder_lift": 2100,
    "elbow_flex": 1990,
    "wrist_flex": 2048,
    "wrist_roll": 2047.5,
    "gripper": 2500,
}
MOTORS = {
    name: LeRobotMotor(number, 0, 37 * number, math.ceil(middle) - 1000, math.floor(middle) + 1000)
    for number, (name, middle) in enumerate(MIDDLES.items(), 1)
}


def degrees_by_lerobot(position: float, motor: LeRobotMotor) -> float:
    """As the MotorsBus of LeRobot does it."""
    return (position - (motor.range_min + motor.range_max) / 2.0) * 360.0 / 4095.0


def angles_rad(arm: Arm, positions: list[int]) -> list[float]:
    return [JointMap(drive).radians(count) for drive, count in zip(arm.drives, positions, strict=True)]


def test_angles_are_those_of_lerobot_and_ranges_are_within_both() -> None:
    arm, notes = taken_over(SO101, MOTORS)
    positions = [1500, 2600, 1700, 2048, 2900]
    by_lerobot = [math.radians(degrees_by_lerobot(at, motor)) for at, motor in zip(positions, MOTORS.values(), strict=False)]
    assert angles_rad(arm, positions) == pytest.approx(by_lerobot, rel=3e-4, abs=1.5e-3)  # half a count
    for drive, before in zip(arm.drives, SO101.drives, strict=True):
        assert drive.joint_upper_rad == pytest.approx(min(before.joint_upper_rad, 1000 * 2.0 * math.pi / 4096), abs=2e-3)
    assert notes[0] == "shoulder_pan: zero at count 2010, -1.534 to 1.534 rad"


def test_identified_zeros_are_those_of_the_generic_arm_in_lerobots_file() -> None:
    arm, _ = taken_over(SO101, MOTORS)
    shifts = [0.02, -0.05, 0.1, 0.0, -0.03]
    turning = iter(shifts)
    links = tuple(
        dataclasses.replace(link, theta_rad=link.theta_rad + next(turning)) if link.joint == "revolute" else link
        for link in arm.links
    )
    calibrated = dataclasses.replace(arm, links=links)
    motors, notes = given_back(calibrated, MOTORS, SO101)
    positions = [1600, 2500, 1800, 2100, 2300]
    ours = [q + shift for q, shift in zip(angles_rad(calibrated, positions), shifts, strict=True)]  # as the generic arm has them
    theirs = [math.radians(degrees_by_lerobot(at, motor)) for at, motor in zip(positions, motors.values(), strict=False)]
    assert theirs == pytest.approx(ours, rel=3e-4, abs=1.5e-3)
    assert motors["gripper"] == MOTORS["gripper"]
    assert [motor.homing_offset for motor in motors.values()] == [motor.homing_offset for motor in MOTORS.values()]
    assert notes[2] == "elbow_flex: zero moved by +0.1000 rad; 0.20 rad of its travel are left out"
    again, _ = given_back(arm, MOTORS, arm)
    assert all(abs(again[name].range_min - motor.range_min) <= 1 for name, motor in MOTORS.items())


def test_what_does_not_fit_is_said(tmp_path: Path) -> None:
    with pytest.raises(ImportedModelError, match="joint 1 is servo 1; the calibration has 6"):
        taken_over(SO101, {"gripper": MOTORS["gripper"]})
    with pytest.raises(ImportedModelError, match="joint 1 is servo 1; the calibration has no servo"):
        taken_over(SO101, {})
    with pytest.raises(ImportedModelError, match="joint 1 is on no smart servo"):
        taken_over(load_arm("right"), MOTORS)
    with pytest.raises(ImportedModelError, match="arm right is another arm than so101: arms so101 and right have other rows"):
        given_back(SO101, MOTORS, load_arm("right"))
    with pytest.raises(ImportedModelError, match="each of its 5 joints, it has 0"):
        taken_over(dataclasses.replace(SO101, drives=()), MOTORS)
    with pytest.raises(ImportedModelError, match=r"shoulder_pan: its range, .* has nothing of"):
        taken_over(with_drive(SO101, 1, joint_lower_rad=1.7), MOTORS)
    for other in ({"gear_ratio": 0.5}, {"encoder_counts_per_rev": 1024}):
        with pytest.raises(ImportedModelError, match="joint 1 is geared or has another encoder"):
            given_back(with_drive(SO101, 1, **other), MOTORS, SO101)
    file = tmp_path / "follower.json"
    for text, said in (
        ("{", "expected a calibration of LeRobot"),
        (b"\x00\xff", "expected a calibration of LeRobot"),
        (b'{"\xff": 1}', "expected a calibration of LeRobot"),
        ('{"a": {"id": 1, "x": ' + "[" * 200_000, "expected a calibration of LeRobot"),
        ('{"a": {"id": 1}}', "missing required field `drive_mode`"),
        (
            json.dumps({"a": {"id": 1, "drive_mode": 0, "homing_offset": 0, "range_min": 9, "range_max": 9}}),
            "range_max above 9, got 9",
        ),
        (
            json.dumps({name: {**msgspec.to_builtins(MOTORS["gripper"]), "id": 1} for name in ("a", "b")}),
            "b: expected an id of its own, got 1, which a has",
        ),
    ):
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(ImportedModelError, match=said):
            read_calibration(file)


def test_the_commands_take_it_over_and_give_it_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    theirs, arm, back = tmp_path / "follower.json", tmp_path / "arm.toml", tmp_path / "new.json"
    theirs.write_text(
        json.dumps({name: {key: getattr(motor, key) for key in LeRobotMotor.__struct_fields__} for name, motor in MOTORS.items()})
    )
    assert main(["new", "--like", "so101", "--name", "mine", "--ports", "/dev/ttyUSB3", "--out", str(tmp_path / "new.toml")]) == 0
    assert main(["arm", str(tmp_path / "new.toml"), "--lerobot", str(theirs), "--out", str(arm)]) == 0
    assert load_arm(arm).drives[0].zero_count == 2010
    assert {board.port for board in load_arm(arm).boards} == {"/dev/ttyUSB3"}
    export = ["export-arm", "--arm", str(arm), "--export", "lerobot", "--out", str(back)]
    assert main(export) == 2
    assert "give the arm's present calibration with --lerobot" in capsys.readouterr().err
    assert main([*export, "--lerobot", str(theirs), "--generic", "so101"]) == 0
    assert read_calibration(back).keys() == MOTORS.keys()
    assert main([*export, "--lerobot", str(theirs)]) == 2
    assert "is not overwritten" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--like", "so99"], f'or "{arm_names()[-1]}", got an unknown name'),
        (["--like", "so101", "--joints", "3"], "copies a whole arm: leave --joints out"),
        (["--like", "so101", "--ports", "a", "b"], "expected 1, as so101 has"),
        (["--like", "so101", "--name", r"a\1"], "name: expected a name of 1 to 64 characters"),
    ],
)
def test_an_arm_like_another_is_that_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], said: str) -> None:
    out = tmp_path / "mine.toml"
    assert main(["new", *more, "--out", str(out)]) == 2
    assert said in capsys.readouterr().err
    assert not out.exists()


def test_quotes_of_names_and_ports_are_part_of_them(tmp_path: Path) -> None:
    out, name, port = tmp_path / "mine.toml", 'my "best" arm', r"\\.\COM9"
    assert main(["new", "--like", "so101", "--name", name, "--ports", port, "--out", str(out)]) == 0
    arm = load_arm(out)
    assert (arm.name, {board.port for board in arm.boards}) == (name, {port})

"""LeRobot's calibration of a servo arm, taken over and given back: zeros and ranges of its joints.

LeRobot keeps a JSON file for each arm: by motor its id, the offset that is stored in the servo, and the least and the greatest
position that the joint was moved to. An angle in degrees is (position - middle) 360 / 4095, with the middle of that range as zero
(its MotorsBus, github.com/huggingface/lerobot at 7427f318). Here a turn has 4096 counts, so its angles are 0.024 % larger.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final

import msgspec

from calib.arm_problem.parallel_axes import in_the_same_rows
from calib.errors import ImportedModelError
from control.errors import ArmError
from control.files import read_bytes
from control.model.arm import Arm, Drive
from control.model.drive import JointMap

COUNTS: Final = 4096  # a turn of an STS, X and XL servo
WORTH_SAYING_rad: Final = 0.02
Position = Annotated[int, msgspec.Meta(ge=0, le=COUNTS - 1)]


class LeRobotMotor(msgspec.Struct):
    """One motor of the file, with LeRobot's keys."""

    id: int
    drive_mode: int
    homing_offset: int
    range_min: Position
    range_max: Position


def read_calibration(path: Path) -> dict[str, LeRobotMotor]:
    """The motors by name. ImportedModelError if it is no such file."""
    try:
        motors = msgspec.json.decode(read_bytes(path), type=dict[str, LeRobotMotor])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ImportedModelError(f"{path}: expected a calibration of LeRobot (JSON, a motor a key): {error}") from None
    named: dict[int, str] = {}
    for name, motor in motors.items():
        if (other := named.setdefault(motor.id, name)) != name:
            raise ImportedModelError(f"{path}: {name}: expected an id of its own, got {motor.id}, which {other} has")
        if motor.range_max <= motor.range_min:
            raise ImportedModelError(f"{path}: {name}: expected range_max above {motor.range_min}, got {motor.range_max}")
    return motors


def taken_over(arm: Arm, motors: Mapping[str, LeRobotMotor]) -> tuple[Arm, tuple[str, ...]]:
    """The arm with LeRobot's zeros, its ranges within LeRobot's; and a sentence a joint. Motors are found by their ids."""
    drives, notes = [], []
    for drive, name in _named_drives(arm):
        motor = _motor_of(arm, drive, motors)
        zero = round(0.5 * (motor.range_min + motor.range_max))
        ends = sorted(drive.encoder_direction * (end - zero) / _counts_per_rad() for end in (motor.range_min, motor.range_max))
        lower, upper = max(drive.joint_lower_rad, ends[0]), min(drive.joint_upper_rad, ends[1])
        if lower >= upper:
            raise ImportedModelError(
                f"{name}: its range, {drive.joint_lower_rad:.3f} to {drive.joint_upper_rad:.3f} rad, has nothing of LeRobot's,"
                f" {ends[0]:.3f} to {ends[1]:.3f} rad"
            )
        drives.append(dataclasses.replace(drive, zero_count=zero, joint_lower_rad=lower, joint_upper_rad=upper))
        notes.append(f"{name}: zero at count {zero}, {lower:.3f} to {upper:.3f} rad")
    return dataclasses.replace(arm, drives=tuple(drives)), tuple(notes)


def given_back(arm: Arm, motors: Mapping[str, LeRobotMotor], generic: Arm) -> tuple[dict[str, LeRobotMotor], tuple[str, ...]]:
    """The calibration with which LeRobot's angles are those of the `generic` arm, as far as zeros can do it; and what it costs.

    A joint whose theta was identified stands elsewhere than the generic arm has it: its zero moves by that. LeRobot has its zero
    in the middle of a range, so the range loses what lies further out on one side. Motors that are no joint stay.
    """
    adapted, notes = dict(motors), []
    names = {motor.id: name for name, motor in motors.items()}
    try:
        both = zip(*(one.links for one in in_the_same_rows(arm, generic)), strict=True)
    except ArmError as problem:
        raise ImportedModelError(f"arm {generic.name} is another arm than {arm.name}: {problem}") from None
    moved = [link.theta_rad - other.theta_rad for link, other in both if link.joint == "revolute"]
    for (drive, called), shift_rad in zip(_named_drives(arm), moved, strict=True):
        motor, counts = _motor_of(arm, drive, motors), _counts_per_rad()
        zero = drive.zero_count - drive.encoder_direction * shift_rad * counts
        ends_rad = (drive.joint_lower_rad + shift_rad, drive.joint_upper_rad + shift_rad)
        reach = min(counts * -ends_rad[0], counts * ends_rad[1], zero, COUNTS - 1 - zero)
        if reach < 1.0:
            raise ImportedModelError(f"{called}: its range does not contain the zero that LeRobot would have")
        low = math.ceil(zero - reach)
        adapted[names[motor.id]] = msgspec.structs.replace(motor, range_min=low, range_max=round(2.0 * zero) - low)
        lost_rad = max(-ends_rad[0], ends_rad[1]) - reach / counts
        cost = f"; {lost_rad:.2f} rad of its travel are left out" if lost_rad > WORTH_SAYING_rad else ""
        notes.append(f"{called}: zero moved by {shift_rad:+.4f} rad{cost}")
    return adapted, tuple(notes)


def _counts_per_rad() -> float:
    return COUNTS / (2.0 * math.pi)


def _named_drives(arm: Arm) -> list[tuple[Drive, str]]:
    """Each joint's drive, and what the joint is called. ImportedModelError if one has none."""
    if len(arm.drives) < arm.joint_count:
        raise ImportedModelError(
            f"arm {arm.name}: expected a [[drive]] for each of its {arm.joint_count} joints, it has {len(arm.drives)}"
        )
    return list(zip(arm.drives, arm.joint_names, strict=True))


def _motor_of(arm: Arm, drive: Drive, motors: Mapping[str, LeRobotMotor]) -> LeRobotMotor:
    board = arm.board(drive)
    if board is None or not arm.kind_of(drive).is_absolute:
        raise ImportedModelError(
            f"arm {arm.name}: joint {drive.joint} is on no smart servo, which LeRobot's calibration is about"
        )
    if not math.isclose(abs(JointMap(drive).counts_per_radian), _counts_per_rad()):
        raise ImportedModelError(
            f"arm {arm.name}: joint {drive.joint} is geared or has another encoder: expected {COUNTS} counts a turn of it, as"
            " LeRobot counts"
        )
    by_id = {motor.id: motor for motor in motors.values()}
    if board.address not in by_id:
        ids = ", ".join(map(str, sorted(by_id))) or "no servo"
        raise ImportedModelError(f"arm {arm.name}: joint {drive.joint} is servo {board.address}; the calibration has {ids}")
    return by_id[board.address]

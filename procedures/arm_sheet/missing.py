"""What an arm.toml lacks, and which commands that keeps from working."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from control.dynamics.dynamics import Dynamics
from control.errors import MissingModel
from control.model.arm import Arm, Drive


@dataclass(frozen=True, slots=True)
class Missing:
    """Something that is not in the file, and what is not possible without it."""

    what: str
    needed_for: str


def missing(arm: Arm) -> tuple[Missing, ...]:
    """Everything that is missing, the most needed first."""
    return tuple(_found(arm))


def _found(arm: Arm) -> Iterator[Missing]:
    has = {drive.joint for drive in arm.drives}
    bare = [joint for joint in range(1, arm.joint_count + 1) if joint not in has]
    if bare:
        yield Missing(
            f"[[drive]] of {_joints(bare)}", "serve, mock, bringup and every motion; torque margins"
        )
    counts = not arm.drives or any(drive.encoder_board >= 0 for drive in arm.drives)
    talks = not arm.drives or any(arm.kind_of(drive).line == "can" for drive in arm.drives)
    absent = ["[[encoder_board]]"] if counts and not arm.encoder_boards else []
    absent += ["[can]"] if talks and arm.can is None else []
    if absent:
        yield Missing(" and ".join(absent), "serve (or give the ports as options)")
    yield from _masses(arm)
    yield from _limits(arm)
    homeless = [
        drive.joint for drive in arm.drives if drive.home is None and not arm.has_absolute_encoder(drive)
    ]
    if homeless:
        yield Missing(f"[drive.home] of {_joints(homeless)}", "home (else set the zero on the encoder board)")
    guessed = [drive.joint for drive in arm.drives if _is_turn_guessed(arm, drive)]
    if guessed:
        yield Missing(
            f"absolute_turns of the boards of {_joints(guessed)}",
            "knowing the pose at power-up: the encoder is taken to be at the joint; one at the motor knows one motor turn",
        )
    yield from _electrical(arm)
    if arm.table is None:
        yield Missing(
            "[table]",
            "session without --camera --free, calibrate without measured tips, verify without --points, demo",
        )
    if arm.camera is None:
        yield Missing("[camera]", "the noise of verify, iso9283 and gap (else it is estimated or assumed)")
    if arm.rest is None:
        yield Missing("[rest]", "tune without --pose; the mock begins at joint angles 0")


def _is_turn_guessed(arm: Arm, drive: Drive) -> bool:
    board = arm.board(drive)
    is_said = board is None or board.absolute_turns is not None or arm.kind_of(drive).is_absolute
    return arm.has_absolute_encoder(drive) and not is_said and drive.gear_ratio != 1.0


def _masses(arm: Arm) -> Iterator[Missing]:
    try:
        Dynamics(arm)
    except MissingModel as error:
        gains = any(None in (drive.pid.kp, drive.pid.ki, drive.pid.kd) for drive in arm.drives)
        what = "feed-forward, guide, mock, payload and torque margins" + ("; serve, without gains" * gains)
        yield Missing(str(error).partition(": ")[2].partition(";")[0], what)


def _limits(arm: Arm) -> Iterator[Missing]:
    for key, needed_for in (
        ("joint_lower_rad", "the joint's end: mock, and motions that stay inside it"),
        ("joint_speed_limit_rad_s", "every motion"),
        ("joint_acceleration_limit_rad_s2", "every motion"),
        ("joint_jerk_limit_rad_s3", "every motion"),
        ("current_limit_A", "a limited torque; torque margins are those at stall"),
    ):
        without = [drive.joint for drive in arm.drives if not math.isfinite(getattr(drive, key))]
        if without:
            yield Missing(f"{key} of {_joints(without)}", needed_for)


def _electrical(arm: Arm) -> Iterator[Missing]:
    for key, needed_for in (
        ("rotor_inertia_kg_m2", "right feed-forward of accelerations and gains from the model"),
        ("inductance_H", "the mock's and gap's current; gap may call its lag a delay"),
    ):
        without = [drive.joint for drive in arm.drives if getattr(drive, key) == 0.0]
        if without:
            yield Missing(f"{key} of {_joints(without)}", needed_for)


def _joints(numbers: list[int]) -> str:
    return f"joint{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers))}"

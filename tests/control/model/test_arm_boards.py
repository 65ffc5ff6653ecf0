"""What arm.toml may say of bought boards: each kind's row of control.model.board_kinds is kept."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from control.errors import ArmError
from control.model.arm import Arm, Home
from control.model.description import load_arm, save_arm
from procedures.on_boards import on_boards
from tests.cell import RIGHT, with_drive


def _absolute(arm: Arm) -> Arm:
    return replace(arm, boards=tuple(replace(board, absolute=True) for board in arm.boards))


def _homed_by_a_switch(arm: Arm) -> Arm:
    return with_drive(arm, 1, home=Home(switch_rad=0.1, index_rad=0.2))


def _counted_elsewhere(arm: Arm) -> Arm:
    return with_drive(
        replace(arm, encoder_boards=RIGHT.encoder_boards), 1, encoder_board=0, encoder_channel=0
    )


def _beside_a_reference_board(arm: Arm) -> Arm:
    return replace(arm, drives=(*arm.drives[:2], RIGHT.drives[2]), encoder_boards=RIGHT.encoder_boards)


def _beside_a_cia402_drive(arm: Arm) -> Arm:
    other = on_boards(RIGHT, "cia402")
    return replace(arm, boards=(*arm.boards[:2], other.boards[2]), drives=(*arm.drives[:2], other.drives[2]))


def _second(**changes: Any) -> Callable[[Arm], Arm]:
    return lambda arm: replace(
        arm, boards=(arm.boards[0], replace(arm.boards[1], **changes), *arm.boards[2:])
    )


def _first_drive(**changes: Any) -> Callable[[Arm], Arm]:
    if changes.get("board") == "":  # as if the line were forgotten
        changes["pid"] = RIGHT.drives[0].pid
    return lambda arm: with_drive(arm, 1, **changes)


@pytest.mark.parametrize(
    ("kind", "change", "said"),
    [
        (
            "vesc",
            _absolute,
            r"absolute of \[\[board\]\] 1: expected true only for moteus, odrive, got true for a vesc",
        ),
        (
            "odrive",
            _homed_by_a_switch,
            r"home of \[\[drive\]\] 1: expected none: its board reads no home switch",
        ),
        (
            "odrive",
            _counted_elsewhere,
            r"encoder_board of \[\[drive\]\] 1: expected none: such a drive closes its own loop",
        ),
        (
            "cia402",
            _counted_elsewhere,
            r"encoder_board of \[\[drive\]\] 1: expected none: such a drive closes its own loop",
        ),
        ("odrive", _beside_a_cia402_drive, "no cia402 beside odrive on one CAN bus"),
        ("odrive", _beside_a_reference_board, "no odrive beside reference motor boards on one CAN bus"),
        ("dynamixel", _second(address=1), "address of .* 2: expected another one than that of dynamixel1"),
        ("dynamixel", _second(baud=57_600), "baud of .* 2: expected 1000000, as dynamixel1 on the same port"),
        ("dynamixel", _second(kind="feetech"), "port of .* 2: .* dynamixel1 on this one is a dynamixel"),
        ("feetech", _second(name="x"), r"name of .* 2: .* got x, which none names|\(feetech1, x, feetech3\)"),
        ("dynamixel", _first_drive(board=""), "name of .* 1: .* got dynamixel1, which none names"),
        ("vesc", _first_drive(board="vesc2"), r"one joint per motor of a board \(board, channel\)"),
        ("vesc", _first_drive(board_channel=2), "board_channel of .* 1: expected 1, its only motor, got 2"),
        ("vesc", _first_drive(encoder_counts_per_rev=2048), "encoder_counts_per_rev of .* 1: expected 18000"),
        (
            "dynamixel",
            _first_drive(encoder_counts_per_rev=2048),
            "encoder_counts_per_rev of .* expected 4096",
        ),
        ("moteus", _second(port="/dev/ttyACM0"), "port of .* 2: expected none: a moteus is on the bus"),
    ],
)
def test_what_a_kind_of_board_cannot_do_is_refused_with_the_place(
    kind: str, change: Callable[[Arm], Arm], said: str, tmp_path: Path
) -> None:
    save_arm(change(on_boards(RIGHT, kind)), tmp_path / "arm.toml")
    with pytest.raises(ArmError, match=said):
        load_arm(tmp_path / "arm.toml")


def test_an_odrive_in_current_mode_may_leave_counting_and_homing_to_an_encoder_board(tmp_path: Path) -> None:
    arm = _counted_elsewhere(on_boards(RIGHT, "odrive"))
    by_torque = with_drive(arm, 1, pid=replace(arm.drives[0].pid, mode="current"), home=RIGHT.drives[0].home)
    save_arm(by_torque, tmp_path / "arm.toml")
    assert load_arm(tmp_path / "arm.toml").can_home

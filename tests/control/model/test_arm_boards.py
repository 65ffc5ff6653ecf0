"""What arm.toml may say of bought boards: each kind's row of control.model.board_kinds is kept."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from control.errors import ArmError
from control.model.arm import Arm, Home
from control.model.can_bus import bus_load, usual_rate_Hz
from control.model.description import load_arm, save_arm
from procedures.on_boards import on_boards
from tests.cell import RIGHT, with_drive


def _absolute(arm: Arm) -> Arm:
    return replace(arm, boards=tuple(replace(board, absolute=True) for board in arm.boards))


def _homed_by_a_switch(arm: Arm) -> Arm:
    return with_drive(arm, 1, home=Home(switch_rad=0.1, index_rad=0.2))


def _counted_elsewhere(arm: Arm) -> Arm:
    return with_drive(replace(arm, encoder_boards=RIGHT.encoder_boards), 1, encoder_board=0, encoder_channel=0)


def _beside_a_reference_board(arm: Arm) -> Arm:
    return replace(arm, drives=(*arm.drives[:2], RIGHT.drives[2]), encoder_boards=RIGHT.encoder_boards)


def _beside_a_cia402_drive(arm: Arm) -> Arm:
    other = on_boards(RIGHT, "cia402")
    return replace(arm, boards=(*arm.boards[:2], other.boards[2]), drives=(*arm.drives[:2], other.drives[2]))


def _second(**changes: Any) -> Callable[[Arm], Arm]:
    return lambda arm: replace(arm, boards=(arm.boards[0], replace(arm.boards[1], **changes), *arm.boards[2:]))


def _first_drive(**changes: Any) -> Callable[[Arm], Arm]:
    if changes.get("board") == "":  # as if the line were forgotten
        changes["pid"] = RIGHT.drives[0].pid
    return lambda arm: with_drive(arm, 1, **changes)


@pytest.mark.parametrize(
    ("kind", "change", "said"),
    [
        ("vesc", _absolute, r"absolute of \[\[board\]\] 1: expected true only for moteus, odrive, got true for a vesc"),
        ("odrive", _homed_by_a_switch, r"home of \[\[drive\]\] 1: expected none: its board reads no home switch"),
        ("odrive", _counted_elsewhere, r"encoder_board of \[\[drive\]\] 1: expected none: such a drive closes its own loop"),
        ("cia402", _counted_elsewhere, r"encoder_board of \[\[drive\]\] 1: expected none: such a drive closes its own loop"),
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
        ("dynamixel", _first_drive(encoder_counts_per_rev=2048), "encoder_counts_per_rev of .* expected 4096"),
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


@pytest.mark.parametrize(
    ("kind", "change", "said"),
    [
        ("dynamixel", {"gear_ratio": 3.0}, r"joint_upper_rad of .* 1: .* one turn, 2.094 rad here, .*gear_ratio = 3"),
        ("feetech", {"joint_lower_rad": -3.2, "joint_upper_rad": 3.2}, "a range below 6.283 rad"),
        ("dynamixel", {"joint_lower_rad": -math.inf}, "a range below 6.283 rad"),
        ("dynamixel", {"gear_ratio": 5.0}, r"below 1\.257 rad.*reads no switch that tells its turn: .* a moteus"),
        ("feetech", {"zero_count": 300}, r"zero_count of .* 1: .* 0 to 4095, here -0.4602 to 5.821 .*about 2048"),
        ("feetech", {"zero_count": 3000, "encoder_direction": -1}, "counts 1305 to 4695 .*zero_count is about 2048"),
    ],
)
def test_a_range_that_leaves_the_turn_that_an_absolute_encoder_knows_is_refused(
    kind: str, change: dict[str, Any], said: str, tmp_path: Path
) -> None:
    save_arm(with_drive(on_boards(RIGHT, kind), 1, **change), tmp_path / "arm.toml")
    with pytest.raises(ArmError, match=said):
        load_arm(tmp_path / "arm.toml")


@pytest.mark.parametrize(("turns", "is_read"), [(None, True), (100.0, True), (1.0, False)])
def test_a_board_that_is_called_absolute_says_over_how_many_turns_of_its_encoder(
    turns: float | None, is_read: bool, tmp_path: Path
) -> None:
    arm = on_boards(RIGHT, "odrive")
    arm = replace(arm, boards=tuple(replace(board, absolute_turns=turns) for board in arm.boards))
    save_arm(replace(arm, drives=tuple(replace(d, gear_ratio=100.0) for d in arm.drives)), tmp_path / "arm.toml")
    if is_read:
        assert load_arm(tmp_path / "arm.toml").unique_rad(arm.drives[0]) == pytest.approx(2.0 * math.pi)
    else:
        with pytest.raises(ArmError, match=r"a range below 0.06283 rad.*gear_ratio = 100 is of gears between"):
            load_arm(tmp_path / "arm.toml")
    alone = replace(arm, boards=tuple(replace(b, absolute=False, absolute_turns=2.0) for b in arm.boards))
    save_arm(alone, tmp_path / "alone.toml")
    with pytest.raises(ArmError, match=r"absolute_turns of .* 1: expected absolute = true beside it"):
        load_arm(tmp_path / "alone.toml")


def on_one_bus(kind: str, boards: int) -> list[Arm]:
    """As many arms on one bus as make so many boards of a kind."""
    arm = on_boards(RIGHT, kind)
    whole, rest = divmod(boards, arm.joint_count)
    parts = [arm] * whole
    return [*parts, replace(arm, drives=arm.drives[:rest], boards=arm.boards[:rest])] if rest else parts


@pytest.mark.parametrize(
    ("kind", "boards", "rate_Hz", "share"),
    [
        ("vesc", 5, 200.0, 5 * 160 * 810 + 200 * (5 * 120 + 310)),
        ("cia402", 3, 500.0, 500 * (3 * 470 + 55)),
        ("odrive", 6, 250.0, 6 * 135 * (500 + 210) + 250 * 6 * 135),
        ("moteus", 3, 750.0, 750 * 3 * 355),
        ("roboclaw", 3, 100.0, 0),
    ],
)
def test_a_can_bus_is_loaded_by_what_bought_boards_send_and_are_sent(
    kind: str, boards: int, rate_Hz: float, share: float
) -> None:
    arms = on_one_bus(kind, boards)
    shared = 310 * (len(arms) - 1) if kind == "vesc" else 55 * (len(arms) - 1) if kind == "cia402" else 0
    assert bus_load(arms, rate_Hz) == pytest.approx((share + rate_Hz * shared) * 1e-6)
    assert usual_rate_Hz(arms) == arms[0].boards_rate_Hz


@pytest.mark.parametrize(
    ("kind", "boards", "rate_Hz"),
    [("cia402", 6, 200.0), ("cia402", 12, 100.0), ("moteus", 12, 150.0), ("odrive", 7, 250.0), ("vesc", 6, 200.0)],
)
def test_the_loop_is_as_slow_as_the_frames_that_it_asks_for_need(kind: str, boards: int, rate_Hz: float) -> None:
    assert usual_rate_Hz(on_one_bus(kind, boards)) == rate_Hz

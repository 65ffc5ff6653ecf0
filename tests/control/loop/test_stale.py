"""A silent board: its last values are marked with their age, and its fault cannot be acknowledged away."""

from __future__ import annotations

import pytest

from console.commands.status import described
from console.screen.drawing import text_of
from console.screen.texts import joint_rows
from control.safety.modes import Mode
from control.server.client import ArmFaulted, RequestRefused
from tests.cell import RIGHT, Cell, holding_cell, open_cell


def test_values_of_boards_that_speak_are_not_marked(cell: Cell) -> None:
    status = cell.client.status()
    assert status["encoder_stale_s"] == status["drive_stale_s"] == [None] * 3
    assert "*" not in described({**status, "arm": "right"})
    assert not any("STALE" in text_of([row]) for row in joint_rows(status, RIGHT, "J1", 80))


def test_a_silent_motor_board_marks_the_values_of_its_joint_alone_with_their_age(cell: Cell) -> None:
    cell.inject("silent", "motor2")
    cell.run(1.0)
    status = cell.client.status()
    assert status["encoder_stale_s"] == [None] * 3
    assert [age is None for age in status["drive_stale_s"]] == [True, False, True]
    assert status["drive_stale_s"][1] == pytest.approx(1.0, abs=0.05)
    page = described({**status, "arm": "right"})
    assert "* joint 2: no report from its motor board for 1.0 s; these are the last values" in page
    marked = [text for row in joint_rows(status, RIGHT, "J1", 80) if "STALE" in (text := text_of([row]))]
    assert len(marked) == 1
    assert "J2?" in marked[0]


def test_the_status_of_seven_joints_fits_80_columns_and_says_once_what_joints_share(cell: Cell) -> None:
    cell.inject("silent", "motor2")
    cell.run(1.0)
    status = {**cell.client.status(), "arm": "right", "warnings": [], "faults": []}
    for key, values in status.items():
        if isinstance(values, list) and len(values) == 3 and key not in ("tip_m", "camera_m"):
            status[key] = [*values, *values, values[0]]
    page = described(status)
    assert max(map(len, page.partition("\n*")[0].splitlines())) <= 80
    assert "* joints 2 and 5: no report from their motor boards for 1.0 s; these are the last values" in page
    assert "drives: 1, 3, 4, 6, 7 OPERATION ENABLED; 2, 5 OPERATION ENABLED*" in page


def test_a_silent_encoder_board_marks_the_angles_also_while_the_drives_are_off() -> None:
    with open_cell() as cell:
        cell.inject("silent", "encoder")
        cell.run(0.5)
        status = cell.client.status()
        assert status["mode"] == "OFF"
        assert status["encoder_stale_s"] == pytest.approx([0.5] * 3, abs=0.05)


@pytest.mark.parametrize("board", ["encoder", "motor1"])
def test_acknowledge_fails_and_names_the_cause_while_it_lasts(cell: Cell, board: str) -> None:
    cell.inject("silent", board)
    cell.until_fault(0.5)
    cell.run(1.0)
    with pytest.raises((ArmFaulted, RequestRefused), match=r'encoder board "enc0"|joint 1'):
        cell.client.acknowledge()
    cell.run(0.1)  # the loop has waited for this board, and has heard no other one meanwhile
    assert len([where for code, where in cell.faults if code in ("drive_silent", "encoder_stale")]) == 1
    cell.rig.clear_faults()
    cell.run(0.2)
    cell.client.acknowledge()
    assert cell.mode is not Mode.FAULT


def test_without_a_fault_there_is_nothing_to_acknowledge(cell: Cell) -> None:
    with pytest.raises(RequestRefused, match="there is no fault"):
        cell.client.acknowledge()


def test_enabling_an_arm_that_holds_or_moves_changes_nothing(cell: Cell) -> None:
    assert cell.client.enable() is False
    cell.start_move((0.2, -0.4, 0.3))
    cell.run(0.1)
    assert cell.client.enable() is False
    assert cell.mode is Mode.MOVING


def test_homing_says_whether_it_moved_and_can_be_asked_for_again() -> None:
    with holding_cell() as cell:
        assert cell.client.home() is False
        steps = set()
        cell.client.on_wait = lambda answer: steps.add(answer["step"])
        assert cell.client.home(again=True) is True
    assert "joint 2 (2 of 3): seeking its index pulse" in steps

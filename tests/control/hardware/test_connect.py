"""Connecting: everything that is wrong is named in one error, and nothing has moved."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from control.errors import MissingModel
from control.hardware.connect import LinkOptions, connect, with_links
from control.model.arm import Arm
from firmware_iface.errors import ConnectionFailed
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import FaultTable
from tests.cell import PERIOD_S, RIGHT, scenario, wired_to, with_drive


def failure(arm: Arm = RIGHT, *faults: FaultTable, **links: Any) -> str:
    """What connecting to a mock with these faults says; checks that no drive was touched."""
    with SteppedRig(RIGHT, scenario(fault=faults)) as rig:
        before = rig.joint_rad()
        with pytest.raises(ConnectionFailed) as caught:
            connect(replace(wired_to(arm, rig), **links), rig.clock, PERIOD_S)
        assert {board.output for board in rig.robot.motor_boards} == {("voltage", 0.0)}
        # With its windings shorted the arm sinks as it did before; nothing has driven it.
        assert rig.joint_rad() == pytest.approx(before, abs=0.02)
        return str(caught.value)


def with_serials(encoder: int | None = None, motor2: int | None = None) -> Arm:
    boards = tuple(replace(board, serial_number=encoder) for board in RIGHT.encoder_boards)
    return replace(with_drive(RIGHT, 2, motor_serial_number=motor2), encoder_boards=boards)


@pytest.fixture
def rig() -> Iterator[SteppedRig]:
    with SteppedRig(RIGHT, scenario()) as made:
        yield made


def test_a_wrong_serial_number_names_the_board_and_both_numbers() -> None:
    message = failure(with_serials(motor2=5, encoder=6))
    assert "joint 2" in message
    assert "enc0" in message
    assert "serial number 5" in message
    assert "serial number 6" in message


@pytest.mark.parametrize("board", ["encoder", "motor2"])
def test_another_protocol_version_is_named(board: str) -> None:
    message = failure(RIGHT, FaultTable("wrong_protocol", board, value=9))
    assert "protocol" in message
    assert ("enc0" if board == "encoder" else "joint 2") in message


@pytest.mark.parametrize("board", ["encoder", "motor3"])
def test_an_encoder_with_other_counts_a_turn_is_named_with_what_arm_toml_says(board: str) -> None:
    message = failure(RIGHT, FaultTable("wrong_counts", board, value=4096, channel=2))
    assert "got 4096" in message
    assert "expected 2048 counts per turn (arm.toml, joint 3)" in message


@pytest.mark.parametrize(("board", "name"), [("encoder", "enc0"), ("motor1", "joint 1")])
def test_a_silent_board_is_named(board: str, name: str) -> None:
    assert name in failure(RIGHT, FaultTable("silent", board))


def test_a_port_that_is_not_there_is_named() -> None:
    port = replace(RIGHT.encoder_boards[0], port="/dev/ttyNONE9")
    assert "/dev/ttyNONE9" in failure(encoder_boards=(port,))


def test_a_can_interface_that_is_not_there_is_named() -> None:
    can = replace(RIGHT.can or pytest.fail("no can"), interface="telegraph", channel="can7")
    assert "telegraph" in failure(can=can)


def test_all_that_is_wrong_is_said_at_once() -> None:
    port = replace(RIGHT.encoder_boards[0], port="/dev/ttyNONE9")
    message = failure(
        with_drive(RIGHT, 1, motor_serial_number=5),
        FaultTable("silent", "motor2"),
        FaultTable("wrong_protocol", "motor3", value=9),
        encoder_boards=(port,),
    )
    for name in ("/dev/ttyNONE9", "joint 1", "joint 2", "joint 3"):
        assert name in message


def test_an_arm_without_a_bus_or_with_too_few_boards_is_refused_before_anything_is_opened(rig: SteppedRig) -> None:
    with pytest.raises(MissingModel, match=r"no \[can\] bus"):
        connect(replace(RIGHT, can=None), rig.clock, PERIOD_S)
    with pytest.raises(MissingModel, match="add an"):
        connect(replace(wired_to(RIGHT, rig), encoder_boards=()), rig.clock, PERIOD_S)
    with pytest.raises(MissingModel, match=r"3 joints but 2 \[\[drive\]\]"):
        connect(replace(RIGHT, drives=RIGHT.drives[:2]), rig.clock, PERIOD_S)


def test_links_of_the_command_line_replace_those_of_the_file() -> None:
    options = LinkOptions(("/dev/ttyUSB7",), "slcan", "/dev/ttyACM3", {"port": 5})
    arm = with_links(RIGHT, options)
    assert [board.port for board in arm.encoder_boards] == ["/dev/ttyUSB7"]
    assert arm.can is not None
    assert (arm.can.interface, arm.can.channel, dict(arm.can.options)) == ("slcan", "/dev/ttyACM3", {"port": 5})
    assert with_links(RIGHT, LinkOptions()) == RIGHT


def test_after_a_failure_the_same_ports_can_be_opened_again(rig: SteppedRig) -> None:
    rig.inject(FaultTable("silent", "motor2"))
    with pytest.raises(ConnectionFailed):
        connect(wired_to(RIGHT, rig), rig.clock, PERIOD_S, rig.camera_port)
    rig.clear_faults()
    connect(wired_to(RIGHT, rig), rig.clock, PERIOD_S, rig.camera_port).close()

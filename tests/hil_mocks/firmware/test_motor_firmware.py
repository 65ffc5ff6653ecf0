"""The motor board's firmware in C beside the mock's own in Python: one document, the same frames, the same voltages."""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest

from hil_mocks.devices.motor_board import MotorBoardMock
from hil_mocks.devices.motor_inputs import BRAKE, OPEN, MotorBoardSetup, Output
from hil_mocks.firmware import MotorBoardFirmware
from tests.firmware import needs_compiler
from tests.fuzz.firmware import MOTOR, MotorTalk, conversations

pytestmark = needs_compiler


def test_both_firmwares_say_the_same_and_are_in_the_same_states() -> None:
    """A part of `make firmware-difference`, with encoder boards, too."""
    assert conversations(100, seed=1) is None


def test_a_late_control_period_does_not_double_the_speed() -> None:
    for kind in (MotorBoardMock, MotorBoardFirmware):
        played = MotorTalk(kind)
        played.write(p18=10_000, p19=0)  # damping alone
        played.enable()
        played.command(0x0F, 3, 0)
        played.run(1, 20, 40_000)
        played.shaft = 0
        played.command(0x0F, 3, played.board.position_count)
        assert played.board.output.value == pytest.approx(-20 / 0.04 * 10e-6)


GOLDEN = MotorBoardSetup(node=1, serial_number=1, counts_per_turn=8, ambient_degC=41.0)


def test_a_reply_is_the_golden_frame_of_the_document() -> None:
    played = MotorTalk(MotorBoardFirmware, GOLDEN)
    for word in (0x06, 0x07, 0x0F):
        played.send(0x101, struct.pack("<BBih", word, 0, 0, 0))
    played.current_A = -2.5
    played.run(2, 0)
    ((can_id, reply),) = played.send(0x101, bytes.fromhex("0f2920d1ffff0000"))
    assert (can_id, reply) == (0x181, bytes.fromhex("37293cf6c05d2900"))
    assert played.board.output == Output("voltage", -12.0)


def test_a_stop_ends_for_good_though_the_clock_wraps() -> None:
    """Held for 71.6 minutes: the board's microseconds are those of the stop again, and it must not begin anew."""
    played = MotorTalk(MotorBoardFirmware)
    played.write(p16=1000, p19=0, p32=0, p36=100, p22=9000)
    played.enable()
    played.command(0x0F, 1, 3000)
    played.run(5, 10)
    played.command(0x0F, 4)
    begun_us = played.now_us
    played.run(200, 0)
    rest = played.board.output
    played.now_us = begun_us + 2**32 + 20_000
    for _ in range(100):
        played.run(1, 0)
        assert played.board.output == rest


def test_extreme_gains_and_counts_saturate() -> None:
    most = 2**31 - 1
    played = MotorTalk(MotorBoardFirmware)
    played.write(p16=most, p17=most, p18=most, p23=most, p22=60_000, p21=60_000, p19=0)
    played.enable()
    for setpoint in (-(2**31), most, 0):
        played.command(0x0F, 3, setpoint, -32768)
        for step in (most, -(2**31), 12345):
            played.run(2, step)
            assert abs(played.board.output.value) <= 24.0
    played.command(0x0F, 4)
    played.run(300, 70_000)
    assert abs(played.board.output.value) <= 24.0


def test_a_falsified_identity_is_said_by_a_sound_firmware() -> None:
    played = MotorTalk(MotorBoardFirmware)
    played.board.setup = replace(MOTOR, serial_number=77, protocol=9)
    answers = [played.send(0x202, struct.pack("<BBBBi", 0, index, 3, 0, 0))[0][1] for index in (0, 1, 3)]
    assert [struct.unpack("<i", answer[4:])[0] for answer in answers] == [9, 77, 2048]


def test_a_disabled_board_that_was_holding_does_not_drive() -> None:
    for kind in (MotorBoardMock, MotorBoardFirmware):
        played = MotorTalk(kind)
        played.write(p16=1000, p36=100)
        played.enable()
        played.command(0x0F, 1, 3000)
        played.run(2, 5)
        played.command(0x0F, 4)
        played.command(0x00, 0)
        played.run(3, 5)
        assert played.board.output == BRAKE
        assert played.board.power_up() is None
        assert played.board.output == OPEN

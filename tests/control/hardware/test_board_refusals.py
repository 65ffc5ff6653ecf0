"""What boards themselves refuse before anything moves, and how a VESC turns to an angle."""

from dataclasses import replace

import pytest

from control.safety.table import Mode
from firmware_iface.canopen.drive import MAKERS
from firmware_iface.errors import ConnectionFailed
from firmware_iface.vesc import wire
from hil_mocks.devices.cia402_drive import MAXON
from hil_mocks.devices.vesc import VescMock, VescSetup
from procedures.on_boards import on_boards
from tests.cell import RIGHT, open_cell, scenario, with_drives

ON_VESCS = on_boards(RIGHT, "vesc")


def test_a_vesc_that_would_turn_the_shorter_way_is_refused_when_it_is_connected() -> None:
    arm = with_drives(ON_VESCS, pid=replace(ON_VESCS.drives[0].pid, mode="position"))
    with (
        pytest.raises(ConnectionFailed, match="a range below half a turn"),
        open_cell(scenario(), arm, period_s=0.005),
    ):
        pass


def test_a_vesc_at_its_joint_and_within_half_a_turn_takes_angles() -> None:
    arm = with_drives(
        ON_VESCS, pid=replace(ON_VESCS.drives[0].pid, mode="position"), gear_ratio=1.0,
        joint_lower_rad=-1.2, joint_upper_rad=1.2,
    )  # fmt: skip
    with open_cell(scenario(), arm, period_s=0.005) as cell:
        assert cell.mode is Mode.OFF


def test_a_roboclaw_is_not_told_a_current_beyond_its_peak() -> None:
    arm = with_drives(on_boards(RIGHT, "roboclaw"), current_limit_A=40.0)
    with pytest.raises(ConnectionFailed, match=r"current_limit_A = 40 is above the 30 A .*2x15A"), open_cell(
        scenario(), arm, period_s=0.01
    ):  # fmt: skip
        pass


def test_a_drive_whose_rated_torque_and_current_contradict_the_arm_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A rated torque in another unit would make a thousandth, or a thousandfold, of every torque."""
    monkeypatch.setitem(MAKERS, MAXON, replace(MAKERS[MAXON], rated_torque_unit_Nm=1e-3))
    with (
        pytest.raises(ConnectionFailed, match=r"rated torque \(0x6076\) is 500 N m, but .* makes 0.5 N m"),
        open_cell(scenario(), on_boards(RIGHT, "cia402"), period_s=0.004),
    ):
        pass


def test_a_vesc_turns_to_an_angle_the_shorter_way() -> None:
    mock = VescMock(VescSetup(5, 0.2, 8.0), lambda: 0.9)
    for moment, (count, sign) in enumerate(
        ((wire.COUNTS_PER_TURN // 10, 1.0), (wire.COUNTS_PER_TURN // 2, -1.0))
    ):
        mock.receive(*wire.position(5, count), now_s=0.001 * moment)
        mock.tick(0.001 * (1 + moment), 0.0, 24.0)
        kind, volts = mock.output
        assert kind == "voltage"
        assert volts * sign > 0.0
